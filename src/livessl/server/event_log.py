"""Decides which events are published and stored, and which early event a final one replaces.

The order in which events were stored, for clients that resume, is in `history/log.py`.

It works on values. The JSON of an event is made once, by `server.api.encode`, when the event is published and stored.
It is read again only from the store, at the beginning of a live run.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol, Self

import orjson

from livessl.clock import Clock
from livessl.core.stream.final_pass import FinalResults
from livessl.core.types import FRAME_NS, Event
from livessl.server.api.encode import JsonObject, Messages, Stages, where
from livessl.server.event_traces import EventTraces
from livessl.server.history.backlog import Write
from livessl.server.latency import Latency
from livessl.server.store import Finalized, Store, StoreError

_log = logging.getLogger(__name__)


class Watcher(Protocol):
    """Gets the events of live runs, on the fusion thread, after the store."""

    def take_early(self, event: JsonObject, time_ns: int) -> None:
        """Take in an event that may still be replaced, and its start in nanoseconds of site time."""
        ...

    def take_final(self, events: Sequence[tuple[JsonObject, int]], until: int) -> None:
        """Take in final events with their starts, and the frame index before which all events are final."""
        ...


class Answer(NamedTuple):
    """Values of an event, rounded as they are published. A final event with the same values is not published again."""

    start_us: int
    duration_s: float
    position_m: list[float] | None
    covariance_m2: list[list[float]] | None
    confidence: float
    arrays: list[str]
    status: str

    @classmethod
    def of(cls, event: Event) -> Self:
        """Return the answer of an event."""
        return cls(event.start_ns // 1000, round(event.duration_s, 6), *where(event.estimate), str(event.status))

    @classmethod
    def restored(cls, start_ns: int, message: JsonObject) -> Self:
        """Return the answer of an event that was published before the server's restart."""
        return cls(start_ns // 1000, *(message[name] for name in cls._fields[1:]))


@dataclass(frozen=True, slots=True)
class EarlyEvent:
    """An event that was published and stored before all of its sound had arrived; a final one may replace it.

    Parameters
    ----------
    id : str
    start_ns, end_ns : int
        Site time.
    source : int
        1; or 2 for the second of two simultaneous sources.
    answer : Answer
    message : JsonObject
        The event as it was published and stored.
    """

    id: str
    start_ns: int
    end_ns: int
    source: int
    answer: Answer
    message: JsonObject

    @classmethod
    def of(cls, event: Event, message: JsonObject) -> Self:
        """Return the early event that was published by this message."""
        return cls(event.id, event.start_ns, event.end_ns, event.source, Answer.of(event), message)

    @classmethod
    def restored(cls, start_ns: int, message: JsonObject) -> Self:
        """Return an early event of before the server's restart, from its row in the store."""
        end_ns = start_ns + round(message["duration_s"] * 1e9)
        answer = Answer.restored(start_ns, message)
        return cls(message["id"], start_ns, end_ns, message.get("source", 1), answer, message)

    def successor(self, events: Sequence[Event]) -> Event | None:
        """Return the event that overlaps this one in time; of two simultaneous sources, the one of the same number."""
        overlapping = [event for event in events if event.start_ns < self.end_ns and self.start_ns < event.end_ns]
        same_source = (event for event in overlapping if event.source == self.source)
        return next(same_source, overlapping[0] if overlapping else None)


class EventLog:
    """Publishes and stores early and final events. For the fusion thread; every thread may read the counters.

    Parameters
    ----------
    site : str
        Name of the site.
    clock : Clock
    store : Store
    latency : Latency
        Measures the latency of events.
    publish : callable
        Gets the message of every event.
    watcher : Watcher or None
        Gets all events of live runs, also those that are not published again.
    traces : EventTraces or None
        Adds spans of the events of live runs; None if nothing is traced.
    """

    def __init__(
        self,
        site: str,
        clock: Clock,
        store: Store,
        latency: Latency,
        publish: Callable[[JsonObject], None],
        watcher: Watcher | None = None,
        traces: EventTraces | None = None,
    ) -> None:
        self._traces = traces
        self._site = site
        self._clock = clock
        self._store = store
        self._latency = latency
        self._publish = publish
        self._watcher = watcher
        self._is_replay = False
        self._early: list[EarlyEvent] = []
        self.published = 0
        """Events published since the start."""

    @property
    def is_saved(self) -> bool:
        """True if the store has taken all final events; until then no node may forget their frames."""
        return self._store.backlog.is_saved

    @property
    def unsaved(self) -> int:
        """Events that wait for the store to take them."""
        return self._store.backlog.unsaved

    @property
    def discarded(self) -> int:
        """Events given up because the store did not take them."""
        return self._store.backlog.discarded

    @property
    def discarded_others(self) -> int:
        """Entries of the journal, and messages for the hub, given up because the store did not take them."""
        return self._store.backlog.discarded_others

    def begin_live(self) -> Finalized:
        """Begin a live run where the last one stopped: restore its early events, and return how far it came."""
        self._is_replay = False
        try:
            self._early = [EarlyEvent.restored(start_ns, row) for start_ns, row in self._store.early_events()]
            return self._store.finalized(self._site)
        except StoreError as error:  # early events are then published anew instead of replaced
            _log.error("%s", error)
            self._early = []
            return Finalized(None, None)

    def begin_replay(self) -> None:
        """Begin a replay: its events replace nothing."""
        self._is_replay = True
        self._early = []

    def add_early(self, event: Event, messages: Messages) -> None:
        """Publish an event that cannot wait for an array that is late or away."""
        stages = self._stages(event)
        message = messages.event(event, stages)
        self._add(message, event.start_ns, early=True)
        if not self._is_replay:
            self._remember(EarlyEvent.of(event, message))
        if self._watcher is not None and not self._is_replay:
            self._watcher.take_early(message, event.start_ns)
        self._publish_event(message, event, stages)

    def add_final(self, results: FinalResults, messages: Messages, clocks: JsonObject) -> None:
        """Store final events in place of the early ones, then publish those that are new or have changed.

        Parameters
        ----------
        results : FinalResults
        messages : Messages
        clocks : JsonObject
            What is known of the arrays' clocks, to which the frame indices of their nodes refer.
        """
        if self._is_replay:
            self._add_replayed(results.events, messages)
            return
        before = [early for early in self._early if early.start_ns < results.until * FRAME_NS]
        successors = [(early, early.successor(results.events)) for early in before]
        known = {early.id: early for early in before}
        rows: list[tuple[JsonObject, int]] = []
        news: list[tuple[JsonObject, Event, Stages | None]] = []
        for event in results.events:
            replaces = [early.id for early, successor in successors if successor is event and early.id != event.id]
            same = known.get(event.id)
            if same is not None and not replaces and same.answer == Answer.of(event):
                rows.append((same.message, event.start_ns))
                continue
            stages = None if event.late or before else self._stages(event)
            message = messages.event(event, stages, replaces)
            rows.append((message, event.start_ns))
            news.append((message, event, stages))
        replaced = [early.id for early, successor in successors if successor is not None]
        done = {event.id for event in results.events} | {early.id for early in before}
        self._early = [early for early in self._early if early.id not in done]
        # bytes need less memory than the values, and thousands may wait for a database
        until, kept = results.until, orjson.dumps(clocks)
        bodies = [(orjson.dumps(message), time_ns) for message, time_ns in rows]

        def store() -> None:
            final = [(orjson.loads(body), time_ns) for body, time_ns in bodies]
            self._store.finalize(self._site, final, replaced, until, orjson.loads(kept))

        nbytes = len(kept) + sum(len(body) for body, _ in bodies)
        self._write(Write(store, len(rows), is_final=True, nbytes=nbytes))
        if self._watcher is not None:
            self._watcher.take_final(rows, results.until)
        for message, event, stages in news:
            self._publish_event(message, event, stages, first=event.id not in known)

    def retry(self) -> None:
        """Offer the store what it has not taken yet, if it is time to."""
        self._store.backlog.retry(self._clock.monotonic_ns())

    def _remember(self, early: EarlyEvent) -> None:
        others = [other for other in self._early if other.id != early.id]
        self._early = sorted([*others, early], key=lambda each: each.start_ns)

    def _add_replayed(self, events: Sequence[Event], messages: Messages) -> None:
        for event in events:
            message = messages.event(event)
            self._add(message, event.start_ns)
            self._publish_event(message, event, None)

    def _add(self, message: JsonObject, time_ns: int, *, early: bool = False) -> None:
        """Have an early event stored, or one of a replay."""
        body = orjson.dumps(message)

        def store() -> None:
            self._store.add(orjson.loads(body), time_ns, early=early)

        self._write(Write(store, 1, is_final=False, nbytes=len(body)))

    def _write(self, write: Write) -> None:
        """Have something stored, without waiting for it while the server runs."""
        self._store.backlog.put(write, self._clock.monotonic_ns())

    def _publish_event(self, message: JsonObject, event: Event, stages: Stages | None, *, first: bool = True) -> None:
        self.published += 1
        if self._traces is None or self._is_replay:
            self._publish(message)
            return
        began_ns = self._clock.now_ns()
        self._publish(message)
        self._traces.published(event, stages, began_ns, self._clock.now_ns(), first=first)

    def _stages(self, event: Event) -> Stages | None:
        """Return the stages of an event's latency; None in a replay, whose sounds are long past."""
        return None if self._is_replay else self._latency.located(event)
