"""Aligns the beams of several arrays in time: by geometry, then by the lag that remains between their clocks."""

from __future__ import annotations

from fractions import Fraction
from typing import Any, Final, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from livessl.core.types import BoolArray, FloatArray

MOST_LAG_S: Final = 0.05
"""Greatest lag, in seconds, between two beams that is searched once known offsets and travel times are subtracted.
Clocks set by NTP differ by milliseconds; larger offsets are estimated from sounds and subtracted before."""

LEAST_PROMINENCE: Final = 5.0
"""Least ratio of the correlation's peak to its root mean square over all lags. Independent noise
gives 3 to 4.5: the largest of a thousand values. Below it the lag is unknown, and the beam is left out."""

_WHITENING: Final = 0.7
"""Exponent of the magnitudes by which the cross-spectrum is divided: 0 correlates the signals as they are, 1 is PHAT,
in which bins of noise alone count as much as the sound."""

_FINE: Final = 4
"""Points per sample at which the correlation is evaluated before its peak is interpolated."""


class Lag(NamedTuple):
    """The lag of a beam behind another one.

    Parameters
    ----------
    lag_s : float
        Positive if the beam is later.
    prominence : float
        Peak of the correlation over its root mean square.
    """

    lag_s: float
    prominence: float


def lag_between(reference: FloatArray, other: FloatArray, sample_rate_hz: float, band_hz: tuple[float, float]) -> Lag:
    """Return the lag of one signal (n,) behind another one (n,), both on one time axis, within `MOST_LAG_S`."""
    size = scipy.fft.next_fast_len(len(reference) + len(other), real=True)
    cross = np.conj(scipy.fft.rfft(reference, size)) * scipy.fft.rfft(other, size)
    frequencies_hz = np.fft.rfftfreq(size, 1.0 / sample_rate_hz)
    outside = (frequencies_hz < band_hz[0]) | (frequencies_hz > band_hz[1])
    magnitude = np.abs(cross)
    least = max(float(magnitude.max(initial=0.0)) * 1e-9, 1e-30)
    white = np.where(outside, 0.0, cross / np.maximum(magnitude, least) ** _WHITENING)
    values = scipy.fft.irfft(white, size * _FINE)
    reach = min(round(MOST_LAG_S * sample_rate_hz), size // 2 - 1) * _FINE
    near = values[np.arange(-reach, reach + 1)]
    top = int(near.argmax())
    rms = float(np.sqrt(np.square(near).mean()))
    if rms == 0.0:
        return Lag(0.0, 0.0)
    return Lag((top - reach) / (_FINE * sample_rate_hz), float(near[top]) / rms)


def shifted(signal: FloatArray, first: float, length: int) -> FloatArray:
    """Return a signal (n,) on an axis of `length` samples; its first sample is at `first`, also between samples."""
    whole = int(np.floor(first))
    part = first - whole
    if part:
        size = scipy.fft.next_fast_len(len(signal) + 64, real=True)
        delay = np.exp(-2j * np.pi * np.arange(size // 2 + 1) * part / size)
        signal = scipy.fft.irfft(scipy.fft.rfft(signal, size) * delay, size)[: len(signal) + 1]
    return _placed(signal, whole, np.zeros(length))


def shifted_mask(mask: BoolArray, first: float, length: int) -> BoolArray:
    """Return a mask (n,) on the same axis; outside it is false."""
    return _placed(mask, round(first), np.zeros(length, dtype=np.bool_))


def resampled(signal: FloatArray, from_hz: float, to_hz: float) -> FloatArray:
    """Return a signal (n,) at another sampling rate."""
    if from_hz == to_hz:
        return signal
    from scipy.signal import resample_poly  # loads slowly, and most sites have one rate

    ratio = Fraction(to_hz / from_hz).limit_denominator(1000)
    return np.asarray(resample_poly(signal, ratio.numerator, ratio.denominator))


def resampled_mask(mask: BoolArray, from_hz: float, to_hz: float, length: int) -> BoolArray:
    """Return a mask (n,) at another sampling rate, with `length` samples."""
    if from_hz == to_hz:
        return mask
    return np.asarray(mask[np.minimum(np.arange(length) * from_hz / to_hz, len(mask) - 1).astype(np.int64)])


def _placed(values: NDArray[Any], first: int, into: NDArray[Any]) -> NDArray[Any]:
    """Return `into` (n,) with values (m,) from sample `first` on; what lies outside is cut off."""
    begin, end = max(first, 0), min(first + len(values), len(into))
    if begin < end:
        into[begin:end] = values[begin - first : end - first]
    return into
