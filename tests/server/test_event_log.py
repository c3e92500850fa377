"""Early and final events: what is published again, what replaces what, and what a failing store costs."""

from __future__ import annotations

import gc
import weakref
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from world_parts import START, HandClock

from livessl.core.stream.final_pass import FinalResults
from livessl.core.types import FRAME_NS, Estimate, Event, Status
from livessl.server.api.encode import JsonObject, Messages
from livessl.server.event_log import EventLog
from livessl.server.history.backlog import MAX_UNSAVED, RETRY_NS
from livessl.server.latency import Arrivals, Latency
from livessl.server.store import Query, Store, StoreError
from small_site import site_of

SITE = site_of()
MESSAGES = Messages(SITE, 0, utc=True)
CLOCKS = {"b": 0.15}


class FullStore(Store):
    """A store on a disk that may be full."""

    full = False

    def add(self, event: JsonObject, time_ns: int, *, early: bool = False) -> None:
        self._refuse()
        super().add(event, time_ns, early=early)

    def finalize(self, *arguments: Any) -> None:
        self._refuse()
        super().finalize(*arguments)

    def _refuse(self) -> None:
        if self.full:
            raise StoreError("disk full")


class Desk:
    """An event log with all that it needs; a second one on the same store is the server after a restart."""

    def __init__(self, store: FullStore | None = None) -> None:
        self.clock = HandClock()
        self.store = FullStore() if store is None else store
        self.published: list[JsonObject] = []
        latency = Latency(self.clock, Arrivals())
        self.log = EventLog(SITE.site, self.clock, self.store, latency, self.published.append)
        self.restored = self.log.begin_live()

    def finish(self, events: Sequence[Event], until: int = START + 1000) -> None:
        self.log.add_final(FinalResults(tuple(events), until), MESSAGES, CLOCKS)

    @property
    def stored(self) -> list[JsonObject]:
        events, _ = self.store.find(Query(limit=1000))
        return events[::-1]


def event(first: int, last: int, *, id: str | None = None, x_m: float = 1.23456789, source: int = 1) -> Event:  # noqa: A002
    """Return an event over these frame indices after the start, both included."""
    start_ns, end_ns = (START + first) * FRAME_NS, (START + last + 1) * FRAME_NS
    estimate = Estimate(start_ns, np.array([x_m, 2.0, 1.0]), np.eye(3) / 3, 0.9, ("north",))
    name = f"small-{first}" if id is None else id
    return Event(
        name, start_ns, end_ns, Status.LOCATED, None, estimate, 0.01, "onset", source=source, complete_ns=end_ns
    )


def restarted(desk: Desk, restart: bool) -> Desk:
    return Desk(desk.store) if restart else desk


@pytest.mark.parametrize("restart", [False, True])
def test_final_event_with_the_same_answer_is_not_published_again(restart: bool) -> None:
    early = event(10, 19)
    desk = Desk()
    desk.log.add_early(early, MESSAGES)
    [published] = desk.published
    later = restarted(desk, restart)
    later.finish([replace(event(10, 19, x_m=1.23456), power=0.02)])  # differs by less than is published
    assert desk.published == [published]
    assert later.published == ([] if restart else [published])
    assert later.stored == [published]
    assert later.store.early_events() == []


@pytest.mark.parametrize("restart", [False, True])
@pytest.mark.parametrize(
    "final",
    [event(10, 19, x_m=1.3), event(10, 20), replace(event(10, 19), status=Status.REFUSED, estimate=None)],
    ids=["place", "length", "status"],
)
def test_final_event_with_another_answer_is_published_under_its_id(final: Event, restart: bool) -> None:
    desk = Desk()
    desk.log.add_early(event(10, 19), MESSAGES)
    later = restarted(desk, restart)
    later.finish([final])
    assert [message["id"] for message in later.published] == ["small-10"] * (1 if restart else 2)
    assert later.published[-1]["replaces"] == []  # it has the same id
    assert later.stored == [later.published[-1]]


@pytest.mark.parametrize("restart", [False, True])
def test_final_event_replaces_the_early_ones_that_it_overlaps(restart: bool) -> None:
    desk = Desk()
    for early in (event(10, 19), event(25, 29), event(50, 59)):
        desk.log.add_early(early, MESSAGES)
    later = restarted(desk, restart)
    later.finish([event(9, 29), event(30, 39)])
    first, second = later.published[-2:]
    assert (first["id"], first["replaces"]) == ("small-9", ["small-10", "small-25"])
    assert (second["id"], second["replaces"]) == ("small-30", [])  # touches one, and overlaps none
    assert [message["id"] for message in later.stored] == ["small-9", "small-30", "small-50"]


