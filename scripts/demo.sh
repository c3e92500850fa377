#!/bin/sh
# Sets livessl up if need be, then runs its demo: sh scripts/demo.sh [OPTIONS of livessl demo]
set -eu
root=$(cd "$(dirname "$0")/.." && pwd)
sh "$root/scripts/setup.sh"
exec "$root/.venv/bin/livessl" demo "$@"
