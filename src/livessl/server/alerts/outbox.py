"""Stores alerts, their deliveries and the rules' states in SQLite, so that a restart loses none.

The alerts of a batch of events are written in one transaction, together with the time up to which events have been
judged. After a crash, later events are judged again, and the keys of alerts prevent a second entry. `delivery` sends
the stored alerts, and sets the time of the next attempt.
"""

from __future__ import annotations

import json
import sqlite3
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

from livessl.errors import RunError
from livessl.schema.alerts import DeliveryState as DeliveryState
from livessl.server.alerts.rules import RuleState
from livessl.server.api.encode import JsonObject

MAX_ALERTS: Final = 100_000
"""Largest number of alerts that are kept, about 200 MB; the oldest are deleted first, delivered or not."""

MAX_WAITING: Final = 1000
"""Largest number of alerts that wait for one action. Further ones become dead letters at once, because the action
obviously does not work."""

BUSY_S: Final = 1.0
"""Longest wait, in seconds, for a file that another program has locked."""

UNKNOWN_IN_JOURNAL: Final = 100
"""Newest alerts that the journal may lack, in a file of a release that did not note what the journal has."""

NO_ACTION: Final = "the site file no longer has this action"
"""Reason for giving up an alert whose action was removed."""

CURE: Final = "free space on its disk, or close the program that locks the file"


class Raised(NamedTuple):
    """An alert, the site time of its subject in nanoseconds, and the names of the actions that deliver it."""

    alert: JsonObject
    time_ns: int
    actions: Sequence[str]


class Due(NamedTuple):
    """A delivery that is due."""

    number: int
    attempts: int
    alert: JsonObject


@dataclass(frozen=True, slots=True)
class Delivery:
    """The delivery of one alert by one action."""

    number: int
    key: str
    action: str
    state: DeliveryState
    attempts: int
    next_ns: int
    error: str | None


class OutboxError(RunError):
    """The outbox cannot be read or written."""


