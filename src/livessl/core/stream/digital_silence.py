"""Separates sound between digital silences from noise that a driver switches on and off. It reads no clock.

Digital silence is a constant signal. A driver delivers it until a device runs, and while it drops out. All channels of
the device then change at the same sample, and the noise is as strong just before the change as it was all the time.
Simulations without noise and noise gates deliver digital silence between sounds. A sound reaches the microphones one
after the other, and it decays.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Final

import numpy as np

from livessl.core.stream.activity import runs
from livessl.core.stream.timeline import Cut
from livessl.core.types import FRAME_S, BoolArray, Float32Array, FloatArray, IntArray

DIGITAL_SILENCE: Final = 1e-14
"""The in-band power, full scale squared, below which a frame is digital silence: -140 dBFS. The noise of the best
converters is 15 dB above it; zeros and other constants are below it."""

LEAST_DROPOUT_S: Final = 0.002
"""Shortest time, in seconds, in which all channels are constant that counts as a dropout. Weak noise of 16 bits is
constant for single samples."""

LEAST_SOUND: Final = 0.2
"""Least share of a frame without dropouts from which its level is known: 10 ms."""

LEAST_SILENT_FRAMES: Final = 4
"""Number of silent frames after which a sound may begin. Simulated noise that runs from the start reaches an array
at a distance of up to 50 m sooner."""

_SLOWEST_SOUND_M_S: Final = 300.0
"""Lower limit of the speed of sound, in m/s: air at -50 degrees Celsius."""

_CONSTANT: Final = 1e-7
"""Deviation from a constant, full scale, up to which a sample belongs to it: the amplitude of `DIGITAL_SILENCE`."""

_LEAST_APART_S: Final = 2e-4
"""Least spread of the arrivals, in seconds, that shows a sound. Noise that is near zero when it is switched is later by
less in a channel."""

_ARRIVED: Final = (1e-2, 2e-2, 4e-2)
"""Amplitudes, relative to the peak, at which the arrivals of a sound are compared. Below, simulations ring: they
interpolate between samples."""

_ALIKE: Final = 0.2
"""Largest difference of these arrivals between the amplitudes, relative to their spread. Noise that fades in reaches
each amplitude at another time in each channel."""

_END_S: Final = 0.02
"""Length, in seconds, of the end of a sound that is compared with what came before it. In a shorter one, the power of
low-pitched noise scatters too much."""

_BEFORE_ENDS: Final = 4
"""Length of the sound before its end, in multiples of `_END_S`."""

_FALLEN: Final = 100.0
"""Least ratio of the power before the end to that at the end, 20 dB, that shows a fast decay. Rooms with an RT60 of
0.18 s or less have it; low-pitched noise does not."""

_DECAYED: Final = 4.0
"""Least ratio of the first to the last third of half a second, 6 dB, that shows a slow decay: an RT60 of
up to 3.5 s."""

_DECAYS_STILL: Final = 1.6
"""Least ratio of the second to the last third in a slow decay, 2 dB. Noise is steady again after a short sound."""


def sound_shares(samples: Float32Array) -> FloatArray:
    """Return the share of each frame without dropouts, from 0 to 1, of frames (F, K, n) of equal rate: (F,).

    A dropout is a time of at least `LEAST_DROPOUT_S` in which all channels are constant; a frame has 50 ms.
    """
    count, _, length = samples.shape
    shares = np.ones(count)
    least = round(LEAST_DROPOUT_S / FRAME_S * length)
    first = samples[:, 0]  # most frames have no dropout, and one channel shows it
    for index in np.flatnonzero(np.count_nonzero(first[:, 1:] == first[:, :-1], axis=1) >= least):
        constant: BoolArray = np.all(samples[index, :, 1:] == samples[index, :, :-1], axis=0)
        gaps = [stop - start for start, stop in runs(constant) if stop - start >= least]
        if gaps:
            shares[index] = max(0.0, 1.0 - (sum(gaps) + 1) / length)
    return shares


class SilenceEdges:
    """Keeps the latest frames of an array, and judges how its signal begins after digital silence and ends before it.

    Parameters
    ----------
    channels : (K,) int64
        Device channels (from 0) of its microphones.
    aperture_m : float
        Largest distance between two microphones, metres.
    sample_rate_hz : float
    """

    def __init__(self, channels: IntArray, aperture_m: float, sample_rate_hz: float) -> None:
        self._channels = channels
        self._end = round(_END_S * sample_rate_hz)
        self._least_apart = _LEAST_APART_S * sample_rate_hz
        self._farthest = aperture_m / _SLOWEST_SOUND_M_S * sample_rate_hz
        self._cuts: deque[Cut] = deque(maxlen=3)
        self._levels: deque[float] = deque(maxlen=10)

    def restart(self) -> None:
        """Forget all frames, because of a gap."""
        self._cuts.clear()
        self._levels.clear()

    def push(self, cut: Cut) -> None:
        """Take in the next frame."""
        self._cuts.append(cut)

    def note_level(self, level: float) -> None:
        """Note the level of the next frame with sound, full scale squared, without dropouts."""
        self._levels.append(level)

    def begin(self) -> None:
        """Forget the levels of the sound before the silence."""
        self._levels.clear()

    def begins_as_sound(self) -> bool:
        """Return whether the sound in the latest frame reached the microphones one after the other."""
        if len(self._cuts) < 2:
            return False
        return self._come_apart(self._joined())

    def ends_as_sound(self) -> bool:
        """Return whether the sound before the latest frame, which is silent, decayed or left the microphones singly."""
        if len(self._cuts) < 2:
            return False
        backwards = self._joined()[:, ::-1]
        return self._come_apart(backwards) or self._falls_fast(backwards) or _falls_slowly(self._levels)

    def _joined(self) -> Float32Array:
        return np.concatenate([cut.samples[self._channels] for cut in self._cuts], axis=1)

    def _come_apart(self, samples: Float32Array) -> bool:
        """Return whether channels (K, n) depart from their first samples at different times, as by sound.

        Weak noise of few bits also departs at different times, but then samples are equal to those before them for as
        long.
        """
        deviation = np.abs(samples - samples[:, :1])
        live = deviation[deviation.max(axis=1) > _ARRIVED[-1] * deviation.max()]
        peak = float(deviation.max())
        if len(live) < 2 or peak <= _CONSTANT:
            return False
        arrivals = np.array([(live > max(_CONSTANT, share * peak)).argmax(axis=1) for share in _ARRIVED])
        apart = int(np.ptp(arrivals, axis=1).min())
        if apart <= self._least_apart or np.ptp(arrivals, axis=1).max() > self._farthest + 2:
            return False
        differences = arrivals - arrivals.mean(axis=1, keepdims=True)
        if np.ptp(differences, axis=0).max() > max(1.5, _ALIKE * apart):
            return False
        return all(
            apart > 2 + 2 * _longest_constant(channel[begin : begin + self._end])
            for channel, begin in zip(live, arrivals[0].tolist(), strict=True)
        )

    def _falls_fast(self, backwards: Float32Array) -> bool:
        departed = np.flatnonzero((np.abs(backwards - backwards[:, :1]) > _CONSTANT).any(axis=0))
        if not departed.size:
            return False
        sound = backwards[:, departed[0] :]
        end, before = sound[:, : self._end], sound[:, self._end : (1 + _BEFORE_ENDS) * self._end]
        if before.shape[1] < self._end:
            return False
        return bool(_FALLEN * _power(end) <= _power(before))


def _longest_constant(samples: FloatArray | Float32Array) -> int:
    """Return the largest number of consecutive samples (n,) that are equal to the one before them."""
    return max((stop - start for start, stop in runs(samples[1:] == samples[:-1])), default=0)


def _falls_slowly(levels: Sequence[float]) -> bool:
    """Return whether levels of consecutive frames fall, up to the last ones."""
    third = len(levels) // 3
    if third < 2:
        return False  # single frames of low-pitched noise scatter
    values = np.array(levels)
    first, last = float(values[:third].mean()), float(values[-third:].mean())
    middle = float(values[third:-third].mean())
    return first >= _DECAYED * last and middle >= _DECAYS_STILL * last


def _power(samples: Float32Array) -> float:
    """Return the mean power of channels (K, n) around their means, full scale squared."""
    return float(np.mean(samples.var(axis=1, dtype=np.float64)))
