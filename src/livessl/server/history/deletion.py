"""Deletes old events and entries in small transactions that give way to new events."""

from __future__ import annotations

import threading
from typing import Final

from livessl.server.forwarding.outbox import Outbox
from livessl.server.history import records
from livessl.server.history.backlog import Backlog
from livessl.server.history.database import Database
from livessl.server.history.event_count import EventCount
from livessl.server.history.journal import remove_older_entries

DELETED_AT_ONCE: Final = 200
"""Old events that are deleted in one transaction: the longest that a new event waits for their deletion."""

GIVE_WAY_S: Final = 2.0
"""Longest wait, in seconds, of such a transaction for new events that are to be stored: each of these would wait for
one, and a store that is busy with both would fall behind. A store that is behind all the time deletes slowly."""

PAUSE_S: Final = 0.01
"""Pause, in seconds, between two of these transactions, in which what waits is written."""


def delete_older(
    database: Database,
    backlog: Backlog,
    outbox: Outbox | None,
    count: EventCount,
    before_ns: int,
    end: threading.Event,
) -> int:
    """Delete the events, entries of the journal, and messages for the hub of before a time.

    They are also overwritten in an SQLite file.

    Parameters
    ----------
    database : Database
    backlog : Backlog
        Events that wait to be stored, and go first.
    outbox : Outbox or None
        Messages for the hub; None for a site without one.
    count : EventCount
        Follows the number of events.
    before_ns : int
        Time in nanoseconds since the epoch.
    end : Event
        Ends it early, between two transactions; the next call does the rest.

    Returns
    -------
    int
        Number of events that were deleted.

    Raises
    ------
    StoreError
        If the database cannot be used.
    """
    gone = 0
    before_ns = max(before_ns, 0)  # a database has no number for a time long before 1970
    while not end.is_set():
        backlog.settle(GIVE_WAY_S)
        with database.writing("delete old events") as connection:
            some = records.remove_older(connection, before_ns, DELETED_AT_ONCE)
            others = remove_older_entries(connection, before_ns, DELETED_AT_ONCE)
            if outbox is not None:
                outbox.expire_with(connection, before_ns)
        count.change(-some)
        gone += some
        if max(some, others) < DELETED_AT_ONCE:
            database.erase()
            break
        end.wait(PAUSE_S)
    return gone