def test_of_two_sources_each_replaces_its_own() -> None:
    desk = Desk()
    desk.log.add_early(event(10, 19, id="a"), MESSAGES)
    desk.log.add_early(event(10, 19, id="a-2", source=2), MESSAGES)
    desk.finish([event(9, 19, id="b"), event(9, 19, id="b-2", source=2)])
    assert [(m["id"], m["replaces"]) for m in desk.published[-2:]] == [("b", ["a"]), ("b-2", ["a-2"])]


def test_early_event_beyond_the_final_pass_may_still_be_replaced() -> None:
    desk = Desk()
    desk.log.add_early(event(10, 19), MESSAGES)
    desk.log.add_early(event(50, 59), MESSAGES)
    desk.finish([event(10, 19)], until=START + 40)
    assert [start_ns for start_ns, _ in desk.store.early_events()] == [(START + 50) * FRAME_NS]
    desk.finish([event(49, 59)], until=START + 80)
    assert desk.published[-1]["replaces"] == ["small-50"]


def test_live_run_goes_on_where_the_last_one_stopped() -> None:
    desk = Desk()
    assert desk.restored == (None, None)
    desk.finish([event(10, 19)], until=START + 40)
    assert Desk(desk.store).restored == (START + 40, CLOCKS)


def test_full_disk_delays_what_is_stored_and_not_what_is_published(caplog: pytest.LogCaptureFixture) -> None:
    desk = Desk()
    desk.store.full = True
    desk.finish([event(10, 19), event(30, 39)], until=START + 40)
    desk.finish([event(50, 59)], until=START + 60)
    assert len(desk.published) == desk.log.published == 3
    assert (desk.log.is_saved, desk.log.unsaved, desk.log.discarded, desk.stored) == (False, 3, 0, [])
    assert "disk full" in caplog.text
    desk.store.full = False
    desk.log.retry()  # too early
    assert desk.log.unsaved == 3
    desk.clock.time_ns += RETRY_NS
    desk.log.retry()
    assert (desk.log.is_saved, desk.log.unsaved, desk.log.discarded) == (True, 0, 0)
    assert desk.stored == desk.published


def test_early_event_that_waits_for_the_disk_holds_no_more_than_its_message() -> None:
    desk, early = Desk(), event(10, 19)
    assert early.estimate is not None
    position = weakref.ref(early.estimate.position_m)
    desk.store.full = True
    desk.log.add_early(event(30, 39), MESSAGES)  # the log keeps the first error, whose traceback has its event
    desk.log.add_early(early, MESSAGES)
    del early
    gc.collect()
    assert (desk.log.unsaved, position()) == (2, None)


def test_events_beyond_the_limit_are_given_up_and_counted() -> None:
    desk = Desk()
    desk.store.full = True
    sizes = [MAX_UNSAVED // 2, MAX_UNSAVED // 2, 1]
    for first, last in pairwise(np.cumsum([0, *sizes])):
        desk.finish([event(10 * int(n), 10 * int(n) + 5) for n in range(first, last)], until=START + 10 * int(last))
    assert desk.log.discarded == sizes[0]
    assert desk.log.unsaved == sizes[1] + 1
    assert desk.log.published == sum(sizes)


def test_early_event_that_waits_for_the_disk_is_replaced_like_others() -> None:
    desk = Desk()
    desk.store.full = True
    desk.log.add_early(event(10, 19), MESSAGES)
    assert (desk.log.is_saved, desk.log.unsaved) == (True, 1)  # its frames are kept until its final event is stored
    desk.finish([event(10, 19)])
    desk.store.full = False
    desk.clock.time_ns += RETRY_NS
    desk.log.retry()
    assert [message["id"] for message in desk.published] == ["small-10"]
    assert desk.stored == desk.published
    assert desk.store.early_events() == []


def test_replayed_events_replace_nothing_and_hold_back_no_frames() -> None:
    desk = Desk()
    desk.log.begin_replay()
    desk.log.add_early(event(10, 19), MESSAGES)
    desk.finish([event(9, 19)])
    assert [message["replaces"] for message in desk.published] == [[], []]
    desk.store.full = True
    desk.finish([event(30, 39)])
    assert (desk.log.is_saved, desk.log.unsaved) == (True, 1)
    assert len(desk.published) == 3
    assert desk.restored == Desk(desk.store).restored  # a replay does not move the final pass
