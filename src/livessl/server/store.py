"""Stores and finds events, and what a restarted server must know: in memory, an SQLite file, or PostgreSQL."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import orjson
from sqlalchemy import select

from livessl.server.forwarding import tables as forwarding
from livessl.server.forwarding.outbox import Outbox
from livessl.server.forwarding.tile import Tile
from livessl.server.history import records
from livessl.server.history.backlog import Backlog
from livessl.server.history.database import CURE, Database, StoreError
from livessl.server.history.deletion import delete_older
from livessl.server.history.event_count import EventCount
from livessl.server.history.heat_map import Cells, HeatMap, count_by_cell
from livessl.server.history.journal import (
    Entry,
    JournalPage,
    JournalQuery,
    journal_page,
    keep_newest_entries,
    put_entry,
)
from livessl.server.history.log import LogPage, LogPosition, log_page
from livessl.server.history.query import Cursor, Page, Query, Row
from livessl.server.history.search import event_page
from livessl.server.history.site_progress import Finalized, disabled_arrays, finalized, put_disabled, put_progress
from livessl.server.history.tables import events
from livessl.site.history_place import history_place
from livessl.site.models import Site

__all__ = ["CURE", "MAX_EVENTS_IN_MEMORY", "Cursor", "Finalized", "JsonObject", "Query", "Store", "StoreError"]

JsonObject = dict[str, Any]

MAX_EVENTS_IN_MEMORY: Final = 10_000
"""Most events kept in memory, about 10 MB, and most entries of the journal; a database on a disk has no such limit."""

SCANNED_AT_ONCE: Final = 1000
"""Events that an export reads at a time."""

_log = logging.getLogger(__name__)


class Store:
    """Keeps events, and what a restarted server must know; every thread may call it.

    Every method that reads or writes raises `StoreError` if the database cannot be used. What must not wait for a
    database goes through `backlog`; what is read includes what was put there before, unless the database fails.

    Parameters
    ----------
    place : Path, str or None
        The SQLite file, or the URL of a PostgreSQL database; None keeps the newest `MAX_EVENTS_IN_MEMORY` in memory.
    forwards : bool
        Whether it has the tables of `livessl.server.forwarding`, and puts final events into the outbox of a hub.
    tile : Tile or None
        Chooses the events for the hub in a hall of several servers; None if all are sent.

    Raises
    ------
    StoreError
        If the file cannot be used. A PostgreSQL server that cannot be reached is tried again later.
    ConfigError
        If the driver of PostgreSQL is not installed.
    """

    def __init__(self, place: Path | str | None = None, *, forwards: bool = False, tile: Tile | None = None) -> None:
        self._bounded = place is None
        self._count = EventCount()
        self._when_ready: deque[Callable[[], None]] = deque()
        self._database = Database(place, (forwarding.prepare,) if forwards else ())
        self.outbox = Outbox(self._database, tile) if forwards else None
        """Messages for the hub; None for a site without one."""
        self.backlog = Backlog(self.prepare)
        """Events that wait to be stored."""
        try:
            self.prepare()
        except StoreError as error:
            if not self._database.is_remote:
                self._database.close()
                raise
            self.backlog.is_failing = True
            _log.error("%s; events are kept in memory until then", error)

    @classmethod
    def of(cls, site: Site) -> Store:
        """Return the store that a site file names."""
        return cls(history_place(site), forwards=site.server.hub is not None, tile=Tile.of(site))

    @property
    def database(self) -> Database:
        """The database, for what else is kept in it."""
        return self._database

    @property
    def is_durable(self) -> bool:
        """True if what it has outlives the server."""
        return not self._bounded

    @property
    def problem(self) -> str | None:
        """Reason why the database has been unusable since the start, as PostgreSQL may be; None otherwise."""
        return self._database.problem

    @property
    def cure(self) -> str:
        """The cure of a database that cannot be written."""
        return self._database.cure

    def prepare(self) -> None:
        """Make or migrate the tables, unless that is done, and do what waits for them."""
        if self._database.prepare():
            with suppress(StoreError):  # only the metrics want the number: nothing must wait for it
                self._count.take(self._database)
        while self._when_ready:
            self._when_ready[0]()
            self._when_ready.popleft()  # not before it is done: an error leaves it for the next time

    def when_ready(self, work: Callable[[], None]) -> None:
        """Have something done as soon as a database that cannot be used now can be used, on any thread."""
        self._when_ready.append(work)

    def add(self, event: JsonObject, time_ns: int, *, early: bool = False) -> None:
        """Store an event, replacing one of the same id; an early event stays early until `finalize` passes its time."""
        with self._database.writing(f"store event {event['id']!r}") as connection:
            change = records.put_events(connection, [(event, time_ns)])
            if early:
                records.put_early(connection, event["id"])
            if self._bounded:
                change -= records.keep_newest(connection, MAX_EVENTS_IN_MEMORY)
        self._count.change(change)

    def add_all(self, given: Sequence[tuple[JsonObject, int]]) -> None:
        """Store many events, each with its start, all or nothing."""
        with self._database.writing(f"store {len(given)} events") as connection:
            change = records.put_events(connection, given)
            if self._bounded:
                change -= records.keep_newest(connection, MAX_EVENTS_IN_MEMORY)
        self._count.change(change)

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
        """
        with self._database.writing(f"store {len(events)} events") as connection:
            change = -records.remove_events(connection, replaced)
            change += records.put_events(connection, events)
            if self._bounded:
                change -= records.keep_newest(connection, MAX_EVENTS_IN_MEMORY)
            kept = records.end_early(connection, frame_index)
            put_progress(connection, site, frame_index, clocks)
            if self.outbox is not None:
                self.outbox.put_final_with(connection, events, kept)
        self._count.change(change)
        if self.outbox is not None:
            self.outbox.wake()

    def finalized(self, site: str) -> Finalized:
        """Return how far the final pass of the site has come."""
        self.backlog.settle()
        with self._database.reading() as connection:
            return finalized(connection, site)

    def disabled(self, site: str) -> frozenset[str]:
        """Return the names of the site's disabled arrays."""
        with self._database.reading() as connection:
            return disabled_arrays(connection, site)

    def enable(self, site: str, array: str, enabled: bool) -> None:
        """Remember whether an array is enabled."""
        with self._database.writing(f"store the state of array {array!r}") as connection:
            put_disabled(connection, site, array, is_disabled=not enabled)

    def early_events(self) -> list[tuple[int, JsonObject]]:
        """Return the events that are still early, oldest first, each with its start in nanoseconds of site time."""
        self.backlog.settle()
        with self._database.reading() as connection:
            return records.early_events(connection)

    def expire(self, before_ns: int, end: threading.Event | None = None) -> int:
        """Delete the events and entries of before a time; return the number of the events. See `delete_older`."""
        end = threading.Event() if end is None else end
        return delete_older(self._database, self.backlog, self.outbox, self._count, before_ns, end)

    def get(self, event_id: str) -> JsonObject | None:
        """Return the event of that id, None if there is none."""
        if "\0" in event_id:  # PostgreSQL cannot compare it
            return None
        self.backlog.settle()
        with self._database.reading() as connection:
            body = connection.execute(select(events.c.body).where(events.c.id == event_id)).scalar()
        return None if body is None else dict(orjson.loads(body))

    def page(self, query: Query) -> Page:
        """Return a page of events, newest first by their start, with the cursors of its neighbours."""
        self.backlog.settle()
        with self._database.reading() as connection:
            return event_page(connection, query)

    def log(self, query: Query, after: LogPosition | None) -> LogPage:
        """Return the events that were stored after a position; see `log_page`."""
        self.backlog.settle()
        kept = MAX_EVENTS_IN_MEMORY if self._bounded else None
        with self._database.reading() as connection:
            return log_page(connection, query, after, kept)

    def find(self, query: Query) -> tuple[list[JsonObject], Cursor | None]:
        """Return events, newest first unless the query says otherwise, and the cursor of the next page or None."""
        page = self.page(query)
        return [row.event for row in page.rows], page.older

    def scan(self, query: Query) -> Iterator[Sequence[Row]]:
        """Yield all events that a query admits, newest first, a page at a time; between pages nothing is locked."""
        following: Query | None = replace(query, limit=SCANNED_AT_ONCE)
        while following is not None:
            page = self.page(following)
            if page.rows:
                yield page.rows
            following = None if page.older is None else replace(following, before=page.older)

    def heat_map(self, query: Query, cells: Cells) -> HeatMap:
        """Return how many of the events that a query admits lie in each cell of a floor plan."""
        self.backlog.settle()
        with self._database.reading() as connection:
            return count_by_cell(connection, query, cells)

    def note(self, entry: Entry) -> None:
        """Store an entry of the journal, unless one of its key is stored."""
        with self._database.writing(f"store entry {entry.key!r} of the journal") as connection:
            put_entry(connection, entry)
            if self._bounded:
                keep_newest_entries(connection, MAX_EVENTS_IN_MEMORY)

    def journal(self, query: JournalQuery) -> JournalPage:
        """Return a page of the journal, newest first."""
        self.backlog.settle()
        with self._database.reading() as connection:
            return journal_page(connection, query)

    def count(self) -> int | None:
        """Return the number of events; None if they could not be counted when the database was opened."""
        return self._count.number

    def close(self) -> None:
        """Write what waits, and release the database."""
        self.backlog.stop()
        self._database.close()
