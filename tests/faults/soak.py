"""A day of a site with four arrays in some minutes: nodes, links, server, store and clients, in simulated time.

All of it is real but two things: what nodes send reaches the server without a socket, and its fusion is stepped from
here. Sounds are rendered once, segmented as a node does it, and come again and again; between them it is quiet.
"""

from __future__ import annotations

import asyncio
import gc
import os
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, ClassVar, NamedTuple, Self
from unittest.mock import patch

from crowd import Crowd
from mutation import mutated, originals
from players import CLIP, HOUR, PLACES, SECOND, SLOT, SOUNDS, Player, rendered_sounds, sound_of
from world import World
from world_parts import START, Event, Post

from livessl import wire
from livessl.clock import utc_ns
from livessl.core.types import FRAME_NS, Message
from livessl.server.app import Server
from livessl.server.latency import Arrival
from livessl.site.models import Site
from small_site import HANG_S, RATE_HZ, site_of

STRIDE = SECOND // 2
"""Intervals that pass at once in quiet."""


GROWTH = 0.05
"""Of the memory after the first hour, at most."""

REFERENCE_HOURS = 1.0
"""After so long everything has been used."""

AT_REST = 200
"""Frames that nodes keep at most while nobody is away: of the sound that goes on, and those on their way."""


RETENTION_S = 3600.0
"""Of events: so that what is kept of them is as much after an hour as after a day."""


def soak_site(directory: Path) -> Site:
    """Four arrays on four nodes in the small room, and a database that forgets."""
    data: dict[str, Any] = {
        "arrays": {
            array: {"geometry": {"tetrahedron": {"edge_m": 0.3}}, "position_m": place}
            for array, place in PLACES.values()
        },
        "nodes": {
            node: {"device": {"name": "x", "sample_rate_hz": RATE_HZ}, "arrays": {array: [1, 2, 3, 4]}}
            for node, (array, _) in PLACES.items()
        },
        "server.events_db": str(directory / "events.db"),
        "store.retention_days": RETENTION_S / 86_400.0,
    }
    return site_of(data)


class Sample(NamedTuple):
    """When it was taken, what memory there was, and how many frames the nodes kept for a server that waits."""

    hours: float
    resident_mb: float
    kept: int

    @property
    def at_rest(self) -> bool:
        """Whether no sound waits for an array that is away."""
        return self.kept < AT_REST


Tell = Callable[[Sample], None]


class _Post(Post):
    """As the receiver, its books on arrivals included."""

    def receive(self, routing_id: bytes, data: bytes) -> list[tuple[bytes, wire.Ack]]:
        before = len(self.queue)
        replies = super().receive(routing_id, data)
        if len(self.queue) > before and isinstance(item := self.queue[-1], Message):
            self.arrivals.note(item.frame_index, Arrival(wire.sent_ns(data), self._clock.now_ns()))
        return replies


