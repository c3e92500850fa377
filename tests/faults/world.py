"""A whole site in one thread and in simulated time: nodes, network, server, and everything that can befall them.

Links, spools, wire, ingest, engine, fusion and store are the real ones; sockets, clocks and the estimator are not. The
estimator's answer is a fingerprint of the very samples it was given, so that two runs that used other frames differ.
"""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from math import inf
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from world_parts import START, DiedError, Event, FragileStore, HandClock, Post

from livessl import wire
from livessl.capture.dealer import Dealer
from livessl.capture.link import Link
from livessl.capture.spool import Spool
from livessl.clock import utc_ns
from livessl.core.types import FRAME_NS, Frame, Mark, Message
from livessl.server.assembly import Outlets, assemble
from livessl.server.fanout import Fanout
from livessl.server.history.backlog import Backlog
from livessl.server.parts import Parts
from livessl.server.sinks import Sinks
from livessl.server.store import Query
from small_site import RATE_HZ, site_of

HANG_OVER, PRE_ROLL = 6, 8
BUFFERED = 30
"""Messages that ZeroMQ and the system take from a node before any arrives."""

WORLD: dict[str, Any] = {
    "nodes": {
        "a": {"device": {"name": "x", "sample_rate_hz": RATE_HZ}, "arrays": {"north": [1, 2, 3, 4]}},
        "b": {"device": {"name": "x", "sample_rate_hz": RATE_HZ}, "arrays": {"south": [1, 2, 3, 4]}},
    }
}
ARRAY_OF = {"a": "north", "b": "south"}


@dataclass
class Wire:
    """One connection: messages on their way, in order, each with the time it arrives."""

    routing_id: bytes
    up: deque[tuple[int, bytes]] = field(default_factory=deque)
    down: deque[tuple[int, bytes]] = field(default_factory=deque)


class Cable(Dealer):
    """The stand-in for the socket of a node's link."""

    def __init__(self, world: World, node: str) -> None:
        self._world = world
        self._node = node
        self._wire: Wire | None = None
        self._broken = False

    def broken(self) -> bool:
        self._look()
        broken, self._broken = self._broken, False
        return broken

    def _look(self) -> None:
        wire_ = self._world.wires.get(self._node)
        self._broken |= self._wire is not None and wire_ is not self._wire
        self._wire = wire_

    def send(self, data: bytes) -> bool:
        sent = self._world.send_up(self._node, data)
        self._look()
        return sent

    def receive(self) -> bytes | None:
        return self._world.receive_down(self._node)

    def wait(self, milliseconds: int) -> None:
        raise AssertionError("a link must not wait in simulated time")

    def close(self, linger_ms: int) -> None:
        self._world.wires.pop(self._node, None)


@dataclass
class Microphones:
    """The messages of an array, as a segmenter makes them: marks, frames around sound, and a pre-roll."""

    array: str
    active: frozenset[int]
    sequence: int = 0
    began: int | None = None

    def messages_at(self, frame_index: int) -> list[Message]:
        if self.began is None:
            self.began = frame_index
        if not any(frame_index - k in self.active for k in range(HANG_OVER + 1) if frame_index - k >= self.began):
            return [Mark(self.array, self.sequence, frame_index, 1e-7, 1e-7, (1e-7,) * 4)]
        messages: list[Message] = []
        if frame_index in self.active and not any(frame_index - k in self.active for k in range(1, HANG_OVER + 1)):
            quiet = 0
            while (
                quiet < PRE_ROLL and frame_index - quiet - 1 >= self.began and self._is_quiet(frame_index - quiet - 1)
            ):
                quiet += 1
            messages += [self._frame(r) for r in range(frame_index - quiet, frame_index)]
        return [*messages, self._frame(frame_index)]

    def _is_quiet(self, frame_index: int) -> bool:
        return not any(frame_index - k in self.active for k in range(HANG_OVER + 1))

    def _frame(self, frame_index: int) -> Frame:
        self.sequence += 1
        rng = np.random.default_rng([frame_index, len(self.array), ord(self.array[0])])
        samples = (rng.integers(-8, 8, (4, 10)) / 16).astype(np.float32)  # sums of these are exact
        active = frame_index in self.active
        power = 1e-2 * rng.uniform(0.5, 1.0) if active else float(rng.choice([1e-7, 2e-3]))
        return Frame(
            self.array, self.sequence, frame_index, frame_index * FRAME_NS, float(RATE_HZ), samples, power, active
        )


@dataclass
class Node:
    """A node's process, while it lives."""

    name: str
    microphones: Microphones
    link: Link
    spool: Spool
    stopped: bool = False
    next_frame_index: int | None = None


