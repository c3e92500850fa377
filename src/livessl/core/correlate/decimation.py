"""Resamples an array's sound (anti-alias low-pass, decimation) to the lower sampling rate that its band needs."""

from __future__ import annotations

from functools import lru_cache
from typing import Final

import numpy as np

from livessl.core.kernels import kernels
from livessl.core.types import Float32Array
from livessl.core.types.arrays import read_only

LEAST_RATE: Final = 2.4
"""Least ratio of the lower sampling rate to the band's upper edge. Between the edge and the frequencies that would be
folded into the band, the filter then has 0.4 times the edge to fall."""

STOP_DB: Final = 70.0
"""Attenuation, in dB, of what would be folded into the band: less of it is left than of rounding to 12 bits, and it
is the same for all microphones of a wave."""

_SPARE_TAPS: Final = 4
"""Taps beyond Kaiser's estimate of the length, which is low by up to 12 dB for filters of 20 to 50 taps."""


def decimation(sample_rate_hz: float, band_hz: tuple[float, float]) -> int:
    """Return the whole factor by which the rate can be lowered for a band; 1 if it cannot."""
    return max(1, int(sample_rate_hz / (LEAST_RATE * band_hz[1])))


class Decimator:
    """A linear-phase low-pass, of which only every so many values are computed. All channels are delayed equally.

    Parameters
    ----------
    channels : int
    factor : int
        2 or more.
    sample_rate_hz : float
    edge_hz : float
        Upper edge of the band that is kept; `factor` must be a `decimation` for it.
    """

    def __init__(self, channels: int, factor: int, sample_rate_hz: float, edge_hz: float) -> None:
        self._factor = factor
        self._taps = low_pass(factor, edge_hz / sample_rate_hz)
        self._tail: Float32Array = np.zeros((channels, len(self._taps) - 1), dtype=np.float32)

    def reset(self) -> None:
        """Start over: silence comes before the next samples."""
        self._tail = np.zeros((len(self._tail), len(self._taps) - 1), dtype=np.float32)

    def push(self, samples: Float32Array) -> Float32Array:
        """Return what the next samples (K, n) add at the lower rate, (K, m)."""
        joined = np.concatenate([self._tail, samples], axis=1)
        count = max(0, (joined.shape[1] - len(self._taps)) // self._factor + 1)
        lower = np.empty((len(joined), count), dtype=np.float32)
        kernels.decimate(joined, self._taps, self._factor, lower)
        self._tail = joined[:, count * self._factor :].copy()
        return lower


@lru_cache(16)
def low_pass(factor: int, edge: float) -> Float32Array:
    """Return the taps of the low-pass, a sinc under a Kaiser window; `edge` is relative to the sampling rate.

    Kaiser's formulas (Oppenheim and Schafer, Discrete-Time Signal Processing, section 7.6) give the length and the
    window's shape for `STOP_DB` between the edge and the lowest frequency that would be folded onto it.
    """
    stop = 1.0 / factor - edge
    count = int(np.ceil((STOP_DB - 7.95) / (2.285 * 2.0 * np.pi * (stop - edge)))) + _SPARE_TAPS | 1
    at = np.arange(count) - count // 2
    taps = np.sinc(at / factor) * np.kaiser(count, 0.1102 * (STOP_DB - 8.7))
    unity: Float32Array = (taps / taps.sum()).astype(np.float32)
    read_only(unity)
    return unity
