"""Rooms with arrays in them, and faults that are made on purpose: what `doctor.py` examines.

Each seed is a room with sides of 6 to 10, 7 to 12 and 2.8 to 4.4 m, an RT60 of 0.3 to 0.8 s, ten sounds, and three
tetrahedra of 0.5 m that are turned at random. They stand 2 cm and 1.2 degrees (standard deviations along each axis)
from where the site file has them, microphones 2 mm from theirs. The seed also chooses the array and the channel that a
fault is at, and the direction of shifts.

Faults of cables, inputs and interfaces are made in the recordings. Faults of poses, of geometry and of temperature are
made in the site file, so that they share the recordings of the set-up without a fault.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Final

import numpy as np
from scipy.spatial.transform import Rotation

from livessl.core.commission.poses import moved
from livessl.core.geometry import posed, tetrahedron
from livessl.core.types import Event, Float32Array, FloatArray, IntArray
from livessl.simulation.of_site import scene_of
from livessl.simulation.scene import Scene, render
from livessl.site.load import parse_site
from livessl.site.models import Site

RATE_HZ: Final = 16000.0
SOUNDS: Final = 10
ARRAYS: Final = ("north", "south", "west")
POSITION_STD_M, ORIENTATION_STD_DEG, MICROPHONE_STD_M = 0.02, 1.2, 0.002
MEASURED_STD_M, MEASURED_STD_DEG = 0.01, 0.4
MEASURED: Final = {"position_m": 0.01, "orientation_deg": 0.5}
"""What remains of the errors of a pose, along each axis, after `livessl calibrate poses` with eight claps, and what the
site file says of it."""

CLOCK_S: Final = 2.0

Recordings = dict[str, Float32Array]
Arrays = dict[str, FloatArray]
Routes = dict[str, tuple[str, IntArray]]
"""Where an array's channels come from: the array whose plugs are in its inputs, and their order."""


