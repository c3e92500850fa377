"""The kinds of noise of the scenario `noise`, at the microphones of a room, and where they come from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from livessl.core.types import Float32Array, FloatArray
from livessl.lab.evaluate.paper import C_M_S
from livessl.lab.evaluate.unit import convolved
from livessl.simulation.noise import diffuse, fan, from_one_side, hum, intermittent, music

FROM_ONE_PLACE: Final = {"fan": fan, "hum": hum, "music": music, "intermittent": intermittent}
"""Kinds of noise of one source in the room."""

KINDS: Final = ("white", "fan", "hum", "talkers", "diffuse", "side", "music", "intermittent")
"""Kinds of noise: of the sensors, from one place, from several, from everywhere, and from outside one wall."""

Emitter = tuple[FloatArray, Float32Array]
"""Place of a source (3,), in metres, and the responses (K, m) from it to the microphones."""


@dataclass(frozen=True, slots=True)
class Noise:
    """Noise at all microphones.

    Parameters
    ----------
    samples : (K, n) float32
        Mean power 1.
    places_m : (N, 3) float64
        Places of its sources; none if it comes from no place in the room.
    """

    samples: Float32Array
    places_m: FloatArray

    def cut(self, rng: np.random.Generator, count: int) -> Noise:
        """Return a random piece of `count` samples, with a mean power of 1."""
        start = int(rng.integers(self.samples.shape[1] - count + 1))
        return Noise(of_unit_power(self.samples[:, start : start + count]), self.places_m)


def make_noise(
    kind: str,
    microphones_m: FloatArray,
    count: int,
    sample_rate_hz: float,
    rng: np.random.Generator,
    machine: Emitter,
    talkers: Sequence[Emitter],
    speech: Sequence[tuple[str, Float32Array]],
) -> Noise:
    """Make noise of a kind.

    Parameters
    ----------
    kind : str
        One of `KINDS`.
    microphones_m : (K, 3) float64
    count : int
        Number of samples.
    sample_rate_hz : float
    rng : numpy.random.Generator
    machine : Emitter
        Source of the kinds in `FROM_ONE_PLACE`.
    talkers : sequence of Emitter
    speech : sequence of (str, (n,) float32)
        Clips for the talkers.
    """
    nowhere_m = np.empty((0, 3))
    if kind == "white":
        return Noise(rng.standard_normal((len(microphones_m), count), dtype=np.float32), nowhere_m)
    if kind in ("diffuse", "side"):
        make = diffuse if kind == "diffuse" else from_one_side
        return Noise(make(rng, microphones_m, count, sample_rate_hz, C_M_S), nowhere_m)
    if kind == "talkers":
        wet = np.zeros((len(microphones_m), count), dtype=np.float32)
        for _, response in talkers:
            before = response.shape[1]
            wet += of_unit_power(convolved(_joined(speech, before + count, rng), response)[:, before : before + count])
        return Noise(of_unit_power(wet), np.array([place_m for place_m, _ in talkers]))
    place_m, response = machine
    before = response.shape[1]  # the room already sounds when the recording begins
    dry = FROM_ONE_PLACE[kind](rng, before + count, sample_rate_hz)
    return Noise(of_unit_power(convolved(dry, response)[:, before : before + count]), place_m[None])


def of_unit_power(samples: Float32Array) -> Float32Array:
    """Scale samples to a mean power of 1 over all channels."""
    return np.asarray(samples / np.sqrt(np.square(samples).mean(dtype=np.float64)), dtype=np.float32)


def _joined(clips: Sequence[tuple[str, Float32Array]], count: int, rng: np.random.Generator) -> Float32Array:
    """Return the clips, of equal power, in random order and from a random moment on: (count,)."""
    order = rng.permutation(len(clips))
    joined = np.concatenate([clips[index][1] / np.sqrt(np.square(clips[index][1]).mean()) for index in order])
    return np.asarray(np.resize(np.roll(joined, -int(rng.integers(len(joined)))), count), dtype=np.float32)
