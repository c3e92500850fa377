"""A hub's database with many events, filled by PostgreSQL itself, and how long a hub's answers take then."""

from __future__ import annotations

import json
import re
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Final

import orjson
import psycopg
from psycopg.rows import dict_row

from history_rows import LOCATED, REFUSED, REFUSED_BODY, ROOM_M, START_NS, STEP_NS, Rows, fill
from hub_processes import measure_answers, running_hub_process
from hub_sites import SimulatedSite, hub_rows
from livessl.clock import SystemClock
from livessl.federation.archive import Archive
from livessl.server.api.encode import JsonObject
from livessl.server.forwarding.link import WINDOW
from livessl.server.history.tables import event_row, tag_rows
from livessl.server.store import Store
from postgresql import SETTINGS, running_postgresql
from processor_time import memory_mb

FILLED_AT_ONCE: Final = 500_000
"""Events that one statement makes."""

CHECKED: Final = 50
"""Events of each part that are compared with what a hub would have stored."""

FILLING: Final = {
    "shared_buffers": "128MB",
    "wal_level": "minimal",
    "max_wal_senders": "0",
    "max_wal_size": "8GB",
    "checkpoint_timeout": "30min",
    "maintenance_work_mem": "512MB",
    "max_parallel_maintenance_workers": "0",
    "statement_timeout": "0",
}
"""Settings of PostgreSQL, by which much is stored at once; the smallest cache that it has by default."""

_EVENT: Final = {
    "id": "id",
    "time_utc": "time_utc",
    "start_s": "start_s",
    "x": "x_mm / 1000.0::float8",
    "y": "y_mm / 1000.0::float8",
    "z": "z_mm / 1000.0::float8",
    "confidence": "confidence",
    "zone": "zone",
    "level": "level_dbfs",
    "duration": "duration_s",
}
"""What stands in the places of the JSON of an event."""


def _chance(seed: int) -> str:
    """Return SQL of a whole number from 0 to 2^63 - 1 that the number of an event gives."""
    return f"(hashint8extended(n, {seed}) & 9223372036854775807)"


def _json(template: str) -> str:
    """Return SQL of the JSON of an event and its site."""
    text = template[:-1] + ',"site":"%(site)s"}'
    parts = re.split(r"%\((\w+)\)[sr]", text)
    values = {**_EVENT, "site": "site"}
    words = [
        f"({values[part]})::text" if at % 2 else "'" + part.replace("%%", "%").replace("'", "''") + "'"
        for at, part in enumerate(parts)
    ]
    return " || ".join(words)


_X, _Y, _Z = (round(1000 * metres) for metres in ROOM_M)

_IS_REFUSED: Final = f"{_chance(1)} % 1000 < {round(1000 * REFUSED)}"

_DRAWN: Final = f"""
    SELECT n,
        'site-' || lpad((n % %(sites)s)::text, 4, '0') AS site,
        'history-' || lpad(n::text, 9, '0') AS id,
        {START_NS} + n * {STEP_NS} AS time_ns,
        n * {STEP_NS} / 1e9::float8 AS start_s,
        to_char(timestamp '1970-01-01' + ({START_NS} + n * {STEP_NS}) / 1000 * interval '1 microsecond',
            'YYYY-MM-DD"T"HH24:MI:SS.US"Z"') AS time_utc,
        {_IS_REFUSED} AS is_refused, CASE WHEN {_IS_REFUSED} THEN 'refused' ELSE 'located' END AS status,
        ({_chance(2)} % {_X})::int AS x_mm, ({_chance(3)} % {_Y})::int AS y_mm, ({_chance(4)} % {_Z})::int AS z_mm,
        CASE WHEN {_IS_REFUSED} THEN 0.0::float8 ELSE {_chance(5)} % 10001 / 10000.0::float8 END AS confidence,
        ({_chance(6)} % 501 - 600) / 10.0::float8 AS level_dbfs,
        ({_chance(7)} % 1900001 + 100000) / 1e6::float8 AS duration_s,
        'zone-' || {_chance(3)} % {_Y} / 1250 AS zone
    FROM generate_series(%(first)s::bigint, %(last)s::bigint) AS n OFFSET 0
"""
"""Random events, each drawn from its number; `OFFSET 0` has each value drawn once."""