class Outbox:
    """Keeps alerts until they are delivered, and afterwards for lists of alerts; every thread may call it.

    Parameters
    ----------
    path : Path or None
        The file; None keeps everything in memory.

    Raises
    ------
    OutboxError
        If the file cannot be used.
    """

    def __init__(self, path: Path | None = None) -> None:
        self.path = path
        self._lock = threading.Lock()
        try:
            self._db = sqlite3.connect(path or ":memory:", timeout=BUSY_S, check_same_thread=False)
            with self._lock, self._db as db:
                _create_tables(db)
        except sqlite3.Error as error:
            raise OutboxError(f"alerts.outbox: cannot use {path}: {error}; name a file in a writable folder") from error

    def commit(
        self,
        raised: Sequence[Raised],
        states: Mapping[str, RuleState],
        now_ns: int,
        judged: tuple[str, int] | None = None,
    ) -> list[JsonObject]:
        """Store raised alerts and states, all or nothing; return the alerts that are new.

        Parameters
        ----------
        raised : sequence of Raised
        states : mapping of str to RuleState
            New states of rules.
        now_ns : int
            Time of the first attempt to deliver, in nanoseconds.
        judged : (str, int) or None
            Site, and site time before which all of its final events have been judged.
        """
        new = []
        with self._kept() as db:
            for name, state in states.items():
                db.execute("INSERT OR REPLACE INTO rules VALUES (?, ?)", (name, json.dumps(state.as_json())))
            if judged is not None:
                db.execute("INSERT OR REPLACE INTO judged VALUES (?, ?)", judged)
            for alert, time_ns, actions in raised:
                added = db.execute(
                    "INSERT OR IGNORE INTO alerts (key, rule, time_ns, json) VALUES (?, ?, ?, ?)",
                    (alert["key"], alert["rule"], time_ns, json.dumps(alert)),
                ).rowcount
                if not added:
                    continue
                new.append(alert)
                for action in dict.fromkeys(actions):
                    self._enqueue(db, alert["key"], action, now_ns)
            if new:
                db.execute("DELETE FROM alerts WHERE number <= (SELECT max(number) FROM alerts) - ?", (MAX_ALERTS,))
        return new

    def _enqueue(self, db: sqlite3.Connection, key: str, action: str, now_ns: int) -> None:
        [waiting] = db.execute(
            "SELECT count(*) FROM deliveries WHERE action = ? AND state = ?", (action, DeliveryState.WAITING)
        ).fetchone()
        full = waiting >= MAX_WAITING
        state = DeliveryState.DEAD if full else DeliveryState.WAITING
        error = f"{MAX_WAITING} alerts were waiting for this action already" if full else None
        db.execute(
            "INSERT INTO deliveries (key, action, state, attempts, next_ns, error) VALUES (?, ?, ?, 0, ?, ?)",
            (key, action, state, now_ns, error),
        )

    def has(self, keys: Iterable[str]) -> bool:
        """Return whether there is an alert with one of these keys."""
        return any(self._rows("SELECT 1 FROM alerts WHERE key = ?", (key,)) for key in keys)

    def get(self, key: str) -> JsonObject | None:
        """Return the alert with a key; None if there is none, or it has been deleted."""
        rows = self._rows("SELECT json FROM alerts WHERE key = ?", (key,))
        return dict(json.loads(rows[0][0])) if rows else None

    def states(self) -> dict[str, RuleState]:
        """Return the states of all rules that have one."""
        return {name: RuleState.restored(json.loads(text)) for name, text in self._rows("SELECT * FROM rules")}

    def judged_until_ns(self, site: str) -> int | None:
        """Return the site time before which all final events have been judged; None before the first."""
        rows = self._rows("SELECT until_ns FROM judged WHERE site = ?", (site,))
        return int(rows[0][0]) if rows else None

    def forget_judged(self, site: str) -> None:
        """Forget up to which time the events of a site are judged, because no rule is about events any more."""
        with self._kept() as db:
            db.execute("DELETE FROM judged WHERE site = ?", (site,))

    def due(self, action: str, now_ns: int, longest_wait_ns: int) -> Due | None:
        """Return the delivery that is due first; None if none is due.

        A delivery whose time is further in the future than the longest wait is due as well, because the machine's clock
        was set back.
        """
        sql = (
            "SELECT d.number, d.attempts, a.json FROM deliveries d JOIN alerts a USING (key) WHERE d.action = ? "
            "AND d.state = ? AND (d.next_ns <= ? OR d.next_ns > ?) ORDER BY d.next_ns, d.number LIMIT 1"
        )
        rows = self._rows(sql, (action, DeliveryState.WAITING, now_ns, now_ns + 2 * longest_wait_ns))
        return Due(rows[0][0], rows[0][1], json.loads(rows[0][2])) if rows else None

    def next_due_ns(self, action: str) -> int | None:
        """Return the time of the next attempt; None if no delivery waits."""
        sql = "SELECT min(next_ns) FROM deliveries WHERE action = ? AND state = ?"
        [(next_ns,)] = self._rows(sql, (action, DeliveryState.WAITING))
        return None if next_ns is None else int(next_ns)

    def hasten(self, action: str, now_ns: int) -> None:
        """Make all deliveries that wait for an action due now, because the action can be reached again."""
        with self._kept() as db:
            db.execute(
                "UPDATE deliveries SET next_ns = ? WHERE action = ? AND state = ? AND next_ns > ?",
                (now_ns, action, DeliveryState.WAITING, now_ns),
            )

    def delivered(self, number: int) -> None:
        """Note that a delivery has arrived."""
        with self._kept() as db:
            db.execute(
                "UPDATE deliveries SET state = ?, attempts = attempts + 1, error = NULL WHERE number = ?",
                (DeliveryState.DELIVERED, number),
            )

    def failed(self, number: int, error: str, next_ns: int | None) -> None:
        """Note a failed attempt; without a time for the next one the delivery is a dead letter."""
        state = DeliveryState.DEAD if next_ns is None else DeliveryState.WAITING
        with self._kept() as db:
            db.execute(
                "UPDATE deliveries SET state = ?, attempts = attempts + 1, error = ?, next_ns = ? WHERE number = ?",
                (state, error, next_ns or 0, number),
            )

    def resend(self, number: int, now_ns: int) -> bool:
        """Make a dead letter due now, with all attempts available again; return False if there is none."""
        with self._kept() as db:
            found = db.execute(
                "UPDATE deliveries SET state = ?, attempts = 0, next_ns = ? WHERE number = ? AND state = ?",
                (DeliveryState.WAITING, now_ns, number, DeliveryState.DEAD),
            ).rowcount
        return found > 0

    def abandon(self, actions: Iterable[str]) -> int:
        """Give up the deliveries of actions other than these, which the site has; return their number."""
        known = list(actions)
        marks = ", ".join("?" * len(known))
        with self._kept() as db:
            return db.execute(
                f"UPDATE deliveries SET state = ?, error = ? WHERE state = ? AND action NOT IN ({marks})",  # noqa: S608 - question marks
                (DeliveryState.DEAD, NO_ACTION, DeliveryState.WAITING, *known),
            ).rowcount

    def action_of_dead(self, number: int) -> str | None:
        """Return the name of the action that has given up a dead letter; None if there is none of that number."""
        sql = "SELECT action FROM deliveries WHERE number = ? AND state = ?"
        rows = self._rows(sql, (number, DeliveryState.DEAD))
        return str(rows[0][0]) if rows else None

    def dismiss(self, number: int | None = None, action: str | None = None) -> int:
        """Dismiss the dead letter of that number, those of an action, or all; return how many there were."""
        with self._kept() as db:
            return db.execute(
                "UPDATE deliveries SET state = ? WHERE state = ? AND (? IS NULL OR number = ?) "
                "AND (? IS NULL OR action = ?)",
                (DeliveryState.DISMISSED, DeliveryState.DEAD, number, number, action, action),
            ).rowcount

    def not_in_journal(self, most: int) -> list[JsonObject]:
        """Return at most `most` alerts that the journal of the history may lack, oldest first."""
        rows = self._rows("SELECT json FROM alerts WHERE NOT in_journal ORDER BY number LIMIT ?", (most,))
        return [json.loads(text) for (text,) in rows]

    def note_in_journal(self, key: str) -> None:
        """Note that the journal of the history has an alert."""
        with self._kept() as db:
            db.execute("UPDATE alerts SET in_journal = 1 WHERE key = ?", (key,))

    def recent(self, limit: int, before: int | None = None, rule: str | None = None) -> list[tuple[int, JsonObject]]:
        """Return alerts, newest first, each with its number; those before a number, and of one rule, if given."""
        sql = (
            "SELECT number, json FROM alerts WHERE (? IS NULL OR number < ?) AND (? IS NULL OR rule = ?) "
            "ORDER BY number DESC LIMIT ?"
        )
        rows = self._rows(sql, (before, before, rule, rule, limit))
        return [(number, json.loads(text)) for number, text in rows]

    def deliveries(self, keys: Sequence[str]) -> dict[str, list[Delivery]]:
        """Return the deliveries of these alerts, by key."""
        found: dict[str, list[Delivery]] = {key: [] for key in keys}
        for key in keys:
            for row in self._rows(_OF_ALERT, (key,)):
                found[key].append(_delivery(row))
        return found

    def dead(self, limit: int, before: int | None = None) -> list[tuple[Delivery, JsonObject]]:
        """Return dead letters, newest first, each with its alert."""
        sql = (
            "SELECT d.number, d.key, d.action, d.state, d.attempts, d.next_ns, d.error, a.json FROM deliveries d "
            "JOIN alerts a USING (key) WHERE d.state = ? AND (? IS NULL OR d.number < ?) "
            "ORDER BY d.number DESC LIMIT ?"
        )
        rows = self._rows(sql, (DeliveryState.DEAD, before, before, limit))
        return [(_delivery(row[:7]), json.loads(row[7])) for row in rows]

    def counts(self) -> dict[tuple[str, str], int]:
        """Return the number of deliveries by action and state."""
        rows = self._rows("SELECT action, state, count(*) FROM deliveries GROUP BY action, state")
        return {(action, state): int(count) for action, state, count in rows}

    def expire(self, before_ns: int) -> int:
        """Delete alerts with subjects before a time, and overwrite them in the file; return their number."""
        with self._kept() as db:
            gone = db.execute("DELETE FROM alerts WHERE time_ns < ?", (before_ns,)).rowcount
        if gone:
            self._rows("PRAGMA wal_checkpoint(TRUNCATE)")
        return gone

    def close(self) -> None:
        """Release the file."""
        with self._lock:
            self._db.close()

    @contextmanager
    def _kept(self) -> Iterator[sqlite3.Connection]:
        try:
            with self._lock, self._db as db:
                yield db
        except sqlite3.Error as error:
            raise OutboxError(f"alerts.outbox: cannot be written: {error}; {CURE}") from error

    def _rows(self, sql: str, values: tuple[Any, ...] = ()) -> list[Any]:
        try:
            with self._lock:
                return self._db.execute(sql, values).fetchall()
        except sqlite3.Error as error:
            raise OutboxError(f"alerts.outbox: cannot be read: {error}; {CURE}") from error


