"""Random events by the million, as rows of the history's tables, and how a database is filled with them."""

from __future__ import annotations

import random
import sqlite3
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import orjson
import psycopg

from livessl.clock import utc_text
from livessl.server.api.encode import JsonObject
from livessl.server.history.tables import event_row, events, tag_rows, tags
from livessl.server.store import Store

EVENTS_A_DAY: Final = 100_000
DAY_NS: Final = 86_400_000_000_000
START_NS: Final = 1_767_225_600_000_000_000
STEP_NS: Final = DAY_NS // EVENTS_A_DAY
"""Time from one event to the next, in nanoseconds."""

BATCH: Final = 20_000
"""Events whose rows are made at a time."""


EVENT_COLUMNS: Final = ("number", *(name for name in events.c.keys() if name != "number"))  # noqa: SIM118 - not a dict
TAG_COLUMNS: Final = tuple(tags.c.keys())


class Rest(NamedTuple):
    """Duration and level of an event, which no measured search filters by together with its place."""

    duration_s: float
    level_dbfs: float


class Rows(NamedTuple):
    """Random events in columns: of `events` as the history has them, and of their zones and arrays."""

    events: list[tuple[object, ...]]
    tags: list[tuple[object, ...]]


def event_of(number: int, time_ns: int, place_m: Sequence[float] | None, confidence: float, rest: Rest) -> JsonObject:
    """Return an event as the server stores it; without a place it is refused."""
    is_refused = place_m is None
    contribution = {"active_s": 0.2, "level_dbfs": -31.2, "azimuth_deg": 12.31, "elevation_deg": -4.52}
    return {
        "kind": "event",
        "id": f"history-{number:09d}",
        "time_utc": utc_text(time_ns),
        "start_s": (time_ns - START_NS) / 1e9,
        "duration_s": rest.duration_s,
        "position_m": None if place_m is None else list(place_m),
        "covariance_m2": None
        if is_refused
        else [[0.0123, 0.001, 0.002], [0.001, 0.0456, 0.003], [0.002, 0.003, 0.0789]],
        "confidence": 0.0 if is_refused else confidence,
        "arrays": [] if is_refused else ["north", "south"],
        "method": "onset",
        "status": "refused" if is_refused else "located",
        "reason": "no direction stands out in the sound" if is_refused else None,
        "heard_by": ["north", "south"],
        "level_dbfs": rest.level_dbfs,
        "contributions": [
            {"array": name, **contribution, "distance_m": 3.2, "agrees": True, "off_deg": 1.5, "asked": False}
            for name in ("north", "south")
        ],
        "zones": [] if place_m is None else [f"zone-{int(place_m[1] / 1.25)}"],
        "membership": [] if place_m is None else [{"name": f"zone-{int(place_m[1] / 1.25)}", "probability": 0.9}],
        "excluded": False,
        "excluded_by": [],
        "late_frames": 0,
        "latency_s": 0.1234,
        "latency_stages_s": {"waited": 0.1, "sent": 0.01, "received": 0.001, "located": 0.0124},
        "late": False,
        "replaces": [],
        "source": 1,
        "candidates": [],
    }


def random_event(rng: random.Random, number: int, time_ns: int) -> JsonObject:
    """Return a random event; a fifth of them is refused."""
    place_m = [round(rng.uniform(0, size), 4) for size in ROOM_M]
    rest = Rest(round(rng.uniform(0.1, 2.0), 6), round(rng.uniform(-60, -10), 1))
    return event_of(number, time_ns, None if rng.random() < REFUSED else place_m, round(rng.random(), 4), rest)


def random_rows(first: int, count: int) -> Rows:
    """Return the rows of many random events, each as `random_event` would be stored, without making its JSON anew."""
    rng = np.random.default_rng(first)
    numbers = np.arange(first, first + count)
    times_ns = START_NS + numbers * STEP_NS
    places_mm = (rng.random((count, 3)) * np.array(ROOM_M) * 1000).astype(np.int64)
    confidences = np.round(rng.random(count), 4)
    refused = rng.random(count) < REFUSED
    levels_dbfs, durations_s = np.round(rng.uniform(-60, -10, count), 1), np.round(rng.uniform(0.1, 2.0, count), 6)
    columns = (numbers, times_ns, places_mm, confidences, refused, levels_dbfs, durations_s)
    found = Rows([], [])
    for number, time_ns, (x, y, z), confidence, is_refused, level, duration in zip(
        *(column.tolist() for column in columns), strict=True
    ):
        name, status, zone = f"history-{number:09d}", "located", f"zone-{y // 1250}"
        body, words = LOCATED, f"{name}\nlocated\nonset\n{zone}\nnorth\nsouth"
        place: tuple[int | None, int | None, int | None] = (x, y, z)
        if is_refused:
            place, confidence, status, body = (None, None, None), 0.0, "refused", REFUSED_BODY
            words = f"{name}\nrefused\nonset\nno direction stands out in the sound"
        text = body % {
            "id": name,
            "time_utc": utc_text(time_ns),
            "start_s": (time_ns - START_NS) / 1e9,
            "x": x / 1000,
            "y": y / 1000,
            "z": z / 1000,
            "confidence": confidence,
            "zone": zone,
            "level": level,
            "duration": duration,
        }
        found.events.append((number + 1, name, time_ns, confidence, status, level, *place, words, text))
        named = [("array", "north"), ("array", "south"), *(() if is_refused else (("zone", zone),))]
        found.tags.extend((kind, each, time_ns, number + 1, confidence, status, level) for kind, each in named)
    return found


