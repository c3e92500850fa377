"""A bounded queue of events that wait for the rules of alerts; what finds no room is read from the store later."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

from livessl.core.types import FRAME_NS
from livessl.server.alerts.history import past_pages
from livessl.server.api.encode import JsonObject
from livessl.server.store import Store

MAX_QUEUE: Final = 1000
"""Largest number of batches of events that wait to be judged. It is reached only if the outbox's disk is full for
hours."""


class Batch(NamedTuple):
    """Events with their starts; for final ones, the site time before which all events are final, otherwise None."""

    events: Sequence[tuple[JsonObject, int]]
    until_ns: int | None


def final_until_ns(store: Store, site: str) -> int:
    """Return the site time before which the store has all final events; 0 if it has none yet."""
    until = store.finalized(site).until
    return 0 if until is None else until * FRAME_NS


class Backlog:
    """Takes events from the fusion thread, and passes them to another thread in order.

    Parameters
    ----------
    site : str
        Name of the site.
    store : Store
        Store from which final events are read that did not fit into the queue.
    """

    def __init__(self, site: str, store: Store) -> None:
        self._site = site
        self._store = store
        self._queue: deque[Batch] = deque()
        self._missed: tuple[int, int] | None = None  # site time from and before which events did not fit
        self._added_ns: int | None = None  # the earliest start of those that were missed since the last look
        self._missing = threading.Lock()
        self._changes: deque[tuple[JsonObject, int]] = deque()
        self.unqueued = 0
        """Events, and changes of tracks in zones, that did not fit into their queues."""

    def __len__(self) -> int:
        """Return the number of batches that wait."""
        return len(self._queue)

    def add_early(self, event: JsonObject, time_ns: int) -> None:
        """Queue an early event; without space it is dropped, because its final result follows."""
        if len(self._queue) < MAX_QUEUE:
            self._queue.append(Batch([(event, time_ns)], None))
        else:
            self.unqueued += 1

    def add_final(self, events: Sequence[tuple[JsonObject, int]], until_ns: int) -> None:
        """Queue final events, and the site time before which all events are final."""
        with self._missing:
            if self._missed is None and len(self._queue) < MAX_QUEUE:
                self._queue.append(Batch(events, until_ns))
                return
            # and so on until the missed ones are judged, so that all are judged in order
            self.unqueued += len(events)
            first_ns = min((time_ns for _, time_ns in events), default=until_ns)
            since_ns, newest_ns = (first_ns, until_ns) if self._missed is None else self._missed
            self._missed = min(first_ns, since_ns), max(until_ns, newest_ns)
            self._added_ns = first_ns if self._added_ns is None else min(first_ns, self._added_ns)

    def add_change(self, change: JsonObject, time_ns: int) -> None:
        """Queue a change of a track in a zone, and its site time; without space it is dropped."""
        if len(self._changes) < MAX_QUEUE:
            self._changes.append((change, time_ns))
        else:
            self.unqueued += 1

    def work_off_changes(self, judge: Callable[[Sequence[tuple[JsonObject, int]]], None]) -> None:
        """Pass all waiting changes of tracks to `judge` together; if it raises an error, they remain in the queue."""
        waiting = list(self._changes)
        if waiting:
            judge(waiting)
        for _ in waiting:
            self._changes.popleft()

    def work_off(self, judge: Callable[[Batch], None]) -> None:
        """Pass all waiting batches to `judge`, oldest first; if it raises an error, that batch and the rest remain.

        Events that did not fit and that the store does not have yet, because its disk is full or its file is locked,
        remain as well.
        """
        while self._queue:
            judge(self._queue[0])
            self._queue.popleft()
        while self._missed is not None:
            with self._missing:
                (since_ns, newest_ns), self._added_ns = self._missed, None
            before_ns = min(newest_ns, final_until_ns(self._store, self._site))
            if before_ns <= since_ns < newest_ns:
                return
            for page, until_ns in past_pages(self._store, since_ns, before_ns):
                judge(Batch(page, until_ns))
            with self._missing:
                newest_ns = self._missed[1]
                since_ns = before_ns if self._added_ns is None else min(before_ns, self._added_ns)
                self._missed = (since_ns, newest_ns) if since_ns < newest_ns else None