def _create_tables(db: sqlite3.Connection) -> None:
    """Set the file up, and create the tables that it lacks."""
    db.execute("PRAGMA journal_mode=WAL")
    db.execute("PRAGMA secure_delete=ON")  # positions are deleted when their events are
    db.execute("PRAGMA foreign_keys=ON")
    db.execute("CREATE TABLE IF NOT EXISTS rules (name TEXT PRIMARY KEY, json TEXT NOT NULL)")
    db.execute("CREATE TABLE IF NOT EXISTS judged (site TEXT PRIMARY KEY, until_ns INTEGER NOT NULL)")
    db.execute(
        "CREATE TABLE IF NOT EXISTS alerts (number INTEGER PRIMARY KEY AUTOINCREMENT, "
        "key TEXT UNIQUE NOT NULL, rule TEXT NOT NULL, time_ns INTEGER NOT NULL, json TEXT NOT NULL)"
    )
    db.execute(
        "CREATE TABLE IF NOT EXISTS deliveries (number INTEGER PRIMARY KEY AUTOINCREMENT, "
        "key TEXT NOT NULL REFERENCES alerts (key) ON DELETE CASCADE, action TEXT NOT NULL, "
        "state TEXT NOT NULL, attempts INTEGER NOT NULL, next_ns INTEGER NOT NULL, error TEXT, "
        "UNIQUE (key, action))"
    )
    db.execute("CREATE INDEX IF NOT EXISTS deliveries_due ON deliveries (action, state, next_ns)")
    _add_in_journal(db)


def _add_in_journal(db: sqlite3.Connection) -> None:
    """Add the column that says whether the journal has an alert, to a file of a release that did not note it."""
    if any(row[1] == "in_journal" for row in db.execute("PRAGMA table_info(alerts)")):
        return
    db.execute("ALTER TABLE alerts ADD COLUMN in_journal INTEGER NOT NULL DEFAULT 0")
    newest = "SELECT number FROM alerts ORDER BY number DESC LIMIT ?"
    db.execute(f"UPDATE alerts SET in_journal = 1 WHERE number NOT IN ({newest})", (UNKNOWN_IN_JOURNAL,))  # noqa: S608 - a constant


_OF_ALERT: Final = (
    "SELECT number, key, action, state, attempts, next_ns, error FROM deliveries WHERE key = ? ORDER BY number"
)


def _delivery(row: Sequence[Any]) -> Delivery:
    number, key, action, state, attempts, next_ns, error = row
    return Delivery(number, key, action, DeliveryState(state), attempts, next_ns, error)
