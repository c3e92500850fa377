"""A fusion that is stepped with the messages of two nodes, and an estimator that says what it was given."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from free_field import RATE_HZ, burst, heard, tetra
from livessl.core.correlate.band import band_power
from livessl.core.correlate.onset_gcc import OnsetGCC
from livessl.core.geometry import Grid
from livessl.core.locate.estimator import Localization, PowerMaps, Sound
from livessl.core.stream.array_health import ArrayStatus
from livessl.core.stream.fusion import Fusion, Role
from livessl.core.stream.parameters import FusionParameters
from livessl.core.stream.site_state import SiteState
from livessl.core.types import (
    FRAME_NS,
    GCC,
    ArraySpec,
    ClockState,
    Event,
    Evidence,
    Float32Array,
    FloatArray,
    Frame,
    Mark,
    Message,
    Output,
)

NORTH = tetra("north", [2.7, 4.2, 1.3])
SOUTH = tetra("south", [2.3, 1.1, 1.5], yaw_deg=71.0)
GRID = Grid(((0.0, 4.2), (0.0, 5.1), (0.0, 2.7)), 0.25)
SOURCE_M = np.array([1.13, 3.31, 1.47])

START = 20 * 1_700_000_000
"""Frame index at which every test begins; those below count from it."""

HANG_OVER = 6
DEADLINE = 10
"""Defaults, in frame indices of 50 ms."""

NOTHING = GCC(np.array([[0, 1]]), np.array([0.0, 1e-4]), np.zeros((1, 2)))
"""Evidence of no sound."""

Arrivals = list[tuple[float, Message]]
"""When, in frame indices after START, a message comes in."""


class Scripted:
    """An estimator that returns one position and remembers what it was given."""

    name = "scripted"

    def __init__(self) -> None:
        self.calls: list[dict[str, list[int]]] = []
        self.prepared: list[tuple[str, float]] = []

    def prepare(self, array: str, sample_rate_hz: float) -> None:
        self.prepared.append((array, sample_rate_hz))

    def onset_front_end(self, array: str, sample_rate_hz: float) -> None:
        return None

    def locate(self, sounds: Mapping[str, Sound]) -> Localization:
        self.calls.append({name: [piece.shape[1] for piece in sound.segments] for name, sound in sounds.items()})
        heard = tuple(Evidence(spec, NOTHING) for spec in (NORTH, SOUTH) if spec.name in sounds)
        return Localization(SOURCE_M.copy(), 0.01 * np.eye(3), 0.5, heard)

    def power_maps(self, evidence: Sequence[Evidence], separately: Collection[str] | None = None) -> PowerMaps:
        return PowerMaps(GRID, np.full(GRID.size, len(evidence), dtype=np.float32), {})


def state_of(estimator: Any = None, arrays: Sequence[ArraySpec] = (NORTH, SOUTH), **parameters: Any) -> SiteState:
    return SiteState("site", arrays, estimator or Scripted(), FusionParameters(**parameters))


def fusion_of(estimator: Any = None, *, updates: bool = False, **parameters: Any) -> Fusion:
    return Fusion(state_of(estimator, **parameters), Role(updates=updates))


def frame(array: str, frame_index: int, active: bool = True, power: float = 1e-2, **changes: Any) -> Frame:
    made = Frame(
        array,
        1,
        START + frame_index,
        (START + frame_index) * FRAME_NS,
        RATE_HZ,
        np.zeros((4, 20), np.float32),
        power,
        active,
    )
    return replace(made, **changes)


def mark(array: str, frame_index: int, **changes: Any) -> Mark:
    return replace(Mark(array, 0, START + frame_index, 1e-7, 1e-7, (1e-7,) * 4, clock=ClockState.LOCKED), **changes)


def node(array: str, active: Collection[int], frame_indices: Iterable[int], delay: float = 0.0) -> Arrivals:
    """The messages of a node, each as its frame index ends: frames while active and in a hang-over, else marks."""
    sent: Arrivals = []
    for frame_index in frame_indices:
        lately = any(frame_index - k in active for k in range(HANG_OVER + 1))
        loud = frame_index in active
        message = frame(array, frame_index, loud, 1e-2 if loud else 1e-7) if lately else mark(array, frame_index)
        if loud and frame_index - 1 not in active:
            sent += [(frame_index + 1 + delay, frame(array, frame_index - k, False, 1e-7)) for k in (2, 1)]
        sent.append((frame_index + 1 + delay, message))
    return sent


def play(
    fusion: Fusion, arrivals: Arrivals, end: int, start: int = 0, every: float = 1.0
) -> list[tuple[float, Output]]:
    """Step through time, in frame indices; what came out, and when."""
    waiting = sorted(arrivals, key=lambda arrival: arrival[0])
    said: list[tuple[float, Output]] = []
    for step in range(round((end - start) / every) + 1):
        now = start + step * every
        here = [message for when, message in waiting if when <= now]
        waiting = waiting[len(here) :]
        said += [(now, output) for output in fusion.step(here, now_ns(now))]
    return said


def now_ns(frame_index: float) -> int:
    return START * FRAME_NS + round(frame_index * FRAME_NS)


def events_of(said: Iterable[tuple[float, Output]]) -> list[tuple[float, Event]]:
    return [(when, output) for when, output in said if isinstance(output, Event)]


def only_event(said: Iterable[tuple[float, Output]]) -> Event:
    ((_, event),) = events_of(said)
    return event


def told(outputs: Iterable[Output]) -> str:
    """All that events say, to the last bit."""
    told = [asdict(replace(output, received=())) for output in outputs if isinstance(output, Event)]
    return json.dumps(told, default=np.ndarray.tolist)


def status_of(fusion: Fusion, array: str, now: float) -> ArrayStatus:
    (status,) = [status for status in fusion.status(now_ns(now)) if status.name == array]
    return status


def sound_frames(
    spec: ArraySpec, first: int, count: int, rate_hz: float = RATE_HZ, *, noise: float = 0.0
) -> list[Frame]:
    """A burst of noise from the source as an array receives it, in frames: real samples, power and activity."""
    n = round(0.05 * rate_hz)
    samples = heard(spec, SOURCE_M, burst(n * count), rate_hz)
    samples += (noise * np.random.default_rng(1).standard_normal(samples.shape)).astype(np.float32)
    made = []
    for k in range(count):
        piece: Float32Array = samples[:, k * n : (k + 1) * n].copy()
        power = float(band_power(piece, rate_hz, spec.band_hz).mean())
        made.append(frame(spec.name, first + k, power > 1e-4, power, samples=piece, sample_rate_hz=rate_hz))
    return made


def live(frames: Sequence[Frame], end: int) -> Arrivals:
    """These frames as they end, and marks before and after."""
    array, frame_indices = frames[0].array, {made.frame_index - START for made in frames}
    quiet = [(k + 1.0, mark(array, k)) for k in range(end) if k not in frame_indices]
    return [(made.frame_index - START + 1.0, made) for made in frames] + list[tuple[float, Message]](quiet)


def position_of(event: Event) -> FloatArray:
    assert event.estimate is not None
    return event.estimate.position_m


class FrontEnd:
    """A front end that remembers what was pushed, and returns for each frame its number."""

    sample_rate_hz = RATE_HZ

    def __init__(self, heard: list[tuple[int, bool] | None]) -> None:
        self.heard = heard

    def push(self, samples: Float32Array, *, quiet: bool) -> OnsetGCC:
        self.heard.append((int(samples[0, 0]), quiet))
        return OnsetGCC(np.array([[samples[0, 0]]], np.float32), np.ones(1))

    def reset(self) -> None:
        self.heard.append(None)


EAST = tetra("east", [3.9, 2.4, 1.9])
THREE = (NORTH, SOUTH, EAST)


def sound_at(fusion: Fusion, frame_index: int, arrays: Sequence[str] = ("north", "south", "east")) -> list[Output]:
    """One short sound that these arrays detect."""
    span = range(frame_index, frame_index + 20)
    arrivals = [message for name in arrays for message in node(name, {frame_index + 5, frame_index + 6}, span)]
    return [output for _, output in play(fusion, arrivals, frame_index + 21, frame_index)]
