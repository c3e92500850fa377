"""Stages of latency: they add up, and are those of the message that arrived last."""

from __future__ import annotations

import numpy as np
import pytest
from prometheus_client import CollectorRegistry

from livessl.clock import UnpacedClock
from livessl.core.types import FRAME_NS, Estimate, Event, Status, Update
from livessl.server.api.encode import Messages, Stages
from livessl.server.latency import KEPT, Arrival, Arrivals, Latency
from small_site import site_of

FRAME_INDEX = 34_000_000_000
END_NS = (FRAME_INDEX + 1) * FRAME_NS
ESTIMATE = Estimate(END_NS - 2 * FRAME_NS, np.ones(3), np.eye(3), 0.5, ("north",))
UPDATE = Update("small-1", Status.LOCATED, ESTIMATE, 0.01, (), END_NS)
BEGUN_NS, ENDED_NS = END_NS - 10 * FRAME_NS, END_NS - 6 * FRAME_NS
EVENT = Event("small-1", BEGUN_NS, ENDED_NS, Status.LOCATED, None, ESTIMATE, 0.01, "x", complete_ns=END_NS)
MS = 1_000_000


def test_stages_are_those_of_the_message_that_arrived_last() -> None:
    arrivals = Arrivals()
    arrivals.note(FRAME_INDEX, Arrival(END_NS + 3 * MS, END_NS + 4 * MS))
    arrivals.note(FRAME_INDEX, Arrival(END_NS + 10 * MS, END_NS + 11 * MS))
    arrivals.note(FRAME_INDEX + 1, Arrival(END_NS + 60 * MS, END_NS + 61 * MS))
    stages = arrivals.stages(UPDATE, END_NS + 15 * MS)
    assert stages is not None
    assert (stages.waited, stages.sent, stages.received, stages.located) == pytest.approx((0.0, 0.010, 0.001, 0.004))
    assert stages.total == stages.ours == pytest.approx(0.015)


def test_quiet_that_ends_an_event_is_not_counted_as_delay() -> None:
    arrivals = Arrivals()
    arrivals.note(FRAME_INDEX, Arrival(END_NS + 2 * MS, END_NS + 3 * MS))
    stages = arrivals.stages(EVENT, END_NS + 7 * MS)
    assert stages is not None
    assert (stages.waited, stages.sent, stages.received, stages.located) == pytest.approx((0.3, 0.002, 0.001, 0.004))
    assert stages.total == pytest.approx(0.307)
    assert stages.ours == pytest.approx(0.007)


def test_stages_are_unknown_without_a_time_stamp() -> None:
    arrivals = Arrivals()
    assert arrivals.stages(UPDATE, END_NS) is None
    arrivals.note(FRAME_INDEX, Arrival(0, END_NS))  # a sender that does not say
    assert arrivals.stages(UPDATE, END_NS) is None
    arrivals.note(FRAME_INDEX, Arrival(END_NS, END_NS))
    assert arrivals.stages(UPDATE, END_NS) is not None


def test_old_arrivals_are_forgotten() -> None:
    arrivals = Arrivals()
    for frame_index in range(FRAME_INDEX, FRAME_INDEX + KEPT):
        arrivals.note(frame_index, Arrival(END_NS, END_NS))
    assert arrivals.stages(UPDATE, END_NS) is not None
    arrivals.note(FRAME_INDEX + KEPT, Arrival(END_NS, END_NS))
    assert arrivals.stages(UPDATE, END_NS) is None


def test_histograms_hold_each_stage_and_the_sum() -> None:
    arrivals = Arrivals()
    arrivals.note(FRAME_INDEX, Arrival(END_NS + 10 * MS, END_NS + 11 * MS))
    latency = Latency(UnpacedClock(END_NS + 15 * MS), arrivals)
    stages = latency.located(EVENT)
    assert stages == Stages(waited=0.3, sent=0.010, received=0.001, located=0.004)
    message = Messages(site_of(), 0, utc=True).event(EVENT, stages)
    for seconds in (0.005, 0.002):  # to two clients
        latency.delivered(message, seconds)
    registry = CollectorRegistry()
    registry.register(latency.histogram)

    def sample(what: str, stage: str, kind: str = "event") -> float | None:
        return registry.get_sample_value(f"livessl_latency_seconds_{what}", {"kind": kind, "stage": stage})

    assert [sample("count", stage) for stage in ("sent", "received", "located")] == [1, 1, 1]
    assert [sample("count", stage) for stage in ("delivered", "total")] == [2, 2]
    assert sample("sum", "sent") == pytest.approx(0.010)
    assert sample("sum", "delivered") == pytest.approx(0.007)
    assert sample("sum", "total") == pytest.approx(0.020 + 0.017)
    assert sample("count", "total", "update") == 0
