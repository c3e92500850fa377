"""Activity detection on 50 ms frames: the paper's rule, exact over a finished event and causal for live use.

The rule (Garcia-Barrios et al., section on the sound activity detector): a frame is active where its mean power is at
least a tenth of the reference power. Exact, the reference is the event's maximum; live, a decaying maximum, never so
low that the background could reach a tenth of it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import scipy.fft

from livessl.core.types import FRAME_S, BoolArray, Float32Array, FloatArray

THRESHOLD: Final = 0.1
"""Active at or above this share of the reference power: the paper's 10 %."""

DEAD: Final = 1e-3
"""A microphone 30 dB below the second loudest of its array hears nothing: half a metre from a source, another
half a metre makes 6 dB."""

_FLOOR_SMOOTHING: Final = 5
"""Frames averaged before the minimum is taken: a 50 ms frame of low-pitched noise alone scatters by several dB."""


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


def is_active(power: FloatArray, reference: float | FloatArray, threshold: float = THRESHOLD) -> BoolArray:
    """The rule: active where power >= threshold * reference, and there is any power at all."""
    return np.asarray((power >= threshold * np.asarray(reference)) & (power > 0.0))


def exact_mask(power: FloatArray, threshold: float = THRESHOLD) -> BoolArray:
    """Which frames of a finished event are active: its own maximum is the reference. `power` (n,)."""
    return is_active(power, float(power.max()), threshold) if len(power) else np.zeros(0, dtype=np.bool_)


def runs(mask: BoolArray) -> list[tuple[int, int]]:
    """Segments of consecutive active frames, as (start, stop) indices."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return [(int(start), int(stop)) for start, stop in zip(edges[::2], edges[1::2], strict=True)]


@dataclass(frozen=True, slots=True)
class ActivityParameters:
    """Numbers of the causal form.

    Parameters
    ----------
    threshold : float
        The rule's share of the reference.
    release_s : float
        Time constant of the decaying maximum. 1 s is 4 dB a second: slower than any room's decay, so that
        reverberation ends a sound instead of becoming one.
    floor_window_s : float
        The background is the least smoothed power in this time.
    floor_factor : float
        Sound is this much above the background.
    min_power : float
        Below this nothing is sound, full scale squared.
    pre_roll_s, hang_over_s : float
        What is kept before the first and after the last active frame.
    """

    threshold: float = THRESHOLD
    release_s: float = 1.0
    floor_window_s: float = 3.0
    floor_factor: float = 4.0
    min_power: float = 1e-9
    pre_roll_s: float = 0.4
    hang_over_s: float = 0.3

    def least_power(self, floor_power: float) -> float:
        """Return the least power, full scale squared, at which a frame can be active over a background."""
        return max(self.floor_factor * floor_power, self.min_power)


class CausalActivity:
    """The rule, frame by frame, knowing only the past."""

    def __init__(self, parameters: ActivityParameters) -> None:
        self._parameters = parameters
        self._keep = float(np.exp(-FRAME_S / parameters.release_s))
        self._maximum = 0.0
        self._latest: deque[float] = deque(maxlen=_FLOOR_SMOOTHING)
        self._smoothed: deque[float] = deque(maxlen=max(1, round(parameters.floor_window_s / FRAME_S)))

    @property
    def floor_power(self) -> float:
        """The background, full scale squared; 0 before anything is known."""
        return min(self._smoothed, default=0.0)

    def prime(self, floor_power: float) -> None:
        """Start from a background already seen."""
        self._smoothed.append(floor_power)

    def push(self, power: float) -> bool:
        """Whether the next frame, of this mean power, is active."""
        parameters = self._parameters
        self._maximum = max(self._maximum * self._keep, power)
        reference = max(self._maximum, parameters.least_power(self.floor_power) / parameters.threshold)
        self._latest.append(power)
        self._smoothed.append(sum(self._latest) / len(self._latest))
        return bool(is_active(np.asarray(power), reference, parameters.threshold))
