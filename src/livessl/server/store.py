"""The history of events, in SQLite: in memory, or in a file where the site names one."""

from __future__ import annotations

import json
import re
import sqlite3
import threading
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

from livessl.core.types import FRAME_NS
from livessl.errors import RunError
from livessl.server.api.encode import JsonObject

MAX_EVENTS_IN_MEMORY: Final = 10_000
"""Most events kept in memory, about 10 MB; a file has no such limit."""

BUSY_S: Final = 0.2
"""Longest wait, in seconds, for a file that another program has locked; it can delay the fusion thread by as much."""

UNLOCK: Final = "close the program that locks the file"
CURE: Final = f"free space on its disk, or {UNLOCK}"
"""Cures of a database that cannot be written."""


class Cursor(NamedTuple):
    """Position of the last event of a page; the next page begins after it."""

    time_ns: int
    number: int

    def __str__(self) -> str:
        return f"{self.time_ns}-{self.number}"

    @classmethod
    def parse(cls, text: str) -> Cursor:
        """Return the cursor of which `text` is the text form.

        Raises
        ------
        ValueError
            If the text is not that of a cursor.
        """
        parts = re.fullmatch(r"(-?[0-9]{1,19})-([0-9]{1,19})", text, re.ASCII)
        cursor = None if parts is None else cls(*map(int, parts.groups()))
        if cursor is None or not all(abs(part) < 2**63 for part in cursor):
            raise ValueError(f"expected the next_cursor of the page before, got {text!r}")
        return cursor


@dataclass(frozen=True, slots=True)
class Query:
    """A search for events: times in nanoseconds since the epoch, both ends included.

    `before` is the cursor of the page before. Events come newest first unless `oldest_first` is set.
    """

    since_ns: int | None = None
    until_ns: int | None = None
    zone: str | None = None
    min_confidence: float | None = None
    limit: int = 50
    before: Cursor | None = None
    oldest_first: bool = False


class Finalized(NamedTuple):
    """Progress of the final pass.

    Parameters
    ----------
    until : int or None
        Frame index before which all events are final; None if there are none yet.
    clocks : JsonObject or None
        What was known of the arrays' clocks then.
    """

    until: int | None
    clocks: JsonObject | None


class StoreError(RunError):
    """The database cannot be read or written."""


