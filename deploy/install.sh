#!/bin/sh
# Installs or updates livessl on this machine with its systemd units, or goes back to the release before:
#
#   sh deploy/install.sh --server --node lab-pc       from a checkout; --wheel FILE or --version 0.3.0 from elsewhere
#   sh deploy/install.sh --roll-back                  the release that ran before runs again
#
# Each release has its own folder under PREFIX/releases, and PREFIX/bin is a link to the one in use, changed at once. An
# update is made beside the running release, must accept the site file, and only then takes its place. If the units do
# not come back, the release before returns by itself. Run again with the same options, it changes nothing that is right.
set -eu

prefix=/opt/livessl
site=/etc/livessl/site.yaml
units=/etc/systemd/system
extras=fast
keep=3
wheel='' version='' server='' nodes='' roll_back='' dry_run='' systemd=yes

say() { printf 'install: %s\n' "$*" >&2; }
fail() { say "$*"; exit 1; }
wrong() { say "$*; see sh deploy/install.sh --help"; exit 2; }

usage() {
    cat <<'END'
usage: sh deploy/install.sh [OPTIONS]

  --server            install the fusion server and start it
  --node NAME         install the capture node NAME of the site file and start it; may be given several times
  --wheel FILE        install this wheel; without it and without --version, the checkout that this file is in
  --version VERSION   install this version from the package index
  --extras LIST       extras to install, separated by commas (default: fast; nodes alone need none: '')
  --site FILE         the site file (default: /etc/livessl/site.yaml)
  --prefix DIR        where releases are kept (default: /opt/livessl)
  --units DIR         where units are put (default: /etc/systemd/system)
  --no-systemd        only put files in place; start, stop and reload nothing
  --roll-back         use the release before the present one again
  --dry-run           print what would be done, and do nothing

example: sh deploy/install.sh --server --node lab-pc --dry-run
END
}

value() { [ $# -ge 2 ] || wrong "expected a value after $1"; printf '%s' "$2"; }

while [ $# -gt 0 ]; do
    case $1 in
        --server) server=yes ;;
        --node) nodes="$nodes $(value "$@")"; shift ;;
        --wheel) wheel=$(value "$@"); shift ;;
        --version) version=$(value "$@"); shift ;;
        --extras) extras=$(value "$@"); shift ;;
        --site) site=$(value "$@"); shift ;;
        --prefix) prefix=$(value "$@"); shift ;;
        --units) units=$(value "$@"); shift ;;
        --no-systemd) systemd='' ;;
        --roll-back) roll_back=yes ;;
        --dry-run) dry_run=yes ;;
        --help | -h) usage; exit 0 ;;
        *) wrong "expected an option, got $1" ;;
    esac
    shift
done
source=$(cd "$(dirname "$0")/.." && pwd)
[ -z "$wheel" ] || [ -z "$version" ] || wrong "expected --wheel or --version, got both"
[ -z "$wheel" ] || [ -f "$wheel" ] || fail "expected a wheel, found no file $wheel"
[ -n "$wheel$version" ] || [ -f "$source/pyproject.toml" ] || wrong "this file is in no checkout: give --wheel or --version"

# Runs a command, or prints it in a dry run.
run() {
    if [ -n "$dry_run" ]; then printf '%s\n' "$*"; else "$@"; fi
}
systemctl_if_wanted() { [ -z "$systemd" ] || run systemctl "$@"; }

services() {
    [ -z "$server" ] || printf 'livessl-server.service\n'
    for node in $nodes; do printf 'livessl-node@%s.service\n' "$node"; done
}

# Makes PREFIX/bin a link to a release in one step: at no time is there none.
use() {
    run ln -sfn "releases/$1/bin" "$prefix/bin.new"
    run mv -T "$prefix/bin.new" "$prefix/bin"
}

in_use() { readlink "$prefix/bin" 2>/dev/null | cut -d / -f 2; }

# Prints the number of the release that was in use before this one.
before() { cat "$prefix/releases/$1/before" 2>/dev/null || true; }

