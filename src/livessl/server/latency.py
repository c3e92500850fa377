"""Measures latency from the sound to a client's socket, by stages, in histograms.

The latency begins at the earliest time at which a result can be known: the end of the window or, for an event, the end
of the quiet that ends it. Time before that is not a delay of this system.
"""

from __future__ import annotations

from collections import deque
from typing import Final, NamedTuple

from prometheus_client import Histogram

from livessl.clock import Clock
from livessl.core.types import FRAME_NS, Event, Update
from livessl.server.api.encode import JsonObject, Stages

KEPT: Final = 1200
"""Number of frame indices whose arrival is remembered: one minute."""

BUCKETS_S: Final = (
    0.001, 0.002, 0.003, 0.005, 0.0075, 0.01, 0.015, 0.02, 0.025, 0.03, 0.04, 0.05, 0.06, 0.08,
    0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.75, 1.0, 2.0, 5.0, 10.0,
)  # fmt: skip
"""Upper bounds of the histograms' buckets, seconds: finest around 20 ms, which a live answer takes."""

DELIVERED: Final = "delivered"
TOTAL: Final = "total"


class Arrival(NamedTuple):
    """Site times at which a message was sent, by its node's clock, and received, by the server's."""

    sent_ns: int
    received_ns: int


class Arrivals:
    """The last arrival of each frame index. The receiver's thread writes, the fusion thread reads."""

    def __init__(self) -> None:
        self._last: dict[int, Arrival] = {}
        self._order: deque[int] = deque()

    def note(self, frame_index: int, arrival: Arrival) -> None:
        """Note that a message of that frame index has arrived."""
        if frame_index not in self._last:
            self._order.append(frame_index)
            if len(self._order) > KEPT:
                del self._last[self._order.popleft()]
        self._last[frame_index] = arrival

    def stages(self, answer: Update | Event, located_ns: int) -> Stages | None:
        """Return the time of each stage for a result that was located at site time `located_ns`.

        Return None if the arrival of the last frame index of the result is not known.
        """
        arrival = self._last.get(answer.complete_ns // FRAME_NS - 1)
        if arrival is None or not arrival.sent_ns:
            return None
        end_ns = answer.end_ns if isinstance(answer, Event) else answer.complete_ns
        return Stages(
            waited=(answer.complete_ns - end_ns) / 1e9,
            sent=(arrival.sent_ns - answer.complete_ns) / 1e9,
            received=(arrival.received_ns - arrival.sent_ns) / 1e9,
            located=(located_ns - arrival.received_ns) / 1e9,
        )


class Latency:
    """The histograms of latency. Every thread may call it.

    Parameters
    ----------
    clock : Clock
    arrivals : Arrivals
    """

    def __init__(self, clock: Clock, arrivals: Arrivals) -> None:
        self._clock = clock
        self._arrivals = arrivals
        self.histogram = Histogram(
            "livessl_latency_seconds",
            "From the end of a window (an event's: of the quiet that ends it) until sent by the node, from there until "
            "received by the server, located, delivered to a client's socket; total is their sum.",
            ["kind", "stage"],
            buckets=BUCKETS_S,
            registry=None,
        )
        self._stages = {
            (kind, stage): self.histogram.labels(kind, stage)
            for kind in ("update", "event")
            for stage in ("sent", "received", "located", DELIVERED, TOTAL)
        }

    def located(self, answer: Update | Event) -> Stages | None:
        """Count a result that was located now; return the time of each stage, or None if it is not known."""
        stages = self._arrivals.stages(answer, self._clock.now_ns())
        if stages is not None:
            kind = "event" if isinstance(answer, Event) else "update"
            for stage in ("sent", "received", "located"):
                self._stages[kind, stage].observe(getattr(stages, stage))
        return stages

    def delivered(self, message: JsonObject, seconds: float) -> None:
        """Count a result that a client's socket accepted `seconds` after it was published."""
        stages = message["latency_stages_s"]
        self._stages[message["kind"], DELIVERED].observe(seconds)
        self._stages[message["kind"], TOTAL].observe(stages["sent"] + stages["received"] + stages["located"] + seconds)