_EVENTS: Final = f"""
INSERT INTO events (number, id, time_ns, confidence, status, level_dbfs, x_mm, y_mm, z_mm, words, body)
SELECT n + 1, site || '/' || id, time_ns, confidence, status, level_dbfs,
    CASE WHEN NOT is_refused THEN x_mm END, CASE WHEN NOT is_refused THEN y_mm END,
    CASE WHEN NOT is_refused THEN z_mm END,
    CASE WHEN is_refused THEN concat_ws(E'\\n', id, 'refused', 'onset', 'no direction stands out in the sound')
        ELSE concat_ws(E'\\n', id, 'located', 'onset', zone, 'north', 'south') END,
    CASE WHEN is_refused THEN {_json(REFUSED_BODY)} ELSE {_json(LOCATED)} END
FROM ({_DRAWN}) AS drawn
"""

_TAGS: Final = f"""
INSERT INTO event_tags (kind, name, time_ns, number, confidence, status, level_dbfs)
SELECT tag.kind, tag.name, time_ns, n + 1, confidence, status, level_dbfs
FROM ({_DRAWN}) AS drawn,
    LATERAL (VALUES ('array', 'north'), ('array', 'south'), ('zone', zone), ('site', site)) AS tag (kind, name)
WHERE NOT (is_refused AND tag.kind = 'zone')
"""


def fill_by_sql(place: str, count: int, first: int, sites: int) -> None:
    """Store so many random events of some sites in turns, made by PostgreSQL, as a hub would have stored them.

    Parameters
    ----------
    place : str
        URL of the database, which nobody else uses meanwhile.
    count : int
    first : int
        Number of the first event: how many are there already.
    sites : int
    """
    Store(place, forwards=True).close()  # makes the tables
    with psycopg.connect(place, autocommit=True) as db:
        if first == 0:
            for table in ("events", "event_tags"):
                db.execute(f"ALTER TABLE {table} SET UNLOGGED")  # a crash would cost the benchmark only
        with _without_indices(db):
            for begin in range(first, first + count, FILLED_AT_ONCE):
                last = min(begin + FILLED_AT_ONCE, first + count) - 1
                for statement in (_EVENTS, _TAGS):
                    db.execute(_filled_in(statement, {"first": begin, "last": last, "sites": sites}))
                print(f"{last + 1} events are stored", file=sys.stderr)
        db.execute("SELECT setval(pg_get_serial_sequence('events', 'number'), (SELECT max(number) FROM events))")
        db.execute("VACUUM ANALYZE events, event_tags")  # as the server's autovacuum does in time
        check_stored(db, first, min(count, CHECKED))
        check_stored(db, max(first, first + count - CHECKED), min(count, CHECKED))


def _filled_in(statement: str, values: dict[str, int]) -> str:
    """Return a statement with whole numbers in their places; it has other percent signs, too."""
    for name, value in values.items():
        statement = statement.replace(f"%({name})s", str(value))
    return statement


@contextmanager
def _without_indices(db: psycopg.Connection[Any]) -> Iterator[None]:
    """Take keys and indices of the events away, and make them again at the end: each once instead of row by row."""
    tables = "('events'::regclass, 'event_tags'::regclass)"
    keys = db.execute(
        "SELECT conrelid::regclass::text, conname, pg_get_constraintdef(oid) FROM pg_constraint "
        f"WHERE conrelid IN {tables} AND contype IN ('p', 'u')"
    ).fetchall()
    indices = db.execute(
        "SELECT indexrelid::regclass::text, pg_get_indexdef(indexrelid) FROM pg_index "
        f"WHERE indrelid IN {tables} AND indexrelid NOT IN (SELECT conindid FROM pg_constraint)"
    ).fetchall()
    for table, name, _ in keys:
        db.execute(f"ALTER TABLE {table} DROP CONSTRAINT {name}")
    for name, _ in indices:
        db.execute(f"DROP INDEX {name}")
    yield
    for table, name, definition in keys:
        db.execute(f"ALTER TABLE {table} ADD CONSTRAINT {name} {definition}")
    for _, definition in indices:
        db.execute(definition)


