#!/bin/sh
# Installs livessl with everything that its tests need, then runs every check: sh scripts/test.sh [OPTIONS of pytest]
set -eu
cd "$(dirname "$0")/.."
packages="chromium-headless-shell mosquitto nats-server nginx-light prometheus libportaudio2 pulseaudio pulseaudio-utils libasound2-plugins systemd openssl
postgresql gcc libc6-dev libasound2-dev"
command -v npm >/dev/null || packages="$packages nodejs npm" # where it is not from elsewhere already

missing=
for package in $packages; do
    [ "$(dpkg-query -W -f '${db:Status-Status}' "$package" 2>/dev/null || true)" = installed ] || missing="$missing $package"
done
# Runs apt-get as root if that needs no password; fails otherwise.
apt_get() {
    command -v apt-get >/dev/null || return 1
    if [ "$(id -u)" -eq 0 ]; then
        DEBIAN_FRONTEND=noninteractive apt-get -qq -o DPkg::Lock::Timeout=120 "$@" >/dev/null
    else
        sudo -n env DEBIAN_FRONTEND=noninteractive apt-get -qq -o DPkg::Lock::Timeout=120 "$@" >/dev/null 2>&1
    fi
}

install_missing() {
    echo "test: installing$missing" >&2
    # shellcheck disable=SC2086  # $missing is a list of words
    if ! { apt_get update && apt_get install -y --no-install-recommends $missing; }; then
        echo "test: installation failed. Tests that need a missing package are skipped: the dashboard in a browser (chromium-headless-shell)," >&2
        echo "test: the units in deploy/ (systemd), TLS (openssl), reverse proxies (nginx-light), MQTT (mosquitto), hubs (nats-server), PostgreSQL (postgresql), metrics (prometheus), TypeScript clients (npm)," >&2
        echo "test: a sound card (the others). To run them, first:" >&2
        echo "test: sudo apt-get install$missing" >&2
    fi
}

if [ -n "$missing" ]; then
    install_missing &
    installing=$!
    # Meanwhile pip downloads, unless it needs a package itself: then one after the other, as apt-get cannot run twice.
    { command -v gcc && python3 -c 'import ensurepip'; } >/dev/null 2>&1 || wait "$installing"
fi
sh scripts/setup.sh dev
[ -z "$missing" ] || wait "$installing"
PATH="$PWD/.venv/bin:$PATH"
export PATH
unset PYTHONDONTWRITEBYTECODE # the tests start hundreds of processes, each of which would compile all modules
set -x
ruff check
ruff format --check
python -m livessl.server.compiling & # once, not in every worker
compiling=$!
mypy & # needs one processor only, for a minute: the tests begin meanwhile
typing=$!
lint-imports
pytest --collect-only -qq "$@" >/dev/null || true # compiles the tests once, not in every worker
wait "$compiling"
pytest -n 6 --dist loadfile --no-loadscope-reorder "$@"
wait "$typing" || { echo "test: mypy found errors, which stand before the tests' output or within it" >&2; exit 1; }
