"""Sound in free air for the tests of the core: exact fractional delays, and arrays that lie off every symmetry."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import ArrayLike
from scipy.signal.windows import tukey

from livessl.core.geometry import posed, tetrahedron
from livessl.core.types import GCC, ArraySpec, Float32Array, FloatArray

C_M_S: Final = 343.0
RATE_HZ: Final = 16000.0
BAND_HZ: Final = (100.0, 6000.0)
MARGIN: Final = 400
"""Silent samples on both sides of a burst: 25 ms at 16 kHz, more than any delay within an array here."""


def tetra(name: str, centre_m: ArrayLike, edge_m: float = 0.3, yaw_deg: float = 17.0) -> ArraySpec:
    """A small tetrahedron, turned so that no axis of it is one of the room's."""
    return ArraySpec(name, posed(tetrahedron(edge_m), centre_m, yaw_deg, 4.0, -3.0), BAND_HZ)


def burst(n: int, seed: int = 0, highest: float = 0.95) -> FloatArray:
    """White noise (n,) up to a share of half the sampling rate, with silent margins, so that it may be delayed."""
    window = np.zeros(n)
    window[MARGIN:-MARGIN] = tukey(n - 2 * MARGIN, 0.2)
    spectrum = np.fft.rfft(np.random.default_rng(seed).standard_normal(n) * window)
    share = np.linspace(0.0, 1.0, len(spectrum)) / highest
    roll_off = 0.5 + 0.5 * np.cos(np.pi * np.clip((share - 0.9) / 0.1, 0.0, 1.0))  # smooth: nothing rings into margins
    return np.asarray(0.1 * np.fft.irfft(spectrum * roll_off, n))


def delayed(sound: FloatArray, delays_s: ArrayLike, rate_hz: float = RATE_HZ) -> Float32Array:
    """The sound (n,) at each of K delays in seconds, fractions of a sample exact: (K, n)."""
    frequency_hz = np.fft.rfftfreq(len(sound), 1.0 / rate_hz)
    phase = np.exp(-2j * np.pi * frequency_hz * np.asarray(delays_s, dtype=np.float64)[:, None])
    return np.fft.irfft(np.fft.rfft(sound) * phase, len(sound), axis=1).astype(np.float32)


def heard(
    spec: ArraySpec, source_m: ArrayLike, sound: FloatArray, rate_hz: float = RATE_HZ, c_m_s: float = C_M_S
) -> Float32Array:
    """What the array's microphones hear of a source, (K, n): differences of delay only, no attenuation."""
    distance_m = np.linalg.norm(spec.microphones_m - np.asarray(source_m), axis=1)
    return delayed(sound, (distance_m - distance_m.mean()) / c_m_s, rate_hz)


def true_lags_s(microphones_m: FloatArray, source_m: ArrayLike, c_m_s: float = C_M_S) -> FloatArray:
    """For pairs (0, 1), (0, 2), ... how much later the second hears it: written out, with nothing from the core."""
    travel_s = [float(np.linalg.norm(np.asarray(source_m) - m)) / c_m_s for m in microphones_m]
    return np.array([later - first for i, first in enumerate(travel_s) for later in travel_s[i + 1 :]])


def ideal_gcc(spec: ArraySpec, lags_s: Sequence[float] | FloatArray, rate_hz: float = RATE_HZ) -> GCC:
    """GCC of a coherent sound at the given lag of each pair, in closed form: the mean of cos over the band."""
    reach = int(np.ceil(spec.aperture_m / C_M_S * rate_hz)) + 2
    axis_s = np.arange(-8 * reach, 8 * reach + 1) / (8.0 * rate_hz)
    count = len(spec.microphones_m)
    pairs = np.array([(i, k) for i in range(count) for k in range(i + 1, count)])
    return GCC(pairs, axis_s, band_mean_cos(axis_s - np.asarray(lags_s)[:, None], spec.band_hz))


def band_mean_cos(lag_s: FloatArray, band_hz: tuple[float, float]) -> FloatArray:
    """Mean over the band of cos(2 pi f tau)."""
    low, high = band_hz
    return np.asarray((high * np.sinc(2.0 * high * lag_s) - low * np.sinc(2.0 * low * lag_s)) / (high - low))


def peak_lags_s(gcc: GCC) -> FloatArray:
    """Lag of each pair's greatest value, by the parabola through it and its neighbours: (P,)."""
    row = np.arange(len(gcc.values))
    top = gcc.values.argmax(axis=1)
    before, at, after = (gcc.values[row, top + shift] for shift in (-1, 0, 1))
    shift = 0.5 * (before - after) / (before - 2.0 * at + after)
    return np.asarray(gcc.lags_s[top] + shift * (gcc.lags_s[1] - gcc.lags_s[0]))
