"""Talkers in a small room, and two channels exchanged: how many places are right, and how many of them nobody is at.

`python benchmarks/close_talkers.py KIND [--events N] [--seed S] [--size X Y Z] [--rt60 S]`. A talker is alone (`one`),
two talk at once, nearer than a metre to one another (`near`) or 1.5 m to 3 m apart (`far`), or one talks while two
channels of the first array are exchanged (`exchanged`). Voices are made up, and 0.3 m or more from walls, floor and
ceiling; two tetrahedra of 0.3 m or 0.5 m are turned at random. The results are in
docs/decisions/0081-what-one-array-alone-receives.md.
"""

from __future__ import annotations

import argparse
from collections import Counter
from typing import Final

import numpy as np

from livessl.core.geometry import posed, tetrahedron
from livessl.core.types import ArraySpec, Event, Float32Array, FloatArray, Status
from livessl.lab.evaluate.unit import convolved
from livessl.recordings.assign import AssignedRecording
from livessl.recordings.recording import MemoryRecording
from livessl.simulation.room import impulse_responses
from mixtures import BAND_HZ, C_M_S, RATE_HZ, site_of
from recordings import events_in

KINDS: Final = ("one", "near", "far", "exchanged")

PLACES: Final = ((0.48, 0.26, 0.47), (0.55, 0.76, 0.5))
"""Places of the arrays as shares of the room's size."""

NEAR_M: Final = 0.5
"""Largest error, in metres, of a place that counts as right."""

WALL_M: Final = 0.3
"""Least distance, in metres, of a voice from walls, floor and ceiling."""

ARRAY_M: Final = 0.5
"""Least distance, in metres, of a voice from a microphone."""

TALK_S: Final = 1.6
LEAD_S: Final = 1.2
LENGTH_S: Final = 4.2

NOISE: Final = 1e-3
"""Root mean square of the microphones' noise, relative to the highest sample."""


def talk(rng: np.random.Generator) -> Float32Array:
    """Return voiced syllables (n,) with pauses."""
    times_s = np.arange(round(TALK_S * RATE_HZ)) / RATE_HZ
    pitch_hz = 120.0 + 60.0 * rng.random() + 15.0 * np.sin(2.0 * np.pi * 3.0 * times_s + 6.0 * rng.random())
    phase = 2.0 * np.pi * np.cumsum(pitch_hz) / RATE_HZ
    voice = sum(np.sin(order * phase) / order**0.7 for order in range(1, 25)) + 0.3 * rng.standard_normal(len(times_s))
    syllables = np.clip(np.sin(2.0 * np.pi * (3.2 + rng.random()) * times_s + 6.0 * rng.random()), 0.0, 1.0) ** 0.7
    return np.asarray(voice / np.abs(voice).max() * syllables, dtype=np.float32)


def drawn_places_m(kind: str, size_m: FloatArray, microphones_m: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Draw the places of the voices (N, 3)."""
    while True:
        first_m, turn = rng.uniform(WALL_M, size_m - WALL_M), rng.uniform(0.0, 2.0 * np.pi)
        apart_m = rng.uniform(0.4, 0.95) if kind == "near" else rng.uniform(1.5, 3.0)
        second_m = first_m + apart_m * np.array([np.cos(turn), np.sin(turn), rng.uniform(-0.2, 0.2)])
        places_m = np.array([first_m, second_m])[: 2 if kind in ("near", "far") else 1]
        clear_m = np.linalg.norm(microphones_m - places_m[:, None], axis=2).min()
        if (places_m > WALL_M).all() and (places_m < size_m - WALL_M).all() and clear_m > ARRAY_M:
            return places_m


def located(kind: str, size_m: FloatArray, rt60_s: float, rng: np.random.Generator) -> tuple[FloatArray, list[Event]]:
    """Play and locate voices; return their places, and the events."""
    edge_m = float(rng.choice([0.3, 0.5]))
    specs = [
        ArraySpec(name, posed(tetrahedron(edge_m), tuple(share * size_m), rng.uniform(0.0, 360.0)), BAND_HZ)
        for name, share in zip(("north", "south"), np.array(PLACES), strict=True)
    ]
    microphones_m = np.vstack([spec.microphones_m for spec in specs])
    places_m = drawn_places_m(kind, size_m, microphones_m, rng)
    samples, begin = np.zeros((8, round(LENGTH_S * RATE_HZ)), dtype=np.float32), round(LEAD_S * RATE_HZ)
    for place_m in places_m:
        (response,) = impulse_responses(
            tuple(size_m), place_m, microphones_m, [rt60_s], sample_rate_hz=RATE_HZ, c_m_s=C_M_S, own_lengths=True,
            compiled=True,
        )  # fmt: skip
        wet = convolved(talk(rng), response)[:, : samples.shape[1] - begin]
        samples[:, begin : begin + wet.shape[1]] += wet
    samples *= np.float32(0.3 / np.abs(samples).max())
    samples += np.float32(0.3 * NOISE) * rng.standard_normal(samples.shape, dtype=np.float32)
    if kind == "exchanged":
        pair = rng.choice(4, 2, replace=False)
        samples[pair] = samples[pair[::-1]]
    parts = [
        AssignedRecording(spec.name, MemoryRecording("talk", float(RATE_HZ), each), 0, (1, 2, 3, 4))
        for spec, each in zip(specs, np.split(samples, 2), strict=True)
    ]
    return places_m, events_in(site_of("talk", specs, size_m.tolist(), None), parts)


def counted(places_m: FloatArray, events: list[Event]) -> Counter[str]:
    """Count what the events of one recording are."""
    counts: Counter[str] = Counter()
    for event in events:
        order = "first" if event.source == 1 else "second"
        if event.status is not Status.LOCATED or event.estimate is None:
            counts[f"{order} {event.status}"] += 1
            continue
        off_m = np.linalg.norm(places_m - event.estimate.position_m, axis=1).min()
        counts[f"{order} {'right' if off_m <= NEAR_M else 'wrong'}"] += 1
    return counts


def main() -> None:
    """Play voices, and print the counts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kind", choices=KINDS)
    parser.add_argument("--events", type=int, default=90, help="recordings (90)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--size", type=float, nargs=3, default=[4.0, 5.0, 3.0], help="the room, in metres (4 5 3)")
    parser.add_argument("--rt60", type=float, default=0.4, help="reverberation time, in seconds (0.4)")
    given = parser.parse_args()
    counts: Counter[str] = Counter()
    for number in range(given.events):
        rng = np.random.default_rng([given.seed, number, KINDS.index(given.kind)])
        counts += counted(*located(given.kind, np.array(given.size), given.rt60, rng))
    print(f"{given.kind}, {given.events} recordings: {dict(sorted(counts.items()))}")


if __name__ == "__main__":
    main()
