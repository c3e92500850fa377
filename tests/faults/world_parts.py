"""Parts of a simulated world that know nothing of it: its clock, the server's socket, and a store that dies."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np

from livessl import wire
from livessl.core.locate.estimator import Localization, PowerMaps, Sound
from livessl.core.types import FRAME_NS, BackfillRequest, Evidence
from livessl.server.ingest import Ingest
from livessl.server.latency import Arrivals
from livessl.server.receiver import Greeted, Item, Joined, Left
from livessl.server.refusals import Refusals
from livessl.server.store import Store, StoreError
from livessl.site.models import Site

START = 20 * 1_767_225_600
"""Frame index at which every world begins."""

Event = dict[str, Any]


class Fingerprint:
    """Says a place that depends on every sample."""

    name = "fingerprint"

    def __init__(self, arrays: object, grid: object, c_m_s: float) -> None:
        pass

    def prepare(self, array: str, sample_rate_hz: float) -> None:
        pass

    def onset_front_end(self, array: str, sample_rate_hz: float) -> None:
        return None

    def locate(self, sounds: Mapping[str, Sound]) -> Localization:
        position = np.zeros(3)
        for k, name in enumerate(sorted(sounds)):
            for n, segment in enumerate(sounds[name].segments):
                ramp = np.arange(1, segment.shape[1] + 1) / 100.0
                position += (k + 1) * np.array([segment.sum(), (segment * ramp).sum() / (n + 1), segment.shape[1]])
        return Localization(position, 0.01 * np.eye(3), 0.5, ())

    def power_maps(self, evidence: Sequence[Evidence], separately: Collection[str] | None = None) -> PowerMaps:
        raise AssertionError("nobody looks at maps here")


class HandClock:
    """Time that the world moves; a stamp may be off."""

    def __init__(self) -> None:
        self.time_ns = START * FRAME_NS
        self.offset_ns = 0

    def now_ns(self) -> int:
        return self.time_ns + self.offset_ns

    def monotonic_ns(self) -> int:
        return self.time_ns

    def sleep_until_ns(self, time_ns: int) -> bool:
        raise AssertionError("nobody sleeps here")


class Post:
    """The receiver without its socket and thread."""

    endpoint = "nowhere"
    delay_s = 0.0

    def __init__(self, site: Site, clock: HandClock) -> None:
        self.ingest = Ingest(site)
        self.arrivals = Arrivals()
        self.refusals = Refusals(clock)
        self.enrolled: list[str] = []
        self.failure: BaseException | None = None
        self.queue: deque[Item] = deque()
        self._clock = clock

    def start(self) -> None:
        """There is no thread."""

    def stop(self) -> None:
        """There is no socket."""

    def request(self, request: BackfillRequest) -> None:
        raise AssertionError("no node here answers requests for missing frames")

    def take(self, most: int, wait_s: float) -> list[Item]:
        return [self.queue.popleft() for _ in range(min(most, len(self.queue)))]

    def receive(self, routing_id: bytes, data: bytes) -> list[tuple[bytes, wire.Ack]]:
        arrival = self.ingest.receive(routing_id, data, self._clock.monotonic_ns())
        if arrival.joined is not None:
            self.queue.append(Joined(arrival.joined))
        if arrival.greeted is not None:
            self.queue.append(Greeted(arrival.greeted))
        if arrival.left is not None:
            self.queue.append(Left(arrival.left))
        if arrival.message is not None:
            self.queue.append(arrival.message)
        return [] if arrival.reply is None else [(routing_id, arrival.reply)]

    def acknowledgements(self) -> list[tuple[bytes, wire.Ack]]:
        return self.ingest.acknowledgements(self._clock.monotonic_ns())


class DiedError(Exception):
    """The server died in the middle of something."""


class FragileStore(Store):
    """A store whose process may die just before or just after an event is kept, or whose disk is full."""

    def __init__(self) -> None:
        super().__init__(None)
        self.dies: str | None = None
        self.full = False

    def add(self, event: Event, time_ns: int, *, early: bool = False) -> None:
        if self.full:
            raise StoreError("disk full")
        super().add(event, time_ns, early=early)

    def finalize(self, *arguments: Any) -> None:
        if self.full:
            raise StoreError("disk full")
        if self.dies == "before":
            raise DiedError
        super().finalize(*arguments)
        if self.dies == "after":
            raise DiedError
