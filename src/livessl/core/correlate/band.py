"""Frequency bands: which bins lie inside, the power in a band, dead channels, and when a band wants the envelope.

It is light, because every check of a site file loads it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
import scipy.fft

from livessl.core.types import BoolArray, Float32Array, FloatArray

ENVELOPE_ABOVE: Final = 0.25
"""Lower band edge over band width from which the envelope is used; 100 to 6000 Hz has 0.017, 4 to 16 kHz 0.33."""

DEAD: Final = 1e-3
"""A microphone 30 dB below the second loudest of its array hears nothing: half a metre from a source, another
half a metre makes 6 dB."""


def uses_envelope(band_hz: tuple[float, float]) -> bool:
    """Whether R is the magnitude instead of the real part: see `GCCPhat`."""
    low, high = band_hz
    return low > ENVELOPE_ABOVE * (high - low)


def band_power(samples: Float32Array, sample_rate_hz: float, band_hz: tuple[float, float]) -> FloatArray:
    """Mean power of each channel inside a band, by Parseval's theorem.

    Rumble and offsets below the band would else decide what is loud; the paper's sounds lie inside it.

    Parameters
    ----------
    samples : (channels, n) float32
    sample_rate_hz : float
    band_hz : (float, float)

    Returns
    -------
    (channels,) float64
        Full scale squared.
    """
    n = samples.shape[1]
    if n == 0:
        return np.zeros(len(samples))
    spectrum = scipy.fft.rfft(samples, axis=1)
    low, high = band_bins(n, sample_rate_hz, band_hz)
    inside = spectrum[:, low:high]
    return np.asarray(2.0 * (inside.real**2 + inside.imag**2).sum(axis=1, dtype=np.float64) / n**2)


def band_bins(n_fft: int, sample_rate_hz: float, band_hz: tuple[float, float]) -> tuple[int, int]:
    """First bin inside a band and first above it, of an `n_fft`-point real FFT; never the bin at 0 Hz."""
    low = max(1, int(np.ceil(band_hz[0] * n_fft / sample_rate_hz)))
    high = min(n_fft // 2, int(np.floor(band_hz[1] * n_fft / sample_rate_hz)))
    return low, high + 1


def dead_channels(segments: Sequence[Float32Array]) -> BoolArray:
    """Which channels of an array's sound, in segments (K, n) each, are dead: (K,).

    The second loudest is what the others are held against: the loudest may be a broken one that crackles. Where fewer
    than two are left, none is called dead, for there is nothing to compare. A constant offset is no sound.
    """
    powers = [np.einsum("kn,kn->k", each, each) - each.shape[1] * each.mean(axis=1) ** 2 for each in segments]
    power = np.sum(powers, axis=0, dtype=np.float64)
    return np.asarray(power < DEAD * np.sort(power)[-2])
