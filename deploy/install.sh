#!/bin/sh
# Installs or updates livessl on this machine with its systemd units, takes an update back that does not stay up (how
# long it waits: `restart`), or rolls back to the release before:
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

# Prints the units that an update restarts: those of the options, or all that run.
running() {
    set -- "$(services)"
    if [ -n "$1" ]; then printf '%s\n' "$1"; else
        systemctl list-units --plain --no-legend 'livessl-*.service' | cut -d ' ' -f 1
    fi
}

# Does one of three things with the history: `copy` copies its SQLite file beside itself before the new release may
# migrate it; `restore` puts the copy back if the new release has done so, as the one before would refuse the file; and
# `forget` deletes the copy, which holds events that the site's retention does not reach.
history() {
    if [ -z "$last" ] || [ -n "$dry_run" ]; then return 0; fi
    "$release/bin/python" - "$1" "$site" "$number" <<'END'
import os
import sqlite3
import sys
from contextlib import closing
from pathlib import Path

from livessl.site.history_place import history_place
from livessl.site.load import load_site


def revision(database):
    try:
        return database.execute("SELECT version_num FROM alembic_version").fetchone()
    except sqlite3.OperationalError:  # of a release that had no such table
        return None


what, site, number = sys.argv[1:]
place = history_place(load_site(Path(site)))
if isinstance(place, str) and what == "copy":
    said = "server.events_db is a PostgreSQL database, which is not copied: going back needs a dump made by pg_dump"
    print(f"install: {said} if the new release migrates it", file=sys.stderr)
if not isinstance(place, Path) or not place.is_file():
    raise SystemExit
copy = place.with_name(f"{place.name}.before-{number}")
if what == "copy":
    os.umask(0o077)
    copy.unlink(missing_ok=True)
if what == "forget":
    copy.unlink(missing_ok=True)
elif what == "copy" or copy.is_file():
    with closing(sqlite3.connect(place, timeout=30)) as now, closing(sqlite3.connect(copy, timeout=30)) as before:
        if what == "copy":
            now.backup(before)
        elif revision(now) != revision(before):
            before.backup(now)
            print(f"install: {place} is again as it was before the update", file=sys.stderr)
END
}

# Restarts what runs, and returns 1 if something does not stay up for five seconds.
restart() {
    [ -n "$systemd" ] || return 0
    # shellcheck disable=SC2046  # a list of names
    set -- $(running)
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
history copy || fail "the history could not be copied, so that nothing was changed; free space beside server.events_db"
use "$number"
systemctl_if_wanted daemon-reload
for service in $(services); do systemctl_if_wanted enable --quiet "$service"; done
if ! restart; then
    [ -n "$last" ] || fail "the units do not stay up; see journalctl -u 'livessl-*'"
    use "$last"
    # shellcheck disable=SC2046  # a list of names
    run systemctl stop $(running) || true
    what="the units of release $number did not stay up: release $last is in use again"
    see="see journalctl -u 'livessl-*'"
    history restore || fail "$what, but the history could not be put back from its copy beside server.events_db; $see"
    restart || fail "$what, but its units do not stay up either; if they refuse the database, restore a copy or dump; $see"
    history forget || say "a copy of the history is left beside server.events_db; delete it"
    fail "$what; $see"
fi
history forget || say "a copy of the history is left beside server.events_db; delete it"

# What is neither in use, nor the release to roll back to, nor among the last ones, goes.
for old in "$prefix"/releases/*; do
    old=${old##*/}
    [ "$old" = "$number" ] || [ "$old" = "$last" ] || [ "$old" = '*' ] || [ "$old" -gt $((number - keep)) ] ||
        run rm -rf "$prefix/releases/$old"
done
say "release $number is in use${last:+; sh deploy/install.sh --roll-back returns to release $last}"