class World:
    """Nodes a and b with an array each, and a server.

    Parameters
    ----------
    seed : int
        Of the sounds, the delays, and whatever chance decides.
    sounds : int
        How many, a second and a half or more apart.
    delay_ticks : (int, int)
        Least and greatest delay of a message, in intervals; messages of a connection stay in order.
    spools : Path or None
        Where the nodes keep their frames; None keeps them in memory.
    """

    array_of: ClassVar[Mapping[str, str]] = ARRAY_OF

    def __init__(
        self, seed: int, sounds: int = 8, delay_ticks: tuple[int, int] = (0, 1), spools: Path | None = None
    ) -> None:
        self.rng = random.Random(seed)
        self.site = site_of(WORLD)
        self.clock = HandClock()
        self.store = FragileStore()
        self.wires: dict[str, Wire] = {}
        self.cut: set[str] = set()
        self.published: list[Event] = []
        self.delay_ticks = delay_ticks
        self.bytes_per_tick = inf  # of each node's link
        self._spools = spools
        self._connections = self._runs = 0
        self.frame_index = START
        self.sounds = self._make_sounds(sounds)
        self.server: Parts | None = None
        self.nodes: dict[str, Node] = {}
        self.down: dict[str, list[tuple[int, int]]] = {name: [] for name in self.array_of}
        self.start_server()
        for name in self.array_of:
            self.start_node(name)

    @property
    def end(self) -> int:
        """The frame index after the last sound."""
        return max(max(active) for _, active in self.sounds) + 2 * HANG_OVER

    def _make_sounds(self, count: int) -> list[tuple[str, frozenset[int]]]:
        """(array, its active intervals) of every sound."""
        sounds: list[tuple[str, frozenset[int]]] = []
        at = START + 30
        for _ in range(count):
            length = self.rng.randint(2, 30)
            for array in self.rng.choice([("north", "south")] * 4 + [("north",), ("south",)]):
                first = at + self.rng.randint(0, 2)
                pauses = {k for k in range(length) if self.rng.random() < 0.2}
                sounds.append((array, frozenset(first + k for k in range(length) if k not in pauses or k == 0)))
            at += length + self.rng.randint(30, 60)
        return sounds

    def start_server(self) -> None:
        fusion = self.site.fusion.model_copy(update={"method": "world_parts:Fingerprint"})
        site = self.site.model_copy(update={"fusion": fusion})
        self.post = Post(site, self.clock)
        outlets = Outlets(self.store, Sinks(()), Fanout(), self.published.append)
        self.server = assemble(site, self.clock, outlets, receiver=self.post)

    def kill_server(self) -> None:
        self.server = None
        self.store.backlog = Backlog(self.store.prepare)  # what waited in the process's memory is gone
        self.wires.clear()

    def start_node(self, name: str) -> None:
        array = self.array_of[name]
        self._runs += 1
        spool = Spool(None if self._spools is None else self._spools / name)
        hello = wire.Hello(name, f"run-{self._runs}", {array: float(RATE_HZ)})
        link = Link("", hello, self.clock, spool=spool, dealer=Cable(self, name))
        self.nodes[name] = Node(name, self._microphones(array), link, spool)
        if self.down[name]:
            self.down[name][-1] = (self.down[name][-1][0], self.frame_index)

    def _microphones(self, array: str) -> Microphones:
        return Microphones(
            array, frozenset(r for of, frame_indices in self.sounds for r in frame_indices if of == array)
        )

    def kill_node(self, name: str) -> None:
        """Its files stay as they are; whatever was in memory is gone."""
        node = self.nodes.pop(name)
        node.spool.close()
        self.wires.pop(name, None)
        self.down[name].append((self.frame_index, 2**62))

    def reset(self, name: str) -> None:
        """The connection breaks: what was on its way is lost, in both directions."""
        self.wires.pop(name, None)

    def send_up(self, node: str, data: bytes) -> bool:
        if node in self.cut:
            if node in self.wires and len(self.wires[node].up) < BUFFERED:
                self.wires[node].up.append((2**62, data))  # the system's buffers take it, and nothing arrives
                return True
            return False
        if node not in self.wires:
            if self.server is None:
                return False
            self._connections += 1
            self.wires[node] = Wire(self._connections.to_bytes(5, "big"))
        up = self.wires[node].up
        if len(up) >= BUFFERED:
            return False
        up.append((self._arrival(up, len(data)), data))
        return True

    def receive_down(self, node: str) -> bytes | None:
        connection = self.wires.get(node)
        if connection is None or not connection.down or connection.down[0][0] > self.clock.time_ns:
            return None
        return connection.down.popleft()[1]

    def _arrival(self, queue: deque[tuple[int, bytes]], size: int = 0) -> int:
        delay = self.rng.uniform(*self.delay_ticks) * FRAME_NS
        before = queue[-1][0] if queue else self.clock.time_ns
        return max(self.clock.time_ns + round(delay), before + round(size / self.bytes_per_tick * FRAME_NS))

    def heal(self, node: str) -> None:
        """The link is there again; TCP may have held on to what was under way, or have given up."""
        self.cut.discard(node)
        if node in self.wires and self.rng.random() < 0.5:
            connection = self.wires[node]
            connection.up = deque((self.clock.time_ns, data) for _, data in connection.up)
        else:
            self.wires.pop(node, None)

    def tick(self) -> None:
        """One frame index passes."""
        self.clock.time_ns += FRAME_NS // 2
        self._serve()
        self.clock.time_ns += FRAME_NS - FRAME_NS // 2
        self.frame_index += 1
        for node in self.nodes.values():
            first = self.frame_index - 1 if node.next_frame_index is None else node.next_frame_index
            if not node.stopped:  # else its device's buffer holds what is heard
                node.link.send(
                    [
                        m
                        for frame_index in range(first, self.frame_index)
                        for m in node.microphones.messages_at(frame_index)
                    ]
                )
                first = self.frame_index
            node.next_frame_index = first
        self._serve()
        for node in self.nodes.values():
            if not node.stopped:
                node.link.service()

    def _serve(self) -> None:
        if self.server is None:
            return
        post = self.post
        replies: list[tuple[bytes, wire.Ack]] = []
        for name, connection in self.wires.items():
            while name not in self.cut and connection.up and connection.up[0][0] <= self.clock.time_ns:
                replies += post.receive(connection.routing_id, connection.up.popleft()[1])
        replies += post.acknowledgements()
        by_id = {connection.routing_id: name for name, connection in self.wires.items()}
        for routing_id, ack in replies:
            to = by_id.get(routing_id)
            if to is not None and to not in self.cut:
                down = self.wires[to].down
                down.append((self._arrival(down), wire.encode(ack)))
        try:
            while True:
                self.server.engine.turn()
                if not post.queue:
                    break
        except DiedError:
            self.store.dies = None
            self.kill_server()

    def run(self, ticks: int) -> None:
        """Let time pass."""
        for _ in range(ticks):
            self.tick()

    def recover(self, ticks: int = 200) -> None:
        """Everything is started and connected again; let it settle."""
        for name in list(self.cut):
            self.heal(name)
        self.store.dies, self.store.full = None, False
        self.bytes_per_tick = inf
        if self.server is None:
            self.start_server()
        for name in self.array_of:
            if name not in self.nodes:
                self.start_node(name)
            self.nodes[name].stopped = False
        self.run(max(0, self.end - self.frame_index) + ticks)

    def events(self) -> list[Event]:
        """The stored events, oldest first, without the fields that depend on when an event was found."""
        found, _ = self.store.find(Query(limit=1000))
        timeless = ("latency_s", "latency_stages_s", "late", "replaces", "late_frames", "start_s")
        return [{key: value for key, value in event.items() if key not in timeless} for event in reversed(found)]

    @property
    def published_events(self) -> list[Event]:
        """The events that were published to subscribers."""
        return [message for message in self.published if message["kind"] == "event"]

    def groups(self) -> list[frozenset[int]]:
        """The sounds, each with the frame indices at which any array detects it."""
        merged: list[frozenset[int]] = []
        for _, active in sorted(self.sounds, key=lambda sound: min(sound[1])):
            if merged and min(active) <= max(merged[-1]) + HANG_OVER:
                merged[-1] |= active
            else:
                merged.append(active)
        return merged

    def found(self) -> list[tuple[frozenset[int], list[Event]]]:
        """The events that lie within each sound, its run-up included."""
        events = self.events()
        return [
            (sound, [e for e in events if min(sound) - PRE_ROLL <= _first_raster(e) <= max(sound)])
            for sound in self.groups()
        ]

    def was_up(self, sound: frozenset[int]) -> bool:
        """Return whether all nodes were up from the pre-roll of a sound to its end."""
        first, last = min(sound) - 2 * PRE_ROLL, max(sound) + 2 * HANG_OVER
        return not any(since <= last and until >= first for spans in self.down.values() for since, until in spans)


def _first_raster(event: Event) -> int:
    return utc_ns(event["time_utc"]) // FRAME_NS
