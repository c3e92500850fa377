"""The scenario `noise`: sounds in rooms with a fan, with talkers in the background, in diffuse and in sensor noise.

Both halves differ in rooms, sounds and every draw. A position is in one room, and all kinds and levels of noise get the
same sounds from it. What is measured is localization, not detection: it is known when the sound begins.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np
import pyarrow as pa

from livessl.core.correlate.band import band_power
from livessl.core.geometry import Grid
from livessl.core.locate.estimator import Estimator, create
from livessl.core.stream.activity import exact_mask
from livessl.core.types import FRAME_S, ArraySpec, BoolArray, Float32Array, FloatArray
from livessl.lab.evaluate.localizer import METHODS, SPACING_M, found_row, half_of, sound_of
from livessl.lab.evaluate.moments import SPEECH
from livessl.lab.evaluate.noise_rooms import NOISE_ROOMS, NoiseRoom
from livessl.lab.evaluate.paper import C_M_S
from livessl.lab.evaluate.parquet import NAME
from livessl.lab.evaluate.scenarios import HALVES, LOCALIZER, NOISE
from livessl.lab.evaluate.unit import PEAK, Clips, Row, convolved
from livessl.simulation.noise import diffuse, fan
from livessl.simulation.room import impulse_responses

KINDS: Final = ("white", "fan", "talkers", "diffuse")
"""Kinds of noise: of the sensors, from one place, from several, from everywhere."""

SNRS_DB: Final = (20.0, 10.0, 5.0)

POSITIONS: Final = 24
"""Number of positions by default: six in each room."""

LEAD_S: Final = 1.0
"""Noise, in seconds, before the sound: more than the pre-roll that a node sends."""

SENSOR_DB: Final = 40.0
"""Level of the sound's mean power, in dB, above the sensor noise that every kind of noise includes."""

TALKERS: Final = 3
"""Number of talkers in the background."""

CLEARANCE_M: Final = 0.5
"""Least distance, in metres, of a source from the arrays' centres."""

APART_M: Final = 1.0
"""Least distance, in metres, of a noise source from the sound."""

WALL_M: Final = 0.2
"""Least distance, in metres, of a source from the walls."""

SCHEMA: Final = pa.schema(
    [
        ("position", pa.int32()),
        *((name, NAME) for name in ("room", "noise", "method", "sound", "clip")),
        *((name, pa.float32()) for name in ("rt60_s", "snr_db", "active_s")),
        *((f"{axis}_m", pa.float32()) for axis in "xyz"),
        *((f"found_{axis}_m", pa.float32()) for axis in "xyz"),
        *((name, pa.float32()) for name in ("error_m", "bearing_deg", "mahalanobis2", "to_noise_m")),
        ("status", NAME),
        ("outvoted", NAME),
        *((name, pa.float32()) for name in ("confidence", "margin", "standing")),
    ]
)
"""One row per sound, noise, level and method, as in the other scenarios. `to_noise_m` is the distance of the position
found from the nearest noise source; null where the noise has no place."""

_SOURCES, _NOISE = 1, 2
"""Keys of the random streams, so that a noise is the same whatever other kinds and levels are run."""


@dataclass(frozen=True, slots=True)
class NoiseSettings:
    """All settings that the results depend on, besides the sounds.

    Parameters
    ----------
    positions : int
        Number of positions of the source; they take the rooms of the half in turn, and each plays one random clip of
        every class.
    snrs_db : tuple of float
        Level of the sound's mean power over its whole recording and all microphones above that of the noise.
    seed : int
    sample_rate_hz : float
    spacing_m : float
        Spacing of the grid that `srp-phat` searches before it refines.
    half : str
        Half of the rooms, clips and random draws: one of `HALVES`.
    """

    positions: int
    snrs_db: tuple[float, ...] = SNRS_DB
    seed: int = 0
    sample_rate_hz: float = 16000.0
    spacing_m: float = SPACING_M
    half: str = HALVES[1]
    scenario: str = NOISE
    experiment: str = LOCALIZER

    def as_dict(self) -> dict[str, Any]:
        """Return the settings as plain values by name."""
        return asdict(self)


@dataclass(frozen=True, slots=True)
class _Noise:
    """Noise at all microphones (K, n), of a mean power of 1, and its places (N, 3); none if it comes from nowhere."""

    samples: Float32Array
    places_m: FloatArray


