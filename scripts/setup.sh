#!/bin/sh
# Sets up .venv in this checkout: sh scripts/setup.sh [EXTRAS], where EXTRAS is empty or names extras of pyproject.toml
# as in `pip install -e '.[dev]'`. Does nothing if nothing has changed since the last time.
set -eu
cd "$(dirname "$0")/.."
extras=${1-}

say() { printf '%s\n' "$*" >&2; }
fail() { say "setup: $*"; exit 1; }

# Runs apt-get as root if that needs no password; fails otherwise.
apt_get() {
    command -v apt-get >/dev/null || return 1
    if [ "$(id -u)" -eq 0 ]; then
        DEBIAN_FRONTEND=noninteractive apt-get -qq -o DPkg::Lock::Timeout=120 "$@" >/dev/null
    else
        sudo -n env DEBIAN_FRONTEND=noninteractive apt-get -qq -o DPkg::Lock::Timeout=120 "$@" >/dev/null 2>&1
    fi
}

# Prints "MAJOR MINOR PATH" if a Python is new enough, and nothing otherwise.
version_of() {
    "$1" -c 'import sys
if sys.version_info >= (3, 11):
    print(*sys.version_info[:2], sys.executable)' 2>/dev/null || true
}

newest_python() {
    for name in python3 python3.13 python3.12 python3.11; do
        command -v "$name" >/dev/null && version_of "$name"
    done | sort -k1,1n -k2,2n | tail -n 1 | cut -d ' ' -f 3-
}

make_venv() {
    python=$(newest_python)
    [ -n "$python" ] || fail "expected Python 3.11 or newer, got $(python3 --version 2>&1 || true); install it: apt install python3 python3-venv"
    if ! "$python" -c 'import venv; from ensurepip import version' 2>/dev/null; then
        package=$("$python" -c 'import sys; print("python%d.%d-venv" % sys.version_info[:2])')
        say "setup: installing $package, which $python needs to make virtual environments"
        { apt_get update && apt_get install -y --no-install-recommends "$package"; } ||
            fail "$python cannot make virtual environments without $package; run: sudo apt install $package"
    fi
    say "setup: making .venv with $("$python" --version)"
    "$python" -m venv --clear .venv
}

# Checks that the environment was made in this place with a Python that still exists: a moved or copied environment
# points to its old place.
venv_is_ours() {
    [ -n "$(version_of .venv/bin/python)" ] && grep -qF "$PWD/.venv/bin/python" .venv/bin/pip 2>/dev/null
}

checksum=$(cksum < pyproject.toml)
stamp=.venv/livessl-setup
if venv_is_ours; then
    case $(cat "$stamp" 2>/dev/null || true) in
        "$checksum [$extras]" | "$checksum [dev]") exit 0 ;; # `dev` includes all other extras
    esac
else
    make_venv
fi
rm -f "$stamp"
say "setup: installing livessl${extras:+ with $extras} and its dependencies into .venv"
.venv/bin/python -m pip install --quiet --quiet --no-compile --disable-pip-version-check -e ".${extras:+[$extras]}"
printf '%s\n' "$checksum [$extras]" > "$stamp"