class Soak(World):
    """The site, disturbed every few minutes. Use as a context.

    Parameters
    ----------
    directory : Path
        For the database.
    seed : int
        Of the faults.
    sample_s : float
        Between two looks at the memory, seconds of the site's.
    tell : callable
        Gets each of these looks.
    absence_first : bool
        Whether the first fault is a long absence: what that takes is then taken when memory is first held on to.
    """

    array_of: ClassVar = {node: array for node, (array, _) in PLACES.items()}

    def __init__(self, directory: Path, seed: int, sample_s: float, tell: Tell, *, absence_first: bool) -> None:
        self._absence_first = absence_first
        self._sample = round(sample_s * SECOND)
        self._tell = tell
        self._soaked = soak_site(directory)
        self._rendered = rendered_sounds(self._soaked)
        self.faults: Counter[str] = Counter()
        self.sent: Counter[str] = Counter()
        self.slots: set[int] = set()
        self.memory: list[Sample] = []
        super().__init__(seed)

    def _make_sounds(self, count: int) -> list[tuple[str, frozenset[int]]]:
        return []

    def _microphones(self, array: str) -> Player:
        return Player(array, frozenset(), sounds=self._rendered, sent=self.sent)

    def start_server(self) -> None:
        self.site = self._soaked
        self.post = _Post(self.site, self.clock)
        self.http = Server(self.site, self.clock, on_event=self._note, receiver=self.post, stepped=True)
        self.server = self.http.parts

    def _note(self, event: Event) -> None:
        self.slots.add((utc_ns(event["time_utc"]) // FRAME_NS - START) // SLOT)

    def __enter__(self) -> Self:
        self._thread = threading.Thread(target=self.http.run, daemon=True)
        self._thread.start()
        while not self.http.uvicorn.started:
            time.sleep(0.01)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.http.stop()
        self._thread.join(timeout=HANG_S)

    @property
    def hours(self) -> float:
        """That have passed."""
        return (self.frame_index - START) / HOUR

    def tick(self) -> None:
        """An interval passes, or in quiet half a second at once: what else there is to do then is much the same."""
        step = STRIDE if self.frame_index % STRIDE == 0 and self._is_quiet() else 1
        self.clock.time_ns += step * FRAME_NS
        self.frame_index += step
        for node in self.nodes.values():
            if not node.stopped:  # else its device's buffer holds what is heard
                first = self.frame_index - step if node.next_frame_index is None else node.next_frame_index
                node.link.send(
                    [
                        m
                        for frame_index in range(first, self.frame_index)
                        for m in node.microphones.messages_at(frame_index)
                    ]
                )
                node.next_frame_index = self.frame_index
        self._serve()

    def _is_quiet(self) -> bool:
        slot, since = divmod(self.frame_index - START, SLOT)
        played = sound_of(slot, len(self._rendered))
        return played is None or not -STRIDE < since - played[0] < CLIP

    def run(self, ticks: int) -> None:
        end = self.frame_index + ticks
        while self.frame_index < end:
            self.tick()
            if self.frame_index % SECOND == 0:
                self._breathe()
            if (self.frame_index - START) % self._sample == 0:
                kept = sum(node.link.kept for node in self.nodes.values())
                self.memory.append(Sample(self.hours, resident_mb(), kept))
                self._tell(self.memory[-1])

    def _breathe(self) -> None:
        """Wait until the server's loop has told all that it was given; else it would fall behind by hours."""
        if self.http.parts.failure is not None:
            raise RuntimeError("the server has failed") from self.http.parts.failure
        assert self.http.loop is not None
        asyncio.run_coroutine_threadsafe(asyncio.sleep(0), self.http.loop).result()

    def disturbances(self) -> Iterator[int]:
        """Do something bad, and say how many intervals shall pass before the next."""
        pool = originals()
        kinds, weights = ["cut", "reset", "stopped", "killed", "rubbish", "away"], [4, 4, 4, 4, 4, 1]
        while True:
            yield self.rng.randint(60 * SECOND, 600 * SECOND)
            name = self.rng.choice(list(self.array_of))
            what = self.rng.choices(kinds, weights)[0]
            if self._absence_first and not self.faults:
                what = "away"
            self.faults[what] += 1
            match what:
                case "cut" | "away":
                    self.cut.add(name)
                    yield self.rng.randint(*((5, 120) if what == "cut" else (900, 1200))) * SECOND
                    self.heal(name)
                case "reset":
                    self.reset(name)
                case "stopped":
                    node = self.nodes[name]
                    node.stopped = True
                    yield self.rng.randint(1, 2 * SECOND)
                    node.stopped = False
                case "killed":
                    self.kill_node(name)
                    yield self.rng.randint(1, 60) * SECOND
                    self.start_node(name)
                case _ if name in self.wires:
                    self.wires[name].up.extend((self.clock.time_ns, mutated(self.rng, pool)) for _ in range(100))


def resident_mb() -> float:
    """Of this process, now."""
    gc.collect()
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


@dataclass(frozen=True)
class Outcome:
    """What came of it, and how much was done.

    `reference_mb`, `least_mb`, `most_mb` and `end_mb` are of looks after the first hour while no array was away, the
    share `resting` of all; `peak_mb` is the most of all looks.
    """

    hours: float
    sounds: int
    events: int
    unheard: int
    messages: dict[str, int]
    begin_mb: float
    reference_mb: float
    least_mb: float
    most_mb: float
    end_mb: float
    peak_mb: float
    resting: float
    stored: int
    faults: dict[str, int]
    clients: dict[str, int]
    seconds: float

    @property
    def growth(self) -> float:
        """The most after the reference, relative to it, less one."""
        return self.most_mb / self.reference_mb - 1.0


def soak(
    directory: Path,
    hours: float,
    reference_hours: float = REFERENCE_HOURS,
    seed: int = 0,
    sample_s: float = 600.0,
    tell: Tell = lambda sample: None,
    *,
    absence_first: bool = True,
) -> Outcome:
    """Let so many hours pass, and hold the memory against what it was after the first of them."""
    began_s = time.monotonic()
    with (
        patch("livessl.server.event_retention.EXPIRE_S", 2.0),
        Soak(directory, seed, sample_s, tell, absence_first=absence_first) as world,
        Crowd(world.http.url) as crowd,
    ):
        begin_mb = resident_mb()
        end = START + round(hours * HOUR)
        for ticks in world.disturbances():
            world.run(min(ticks, end - world.frame_index))
            if world.frame_index >= end:
                break
        world.run(SLOT)  # the last sound's end
        sounds = {slot for slot in range(round(hours * HOUR) // SLOT) if sound_of(slot, SOUNDS) is not None}
        after = [sample for sample in world.memory if sample.hours >= reference_hours]
        resting = [sample.resident_mb for sample in after if sample.at_rest]
        return Outcome(
            hours=hours,
            sounds=len(sounds),
            events=world.http.parts.event_log.published,
            unheard=len(sounds - world.slots),
            messages=dict(world.sent),
            begin_mb=round(begin_mb, 1),
            reference_mb=round(resting[0], 1),
            least_mb=round(min(resting), 1),
            most_mb=round(max(resting), 1),
            end_mb=round(resting[-1], 1),
            peak_mb=round(max(sample.resident_mb for sample in world.memory), 1),
            resting=len(resting) / len(after),
            stored=world.http.parts.store.count() or 0,
            faults=dict(world.faults),
            clients=dict(crowd.heard),
            seconds=round(time.monotonic() - began_s, 1),
        )
