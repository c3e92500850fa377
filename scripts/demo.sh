#!/bin/sh
# Installs livessl if necessary, then runs its demo: sh scripts/demo.sh [OPTIONS of livessl demo]
set -eu
root=$(cd "$(dirname "$0")/.." && pwd)
sh "$root/scripts/setup.sh"
exec "$root/.venv/bin/livessl" demo "$@"
