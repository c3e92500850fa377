"""A sound in a free field as arrays record it, with quiet before it, for the tests of the enhancement."""

from __future__ import annotations

from typing import Final

import numpy as np

from livessl.core.enhance.beam import ArraySound
from livessl.core.geometry import tetrahedron
from livessl.core.types import ArraySpec, FloatArray

RATE_HZ: Final = 16000.0
C_M_S: Final = 343.0
QUIET_S: Final = 0.4
SOUND_S: Final = 0.6
TAIL_S: Final = 0.2
BAND_HZ: Final = (100.0, 6000.0)

NORTH: Final = ArraySpec("north", tetrahedron(0.5) + np.array([1.0, 1.2, 1.5]), BAND_HZ)
SOUTH: Final = ArraySpec("south", tetrahedron(0.4) + np.array([4.5, 3.1, 1.4]), BAND_HZ)
PLACE_M: Final = np.array([2.2, 3.3, 1.1])


def burst(seed: int = 0, rate_hz: float = RATE_HZ) -> FloatArray:
    """Noise in the arrays' band, zero outside the sound's time: (n,)."""
    rng = np.random.default_rng(seed)
    count = round((QUIET_S + SOUND_S + TAIL_S) * rate_hz)
    at_s = np.arange(count) / rate_hz
    spectrum = np.fft.rfft(np.where((at_s >= QUIET_S) & (at_s < QUIET_S + SOUND_S), rng.standard_normal(count), 0.0))
    frequencies_hz = np.fft.rfftfreq(count, 1.0 / rate_hz)
    inside = (frequencies_hz > 200.0) & (frequencies_hz < min(5000.0, 0.4 * rate_hz))
    return 0.1 * np.fft.irfft(spectrum * inside, count)


def received(spec: ArraySpec, sound: FloatArray, place_m: FloatArray = PLACE_M, rate_hz: float = RATE_HZ) -> FloatArray:
    """What the microphones receive of a sound without noise, (K, n): delayed and weakened by the distance."""
    distance_m = np.linalg.norm(spec.microphones_m - place_m, axis=1)
    frequencies_hz = np.fft.rfftfreq(len(sound), 1.0 / rate_hz)
    delays = np.exp(-2j * np.pi * frequencies_hz * distance_m[:, None] / C_M_S) / distance_m[:, None]
    return np.fft.irfft(np.fft.rfft(sound) * delays, len(sound))


def recorded(
    spec: ArraySpec, samples: FloatArray, *, time_ns: int = 0, rate_hz: float = RATE_HZ, hole: slice | None = None
) -> ArraySound:
    """Samples as an array's sound; those in the hole are missing."""
    count = samples.shape[1]
    at_s = np.arange(count) / rate_hz
    known = np.ones(count, dtype=np.bool_)
    if hole is not None:
        known[hole] = False
    given = np.asarray(samples * known, dtype=np.float32)
    quiet, sound = known & (at_s < QUIET_S - 0.02), known & (at_s >= QUIET_S) & (at_s < QUIET_S + SOUND_S)
    return ArraySound(spec, time_ns, rate_hz, given, known, quiet, sound)


def hiss(spec: ArraySpec, count: int, seed: int, level: float) -> FloatArray:
    """Noise of the microphones themselves, (K, n)."""
    return level * np.random.default_rng(seed).standard_normal((len(spec.microphones_m), count))
