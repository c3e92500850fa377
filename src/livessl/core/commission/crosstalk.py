"""Finds crosstalk: channels that receive each other's signal through interface or cable, without delay.

Through the air, a sound reaches two microphones with a delay that depends on its place. Through the interface, the
sound and the noise of the other channel arrive without delay. The phases between two channels, in all bins of the
spectrum, therefore have a common part at delay 0 that remains when many windows are combined. A fan in the middle
between two microphones has the same effect in pauses, but not during sounds. The common part must therefore be present
during sounds as well.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from itertools import combinations
from typing import Final

import numpy as np
import scipy

from livessl.core.commission.finding import Finding, Severity
from livessl.core.types import ComplexArray, Float32Array, FloatArray

WINDOW_S: Final = 0.5
"""Length of a window, seconds: long compared with reverberation and delays, so that the phases of bins are
independent."""

MOST_WINDOWS: Final = 240
"""Number of latest windows that are combined."""

LEAST_WINDOWS: Final = 6
"""Fewest windows with sound from which crosstalk is judged."""

LOUD: Final = 10.0
"""Least power of a window with sound, relative to the quietest fifth of windows."""

WITH_SOUND: Final = 0.5
"""Least common part in windows with sound, relative to the common part in all windows."""

LEAST_LAG: Final = 6
"""Smallest delay, in samples, between two microphones that are compared: with less, delay 0 does not stand out."""

MOST_PAIRS: Final = 28
"""Largest number of pairs of channels that are compared: those of eight channels. With more channels, each is compared
with the next one."""

LEAST_SHARE: Final = 0.03
"""Least common part that is reported: crosstalk of about -28 dB."""

MOST_SHARE: Final = 0.5
"""Common part above which two channels have the same signal, which is another fault."""

STANDING: Final = 5.0
"""Least ratio of the common part at delay 0 to the median at other delays; random phases exceed 4.5 once in 10^6."""

_BESIDE: Final = 2
"""Delay, in samples, from which the common part at delay 0 has no influence."""

_NEAR: Final = 5
"""Delay, in samples, up to which the sound field itself is the same as at delay 0."""

_SHARE_OF_LEVEL: Final = np.pi / 4.0
"""Common part for a level of crosstalk of 1, to first order, if the bins of both channels are independent and Gaussian
with equal power: half the mean of the inverse ratio of their magnitudes, which is pi/2."""


class CrosstalkMeter:
    """Measures crosstalk between the channels of one array from its samples.

    Parameters
    ----------
    microphones_m : (K, 3) float64
        Metres.
    sample_rate_hz : float
    c_m_s : float
        Speed of sound, m/s.
    """

    def __init__(self, microphones_m: FloatArray, sample_rate_hz: float, c_m_s: float) -> None:
        lags = {
            (i, k): int(np.linalg.norm(microphones_m[i] - microphones_m[k]) / c_m_s * sample_rate_hz)
            for i, k in combinations(range(len(microphones_m)), 2)
        }
        pairs = [pair for pair, lag in lags.items() if lag >= LEAST_LAG]
        if len(pairs) > MOST_PAIRS:
            pairs = [(i, k) for i, k in pairs if k == i + 1]
        self._pairs = pairs
        self._lags = [lags[pair] for pair in pairs]
        self._window = scipy.fft.next_fast_len(round(WINDOW_S * sample_rate_hz), real=True) + 1
        self._windows: deque[tuple[FloatArray, ComplexArray]] = deque(maxlen=MOST_WINDOWS)
        self._rest: Float32Array = np.zeros((len(microphones_m), 0), dtype=np.float32)

    def push(self, samples: Float32Array) -> None:
        """Take in the next samples (K, n)."""
        if not self._pairs:
            return
        joined = np.concatenate([self._rest, samples], axis=1)
        whole = joined.shape[1] // self._window
        for index in range(whole):
            self._take(joined[:, index * self._window : (index + 1) * self._window])
        self._rest = joined[:, whole * self._window :].copy()

    def shares(self) -> dict[tuple[int, int], float]:
        """Return the common part at delay 0 of each pair of channels, from 0, that has crosstalk; 0 to 1."""
        if not self._windows:
            return {}
        powers = np.array([power for power, _ in self._windows])
        loud = powers >= LOUD * np.percentile(powers, 20, axis=0)
        correlations = np.array([correlation for _, correlation in self._windows])
        found = {}
        for index, ((i, k), most) in enumerate(zip(self._pairs, self._lags, strict=True)):
            with_sound = correlations[loud[:, i] | loud[:, k], index]
            if len(with_sound) < LEAST_WINDOWS:
                continue
            share, standing = _common_part(correlations[:, index], most)
            if LEAST_SHARE <= share < MOST_SHARE and standing >= STANDING:
                there, _ = _common_part(with_sound, most)
                if there >= WITH_SOUND * share:
                    found[i, k] = share
        return found

    def faults(self, array: str) -> Iterator[Finding]:
        """Yield a warning for each channel with crosstalk; for both of a pair if neither is in all pairs."""
        shares = self.shares()
        common = set.intersection(*(set(pair) for pair in shares)) if len(shares) > 1 else set()
        for index in sorted(common or {index for pair in shares for index in pair}):
            partners = {k if i == index else i: share for (i, k), share in shares.items() if index in (i, k)}
            level_db = 20.0 * float(np.log10(max(partners.values()) / _SHARE_OF_LEVEL))
            *others, last = (f"{other + 1}" for other in sorted(partners))
            names = f"channels {', '.join(others)} and {last}" if others else f"channel {last}"
            yield Finding(
                "crosstalk",
                array,
                index + 1,
                Severity.WARNING,
                0.95,
                f"channel {index + 1} of {array!r} and {names} leak into each other at about {level_db:.0f} dB",
                "keep their cables apart, check the plugs and the ground, and switch off mixing in the interface",
            )

    def _take(self, window: Float32Array) -> None:
        """Keep the power of a window, and its mean phases between the channels at the examined delays."""
        spectra = scipy.fft.rfft(np.diff(window, axis=1), axis=1)[:, 1:]
        magnitudes = np.abs(spectra)
        unit = np.divide(spectra, magnitudes, out=np.zeros_like(spectra), where=magnitudes > 0.0)
        cross = np.zeros((len(self._pairs), self._window - 1), dtype=spectra.dtype)
        for index, (i, k) in enumerate(self._pairs):
            cross[index, 1 : 1 + spectra.shape[1]] = np.conj(unit[i]) * unit[k]
        most = max(self._lags)
        correlation = scipy.fft.ifft(cross, axis=1) * (cross.shape[1] / spectra.shape[1])
        lags = np.arange(-most, most + 1)
        power = (magnitudes.astype(np.float64) ** 2).mean(axis=1)
        self._windows.append((power, correlation[:, lags].astype(np.complex64)))


def _common_part(correlations: ComplexArray, most: int) -> tuple[float, float]:
    """Return the common part at delay 0 of windows (W, L), and its ratio to the median at other delays."""
    middle = correlations.shape[1] // 2
    combined = np.median(correlations.real, axis=0) + 1j * np.median(correlations.imag, axis=0)
    lags = np.abs(np.arange(correlations.shape[1]) - middle)
    near = combined[(lags >= _BESIDE) & (lags <= _NEAR)]
    field = np.median(near.real) + 1j * np.median(near.imag)
    others = np.abs(combined - field)[(lags >= _BESIDE) & (lags <= most)]
    share = float(abs(combined[middle] - field))
    return share, share / max(float(np.median(others)), 1e-9)