def _template(event: JsonObject) -> str:
    """Return the JSON of an event, with places for what differs."""
    zone = f"zone-{int(PLACE_M[1] / 1.25)}"
    text = orjson.dumps(event).decode().replace("%", "%%").replace(zone, "%(zone)s")
    marks = {
        '"id":"history-000000007"': '"id":"%(id)s"',
        f'"time_utc":"{event["time_utc"]}"': '"time_utc":"%(time_utc)s"',
        f'"start_s":{event["start_s"]!r}': '"start_s":%(start_s)r',
        f'"position_m":{orjson.dumps(PLACE_M).decode()}': '"position_m":[%(x)r,%(y)r,%(z)r]',
        '"confidence":0.125': '"confidence":%(confidence)r',
        '"level_dbfs":-47.125': '"level_dbfs":%(level)r',
        '"duration_s":0.375': '"duration_s":%(duration)r',
    }
    for old, new in marks.items():
        text = text.replace(old, new)
    return text


ROOM_M: Final = (8.0, 9.999, 4.0)
PLACE_M: Final = (1.5, 2.75, 3.25)
REFUSED: Final = 0.2
"""Share of the events that are refused."""

LOCATED: Final = _template(event_of(7, START_NS + 7 * STEP_NS, PLACE_M, 0.125, Rest(0.375, -47.125)))
REFUSED_BODY: Final = _template(event_of(7, START_NS + 7 * STEP_NS, None, 0.125, Rest(0.375, -47.125)))
"""JSON of an event, with places for what differs."""


def check_rows(rows: Rows) -> None:
    """Fail unless the rows are those that the server itself makes of these events."""
    tagged = iter(rows.tags)
    for given in rows.events:
        row = dict(zip(EVENT_COLUMNS, given, strict=True))
        event, number = orjson.loads(str(row["body"])), row.pop("number")
        made = event_row(event, int(str(row["time_ns"])))
        assert {**made, "body": row["body"]} == row, (made, row)
        wanted = {tuple(tag[name] for name in TAG_COLUMNS) for tag in tag_rows(event, made, int(str(number)))}
        assert {next(tagged) for _ in wanted} == wanted


def fill(place: str, count: int, first: int = 0, make: Callable[[int, int], Rows] = random_rows) -> float:
    """Store random events, oldest first, by the database's own means for many rows; return how many a second.

    Parameters
    ----------
    place : str
        SQLite file, or URL of a PostgreSQL database.
    count : int
    first : int
        Number of the first event: how many are there already.
    make : callable
        Returns the rows of as many events from a number on.
    """
    Store(place if "://" in place else Path(place)).close()  # makes the tables
    check_rows(random_rows(0, 100))
    begun = time.perf_counter()
    with ExitStack() as stack:
        put = stack.enter_context(_postgresql_copy(place) if "://" in place else _sqlite_rows(place))
        for done in range(0, count, BATCH):
            put(make(first + done, min(BATCH, count - done)))
            if done % 500_000 == 0:
                print(f"{done} of {count} events are stored", file=sys.stderr)
    return count / (time.perf_counter() - begun)


@contextmanager
def _sqlite_rows(place: str) -> Iterator[Callable[[Rows], None]]:
    """Statements prepared once, and nothing forced to the disk meanwhile: a crash would cost the benchmark only."""
    marks = [", ".join("?" * len(columns)) for columns in (EVENT_COLUMNS, TAG_COLUMNS)]
    with closing(sqlite3.connect(place, isolation_level=None)) as db:
        for setting in ("journal_mode=OFF", "synchronous=OFF", "cache_size=-400000", "locking_mode=EXCLUSIVE"):
            db.execute(f"PRAGMA {setting}")
        db.execute("BEGIN")

        def put(rows: Rows) -> None:
            db.executemany(f"INSERT INTO events ({', '.join(EVENT_COLUMNS)}) VALUES ({marks[0]})", rows.events)
            db.executemany(f"INSERT INTO event_tags ({', '.join(TAG_COLUMNS)}) VALUES ({marks[1]})", rows.tags)

        yield put
        db.execute("COMMIT")


@contextmanager
def _postgresql_copy(place: str) -> Iterator[Callable[[Rows], None]]:
    with psycopg.connect(place, autocommit=True) as db:

        def copy(table: str, columns: Sequence[str], rows: list[tuple[object, ...]]) -> None:
            with db.cursor() as cursor, cursor.copy(f"COPY {table} ({', '.join(columns)}) FROM STDIN") as sent:
                for row in rows:
                    sent.write_row(row)

        def put(rows: Rows) -> None:
            copy("events", EVENT_COLUMNS, rows.events)
            copy("event_tags", TAG_COLUMNS, rows.tags)

        yield put
        db.execute("SELECT setval(pg_get_serial_sequence('events', 'number'), (SELECT max(number) FROM events))")
        db.execute("VACUUM ANALYZE")  # as the server's autovacuum does in time
