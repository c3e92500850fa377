"""The history of events, in SQLite: in memory, or in a file where the site names one."""

from __future__ import annotations

import json
import sqlite3
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from livessl.messages import JsonObject

MAX_EVENTS_IN_MEMORY: Final = 10_000
"""About 10 MB. A file has no such limit."""


@dataclass(frozen=True, slots=True)
class Query:
    """Which events: times in nanoseconds since the epoch, both ends included; `before` is a page's cursor."""

    since_ns: int | None = None
    until_ns: int | None = None
    zone: str | None = None
    min_confidence: float | None = None
    limit: int = 50
    before: int | None = None


class StoreError(Exception):
    """The file cannot be used."""


class Store:
    """Keeps events; safe to call from any thread.

    Parameters
    ----------
    path : Path or None
        The database file; None keeps the newest `MAX_EVENTS_IN_MEMORY` in memory.
    """

    def __init__(self, path: Path | None = None) -> None:
        self._bounded = path is None
        self._lock = threading.Lock()
        try:
            self._db = sqlite3.connect(path or ":memory:", check_same_thread=False)
            with self._db:
                self._db.execute("PRAGMA journal_mode=WAL")
                self._db.execute(
                    "CREATE TABLE IF NOT EXISTS events (number INTEGER PRIMARY KEY AUTOINCREMENT, id TEXT UNIQUE, "
                    "time_ns INTEGER, confidence REAL, json TEXT)"
                )
                self._db.execute("CREATE INDEX IF NOT EXISTS events_time ON events (time_ns)")
        except sqlite3.Error as error:
            raise StoreError(
                f"server.events_db: cannot use {path}: {error}; name a file in a writable folder"
            ) from error

    def add(self, event: JsonObject, time_ns: int) -> None:
        """Keep an event; one of the same id is replaced."""
        with self._lock, self._db:
            self._db.execute(
                "INSERT OR REPLACE INTO events (id, time_ns, confidence, json) VALUES (?, ?, ?, ?)",
                (event["id"], time_ns, event["confidence"], json.dumps(event)),
            )
            if self._bounded:
                self._db.execute(
                    "DELETE FROM events WHERE number <= (SELECT max(number) FROM events) - ?", (MAX_EVENTS_IN_MEMORY,)
                )

    def get(self, event_id: str) -> JsonObject | None:
        """The event of that id."""
        with self._lock:
            row = self._db.execute("SELECT json FROM events WHERE id = ?", (event_id,)).fetchone()
        return None if row is None else dict(json.loads(row[0]))

    def find(self, query: Query) -> tuple[list[JsonObject], int | None]:
        """Events newest first, and the cursor of the next page or None."""
        conditions = {
            "time_ns >= ?": query.since_ns,
            "time_ns <= ?": query.until_ns,
            "confidence >= ?": query.min_confidence,
            "number < ?": query.before,
            "EXISTS (SELECT 1 FROM json_each(events.json, '$.zones') WHERE value = ?)": query.zone,
        }
        asked = {text: value for text, value in conditions.items() if value is not None}
        where = f"WHERE {' AND '.join(asked)} " if asked else ""
        sql = f"SELECT number, json FROM events {where}ORDER BY number DESC LIMIT ?"  # noqa: S608 - fixed texts
        with self._lock:
            rows = self._db.execute(sql, (*asked.values(), query.limit + 1)).fetchall()
        page = rows[: query.limit]
        return [json.loads(text) for _, text in page], page[-1][0] if len(rows) > query.limit else None

    def count(self) -> int:
        """How many events are kept."""
        with self._lock:
            return int(self._db.execute("SELECT count(*) FROM events").fetchone()[0])

    def close(self) -> None:
        """Release the file."""
        with self._lock:
            self._db.close()
