"""A day of a site with four arrays in some minutes: nodes, links, server, store and clients, in simulated time.

All of it is real but two things: what nodes send reaches the server without a socket, and its fusion is stepped from
here. Sounds are rendered once, segmented as a node does it, and come again and again; between them it is quiet.
"""

from __future__ import annotations

import asyncio
import gc
import json
import os
import random
import socket
import threading
import time
import urllib.request
from collections import Counter
from collections.abc import AsyncIterator, Callable, Iterator, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from types import TracebackType
from typing import Any, ClassVar, NamedTuple, Self
from unittest.mock import patch

from mutation import mutated, originals
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed
from world import START, Event, Microphones, Post, World

from clients import Listener, Log, open_client
from livessl import wire
from livessl.clock import UnpacedClock, utc_ns
from livessl.core.types import FRAME_NS, Frame, Message
from livessl.recordings.assign import AssignedRecording, make_pipelines
from livessl.recordings.play import paced_messages
from livessl.recordings.recording import MemoryRecording
from livessl.server.app import Server
from livessl.server.latency import Arrival
from livessl.simulation.scene import make_scene, render
from livessl.site.models import Site
from small_site import HANG_S, RATE_HZ, hiss, site_of

SECOND = 20
HOUR = 3600 * SECOND
SLOT = 60 * SECOND
"""One sound in each, but for every eighth hour, which is quiet."""

STRIDE = SECOND // 2
"""Intervals that pass at once in quiet."""

CLIP = 5 * SECOND
"""Longer than a sound's recording is, with the quiet at its end."""

SOUNDS = 8
"""Different ones, each at a place of its own."""

PLACES = {
    "a": ("north", [1.9, 1.0, 1.4]),
    "b": ("south", [2.2, 4.1, 1.5]),
    "c": ("east", [3.3, 2.6, 1.6]),
    "d": ("west", [0.7, 2.3, 1.5]),
}
"""Nodes, each with an array and its place."""

GROWTH = 0.05
"""Of the memory after the first hour, at most."""

REFERENCE_HOURS = 1.0
"""After so long everything has been used."""

AT_REST = 200
"""Frames that nodes keep at most while nobody is away: of the sound that goes on, and those on their way."""

READERS = 3
"""Clients that read everything."""

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

Heard = Mapping[int, Sequence[Frame]]
"""What an array's node sends of a sound, by frame index since the sound's recording began."""


def rendered_sounds(site: Site) -> list[dict[str, Heard]]:
    """Each of the sounds as every array's node sends it."""
    sounds: list[dict[str, Heard]] = []
    for k in range(SOUNDS):
        scene = make_scene(
            site.room.size_m,
            rt60_s=0.2,
            sounds=[("burst", hiss(0.2 + 0.1 * k, 1, seed=k)[0])],
            count=1,
            sample_rate_hz=RATE_HZ,
            c_m_s=site.c_m_s,
            keep_away_m=[spec.centre_m for spec in site.specs],
            seed=k,
            lead_s=1.0,
        )
        heard: dict[str, Heard] = {}
        for spec in site.specs:
            samples = render(scene, spec.microphones_m, seed=k)
            part = AssignedRecording(spec.name, MemoryRecording(spec.name, float(RATE_HZ), samples), 0, (1, 2, 3, 4))
            heard[spec.name] = _by_interval(site, part)
        sounds.append(heard)
    return sounds


def _by_interval(site: Site, part: AssignedRecording) -> dict[int, list[Frame]]:
    found: dict[int, list[Frame]] = {}
    run_up: list[Frame] = []
    for _, batch in paced_messages(*make_pipelines(site, [part]), UnpacedClock()):
        for message in batch:
            if isinstance(message, Frame):
                run_up.append(message)
                if message.active or message.frame_index - 1 in found:
                    found[message.frame_index], run_up = run_up, []
    return found


@dataclass
class Player(Microphones):
    """An array in a room where the rendered sounds come again and again."""

    sounds: Sequence[Mapping[str, Heard]] = ()
    sent: Counter[str] = field(default_factory=Counter)

    def messages_at(self, frame_index: int) -> list[Message]:
        messages = self._heard(frame_index)
        self.sent.update(type(message).__name__ for message in messages)
        return messages

    def _heard(self, frame_index: int) -> list[Message]:
        slot, since = divmod(frame_index - START, SLOT)
        played = sound_of(slot, len(self.sounds))
        if played is None:
            return super().messages_at(frame_index)
        began = frame_index - since + played[0]
        frames = self.sounds[played[1]][self.array].get(frame_index - began, ())
        if not frames:
            return super().messages_at(frame_index)
        messages: list[Message] = []
        for frame in frames:
            self.sequence += 1
            at = frame.frame_index + began
            messages.append(
                replace(frame, sequence=self.sequence, frame_index=at, time_ns=frame.time_ns + began * FRAME_NS)
            )
        return messages


