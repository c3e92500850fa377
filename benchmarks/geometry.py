"""The default localizer where geometry is ambiguous: flat arrays, sounds near a wall, and sounds behind it.

`python benchmarks/geometry.py room|wall|end|outside|flat --events DIR`. The sounds are those of DCASE 2016 task 2, by
default the development half. `--moved` and `--turned` describe the arrays wrongly, as a site file may. It prints one
row for each reverberation time; the results are in docs/accuracy/experiments.md.
"""

from __future__ import annotations

import argparse
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from livessl.core.geometry import Grid, circle, posed
from livessl.core.locate.confidence import NEAR_M
from livessl.core.locate.estimator import Localization, create
from livessl.core.stream.activity import exact_mask
from livessl.core.stream.verdict import judged
from livessl.core.types import FRAME_S, ArraySpec, Float32Array, FloatArray, Status
from livessl.lab.evaluate.job import read_clips
from livessl.lab.evaluate.localizer import half_of, sound_of
from livessl.lab.evaluate.paper import BAND_HZ, C_M_S, CLASSES, ROOM_M, pair
from livessl.lab.evaluate.scenarios import HALVES
from livessl.lab.evaluate.unit import convolved
from livessl.simulation.room import impulse_responses

RATE_HZ: Final = 16000.0
FRAME: Final = round(FRAME_S * RATE_HZ)
LEAD_S: Final = 0.53
RT60S_S: Final = (0.0, 0.4, 1.0, 2.0)
SNRS_DB: Final = (np.inf, 20.0, 10.0)
SIZE_M: Final = np.array(ROOM_M)
FLAT_M: Final = 1.2
"""Height, in metres, of the flat arrays: 0.2 m wide, 5 m apart."""
LONGER_M: Final = 7.0
"""Length, in metres, by which the room of sounds outside is longer than the search volume, at either end."""
OUTSIDE_M: Final = (0.6, 6.8)
"""Distance, in metres, of sounds outside from the end of the search volume, least and most."""
POSES: Final = 6
"""Wrong descriptions of the arrays; each serves every sixth position."""


@dataclass(frozen=True)
class Answer:
    """One answer: its status, its error in metres, that of its best candidate, and whether it names the outside."""

    status: Status
    error_m: float
    candidate_m: float
    outside: bool


def arrays_of(kind: str) -> list[ArraySpec]:
    """Return two tetrahedra of 0.5 m, or two flat arrays, 5 m apart."""
    if kind != "flat":
        return list(pair(SIZE_M / 2.0, 1, 5))
    places = ((4.0, 7.5, FLAT_M, 0.0), (4.0, 2.5, FLAT_M, 13.0))
    return [
        ArraySpec(name, posed(circle(0.1, 6), (x, y, z), yaw), BAND_HZ)
        for name, (x, y, z, yaw) in zip("ab", places, strict=True)
    ]


def source_m(kind: str, rng: np.random.Generator) -> FloatArray:
    """Draw a position: anywhere, near a wall, near an end wall in line with the arrays, or behind that wall."""
    place_m = rng.uniform(0.0, 1.0, 3) * SIZE_M
    if kind == "wall":
        axis, gap_m = int(rng.integers(3)), rng.uniform(0.02, 0.3)
        place_m[axis] = gap_m if rng.integers(2) else SIZE_M[axis] - gap_m
    if kind == "end":
        gap_m = rng.uniform(0.02, 0.6)
        place_m = np.array([4.0, gap_m if rng.integers(2) else SIZE_M[1] - gap_m, 2.0])
        place_m[[0, 2]] += rng.uniform(-1.0, 1.0, 2)
    if kind == "outside":
        place_m[1] = SIZE_M[1] + rng.uniform(*OUTSIDE_M)
    return np.asarray(place_m)


def recordings(kind: str, specs: Sequence[ArraySpec], arguments: argparse.Namespace) -> Iterator[Recording]:
    """Simulate one clip for each position and reverberation time."""
    clips = half_of(read_clips(arguments.events, CLASSES, RATE_HZ), arguments.half)
    longer_m = np.array([0.0, LONGER_M, 0.0]) if kind == "outside" else np.zeros(3)
    for number in range(arguments.positions):
        rng = np.random.default_rng([arguments.seed, number, zlib.crc32(kind.encode())])
        place_m = source_m(kind, rng)
        responses = impulse_responses(
            tuple(SIZE_M + 2.0 * longer_m),
            place_m + longer_m,
            np.vstack([spec.microphones_m for spec in specs]) + longer_m,
            RT60S_S,
            sample_rate_hz=RATE_HZ,
            c_m_s=C_M_S,
            own_lengths=True,
            compiled=True,
        )
        for rt60_s, response in zip(RT60S_S, responses, strict=True):
            each = clips[CLASSES[int(rng.integers(len(CLASSES)))]]
            wet = convolved(each[int(rng.integers(len(each)))][1], response)
            snr_db = SNRS_DB[int(rng.integers(len(SNRS_DB)))]
            noise = np.sqrt(np.square(wet).mean(dtype=np.float64) * 10.0 ** (-snr_db / 10.0))
            samples = np.pad(wet, ((0, 0), (round(LEAD_S * RATE_HZ), 0)))
            samples = samples + (noise * rng.standard_normal(samples.shape)).astype(np.float32)
            samples = np.rint(samples / np.abs(samples).max() * 2.0**15).clip(-(2.0**15), 2.0**15 - 1) / 2.0**15
            parts = np.split(np.asarray(samples, dtype=np.float32), len(specs))
            yield Recording(number, rt60_s, place_m, dict(zip((spec.name for spec in specs), parts, strict=True)))