class NoisePosition:
    """Turns the number of a position into its rows. Made once in each worker.

    Parameters
    ----------
    settings : NoiseSettings
    clips : Clips
        All clips; the settings choose the half that is used.

    Raises
    ------
    ValueError
        If there is no speech for the talkers.
    """

    def __init__(self, settings: NoiseSettings, clips: Clips) -> None:
        if SPEECH not in clips:
            raise ValueError(
                f"--classes: the talkers of {NOISE} need speech, expected {SPEECH} among them, got {', '.join(clips)}; "
                f"add {SPEECH}"
            )
        self._settings = settings
        self._clips = half_of(clips, settings.half)
        self._estimators: dict[str, dict[str, Estimator]] = {}

    def rows(self, number: int) -> list[Row]:
        """Simulate and localize position `number`: one row per sound, kind and level of noise, and method."""
        settings = self._settings
        rooms = NOISE_ROOMS[settings.half]
        room = rooms[number % len(rooms)]
        rng = np.random.default_rng(self._seed(number, _SOURCES, ""))
        source_m = _free_place_m(room, rng)
        fan_m, *talkers_m = (_free_place_m(room, rng, source_m) for _ in range(1 + TALKERS))
        to_sound, to_fan, *to_talkers = (self._response(room, place_m) for place_m in (source_m, fan_m, *talkers_m))
        chosen = {name: clips[int(rng.integers(len(clips)))] for name, clips in self._clips.items()}
        lead = round((LEAD_S + rng.uniform(0.0, FRAME_S)) * settings.sample_rate_hz)
        rows: list[Row] = []
        for name, (clip, sound) in chosen.items():
            wet = np.pad(convolved(sound, to_sound), ((0, 0), (lead, 0)))
            for kind in KINDS:
                draws = np.random.default_rng(self._seed(number, _NOISE, f"{name} {kind}"))
                noise = self._noise(kind, room, wet.shape[1], draws, (fan_m, to_fan), (talkers_m, to_talkers))
                sensors = draws.standard_normal(wet.shape, dtype=np.float32)
                for snr_db in settings.snrs_db:
                    head = {"position": number, "room": room.name, "noise": kind, "sound": name, "clip": clip}
                    head |= {"rt60_s": room.rt60_s, "snr_db": snr_db}
                    recorded = _mixed(room, wet, lead, [(noise.samples, snr_db), (sensors, SENSOR_DB)])
                    found = self._found(room, recorded, lead, source_m, noise.places_m)
                    rows += [head | row for row in found]
        return rows

    def _seed(self, number: int, purpose: int, name: str) -> np.random.SeedSequence:
        key = (HALVES.index(self._settings.half), number, purpose, zlib.crc32(name.encode()))
        return np.random.SeedSequence(self._settings.seed, spawn_key=key)

    def _response(self, room: NoiseRoom, place_m: FloatArray) -> Float32Array:
        (response,) = impulse_responses(
            room.size_m,
            place_m,
            room.microphones_m,
            [room.rt60_s],
            sample_rate_hz=self._settings.sample_rate_hz,
            c_m_s=C_M_S,
            own_lengths=True,
            compiled=True,
        )
        return np.asarray(response)

    def _noise(
        self,
        kind: str,
        room: NoiseRoom,
        count: int,
        rng: np.random.Generator,
        of_fan: tuple[FloatArray, Float32Array],
        of_talkers: tuple[Sequence[FloatArray], Sequence[Float32Array]],
    ) -> _Noise:
        """Make noise of a kind; `of_fan` and `of_talkers` are places and the responses from them."""
        rate_hz, nowhere_m = self._settings.sample_rate_hz, np.empty((0, 3))
        match kind:
            case "white":
                shape = (len(room.microphones_m), count)
                return _Noise(rng.standard_normal(shape, dtype=np.float32), nowhere_m)
            case "diffuse":
                return _Noise(diffuse(rng, room.microphones_m, count, rate_hz, C_M_S), nowhere_m)
            case "fan":
                place_m, response = of_fan
                before = response.shape[1]  # the room already sounds when the recording begins
                wet = convolved(fan(rng, before + count, rate_hz), response)[:, before : before + count]
                return _Noise(_of_unit_power(wet), place_m[None])
            case _:
                places_m, responses = of_talkers
                wet = np.zeros((len(room.microphones_m), count), dtype=np.float32)
                for response in responses:
                    before = response.shape[1]
                    speech = _speech(self._clips[SPEECH], before + count, rng)
                    wet += _of_unit_power(convolved(speech, response)[:, before : before + count])
                return _Noise(_of_unit_power(wet), np.array(places_m))

    def _found(
        self,
        room: NoiseRoom,
        recorded: Mapping[str, Float32Array],
        lead: int,
        source_m: FloatArray,
        noises_m: FloatArray,
    ) -> Iterator[Row]:
        """Locate a sound by each method, and compare the results with the truth."""
        rate_hz = self._settings.sample_rate_hz
        active = {spec.name: _active(recorded[spec.name], lead, spec, rate_hz) for spec in room.arrays}
        for method, estimator in self._methods(room).items():
            sounds = {
                spec.name: sound_of(estimator, spec, recorded[spec.name], active[spec.name], rate_hz)
                for spec in room.arrays
            }
            row = found_row(estimator, sounds, room.arrays, source_m)
            if len(noises_m):
                found_m = np.array([row[f"found_{axis}_m"] for axis in "xyz"])
                row["to_noise_m"] = float(np.linalg.norm(noises_m - found_m, axis=1).min())
            yield {"method": method} | row

    def _methods(self, room: NoiseRoom) -> dict[str, Estimator]:
        if room.name not in self._estimators:
            x, y, z = room.size_m
            grid = Grid(((0.0, x), (0.0, y), (0.0, z)), self._settings.spacing_m)
            self._estimators[room.name] = {method: create(method, room.arrays, grid, C_M_S) for method in METHODS}
        return self._estimators[room.name]


