"""The scenario `noise`: sounds in rooms with the noise that rooms have.

Both halves differ in rooms, sounds and every draw. A position is in one room, and all kinds and levels of noise get the
same sounds from it. What is measured is localization, not detection: it is known when the sound begins.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Final

import numpy as np
import pyarrow as pa

from livessl.core.correlate.band import band_power
from livessl.core.geometry import Grid
from livessl.core.locate.estimator import Course, Estimator, create
from livessl.core.stream.activity import exact_mask
from livessl.core.types import FRAME_S, ArraySpec, BoolArray, Float32Array, FloatArray
from livessl.lab.evaluate.localizer import METHODS, PRE_ROLL_FRAMES, SPACING_M, compared, half_of, sound_of
from livessl.lab.evaluate.moments import SPEECH
from livessl.lab.evaluate.noise_kinds import KINDS, Emitter, Noise, make_noise
from livessl.lab.evaluate.noise_rooms import NOISE_ROOMS, NoiseRoom
from livessl.lab.evaluate.noise_sounds import OTHER_SOUNDS
from livessl.lab.evaluate.paper import C_M_S
from livessl.lab.evaluate.parquet import NAME
from livessl.lab.evaluate.scenarios import HALVES, LOCALIZER, NOISE
from livessl.lab.evaluate.unit import PEAK, Clips, Row, convolved
from livessl.simulation.walls import wall_absorption, wall_responses

SNRS_DB: Final = (20.0, 10.0, 5.0, 0.0)

POSITIONS: Final = 24
"""Number of positions by default: three in each room."""

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

WHERE: Final[Mapping[str, tuple[float, float]]] = {"inside": (0.0, 0.7), "edge": (0.7, 1.2), "outside": (1.2, np.inf)}
"""Places of a source in plan: ranges of its distance from the middle of the arrays, relative to that of the array which
is furthest from there."""

FACING: Final = ("all around", "towards", "away")
"""Radiation of a source: equal in all directions, or as a talker who faces the nearest array or turns away from it."""

OTHER_NOISE: Final = ("diffuse", 20.0)
"""Kind and level, in dB, of the noise with which the sounds of `OTHER_SOUNDS` are played."""

SCHEMA: Final = pa.schema(
    [
        ("position", pa.int32()),
        *((name, NAME) for name in ("room", "noise", "method", "sound", "clip", "where", "facing")),
        *((name, pa.float32()) for name in ("rt60_s", "snr_db", "active_s")),
        *((f"{axis}_m", pa.float32()) for axis in "xyz"),
        *((f"found_{axis}_m", pa.float32()) for axis in "xyz"),
        *((name, pa.float32()) for name in ("error_m", "bearing_deg", "mahalanobis2", "to_noise_m", "candidate_m")),
        ("status", NAME),
        ("outvoted", NAME),
        ("whole", pa.bool_()),
        *((name, pa.float32()) for name in ("confidence", "margin", "standing", "second_array", "crossing_deg")),
        *((name, pa.float32()) for name in ("share", "background", "beginning", "spread_m")),
        ("of_lines", pa.bool_()),
    ]
)
"""One row per sound, noise, level and method, as in the other scenarios. `to_noise_m` is the distance of the position
found from the nearest noise source; null where the noise has no place. `candidate_m` is the distance of the nearest
candidate place from the truth; null without candidates. The columns from `whole` on are the features of `onset`'s
confidence."""

_SOURCES, _NOISE, _OTHERS = 1, 2, 3
"""Keys of the random streams, so that a noise is the same whatever other kinds and levels are run."""

_TRIES: Final = 400
"""Places that are drawn in search of one in the wanted part of a room; small rooms may have hardly any."""


@dataclass(frozen=True, slots=True)
class NoiseSettings:
    """All settings that the results depend on, besides the sounds.

    Parameters
    ----------
    positions : int
        Number of positions of the source; they take the rooms of the half in turn, and each plays one random clip of
        every class. 72 have every room with every place of `WHERE` and every one of `FACING` once.
    snrs_db : tuple of float
        Level of the sound's mean power over its whole recording and all microphones above that of the noise.
    seed : int
    sample_rate_hz : float
    spacing_m : float
        Spacing of the grid that `srp-phat` searches before it refines.
    half : str
        Half of the rooms, clips and random draws: one of `HALVES`.
    kinds : tuple of str
        Kinds of noise.
    others : bool
        Whether the sounds of `OTHER_SOUNDS` are played, too.
    """

    positions: int
    snrs_db: tuple[float, ...] = SNRS_DB
    seed: int = 0
    sample_rate_hz: float = 16000.0
    spacing_m: float = SPACING_M
    half: str = HALVES[1]
    kinds: tuple[str, ...] = KINDS
    others: bool = True
    scenario: str = NOISE
    experiment: str = LOCALIZER

    def as_dict(self) -> dict[str, Any]:
        """Return the settings as plain values by name."""
        return asdict(self)


@dataclass(frozen=True, slots=True)
class _Scene:
    """A room with a source of sound and sources of noise, and what they give at the microphones.

    Parameters
    ----------
    room : NoiseRoom
    head : Row
        Columns that all rows of the position share.
    source : Emitter
    noises : mapping of str to Noise
        Noise of each kind, longer than every sound.
    """

    room: NoiseRoom
    head: Row
    source: Emitter
    noises: Mapping[str, Noise]


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
        rng = np.random.default_rng(self._seed(number, _SOURCES, ""))
        chosen = {name: clips[int(rng.integers(len(clips)))] for name, clips in self._clips.items()}
        others = self._other_sounds(number) if settings.others else {}
        longest = max(len(sound) for _, sound in (*chosen.values(), *others.values()))
        scene = self._scene(number, rng, longest)
        lead = round((LEAD_S + rng.uniform(0.0, FRAME_S)) * settings.sample_rate_hz)
        rows: list[Row] = []
        for name, (clip, sound) in chosen.items():
            head = {"sound": name, "clip": clip}
            rows += self._in_noise(scene, sound, lead, head, dict.fromkeys(settings.kinds, settings.snrs_db))
        kind, snr_db = OTHER_NOISE
        for name, (clip, sound) in others.items():
            rows += self._in_noise(scene, sound, lead, {"sound": name, "clip": clip}, {kind: (snr_db,)})
        return rows

    def _other_sounds(self, number: int) -> dict[str, tuple[str, Float32Array]]:
        """Synthesize each of `OTHER_SOUNDS` anew; the name of the clip is that of the sound."""
        rate_hz = self._settings.sample_rate_hz
        draws = {name: np.random.default_rng(self._seed(number, _OTHERS, name)) for name in OTHER_SOUNDS}
        return {name: (name, make(draws[name], rate_hz)) for name, make in OTHER_SOUNDS.items()}

    def _scene(self, number: int, rng: np.random.Generator, longest: int) -> _Scene:
        """Draw the sources of a position, and make the noise of each kind for sounds of up to `longest` samples."""
        settings = self._settings
        rooms = NOISE_ROOMS[settings.half]
        room = rooms[number % len(rooms)]
        wanted, facing = list(WHERE)[number % len(WHERE)], FACING[number // len(WHERE) % len(FACING)]
        source_m = _free_place_m(room, rng, wanted=wanted)
        machine_m, *talkers_m = (_free_place_m(room, rng, source_m) for _ in range(1 + TALKERS))
        emitted = self._emitter(room, source_m, _faced(room, source_m, facing))
        machine, *talkers = (self._emitter(room, place_m) for place_m in (machine_m, *talkers_m))
        count = longest + emitted[1].shape[1] + round((2.0 * LEAD_S + FRAME_S) * settings.sample_rate_hz)
        kinds = dict.fromkeys((*settings.kinds, *((OTHER_NOISE[0],) if settings.others else ())))
        noises = {
            kind: make_noise(
                kind,
                room.microphones_m,
                count,
                settings.sample_rate_hz,
                np.random.default_rng(self._seed(number, _NOISE, kind)),
                machine,
                talkers,
                self._clips[SPEECH],
            )
            for kind in kinds
        }
        head = {"position": number, "room": room.name, "rt60_s": room.rt60_s, "facing": facing}
        return _Scene(room, head | {"where": where(room, source_m)}, emitted, noises)

    def _in_noise(
        self,
        scene: _Scene,
        sound: Float32Array,
        lead: int,
        head: Row,
        levels_db: Mapping[str, tuple[float, ...]],
    ) -> list[Row]:
        """Locate one sound in noise of each kind and level by each method."""
        number, name = int(scene.head["position"]), str(head["sound"])
        source_m, response = scene.source
        wet = np.pad(convolved(sound, response), ((0, 0), (lead, 0)))
        rows: list[Row] = []
        for kind, snrs_db in levels_db.items():
            draws = np.random.default_rng(self._seed(number, _NOISE, f"{name} {kind}"))
            noise = scene.noises[kind].cut(draws, wet.shape[1])
            sensors = draws.standard_normal(wet.shape, dtype=np.float32)
            for snr_db in snrs_db:
                recorded = _mixed(scene.room, wet, lead, [(noise.samples, snr_db), (sensors, SENSOR_DB)])
                own = scene.head | head | {"noise": kind, "snr_db": snr_db}
                rows += [own | row for row in self._found(scene.room, recorded, lead, source_m, noise.places_m)]
        return rows

    def _seed(self, number: int, purpose: int, name: str) -> np.random.SeedSequence:
        key = (HALVES.index(self._settings.half), number, purpose, zlib.crc32(name.encode()))
        return np.random.SeedSequence(self._settings.seed, spawn_key=key)

    def _emitter(self, room: NoiseRoom, place_m: FloatArray, facing: FloatArray | None = None) -> Emitter:
        response = wall_responses(
            room.size_m,
            place_m,
            room.microphones_m,
            wall_absorption(room.rt60_s, room.size_m, room.shares, room.bands, C_M_S),
            duration_s=max(room.rt60_s, 1.5 * float(np.linalg.norm(room.size_m)) / C_M_S),
            sample_rate_hz=self._settings.sample_rate_hz,
            c_m_s=C_M_S,
            facing=facing,
        )
        return place_m, response

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
        courses = {spec.name: _course(recorded[spec.name], lead, spec, rate_hz) for spec in room.arrays}
        for method, estimator in self._methods(room).items():
            sounds = {}
            for spec in room.arrays:
                active, course = courses[spec.name]
                sound = sound_of(estimator, spec, recorded[spec.name], active, rate_hz)
                sounds[spec.name] = replace(sound, course=course) if sound.onsets else sound
            found = estimator.locate(sounds)
            row = compared(found, sounds, room.arrays, source_m)
            if len(noises_m):
                row["to_noise_m"] = float(np.linalg.norm(noises_m - found.position_m, axis=1).min())
            if found.candidates:
                row["candidate_m"] = min(float(np.linalg.norm(c.position_m - source_m)) for c in found.candidates)
            if found.features is not None:
                row |= {name: getattr(found.features, name) for name in _FEATURES}
            yield {"method": method} | row

    def _methods(self, room: NoiseRoom) -> dict[str, Estimator]:
        if room.name not in self._estimators:
            x, y, z = room.size_m
            grid = Grid(((0.0, x), (0.0, y), (0.0, z)), self._settings.spacing_m)
            self._estimators[room.name] = {method: create(method, room.arrays, grid, C_M_S) for method in METHODS}
        return self._estimators[room.name]


_FEATURES: Final = (
    "whole", "second_array", "crossing_deg", "share", "background", "beginning", "spread_m", "of_lines",
)  # fmt: skip
"""Features of the confidence that the other scenarios do not store."""


def where(room: NoiseRoom, place_m: FloatArray) -> str:
    """Return in which part of `WHERE` a place (3,) is."""
    centres_m = np.array([spec.centre_m for spec in room.arrays])[:, :2]
    middle_m = centres_m.mean(axis=0)
    reach = np.linalg.norm(place_m[:2] - middle_m) / np.linalg.norm(centres_m - middle_m, axis=1).max()
    return next(name for name, (least, most) in WHERE.items() if least <= reach < most)


def _faced(room: NoiseRoom, source_m: FloatArray, facing: str) -> FloatArray | None:
    """Return the horizontal direction (3,) that a source faces; None if it radiates equally in all directions."""
    if facing == FACING[0]:
        return None
    towards = min((spec.centre_m - source_m for spec in room.arrays), key=lambda way: float(np.linalg.norm(way)))
    level = np.array([towards[0], towards[1], 0.0])
    return level if facing == FACING[1] else -level


def _free_place_m(
    room: NoiseRoom, rng: np.random.Generator, but_m: FloatArray | None = None, wanted: str | None = None
) -> FloatArray:
    """Draw a place (3,) away from walls, arrays and, if given, from another place; in the wanted part, if there is one.

    Rooms whose arrays are at the walls have hardly any place outside them; then any free place is taken.
    """
    taken = [(spec.centre_m, CLEARANCE_M) for spec in room.arrays]
    if but_m is not None:
        taken.append((but_m, APART_M))
    tries = 0
    while True:  # far more than half of every room is free
        place_m = rng.uniform(WALL_M, np.array(room.size_m) - WALL_M)
        tries += 1
        if all(np.linalg.norm(place_m - other_m) >= least_m for other_m, least_m in taken) and (
            wanted is None or tries > _TRIES or where(room, place_m) == wanted
        ):
            return np.asarray(place_m)


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


def _course(samples: Float32Array, lead: int, spec: ArraySpec, sample_rate_hz: float) -> tuple[BoolArray, Course]:
    """Return which whole frames of 50 ms of an array's recording (K, n) are active, (F,), and the course of its sound.

    Frames before the sound are quiet, as they are to a node that knows the background. From the frame in which the
    sound is emitted on, the rule applies to the power in the array's band.
    """
    frame = round(FRAME_S * sample_rate_hz)
    first, count = lead // frame, samples.shape[1] // frame
    start = max(0, first - PRE_ROLL_FRAMES)
    powers = np.array(
        [
            float(band_power(samples[:, k * frame : (k + 1) * frame], sample_rate_hz, spec.band_hz).mean())
            for k in range(start, count)
        ]
    )
    active = np.concatenate([np.zeros(first, dtype=np.bool_), exact_mask(powers[first - start :])])
    loud = np.flatnonzero(active)
    frames = np.arange(max(0, int(loud[0]) - PRE_ROLL_FRAMES), int(loud[-1]) + 1)  # as `sound_of` takes them
    return active, Course(frames, powers[frames - start], int(loud[0]))