def check_stored(db: psycopg.Connection[Any], first: int, count: int) -> None:
    """Fail unless so many rows from a number on, and no others of these events, are what a hub makes of the events.

    Raises
    ------
    ValueError
        If one differs.
    """
    between = (first + 1, first + count)
    cursor = db.cursor(row_factory=dict_row)
    rows = cursor.execute("SELECT * FROM events WHERE number BETWEEN %s AND %s ORDER BY number", between).fetchall()
    tags = cursor.execute("SELECT * FROM event_tags WHERE number BETWEEN %s AND %s", between).fetchall()
    if len(rows) != count:
        raise ValueError(f"expected {count} events from number {first + 1} on, got {len(rows)}")
    found = {tuple(tag.values()) for tag in tags}
    wanted: set[tuple[Any, ...]] = set()
    for row in rows:
        event = orjson.loads(row["body"])
        made = event_row(event, START_NS + (row["number"] - 1) * STEP_NS)
        compared = {name: made[name] for name in ("time_ns", "confidence", "status", "level_dbfs")}
        named = {"kind": "site", "name": event["site"], "number": row["number"], **compared}
        wanted |= {tuple(tag[name] for name in tags[0]) for tag in (*tag_rows(event, made, row["number"]), named)}
        expected = {**made, "id": f"{event['site']}/{event['id']}", "number": row["number"], "body": row["body"]}
        if expected != row:
            raise ValueError(f"expected the row {expected}, got {row}")
    if wanted != found or len(tags) != len(found):
        raise ValueError(f"expected the tags {sorted(wanted)}, got {sorted(map(str, tags))}")


def _filled(place: str, count: int, first: int, sites: int) -> None:
    """Fill the database of a hub with so many events more."""

    def make(number: int, of: int) -> Rows:
        return hub_rows(number, of, sites)

    if "://" in place:
        fill_by_sql(place, count, first, sites)
    else:
        fill(place, count, first, make)


def _introduce(place: str, sites: int) -> None:
    """Let a hub know so many sites and their arrays."""
    archive = Archive(place if "://" in place else Path(place), SystemClock())
    try:
        simulated = [SimulatedSite(number) for number in range(sites)]
        known = [message for site in simulated for message in site.begin()]
        for batch in (known[start : start + WINDOW] for start in range(0, len(known), WINDOW)):
            taken = archive.take(batch, 0.0)
            assert len(taken.done) == len(batch)
        archive.note_reports({site.name: json.loads(site.report()) for site in simulated})
    finally:
        archive.close()


def measure_history(
    counts: Sequence[int], sites: int, seconds: float, folder: Path, sqlite: bool
) -> Iterator[JsonObject]:
    """Fill a hub's database step by step, and yield the answers of a hub at each."""
    with ExitStack() as stack:
        place, filled = str(folder / "hub.sqlite"), None
        if not sqlite:
            postgresql = stack.enter_context(running_postgresql({**SETTINGS, **FILLING}))
            place = postgresql.url()
            filled = postgresql, place
        stored = 0
        for count in sorted(counts):
            begun = time.perf_counter()
            _filled(place, count - stored, stored, sites)
            filled_s = time.perf_counter() - begun
            if not stored:
                _introduce(place, sites)
            stored = count
            with running_hub_process(folder, sqlite, filled) as world:
                measure_answers(world, sites, 0.0, count)  # the first look reads from disk
                answers = measure_answers(world, sites, seconds, count)
                yield {
                    "history": count,
                    "sites": sites,
                    "filled_s": filled_s,
                    "database_bytes": _stored_bytes(place),
                    "answers": answers,
                    "hub_memory_mb": memory_mb(world.hub.process.pid, "VmHWM"),
                }


def _stored_bytes(place: str) -> int:
    """Return the size of a database with its indices."""
    if "://" not in place:
        return Path(place).stat().st_size
    with psycopg.connect(place) as db:
        row = db.execute("SELECT pg_database_size(current_database())").fetchone()
    assert row is not None
    return int(row[0])
