"""The load of `bench --live`: one process sends the sound of many arrays over the real wire."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any, Final

import numpy as np
import yaml

from livessl import wire
from livessl.capture.link import Link
from livessl.clock import Clock, SystemClock
from livessl.core.correlate.band import band_power
from livessl.core.types import FRAME_NS, FRAME_S, ArraySpec, Float32Array, Frame
from livessl.simulation.scene import Scene, Source, render, synthesised_sounds
from livessl.site.load import parse_site
from livessl.site.models import Site

SOUND_FRAMES: Final = 40
"""Length of each sound, in frames: 2 s."""

PAUSE_FRAMES: Final = 8
"""Pause after each sound, in frames: 0.4 s, longer than the hang-over, so that each sound becomes an event."""

PERIOD_FRAMES: Final = SOUND_FRAMES + PAUSE_FRAMES

PLACES: Final = 2
"""Number of positions of the sound, used in turn."""

RATE_HZ: Final = 44100.0
ARRAYS_A_NODE: Final = 2
"""Arrays of four microphones on an eight-channel interface."""

ROOM_M: Final = (8.0, 10.0, 4.0)
EDGE_M: Final = 0.5
SETTLE_NS: Final = 2_000_000_000
"""Time, in nanoseconds, to wait for the last acknowledgements."""


@dataclass(frozen=True, slots=True)
class Report:
    """The report of a load process.

    Parameters
    ----------
    sent : int
        Frames that were sent.
    dropped : int
        Frames that a spool dropped, or that were never acknowledged.
    lateness_s : tuple of float
        Delay of the last array's frame for each frame index: the load's own share of the latency.
    """

    sent: int
    dropped: int
    lateness_s: tuple[float, ...]


def site_text(arrays: int, spacing_m: float, bind: str, http_port: int) -> str:
    """Return a site file with tetrahedra of half a metre all over a room of 8 x 10 x 4 m."""
    columns = max(1, round(np.sqrt(arrays * ROOM_M[0] / ROOM_M[1])))
    rows = -(-arrays // columns)
    named: dict[str, Any] = {}
    for index in range(arrays):
        row, column = divmod(index, columns)
        x = ROOM_M[0] * (column + 0.5) / columns
        y = ROOM_M[1] * (row + 0.5) / rows
        named[f"a{index + 1:02d}"] = {
            "geometry": {"tetrahedron": {"edge_m": EDGE_M}},
            "position_m": [round(x, 3), round(y, 3), (2.6, 3.0)[(row + column) % 2]],
            "orientation_deg": {"yaw": 37.0 * index % 360},
        }
    data = {
        "site": "bench",
        "room": {"size_m": list(ROOM_M)},
        "grid": {"spacing_m": spacing_m},
        "arrays": named,
        "server": {"bind": bind, "http": {"host": "127.0.0.1", "port": http_port}},
    }
    return yaml.safe_dump(data, sort_keys=False)


def windows_ns(site: Site, start_ns: int, end_ns: int) -> list[int]:
    """Return the ends of the windows for which updates are due: one every `update_s` of a sound."""
    step = round(site.fusion.update_s / FRAME_S)
    ends = []
    for frame_index in range(start_ns // FRAME_NS, end_ns // FRAME_NS):
        number = frame_index % PERIOD_FRAMES
        if number < SOUND_FRAMES and (number + 1) % step == 0:
            ends.append((frame_index + 1) * FRAME_NS)
    return ends


def play(site_file_text: str, endpoint: str, rt60_s: float, parent: Connection) -> None:
    """Load a server, in a process of its own.

    It sends `None` once the sound is ready. A message of the parent starts it, and another one ends it; then it sends
    its `Report`.
    """
    site, clock = parse_site(site_file_text), SystemClock()
    scene = _scene(site, rt60_s)
    sounds = [_Sound(spec, scene, seed) for seed, spec in enumerate(site.specs)]
    parent.send(None)
    parent.recv()
    nodes = [sounds[first : first + ARRAYS_A_NODE] for first in range(0, len(sounds), ARRAYS_A_NODE)]
    links = [
        Link(endpoint, wire.Hello(f"load-{k}", f"run-{clock.now_ns()}-{k}", {s.array: RATE_HZ for s in node}), clock)
        for k, node in enumerate(nodes)
    ]
    try:
        parent.send(_play(links, nodes, parent.poll, clock))
    finally:
        for link in links:
            link.close(bye=True)


def _play(
    links: Sequence[Link], nodes: Sequence[Sequence[_Sound]], should_end: Callable[[], bool], clock: Clock
) -> Report:
    lateness_s: list[float] = []
    sent = 0
    frame_index = clock.now_ns() // FRAME_NS + 1
    while not should_end():
        while not clock.sleep_until_ns((frame_index + 1) * FRAME_NS):
            pass
        for link, node in zip(links, nodes, strict=True):
            link.send(sound.frame(frame_index, sent + 1) for sound in node)
        sent += 1
        lateness_s.append(clock.now_ns() / 1e9 - (frame_index + 1) * FRAME_S)
        frame_index += 1
    deadline_ns = clock.monotonic_ns() + SETTLE_NS
    while any(link.pending for link in links) and clock.monotonic_ns() < deadline_ns:
        clock.sleep_until_ns(clock.now_ns() + FRAME_NS)
        for link in links:
            link.service()
    arrays = sum(len(node) for node in nodes)
    return Report(sent * arrays, sum(link.dropped + link.pending for link in links), tuple(lateness_s))


class _Sound:
    """The sound at one array, frame by frame, repeated."""

    def __init__(self, spec: ArraySpec, scene: Scene, seed: int) -> None:
        self.array = spec.name
        self._frames = list(_cut(render(scene, spec.microphones_m, seed=seed)))
        self._power = [float(band_power(frame, RATE_HZ, spec.band_hz).mean()) for frame in self._frames]

    def frame(self, frame_index: int, sequence: int) -> Frame:
        """Return the frame of a frame index."""
        index = frame_index % len(self._frames)
        active = index % PERIOD_FRAMES < SOUND_FRAMES
        samples, power = self._frames[index], self._power[index]
        return Frame(self.array, sequence, frame_index, frame_index * FRAME_NS, RATE_HZ, samples, power, active)


def _scene(site: Site, rt60_s: float) -> Scene:
    """Return the scene: a lasting voice at one position after the other, the same for all arrays."""
    rng = np.random.default_rng(5)
    voice = dict(synthesised_sounds(RATE_HZ, seed=5))["voice"]
    lasting = np.tile(voice, 1 + int(SOUND_FRAMES * FRAME_S * RATE_HZ) // len(voice))
    lasting = lasting[: int(SOUND_FRAMES * FRAME_S * RATE_HZ)]
    x, y, _ = site.room.size_m
    places = rng.uniform((0.8, 0.8, 0.8), (x - 0.8, y - 0.8, 1.8), (PLACES, 3))
    sources = [Source("voice", k * PERIOD_FRAMES * FRAME_S, place, lasting) for k, place in enumerate(places)]
    duration_s = PLACES * PERIOD_FRAMES * FRAME_S
    return Scene(site.room.size_m, rt60_s, site.c_m_s, RATE_HZ, tuple(sources), duration_s, level_dbfs=-15.0)


def _cut(recorded: Float32Array) -> Iterator[Float32Array]:
    """Yield frames (K, n); at this sample rate all have the same length."""
    samples = round(FRAME_S * RATE_HZ)
    for first in range(0, recorded.shape[1] - samples + 1, samples):
        yield np.ascontiguousarray(recorded[:, first : first + samples])