@lru_cache(maxsize=8)
def sound_of(slot: int, count: int) -> tuple[int, int] | None:
    """When in its slot a sound's recording begins, in intervals, and which it is."""
    if slot * SLOT // HOUR % 8 == 7:
        return None
    rng = random.Random(slot)
    return rng.randrange(SLOT // 2), rng.randrange(count)


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


class _Reader(Listener):
    """Counts events."""

    def __init__(self, heard: Counter[str]) -> None:
        super().__init__(Log())
        self._heard = heard

    def note(self, data: bytes, body: int, length: int, now_ns: int) -> None:
        self._heard["messages"] += 1
        self._heard["events"] += data.startswith(b'"kind":"event"', data.find(b'"kind"', body))


class Crowd:
    """Clients in a thread of their own: some that read, one that stalls, one that comes and goes, one that asks.

    Parameters
    ----------
    url : str
        The server's.
    """

    def __init__(self, url: str) -> None:
        host, port = url.removeprefix("http://").split(":")
        self._address = host, int(port)
        self._url = url
        self._live = f"ws{url.removeprefix('http')}/api/v1"
        self.heard: Counter[str] = Counter()
        self._connections: set[ClientConnection] = set()
        self._ended = threading.Event()
        self._failures: list[Exception] = []
        works = (self._listen, self._poll)
        self._threads = [threading.Thread(target=self._watched, args=[work], daemon=True) for work in works]

    def __enter__(self) -> Self:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ended.set()
        for thread in self._threads:
            thread.join(timeout=HANG_S)
        if self._failures and kind is None:
            raise ExceptionGroup("clients failed", self._failures)

    def _watched(self, work: Callable[[], None]) -> None:
        try:
            work()
        except Exception as failure:  # noqa: BLE001 - whatever it is, the run shall fail by it
            self._failures.append(failure)

    def _listen(self) -> None:
        asyncio.run(self._listen_all())

    async def _listen_all(self) -> None:
        loop = asyncio.get_running_loop()
        readers = [open_client(*self._address, None, "update,event,track,arrays") for _ in range(READERS)]
        listeners = [(await loop.create_connection(lambda: _Reader(self.heard), sock=each))[1] for each in readers]
        tasks = [asyncio.create_task(work) for work in (self._watch_map(), self._come_and_go(), self._stall())]
        while not self._ended.is_set():
            await asyncio.sleep(0.1)
            for task in tasks:
                if task.done():
                    task.result()  # nobody ends before the others
        for listener in listeners:
            listener.close()
        await asyncio.gather(*(each.close() for each in self._connections))
        await asyncio.gather(*tasks)

    async def _watch_map(self) -> None:
        async with self._connected(f"{self._live}/map") as connection:
            async for _ in connection:
                self.heard["maps"] += 1

    async def _come_and_go(self) -> None:
        address = f"{self._live}/live"
        while not self._ended.is_set():
            async with self._connected(address) as connection:
                try:
                    for _ in range(20):
                        seq = json.loads(await connection.recv()).get("seq")
                        address = address if seq is None else f"{self._live}/live?since_seq={seq}"
                    self.heard["visits"] += 1
                except ConnectionClosed:
                    self.heard["visits cut"] += 1
            await asyncio.sleep(2.0)

    @asynccontextmanager
    async def _connected(self, address: str) -> AsyncIterator[ClientConnection]:
        async with connect(address, compression=None, ping_interval=None) as connection:
            self._connections.add(connection)
            try:
                yield connection
            finally:
                self._connections.discard(connection)

    async def _stall(self) -> None:
        while not self._ended.is_set():
            with await asyncio.to_thread(open_client, *self._address, 4096) as lazy:
                while not (_hung_up(lazy) or self._ended.is_set()):
                    await asyncio.sleep(0.2)
            self.heard["stalled clients"] += 1

    def _poll(self) -> None:
        asked = ["health", "arrays", "events?limit=200", "tracks", "map", "../../metrics", "openapi.json"]
        for k in range(10**9):
            address = f"{self._url}/api/v1/{asked[k % len(asked)]}".replace("/api/v1/../..", "")
            with urllib.request.urlopen(address) as answer:
                answer.read()
            self.heard["answers"] += 1
            if self._ended.wait(4.0):
                return


def _hung_up(connection: socket.socket) -> bool:
    """Whether the server has cut it; what it sent stays unread."""
    try:
        connection.send(b"")
        return connection.recv(1, socket.MSG_PEEK) == b""
    except BlockingIOError:
        return False
    except ConnectionError:
        return True


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
