"""The sound of a session, moment by moment: single sounds, two sounds at once, or a talker; and the true positions."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from livessl.core.types import Float32Array, FloatArray
from livessl.lab.evaluate.paper import C_M_S, ROOM_M
from livessl.lab.evaluate.scenarios import SessionCase
from livessl.lab.evaluate.unit import Clips, Row, convolved
from livessl.simulation.moving import place_on_way, render_moving
from livessl.simulation.room import impulse_responses

TOGETHER_S: Final = 0.1
"""Longest time, in seconds, between the starts of two sounds at once."""

APART_M: Final = 1.5
"""Least distance, in metres, between two sounds at once."""

WALK_M_S: Final = 1.0
WALK_S: Final = 8.0
"""Time, in seconds, after which the talker begins no further clip."""

WALKER_M: Final = 1.5
"""Height, in metres, of the talker's mouth."""

MARGIN_M: Final = 1.0
"""Least distance, in metres, of the talker from the walls."""

TRUTH_S: Final = 0.05
"""Time, in seconds, between two true positions of a talker."""

SPEECH: Final = "speech"
"""Class of the talker's clips."""


@dataclass(frozen=True, slots=True)
class Moment:
    """One sound, or two at once.

    Parameters
    ----------
    wet : (K, n) float32
        Sound at all microphones, reverberation included; its mean power is 1.
    truths : tuple of Row
        True positions; their `time_s` counts from the first sample.
    """

    wet: Float32Array
    truths: tuple[Row, ...]


@dataclass(frozen=True, slots=True)
class _Sounding:
    """A clip at a position.

    `wet` (K, n) is the sound at the microphones; `begin` and `length`, in samples, say when the clip is emitted.
    """

    name: str
    clip: str
    place_m: FloatArray
    wet: Float32Array
    length: int
    begin: int = 0

    def later(self, samples: int) -> _Sounding:
        wet = np.pad(self.wet, ((0, 0), (samples, 0)))
        return _Sounding(self.name, self.clip, self.place_m, wet, self.length, self.begin + samples)


class MomentSimulator:
    """Simulates the moments of a session in the paper's room.

    Parameters
    ----------
    clips : Clips
    microphones_m : (K, 3) float64
    sample_rate_hz : float
    """

    def __init__(self, clips: Clips, microphones_m: FloatArray, sample_rate_hz: float) -> None:
        self._clips = clips
        self._microphones_m = microphones_m
        self._rate_hz = sample_rate_hz

    def moments(self, case: SessionCase, rt60_s: float, rng: np.random.Generator) -> list[Moment]:
        """Simulate the moments of one case, in order."""
        if case.walks is not None:
            return [self._talker(case.walks, rt60_s, rng)]
        names = [name for _ in range(case.rounds) for name in rng.permutation(list(self._clips))]
        sounds = [self._sounding(name, rt60_s, rng) for name in names]
        if not case.pairs:
            return [self._moment([sound]) for sound in sounds]
        moments = []
        for one, other in zip(sounds[::2], sounds[1::2], strict=True):
            while np.linalg.norm(one.place_m - other.place_m) < APART_M:
                other = self._sounding(other.name, rt60_s, rng)
            lag = round(rng.uniform(0.0, TOGETHER_S) * self._rate_hz)
            moments.append(self._moment([one] if case.alone else [one, other.later(lag)]))
        return moments

    def _sounding(self, name: str, rt60_s: float, rng: np.random.Generator) -> _Sounding:
        clips = self._clips[name]
        clip, sound = clips[int(rng.integers(len(clips)))]
        place_m = np.asarray(rng.uniform(0.0, 1.0, 3) * ROOM_M)
        (responses,) = impulse_responses(
            ROOM_M,
            place_m,
            self._microphones_m,
            [rt60_s],
            sample_rate_hz=self._rate_hz,
            c_m_s=C_M_S,
            own_lengths=True,
            compiled=True,
        )
        return _Sounding(name, clip, place_m, _at_unit_power(convolved(sound, responses)), len(sound))

    def _moment(self, sounds: Sequence[_Sounding]) -> Moment:
        wet = np.zeros((len(self._microphones_m), max(sound.wet.shape[1] for sound in sounds)), dtype=np.float32)
        truths: list[Row] = []
        for number, sound in enumerate(sounds):
            wet[:, : sound.wet.shape[1]] += sound.wet
            middle_s = (sound.begin + 0.5 * sound.length) / self._rate_hz
            truth = row_of("truth", number, middle_s, sound.place_m)
            truths.append(truth | {"sound": sound.name, "clip": sound.clip})
        return Moment(_at_unit_power(wet), tuple(truths))

    def _talker(self, walks: bool, rt60_s: float, rng: np.random.Generator) -> Moment:
        """Simulate a talker whose clips follow one another with short pauses; without `walks`, the talker stands."""
        clips = self._clips[SPEECH]
        parts: list[Float32Array] = []
        spoken: list[tuple[float, float]] = []
        length = 0
        while length < WALK_S * self._rate_hz:
            _, sound = clips[int(rng.integers(len(clips)))]
            pause = round(rng.uniform(0.1, 0.4) * self._rate_hz)
            parts += [sound / np.sqrt(np.square(sound).mean()), np.zeros(pause, dtype=np.float32)]
            spoken.append((length / self._rate_hz, (length + len(sound)) / self._rate_hz))
            length += len(sound) + pause
        times_s, way_m = _way(length / self._rate_hz, rng)
        if not walks:
            way_m = np.repeat(way_m[:1], len(way_m), axis=0)
        wet = render_moving(
            np.concatenate(parts),
            times_s,
            way_m,
            self._microphones_m,
            room_size_m=ROOM_M,
            rt60_s=rt60_s,
            sample_rate_hz=self._rate_hz,
            c_m_s=C_M_S,
            compiled=True,
        )
        at_s = np.concatenate([np.arange(start, stop, TRUTH_S) for start, stop in spoken])
        places_m = place_on_way(times_s, way_m, at_s)
        truths = tuple(row_of("truth", 0, float(s), place_m) for s, place_m in zip(at_s, places_m, strict=True))
        return Moment(_at_unit_power(wet), truths)


def row_of(kind: str, number: int, time_s: float, place_m: Iterable[float]) -> Row:
    """Return the columns that truths, events and states of tracks share."""
    place = {f"{axis}_m": value for axis, value in zip("xyz", place_m, strict=True)}
    return {"kind": kind, "number": number, "time_s": time_s, **place}


def _at_unit_power(wet: Float32Array) -> Float32Array:
    return np.asarray(wet / np.sqrt(np.square(wet).mean(dtype=np.float64)), dtype=np.float32)


def _way(duration_s: float, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Draw a walk at constant speed between random waypoints: times (N,) and waypoints (N, 3)."""
    low_m, high_m = np.full(2, MARGIN_M), np.array(ROOM_M[:2]) - MARGIN_M
    times_s, points_m = [0.0], [rng.uniform(low_m, high_m)]
    while times_s[-1] < duration_s:
        next_m = rng.uniform(low_m, high_m)
        length_m = float(np.linalg.norm(next_m - points_m[-1]))
        times_s.append(times_s[-1] + length_m / WALK_M_S)
        points_m.append(next_m)
    return np.array(times_s), np.column_stack([points_m, np.full(len(points_m), WALKER_M)])