@dataclass(frozen=True, slots=True)
class Target:
    """Where a seed's faults are: array, index of the channel, another channel, and a source of random numbers."""

    array: str
    channel: int
    other: int
    rng: np.random.Generator

    def direction(self) -> FloatArray:
        """A direction in space, (3,)."""
        drawn = self.rng.standard_normal(3)
        return np.asarray(drawn / np.linalg.norm(drawn))


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault: what it does to the recordings, the plugs or the site file, and what should be said.

    `routed` says which plugs are in which inputs. `expected` holds the codes that name it; empty if nothing should be
    said. `of` is "array" or "channel" if the array, or also the channel, has to be named. `settings` are settings of
    the site file that are wrong. `live` is False where a server finds it without sounds, from what the nodes report.
    `measured` is True where the poses in the site file were measured with claps before the fault was made.
    """

    name: str
    expected: tuple[str, ...]
    of: str | None = "channel"
    recorded: Callable[[Recordings, Target], None] | None = None
    routed: Callable[[Target], Routes] | None = None
    filed: Callable[[Arrays, Target], None] | None = None
    settings: tuple[tuple[str, Any], ...] = ()
    live: bool = True
    measured: bool = False


def _channel(change: Callable[[Float32Array, np.random.Generator], Float32Array]) -> Callable[..., None]:
    def apply(recordings: Recordings, at: Target) -> None:
        samples = recordings[at.array]
        samples[at.channel] = change(samples[at.channel], at.rng)

    return apply


def _hum(samples: Float32Array, rng: np.random.Generator) -> Float32Array:
    time_s, mains_hz = np.arange(len(samples)) / RATE_HZ, float(rng.choice([50.0, 60.0]))
    hum = sum(0.01 / n * np.sin(2.0 * np.pi * mains_hz * n * time_s) for n in (1, 3, 5))
    return (samples + hum).astype(np.float32)


def _clip(samples: Float32Array, _rng: np.random.Generator) -> Float32Array:
    return np.asarray(np.clip(samples * np.float32(8.0 / max(1e-9, np.abs(samples).max())), -1.0, 1.0))


def _late(samples: Float32Array, _rng: np.random.Generator) -> Float32Array:
    return np.concatenate([np.zeros(2, dtype=np.float32), samples[:-2]])


def _noise(samples: Float32Array, rng: np.random.Generator) -> Float32Array:
    return (10**-2.5 * rng.standard_normal(len(samples))).astype(np.float32)


def _louder(recordings: Recordings, at: Target) -> None:
    others = np.delete(np.arange(4), at.channel)  # which are made softer: the loud one must not be clipped
    recordings[at.array][others] *= np.float32(10.0**-0.5)


def _duplicate(recordings: Recordings, at: Target) -> None:
    first, second = sorted((at.channel, at.other))  # the second one is said to carry the signal of the first
    recordings[at.array][second] = recordings[at.array][first]


def _crosstalk(recordings: Recordings, at: Target) -> None:
    recordings[at.array][at.channel] += np.float32(0.1) * recordings[at.array][at.other]


def _behind(recordings: Recordings, at: Target) -> None:
    late = round(CLOCK_S * RATE_HZ)
    recordings[at.array] = np.roll(recordings[at.array], late, axis=1)


def _swap(at: Target) -> Routes:
    order = np.arange(4)
    order[[at.channel, at.other]] = order[[at.other, at.channel]]
    return {at.array: (at.array, order)}


def _rotate(at: Target) -> Routes:
    order, three = np.arange(4), np.delete(np.arange(4), at.channel)
    order[three] = np.roll(three, 1)
    return {at.array: (at.array, order)}


def _mirror(_at: Target) -> Routes:
    return {array: (array, np.array([0, 1, 3, 2])) for array in ARRAYS}


def _exchange(_at: Target) -> Routes:
    return {"north": ("south", np.arange(4)), "south": ("north", np.arange(4))}


def _turn(angle_deg: float) -> Callable[..., None]:
    def apply(filed: Arrays, at: Target) -> None:
        centre_m = filed[at.array].mean(axis=0)
        sense = at.rng.choice([-1.0, 1.0])
        turn = Rotation.from_euler("z", sense * angle_deg, degrees=True)
        filed[at.array] = turn.apply(filed[at.array] - centre_m) + centre_m

    return apply


def _shift(distance_m: float) -> Callable[..., None]:
    def apply(filed: Arrays, at: Target) -> None:
        angle = at.rng.uniform(0.0, 2.0 * np.pi)
        filed[at.array] = filed[at.array] + distance_m * np.array([np.cos(angle), np.sin(angle), 0.0])

    return apply


def _displace(filed: Arrays, at: Target) -> None:
    filed[at.array] = filed[at.array].copy()
    filed[at.array][at.channel] += 0.05 * at.direction()


FAULTS: Final = (
    Fault("none", (), None),
    Fault("none, poses measured", (), None, live=False, measured=True),
    Fault("dead", ("dead",), recorded=_channel(lambda x, _: 0.0 * x)),
    Fault("dead, own noise at -50 dBFS", ("deaf",), recorded=_channel(_noise)),
    Fault("20 dB weaker", ("level",), recorded=_channel(lambda x, _: np.float32(0.1) * x)),
    Fault("10 dB louder", ("level",), recorded=_louder),
    Fault("hum", ("hum",), recorded=_channel(_hum), live=False),
    Fault("constant", ("dc",), recorded=_channel(lambda x, _: x + np.float32(0.05)), live=False),
    Fault("clipping", ("clipping",), recorded=_channel(_clip), live=False),
    Fault("crosstalk of -20 dB", ("crosstalk",), recorded=_crosstalk, live=False),
    Fault("inverted", ("inverted",), recorded=_channel(lambda x, _: -x)),
    Fault("one signal on two channels", ("duplicate",), "array", recorded=_duplicate),
    Fault("two samples late", ("late_channel",), recorded=_channel(_late)),
    Fault("two channels swapped", ("swapped",), "array", routed=_swap),
    Fault("three channels exchanged", ("swapped", "turned"), "array", routed=_rotate),
    Fault("all wired the other way round", ("mirrored",), None, routed=_mirror),
    Fault("inputs of two arrays exchanged", ("exchanged",), None, routed=_exchange),
    Fault("microphone 5 cm off", ("geometry",), filed=_displace),
    Fault("turned by 5 degrees", ("turned",), "array", filed=_turn(5.0)),
    Fault("turned by 8 degrees", ("turned",), "array", filed=_turn(8.0)),
    Fault("turned by 15 degrees", ("turned",), "array", filed=_turn(15.0)),
    Fault("turned by 30 degrees", ("turned",), "array", filed=_turn(30.0)),
    Fault("moved by 0.5 m", ("moved",), "array", filed=_shift(0.5)),
    Fault("turned by 5 degrees, poses measured", ("turned",), "array", filed=_turn(5.0), live=False, measured=True),
    Fault("moved by 0.5 m, poses measured", ("moved",), "array", filed=_shift(0.5), live=False, measured=True),
    Fault("temperature 20 degrees off", ("temperature",), None, settings=(("temperature_c", 0.0),)),
    Fault("clock 2 s off", ("clock",), None, recorded=_behind, live=False),
)


class Room:
    """One room: its scene, and the recordings of its arrays, which are made once.

    Parameters
    ----------
    seed : int
    recordings : Recordings or None
        What the arrays of the faultless set-up record; None to render it when it is needed.
    """

    def __init__(self, seed: int, recordings: Recordings | None = None) -> None:
        self.seed = seed
        rng = np.random.default_rng([seed, 1])
        self._size_m = [round(float(side), 2) for side in rng.uniform([6.0, 7.0, 2.8], [10.0, 12.0, 4.4])]
        width_m, length_m, _ = self._size_m
        self.rt60_s = float(rng.uniform(0.3, 0.8))
        wall_m = np.array([[width_m / 2.0, 1.3], [width_m / 2.0, length_m - 1.3], [1.2, length_m / 2.0]])
        self._filed: Arrays = {}
        for name, (x_m, y_m) in zip(ARRAYS, wall_m, strict=True):
            along_m, z_m, yaw_deg = rng.uniform([-0.8, 1.5, -180.0], [0.8, 2.3, 180.0])
            at_m = (x_m, y_m + along_m, z_m) if name == "west" else (x_m + along_m, y_m, z_m)
            self._filed[name] = posed(tetrahedron(0.5), at_m, yaw_deg=float(yaw_deg))
        self._recordings = recordings

    @cached_property
    def scene(self) -> Scene:
        """Ten sounds at random places."""
        site = self.site_with(FAULTS[0], len(ARRAYS))
        return scene_of(site, rt60_s=self.rt60_s, count=SOUNDS, sample_rate_hz=RATE_HZ, seed=self.seed)

    @property
    def target(self) -> Target:
        """Where this room's faults are; of two arrays, the target is one."""
        rng = np.random.default_rng([self.seed, 3])
        channel, other = rng.permutation(4)[:2]
        return Target(ARRAYS[rng.integers(2)], int(channel), int(other), rng)

    def site_with(self, fault: Fault, arrays: int) -> Site:
        """The site file with a fault that is made there."""
        filed = {name: self._measured(name) if fault.measured else self._filed[name] for name in ARRAYS}
        if fault.filed is not None:
            fault.filed(filed, self.target)
        text: dict[str, Any] = {
            "site": "doctor",
            "room": {"size_m": self._size_m},
            "arrays": {name: {"microphones_m": filed[name].tolist()} for name in ARRAYS[:arrays]},
            **({"uncertainty": MEASURED} if fault.measured else {}),
            **dict(fault.settings),
        }
        return parse_site(json.dumps(text))

    def recordings_with(self, fault: Fault, arrays: int) -> Recordings:
        """What the arrays record, with a fault that is made there."""
        if self._recordings is None:
            specs = self.site_with(FAULTS[0], len(ARRAYS)).specs
            placed = [replace(spec, microphones_m=self.built(spec.name)) for spec in specs]
            self._recordings = {
                spec.name: render(self.scene, spec.microphones_m, seed=self.seed + 1 + number)
                for number, spec in enumerate(placed)
            }
        recordings = {name: self._recordings[name].copy() for name in ARRAYS[:arrays]}
        if fault.recorded is not None:
            fault.recorded(recordings, self.target)
        if fault.routed is not None:
            routes = fault.routed(self.target).items()
            routed = {array: recordings[source][order] for array, (source, order) in routes if array in recordings}
            recordings |= routed
        return recordings

    def built(self, name: str) -> FloatArray:
        """The true places of an array's microphones, metres: not quite those of the site file."""
        turn, shift_m, own_m = self._off(name)
        return moved(self._filed[name], shift_m, turn) + own_m

    def _measured(self, name: str) -> FloatArray:
        """The places of an array's microphones with its pose as measured, metres."""
        turn, shift_m, _ = self._off(name)
        rng = np.random.default_rng([self.seed, 4, ARRAYS.index(name)])
        off_m, off = rng.normal(0.0, MEASURED_STD_M, 3), np.radians(rng.normal(0.0, MEASURED_STD_DEG, 3))
        return moved(moved(self._filed[name], shift_m, turn), off_m, off)

    def _off(self, name: str) -> tuple[FloatArray, FloatArray, FloatArray]:
        """How an array differs from the site file: turn, radians, shift, and shift of each microphone, metres."""
        rng = np.random.default_rng([self.seed, 2, ARRAYS.index(name)])
        turn = np.radians(rng.normal(0.0, ORIENTATION_STD_DEG, 3))
        own_m = rng.normal(0.0, MICROPHONE_STD_M, self._filed[name].shape)
        return turn, rng.normal(0.0, POSITION_STD_M, 3), own_m

    def error_m(self, events: Sequence[Event]) -> float:
        """Median distance between the sounds and what was found of them, metres; infinite where nothing was."""
        errors = []
        for source in self.scene.sources:
            end_s = source.start_s + len(source.sound) / RATE_HZ
            found = [
                float(np.linalg.norm(event.estimate.position_m - source.position_m))
                for event in events
                if event.estimate is not None
                and event.start_ns / 1e9 < end_s + 0.1
                and event.end_ns / 1e9 > source.start_s
            ]
            errors.append(min(found, default=np.inf))
        return float(np.median(errors))