def _free_place_m(room: NoiseRoom, rng: np.random.Generator, but_m: FloatArray | None = None) -> FloatArray:
    """Draw a place (3,) away from walls, arrays and, if given, from another place."""
    taken = [(spec.centre_m, CLEARANCE_M) for spec in room.arrays]
    if but_m is not None:
        taken.append((but_m, APART_M))
    while True:  # far more than half of every room is free
        place_m = rng.uniform(WALL_M, np.array(room.size_m) - WALL_M)
        if all(np.linalg.norm(place_m - other_m) >= least_m for other_m, least_m in taken):
            return np.asarray(place_m)


def _speech(clips: Sequence[tuple[str, Float32Array]], count: int, rng: np.random.Generator) -> Float32Array:
    """Return the clips of speech, of equal power, in random order and from a random moment on: (count,)."""
    order = rng.permutation(len(clips))
    joined = np.concatenate([clips[index][1] / np.sqrt(np.square(clips[index][1]).mean()) for index in order])
    return np.asarray(np.resize(np.roll(joined, -int(rng.integers(len(joined)))), count), dtype=np.float32)


def _of_unit_power(samples: Float32Array) -> Float32Array:
    return np.asarray(samples / np.sqrt(np.square(samples).mean(dtype=np.float64)), dtype=np.float32)


def _mixed(
    room: NoiseRoom, wet: Float32Array, lead: int, noises: Sequence[tuple[Float32Array, float]]
) -> dict[str, Float32Array]:
    """Add noises, each a number of dB below the sound, set each array's level, and round to 16 bits."""
    power = np.square(wet[:, lead:]).mean(dtype=np.float64)
    samples = wet.copy()
    for noise, snr_db in noises:
        samples += np.float32(np.sqrt(power * 10.0 ** (-snr_db / 10.0))) * noise
    recorded, first = {}, 0
    for spec in room.arrays:
        own = samples[first : first + len(spec.microphones_m)]
        first += len(own)
        scale = np.float32(PEAK * 32768.0 / np.abs(own).max())
        recorded[spec.name] = np.asarray(np.rint(own * scale) / np.float32(32768.0), dtype=np.float32)
    return recorded


def _active(samples: Float32Array, lead: int, spec: ArraySpec, sample_rate_hz: float) -> BoolArray:
    """Return which whole frames of 50 ms of an array's recording (K, n) are active: (F,).

    Frames before the sound are quiet, as they are to a node that knows the background. From the frame in which the
    sound is emitted on, the rule applies to the power in the array's band.
    """
    frame = round(FRAME_S * sample_rate_hz)
    first, count = lead // frame, samples.shape[1] // frame
    powers = [
        float(band_power(samples[:, k * frame : (k + 1) * frame], sample_rate_hz, spec.band_hz).mean())
        for k in range(first, count)
    ]
    return np.concatenate([np.zeros(first, dtype=np.bool_), exact_mask(np.array(powers))])