@dataclass(frozen=True)
class Recording:
    """The sound of one position (K, n) by array, with its true place."""

    number: int
    rt60_s: float
    place_m: FloatArray
    samples: Mapping[str, Float32Array]


def described(spec: ArraySpec, moved_m: float, turned_deg: float, rng: np.random.Generator) -> ArraySpec:
    """Return an array as a wrong site file describes it: normal errors along each axis, and about a random one."""
    axis = rng.standard_normal(3)
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    angle = np.radians(turned_deg) * rng.standard_normal()
    rotation = np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross
    positions_m = spec.centre_m + (spec.microphones_m - spec.centre_m) @ rotation.T
    return ArraySpec(spec.name, positions_m + moved_m * rng.standard_normal(3), spec.band_hz)


def answer(found: Localization, place_m: FloatArray, specs: Sequence[ArraySpec]) -> Answer:
    """Compare a localization with the truth."""
    status, why = judged(found, [spec for spec in specs if spec.name not in (found.outliers or {})])
    places_m = [
        found.position_m,
        *(each.position_m for each in getattr(found, "candidates", ())),
    ]  # older commits have none
    errors_m = [float(np.linalg.norm(each - place_m)) for each in places_m]
    return Answer(status, errors_m[0], min(errors_m), "outside the search volume" in (why or ""))


def row(rt60_s: float, answers: Sequence[Answer]) -> str:
    """Return one line of the table."""
    located = [each for each in answers if each.status is Status.LOCATED]
    directions = [each for each in answers if each.status is Status.DIRECTION_ONLY]
    return (
        f"RT60 {rt60_s:3.1f} s: {len(answers)} sounds, {len(located)} located, "
        f"{sum(each.error_m > NEAR_M for each in located)} of them wrong and "
        f"{sum(each.error_m > 1.5 for each in located)} by more than 1.5 m; {len(directions)} directions, "
        f"{sum(each.candidate_m <= NEAR_M for each in directions)} of them with a right candidate; "
        f"{sum(each.outside for each in answers)} outside"
    )


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("kind", choices=("room", "wall", "end", "outside", "flat"))
    parser.add_argument("--events", type=Path, required=True, help="folder of the clips")
    parser.add_argument("--half", choices=HALVES, default=HALVES[0])
    parser.add_argument("--positions", type=int, default=45)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--moved", type=float, default=0.0, help="error of the arrays' positions, metres")
    parser.add_argument("--turned", type=float, default=0.0, help="error of their angles, degrees")
    arguments = parser.parse_args()
    specs = arrays_of(arguments.kind)
    x, y, z = ((0.0, float(length)) for length in SIZE_M)
    estimators = []
    for pose in range(POSES if arguments.moved or arguments.turned else 1):
        rng = np.random.default_rng([arguments.seed, pose])
        believed = [described(spec, arguments.moved, arguments.turned, rng) for spec in specs]
        estimators.append((believed, create("onset", believed, Grid((x, y, z), 0.1), C_M_S)))
    answers: dict[float, list[Answer]] = {rt60_s: [] for rt60_s in RT60S_S}
    for each in recordings(arguments.kind, specs, arguments):
        believed, estimator = estimators[each.number % len(estimators)]
        sounds = {}
        for spec in believed:
            samples = each.samples[spec.name]
            frames = samples[:, : samples.shape[1] // FRAME * FRAME].reshape(len(samples), -1, FRAME)
            active = exact_mask(np.square(frames).mean(axis=(0, 2), dtype=np.float64))
            sounds[spec.name] = sound_of(estimator, spec, samples, active, RATE_HZ)
        answers[each.rt60_s].append(answer(estimator.locate(sounds), each.place_m, believed))
    for rt60_s, some in answers.items():
        print(row(rt60_s, some))
    print("all:", row(0.0, [each for some in answers.values() for each in some]).partition(": ")[2])


if __name__ == "__main__":
    main()
