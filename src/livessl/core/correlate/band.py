"""Applies an array's frequency band: bins inside it, power in it, dead channels of a sound, when the envelope is used.

Which band is used: the default of `band_hz` is in `site/models.py`, an array's own in `site/build/arrays.py`.

Checking a site file loads this module, so it imports nothing that locates.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
import scipy

from livessl.core.types import BoolArray, ComplexArray, Float32Array, FloatArray

ENVELOPE_ABOVE: Final = 0.25
"""Ratio of lower band edge to band width above which the envelope is used: 0.017 for 100 to 6000 Hz, 0.33 for 4 to
16 kHz."""

DEAD: Final = 1e-3
"""Power relative to the second loudest microphone of the array, 30 dB lower, below which a microphone is dead. Distance
cannot explain so much: half a metre from a source, another half a metre makes 6 dB."""


def uses_envelope(band_hz: tuple[float, float]) -> bool:
    """Return whether a band's GCC is the magnitude instead of the real part: see `GCCPhat`."""
    low, high = band_hz
    return low > ENVELOPE_ABOVE * (high - low)


def band_power(samples: Float32Array, sample_rate_hz: float, band_hz: tuple[float, float]) -> FloatArray:
    """Mean power of each channel inside a band, by Parseval's theorem.

    Without the band, rumble and offsets would decide what is loud.

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
    return spectrum_power(scipy.fft.rfft(samples, axis=1), n, sample_rate_hz, band_hz)


def spectrum_power(
    spectra: ComplexArray, count: int, sample_rate_hz: float, band_hz: tuple[float, float]
) -> FloatArray:
    """Mean power (K,) of each channel inside a band, full scale squared, from spectra (K, F) of `count` samples."""
    low, high = band_bins(count, sample_rate_hz, band_hz)
    inside = spectra[:, low:high]
    return np.asarray(2.0 * (inside.real**2 + inside.imag**2).sum(axis=1, dtype=np.float64) / count**2)


def band_bins(n_fft: int, sample_rate_hz: float, band_hz: tuple[float, float]) -> tuple[int, int]:
    """First bin inside a band and first bin above it, in an `n_fft`-point real FFT; the bin at 0 Hz is never inside."""
    low = max(1, int(np.ceil(band_hz[0] * n_fft / sample_rate_hz)))
    high = min(n_fft // 2, int(np.floor(band_hz[1] * n_fft / sample_rate_hz)))
    return low, high + 1


def dead_channels(segments: Sequence[Float32Array]) -> BoolArray:
    """Find the dead channels of an array's sound, given in segments (K, n): (K,).

    Channels are compared with the second loudest, because the loudest may be broken and crackle. In silence, and with
    sound on one channel alone, none is called dead. A constant offset does not count as sound.
    """
    power = np.sum([_centred_power(each) for each in segments], axis=0)
    return np.asarray(power < DEAD * np.sort(power)[-2])


def _centred_power(samples: Float32Array) -> FloatArray:
    """Return the power (K,) of the samples (K, n) around their means; the difference of squares would cancel."""
    count = samples.shape[1]
    means = samples @ np.full(count, 1.0 / max(count, 1), dtype=np.float32)
    return np.array([np.vdot(row, row) for row in samples - means[:, None]], dtype=np.float64)
