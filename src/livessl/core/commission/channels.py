"""Finds faults of single channels in their samples, with or without sounds: clipping, a constant, hum, noise."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from livessl.core.commission.finding import Finding, Severity
from livessl.core.types import Float32Array, FloatArray

CLIPPED: Final = 0.995
"""Magnitude at and above which a sample counts as clipped if its neighbour does too; full scale is 1."""

MOST_CLIPPED: Final = 20
"""Clipped samples that are not told yet."""

MOST_CONSTANT: Final = 0.01
"""Magnitude of a channel's mean that is not told yet, full scale 1."""

MAINS_HZ: Final = (50.0, 60.0)
HARMONICS: Final = 6
"""Harmonics of the mains that are looked at."""

MOST_WINDOWS: Final = 120
"""Windows, the last ones, in which hum is looked for."""

LEAST_LINES: Final = 2
"""Fewest of these that are hum without the first: a single one may be any tone."""

HUM_DB: Final = 15.0
"""Height, in decibels, of a line over the spectrum beside it, from which it is hum."""

HUM_DBFS: Final = -70.0
"""Least level of the lines together, dB re full scale."""

NOISY_DB: Final = 10.0
"""Level of a channel's noise over its neighbours', in decibels, from which it is told."""

_WINDOW_S: Final = 1.0
_FRAME_S: Final = 0.05
_QUIET: Final = 20.0
"""Percentile of the frames' powers that is taken as the noise between sounds."""

_LINE_HZ: Final = 1.5
_BESIDE_HZ: Final = (4.0, 15.0)


class ChannelMeter:
    """Accumulates what the samples of one array's channels say about them.

    Parameters
    ----------
    count : int
        Number of channels, K.
    sample_rate_hz : float
    """

    def __init__(self, count: int, sample_rate_hz: float) -> None:
        self._rate_hz = sample_rate_hz
        self._window = round(_WINDOW_S * sample_rate_hz)
        self._frame = round(_FRAME_S * sample_rate_hz)
        self._hann = np.hanning(self._window)
        self._low_bins = min(self._window // 2 + 1, round((HARMONICS * max(MAINS_HZ) + _BESIDE_HZ[1]) * _WINDOW_S) + 1)
        self._low: list[FloatArray] = []  # spectrum of each window, up to the highest harmonic
        self._windows = self._samples = 0
        self._sum, self._clipped = np.zeros(count), np.zeros(count, dtype=np.int64)
        self._quiet: list[FloatArray] = []
        self._rest: Float32Array = np.zeros((count, 0), dtype=np.float32)

    def push(self, samples: Float32Array) -> None:
        """Take in the next samples (K, n)."""
        joined = np.concatenate([self._rest, samples], axis=1)
        whole = joined.shape[1] // self._window
        for index in range(whole):
            self._take(joined[:, index * self._window : (index + 1) * self._window])
        self._rest = joined[:, whole * self._window :].copy()

    def _take(self, window: Float32Array) -> None:
        self._windows += 1
        self._samples += window.shape[1]
        self._sum += window.sum(axis=1, dtype=np.float64)
        over = np.abs(window) >= CLIPPED
        self._clipped += (over[:, 1:] & over[:, :-1]).sum(axis=1)
        centred = window - window.mean(axis=1, keepdims=True)
        spectrum = np.fft.rfft(centred * self._hann, axis=1)[:, : self._low_bins]
        self._low = [*self._low[1 - MOST_WINDOWS :], np.abs(spectrum) ** 2]
        frames = window[:, : self._window // self._frame * self._frame].reshape(len(window), -1, self._frame)
        powers = (np.diff(frames, axis=2).astype(np.float64) ** 2).mean(axis=2)
        self._quiet.append(np.percentile(powers, _QUIET, axis=1))

    def faults(self, array: str) -> Iterator[Finding]:
        """Yield what is wrong with the channels of an array of that name; nothing for less than a second of samples."""
        if self._windows == 0:
            return
        mean, hum = self._sum / self._samples, self._hum_dbfs()
        floor = np.median(np.array(self._quiet), axis=0)
        floor_db = 10.0 * np.log10(np.maximum(floor, 1e-20) / max(float(np.median(floor)), 1e-20))
        for index in range(len(mean)):
            where = f"channel {index + 1} of {array!r}"
            if self._clipped[index] > MOST_CLIPPED:
                share = self._clipped[index] / self._samples
                what = f"{where} clips: {self._clipped[index]} samples, {100 * share:.2g} %"
                yield _warning("clipping", array, index, what, "lower the gain of this input")
            if abs(mean[index]) > MOST_CONSTANT:
                what = f"{where} has a constant of {mean[index]:+.3f} of full scale"
                yield _warning("dc", array, index, what, "check the input and its microphone; a high-pass filter helps")
            if (found := hum[index]) is not None:
                mains_hz, dbfs = found
                what = f"{where} hums at {mains_hz:.0f} Hz, {dbfs:.0f} dBFS"
                yield _warning("hum", array, index, what, "use balanced cables, and keep them away from mains cables")
            if floor_db[index] > NOISY_DB:
                what = f"{where} has {floor_db[index]:.0f} dB more noise than its neighbours"
                yield _warning("noisy", array, index, what, "check its cable, microphone and gain")

    def _hum_dbfs(self) -> list[tuple[float, float] | None]:
        """Frequency and level of each channel's hum; None where there is none."""
        # power of a sine at each bin; the median over the windows leaves out voices, which have lines as well
        spectrum = 2.0 * np.median(self._low, axis=0) / self._hann.sum() ** 2
        found: list[tuple[float, float] | None] = []
        for channel in spectrum:
            best: tuple[float, float] | None = None
            for mains_hz in MAINS_HZ:
                lines = [self._line(channel, n * mains_hz) for n in range(1, HARMONICS + 1)]
                if lines[0] == 0.0 and np.count_nonzero(lines) < LEAST_LINES:
                    continue
                level = 10.0 * float(np.log10(sum(lines)))
                if level >= HUM_DBFS and (best is None or level > best[1]):
                    best = mains_hz, level
            found.append(best)
        return found

    def _line(self, spectrum: FloatArray, at_hz: float) -> float:
        """Power of the line at a frequency; 0 if none stands out."""
        frequency_hz = np.arange(len(spectrum)) / _WINDOW_S
        off_hz = np.abs(frequency_hz - at_hz)
        line = float(spectrum[off_hz <= _LINE_HZ].max(initial=0.0))
        beside = spectrum[(off_hz >= _BESIDE_HZ[0]) & (off_hz <= _BESIDE_HZ[1])]
        floor = float(np.median(beside)) if len(beside) else 0.0
        return line if line > floor * 10.0 ** (HUM_DB / 10.0) else 0.0


def _warning(fault: str, array: str, index: int, message: str, cure: str) -> Finding:
    return Finding(fault, array, index + 1, Severity.WARNING, 0.95, message, cure)