class Store:
    """Keeps events, and what a restarted server must know; every thread may call it.

    A file has one connection for writing and one for reading, so that no slow query delays an event.

    Parameters
    ----------
    path : Path or None
        The database file; None keeps the newest `MAX_EVENTS_IN_MEMORY` in memory.
    """

    def __init__(self, path: Path | None = None) -> None:
        self._bounded = path is None
        try:
            self._writing = self._reading = _Connection(path or ":memory:")
            with self._writing.lock, self._writing.db as db:
                db.execute("PRAGMA journal_mode=WAL")
                db.execute("PRAGMA secure_delete=ON")  # deleted rows are overwritten
                db.execute(
                    "CREATE TABLE IF NOT EXISTS events (number INTEGER PRIMARY KEY AUTOINCREMENT, id TEXT UNIQUE, "
                    "time_ns INTEGER, confidence REAL, json TEXT)"
                )
                db.execute("CREATE INDEX IF NOT EXISTS events_time ON events (time_ns)")
                db.execute("CREATE TABLE IF NOT EXISTS provisional (id TEXT PRIMARY KEY)")
                # existing databases have these names: `settled` stands for final, `raster` for frame index
                db.execute("CREATE TABLE IF NOT EXISTS settled (site TEXT PRIMARY KEY, raster INTEGER)")
                db.execute("CREATE TABLE IF NOT EXISTS disabled (site TEXT, array TEXT, PRIMARY KEY (site, array))")
                db.execute("CREATE TABLE IF NOT EXISTS clocks (site TEXT PRIMARY KEY, json TEXT)")
            if path is not None:
                self._reading = _Connection(f"{path.resolve().as_uri()}?mode=ro")
        except sqlite3.Error as error:
            raise StoreError(
                f"server.events_db: cannot use {path}: {error}; name a file in a writable folder"
            ) from error

    def add(self, event: JsonObject, time_ns: int, *, early: bool = False) -> None:
        """Store an event, replacing one of the same id; an early event stays early until `finalize` passes its time.

        Raises
        ------
        StoreError
            If the file is locked, or its disk is full.
        """
        with self._kept(f"event {event['id']!r}") as db:
            self._insert(db, event, time_ns)
            if early:
                db.execute("INSERT OR IGNORE INTO provisional VALUES (?)", (event["id"],))

    def finalize(
        self,
        site: str,
        events: Sequence[tuple[JsonObject, int]],
        replaced: Iterable[str],
        frame_index: int,
        clocks: JsonObject,
    ) -> None:
        """Keep what the final pass found, all or nothing.

        Parameters
        ----------
        site : str
            Name of the site.
        events : sequence of (JsonObject, int)
            Final events, each with its start in nanoseconds of site time.
        replaced : iterable of str
            Ids of early events to delete.
        frame_index : int
            All other events before it become final as they are.
        clocks : JsonObject
            What is known of the arrays' clocks, which relates their frame indices to those of the site.

        Raises
        ------
        StoreError
            If the file is locked, or its disk is full.
        """
        with self._kept(f"{len(events)} events") as db:
            db.executemany("DELETE FROM events WHERE id = ?", [(old,) for old in replaced])
            for event, time_ns in events:
                self._insert(db, event, time_ns)
            db.execute(
                "DELETE FROM provisional WHERE NOT EXISTS (SELECT 1 FROM events WHERE events.id = provisional.id "
                "AND time_ns >= ?)",
                (frame_index * FRAME_NS,),
            )
            db.execute("INSERT OR REPLACE INTO settled VALUES (?, ?)", (site, frame_index))
            db.execute("INSERT OR REPLACE INTO clocks VALUES (?, ?)", (site, json.dumps(clocks)))

    def finalized(self, site: str) -> Finalized:
        """Return how far the final pass of the site has come."""
        sql = "SELECT raster, json FROM settled LEFT JOIN clocks USING (site) WHERE site = ?"
        rows = self._reading.rows(sql, (site,))
        if not rows:
            return Finalized(None, None)
        frame_index, clocks = rows[0]
        return Finalized(int(frame_index), None if clocks is None else json.loads(clocks))

    def disabled(self, site: str) -> frozenset[str]:
        """Return the names of the site's disabled arrays."""
        rows = self._reading.rows("SELECT array FROM disabled WHERE site = ?", (site,))
        return frozenset(array for (array,) in rows)

    def enable(self, site: str, array: str, enabled: bool) -> None:
        """Remember whether an array is enabled.

        Raises
        ------
        StoreError
            If the file is locked, or its disk is full.
        """
        sql = (
            "DELETE FROM disabled WHERE site = ? AND array = ?"
            if enabled
            else "INSERT OR IGNORE INTO disabled VALUES (?, ?)"
        )
        with self._kept(f"the state of array {array!r}") as db:
            db.execute(sql, (site, array))

    def early_events(self) -> list[tuple[int, JsonObject]]:
        """Return the events that are still early, oldest first, each with its start in nanoseconds of site time.

        Raises
        ------
        StoreError
            If the file cannot be read.
        """
        sql = "SELECT time_ns, json FROM events JOIN provisional USING (id) ORDER BY time_ns"
        try:
            return [(time_ns, json.loads(text)) for time_ns, text in self._writing.rows(sql)]
        except sqlite3.Error as error:
            raise StoreError(f"server.events_db: cannot read: {error}; {UNLOCK}") from error

    def _insert(self, db: sqlite3.Connection, event: JsonObject, time_ns: int) -> None:
        db.execute(
            "INSERT INTO events (id, time_ns, confidence, json) VALUES (?, ?, ?, ?) ON CONFLICT (id) DO UPDATE "
            "SET time_ns = excluded.time_ns, confidence = excluded.confidence, json = excluded.json",
            (event["id"], time_ns, event["confidence"], json.dumps(event)),
        )
        if self._bounded:
            db.execute(
                "DELETE FROM events WHERE number <= (SELECT max(number) FROM events) - ?", (MAX_EVENTS_IN_MEMORY,)
            )

    @contextmanager
    def _kept(self, what: str) -> Iterator[sqlite3.Connection]:
        try:
            with self._writing.lock, self._writing.db as db:
                yield db
        except sqlite3.Error as error:
            raise StoreError(f"server.events_db: cannot store {what}: {error}; {CURE}") from error

    def expire(self, before_ns: int) -> int:
        """Delete the events that began before a time, and overwrite them in the file; return their number.

        Raises
        ------
        StoreError
            If the file is locked.
        """
        try:
            with self._writing.lock:
                with self._writing.db as db:
                    gone = db.execute("DELETE FROM events WHERE time_ns < ?", (before_ns,)).rowcount
                busy, *_ = self._writing.db.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchone()
                if busy:
                    raise StoreError(f"server.events_db: its journal was not emptied of old events; {UNLOCK}")
        except sqlite3.Error as error:
            raise StoreError(f"server.events_db: old events were not deleted: {error}; {UNLOCK}") from error
        return gone

    def get(self, event_id: str) -> JsonObject | None:
        """Return the event of that id, None if there is none."""
        rows = self._reading.rows("SELECT json FROM events WHERE id = ?", (event_id,))
        return dict(json.loads(rows[0][0])) if rows else None

    def find(self, query: Query) -> tuple[list[JsonObject], Cursor | None]:
        """Return events, newest first by their time unless asked otherwise, and the cursor of the next page or None."""
        beyond, order = (">", "ASC") if query.oldest_first else ("<", "DESC")
        conditions: dict[str, tuple[Any, ...]] = {
            "time_ns >= ?": (query.since_ns,),
            "time_ns <= ?": (query.until_ns,),
            "confidence >= ?": (query.min_confidence,),
            f"(time_ns, number) {beyond} (?, ?)": query.before or (None,),
            "EXISTS (SELECT 1 FROM json_each(events.json, '$.zones') WHERE value = ?)": (query.zone,),
        }
        used = {text: values for text, values in conditions.items() if values != (None,)}
        where = f"WHERE {' AND '.join(used)} " if used else ""
        ordered = f"ORDER BY time_ns {order}, number {order} LIMIT ?"
        sql = f"SELECT time_ns, number, json FROM events {where}{ordered}"  # noqa: S608 - fixed texts
        rows = self._reading.rows(sql, (*(value for values in used.values() for value in values), query.limit + 1))
        page = rows[: query.limit]
        next_page = Cursor(*page[-1][:2]) if len(rows) > query.limit else None
        return [json.loads(text) for _, _, text in page], next_page

    def count(self) -> int:
        """Return the number of events."""
        return int(self._reading.rows("SELECT count(*) FROM events")[0][0])

    def close(self) -> None:
        """Release the file."""
        for connection in (self._reading, self._writing):
            with connection.lock:
                connection.db.close()


class _Connection:
    """A connection to the database, and the lock that guards its use."""

    def __init__(self, path: Path | str) -> None:
        self.lock = threading.Lock()
        uri = str(path).startswith("file:")
        self.db = sqlite3.connect(path, timeout=BUSY_S, check_same_thread=False, uri=uri)

    def rows(self, sql: str, values: tuple[Any, ...] = ()) -> list[Any]:
        """Return all rows of a query."""
        with self.lock:
            return self.db.execute(sql, values).fetchall()