# Restarts what runs, and returns 1 if something does not stay up for five seconds.
restart() {
    [ -n "$systemd" ] || return 0
    # shellcheck disable=SC2046  # lists of names
    set -- $(services)
    # shellcheck disable=SC2046
    [ $# -gt 0 ] || set -- $(systemctl list-units --plain --no-legend 'livessl-*.service' | cut -d ' ' -f 1)
    [ $# -gt 0 ] || return 0
    run systemctl restart "$@"
    [ -z "$dry_run" ] || return 0
    sleep 5
    systemctl is-active --quiet "$@"
}

if [ -n "$roll_back" ]; then
    now=$(in_use)
    [ -n "$now" ] || fail "expected an installation at $prefix/bin, found none"
    then=$(before "$now")
    [ -n "$then" ] && [ -d "$prefix/releases/$then" ] || fail "there is no release before $now in $prefix/releases"
    use "$then"
    restart || fail "went back to release $then, but its units do not stay up; see journalctl -u 'livessl-*'"
    say "release $then is in use again"
    exit 0
fi

[ -f "$site" ] || fail "expected a site file at $site, found none; make one by \`livessl init\`, or give --site"
for tool in python3 ${systemd:+systemctl}; do
    command -v "$tool" >/dev/null || fail "expected $tool, found none"
done

if [ -d "$prefix/bin" ] && [ ! -L "$prefix/bin" ]; then
    fail "expected $prefix/bin to be a link that this installer made, got a folder; move $prefix away first"
fi
last=$(in_use)
number=1
while [ -e "$prefix/releases/$number" ]; do number=$((number + 1)); done
release=$prefix/releases/$number
if [ -n "$wheel" ]; then what=$wheel; elif [ -n "$version" ]; then what="livessl==$version"; else what=$source; fi
[ -z "$extras" ] || case $what in
    livessl==*) what="livessl[$extras]==$version" ;;
    *) what="${what}[$extras]" ;;
esac

say "installing $what as release $number in $release"
[ -n "$dry_run" ] || trap '[ "$(in_use)" = "$number" ] || rm -rf "$release"' EXIT
trap 'exit 130' INT TERM
run mkdir -p "$prefix/releases"
run python3 -m venv "$release"
if [ "$extras" = fast ] && [ -f "$source/deploy/requirements.lock" ]; then # versions that were tested, by their checksums
    run "$release/bin/python" -m pip install --quiet --disable-pip-version-check --require-hashes -r "$source/deploy/requirements.lock"
fi
run "$release/bin/python" -m pip install --quiet --disable-pip-version-check "$what"
run "$release/bin/livessl" check "$site" >&2 || fail "the new release does not accept $site; nothing was changed"
[ -z "$last" ] || [ -n "$dry_run" ] || printf '%s\n' "$last" >"$release/before"

for unit in livessl-server.service livessl-node@.service; do
    [ -n "$dry_run" ] || sed "s|/opt/livessl/|$prefix/|; s|/etc/livessl/site.yaml|$site|" "$source/deploy/$unit" >"$release/$unit"
    run install -D -m 644 "$release/$unit" "$units/$unit"
done
use "$number"
systemctl_if_wanted daemon-reload
for service in $(services); do systemctl_if_wanted enable --quiet "$service"; done
if ! restart; then
    [ -n "$last" ] || fail "the units do not stay up; see journalctl -u 'livessl-*'"
    use "$last"
    restart || true
    fail "the units of release $number did not stay up: release $last is in use again; see journalctl -u 'livessl-*'"
fi

# What is neither in use, nor the release to roll back to, nor among the last ones, goes.
for old in "$prefix"/releases/*; do
    old=${old##*/}
    [ "$old" = "$number" ] || [ "$old" = "$last" ] || [ "$old" = '*' ] || [ "$old" -gt $((number - keep)) ] ||
        run rm -rf "$prefix/releases/$old"
done
say "release $number is in use${last:+; sh deploy/install.sh --roll-back returns to release $last}"
