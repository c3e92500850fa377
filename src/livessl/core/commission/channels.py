"""Finds faults of single channels in their samples: clipping, a constant (DC), mains hum, noise above the others.

`findings` finds dead, deaf, copied and inverted channels by the sounds that arrays received. Swapped channels are
tried in `hypotheses`, compared in `judge` (in `trial` for sounds at known places), and chosen in `diagnosis`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import scipy

from livessl.core.commission.finding import Finding, Severity
from livessl.core.types import Float32Array, FloatArray

CLIPPED: Final = 0.995
"""Magnitude at and above which a sample counts as clipped if its neighbour does too; full scale is 1."""

MOST_CLIPPED: Final = 20
"""Greatest number of clipped samples that is not reported."""

MOST_CONSTANT: Final = 0.01
"""Greatest magnitude of a channel's mean, full scale 1, that is not reported."""

MAINS_HZ: Final = (50.0, 60.0)
HARMONICS: Final = 6
"""Number of harmonics of the mains that are examined."""

MOST_WINDOWS: Final = 120
"""Number of windows, the latest, in which hum is looked for."""

LEAST_LINES: Final = 2
"""Fewest harmonics that count as hum if the first one is missing: a single one may be any tone."""

HUM_DB: Final = 15.0
"""Height, in decibels, of a line over the spectrum beside it, from which it is hum."""

HUM_DBFS: Final = -70.0
"""Least level of the lines together, dB re full scale."""

NOISY_DB: Final = 10.0
"""Level of a channel's noise above that of its neighbours, in decibels, from which it is reported."""

CLIPPING_CURE: Final = "lower the gain of this input"

SILENCE_DBFS: Final = -200.0
"""Level that stands for digital silence, dB re full scale."""

_WINDOW_S: Final = 1.0
_FRAME_S: Final = 0.05
_QUIET: Final = 20.0
"""Percentile of the frames' powers that is taken as the noise between sounds."""

_LINE_HZ: Final = 1.5
_BESIDE_HZ: Final = (4.0, 15.0)


@dataclass(frozen=True, slots=True)
class ChannelFigures:
    """The figures of one channel.

    Parameters
    ----------
    mean : float
        Mean of the samples, full scale 1.
    hum_hz : float or None
        Frequency of the mains whose lines stand out, Hz; None if none do.
    hum_dbfs : float or None
        Level of these lines together, dB re full scale squared; None without hum.
    noise_dbfs : float
        Power about the mean in the quietest fifth of frames of 50 ms, dB re full scale squared.
    roughness : float
        Mean squared difference of neighbouring samples in these frames: noise with less weight on low frequencies.
    """

    mean: float
    hum_hz: float | None
    hum_dbfs: float | None
    noise_dbfs: float
    roughness: float


def dbfs(power: float) -> float:
    """Return a power in dB re full scale squared, so that a sine of full scale has -3; silence is `SILENCE_DBFS`."""
    return max(SILENCE_DBFS, 10.0 * float(np.log10(max(power, 1e-30))))


def noise_over_neighbours_db(figures: Sequence[ChannelFigures]) -> list[float]:
    """Return how far the noise of each channel is above the median of all, in decibels."""
    median = float(np.median([of.roughness for of in figures])) if figures else 0.0
    return [10.0 * float(np.log10(max(of.roughness, 1e-20) / max(median, 1e-20))) for of in figures]


class ChannelMeter:
    """Accumulates what the samples of one array's channels say about them.

    Parameters
    ----------
    count : int
        Number of channels, K.
    sample_rate_hz : float
    windows : int or None
        Number of seconds, the last ones, that mean, hum and noise are taken from; None for all (for hum the last
        `MOST_WINDOWS`).

    Attributes
    ----------
    clipped : (K,) int64
        Clipped samples of each channel so far.
    windows : int
        Whole windows of one second so far.
    """

    def __init__(self, count: int, sample_rate_hz: float, windows: int | None = None) -> None:
        self._window = round(_WINDOW_S * sample_rate_hz)
        self._frame = round(_FRAME_S * sample_rate_hz)
        self._hann = np.hanning(self._window).astype(np.float32)
        self._low_bins = min(self._window // 2 + 1, round((HARMONICS * max(MAINS_HZ) + _BESIDE_HZ[1]) * _WINDOW_S) + 1)
        # spectrum of each window, up to the highest harmonic
        self._low: deque[FloatArray] = deque(maxlen=min(windows or MOST_WINDOWS, MOST_WINDOWS))
        self._means: deque[FloatArray] = deque(maxlen=windows)
        self._rough: deque[FloatArray] = deque(maxlen=windows)
        self._quiet: deque[FloatArray] = deque(maxlen=windows)
        self._samples = 0
        self._last_over = np.zeros((count, 1), dtype=np.bool_)
        self._rest: Float32Array = np.zeros((count, 0), dtype=np.float32)
        self.windows = 0
        self.clipped = np.zeros(count, dtype=np.int64)

    def push(self, samples: Float32Array) -> None:
        """Take in the next samples (K, n)."""
        over = np.concatenate([self._last_over, np.abs(samples) >= CLIPPED], axis=1)
        self.clipped += (over[:, 1:] & over[:, :-1]).sum(axis=1)
        self._last_over = over[:, -1:]
        self._samples += samples.shape[1]
        joined = np.concatenate([self._rest, samples], axis=1)
        whole = joined.shape[1] // self._window
        for index in range(whole):
            self._take(joined[:, index * self._window : (index + 1) * self._window])
        self._rest = joined[:, whole * self._window :].copy()

    def _take(self, window: Float32Array) -> None:
        self.windows += 1
        self._means.append(window.mean(axis=1, dtype=np.float64))
        centred = window - window.mean(axis=1, keepdims=True)
        # in single precision, whose errors are far below the least hum: four times as fast
        spectrum = scipy.fft.rfft(centred * self._hann, axis=1)[:, : self._low_bins]
        self._low.append(np.abs(spectrum).astype(np.float64) ** 2)
        frames = window[:, : self._window // self._frame * self._frame].reshape(len(window), -1, self._frame)
        self._rough.append(np.percentile(_mean_square(np.diff(frames, axis=2)), _QUIET, axis=1))
        about_mean = frames - frames.mean(axis=2, keepdims=True)
        self._quiet.append(np.percentile(_mean_square(about_mean), _QUIET, axis=1))

    def figures(self) -> tuple[ChannelFigures, ...]:
        """Return the figures of each channel; nothing for less than a second of samples."""
        if self.windows == 0:
            return ()
        mean, hum = np.mean(self._means, axis=0), self._hum_dbfs()
        rough, quiet = np.median(self._rough, axis=0), np.median(self._quiet, axis=0)
        return tuple(
            ChannelFigures(
                mean=float(mean[index]),
                hum_hz=None if of_hum is None else of_hum[0],
                hum_dbfs=None if of_hum is None else of_hum[1],
                noise_dbfs=dbfs(quiet[index]),
                roughness=float(rough[index]),
            )
            for index, of_hum in enumerate(hum)
        )

    def faults(self, array: str) -> Iterator[Finding]:
        """Yield what is wrong with the channels of an array of that name; nothing for less than a second of samples."""
        figures = self.figures()
        over_db = noise_over_neighbours_db(figures)
        for index, of in enumerate(figures):
            where = f"channel {index + 1} of {array!r}"
            if self.clipped[index] > MOST_CLIPPED:
                share = self.clipped[index] / self._samples
                what = f"{where} clips: {self.clipped[index]} samples, {100 * share:.2g} %"
                yield _warning("clipping", array, index, what, CLIPPING_CURE)
            yield from steady_faults(array, index, of.mean, of.hum_hz, of.hum_dbfs, over_db[index])

    def _hum_dbfs(self) -> list[tuple[float, float] | None]:
        """Frequency and level of each channel's hum; None where there is none."""
        # power of a sine at each bin; the median over the windows leaves out voices, which have lines as well
        spectrum = 2.0 * np.median(self._low, axis=0) / float(self._hann.sum()) ** 2
        found: list[tuple[float, float] | None] = [None] * len(spectrum)
        for mains_hz in MAINS_HZ:
            lines = np.array([_line(spectrum, n * mains_hz) for n in range(1, HARMONICS + 1)])
            hums = (lines[0] > 0.0) | (np.count_nonzero(lines, axis=0) >= LEAST_LINES)
            for index in np.flatnonzero(hums).tolist():
                level, best = 10.0 * float(np.log10(lines[:, index].sum())), found[index]
                if level >= HUM_DBFS and (best is None or level > best[1]):
                    found[index] = mains_hz, level
        return found


def steady_faults(
    array: str,
    index: int,
    mean: float | None,
    hum_hz: float | None,
    hum_dbfs: float | None,
    noise_over_db: float | None,
) -> Iterator[Finding]:
    """Yield what the lasting figures of one channel (from 0) show: a constant, hum, more noise than its neighbours."""
    where = f"channel {index + 1} of {array!r}"
    if mean is not None and abs(mean) > MOST_CONSTANT:
        what = f"{where} has a constant of {mean:+.3f} of full scale"
        yield _warning("dc", array, index, what, "check the input and its microphone; a high-pass filter helps")
    if hum_hz is not None and hum_dbfs is not None:
        what = f"{where} hums at {hum_hz:.0f} Hz, {hum_dbfs:.0f} dBFS"
        yield _warning("hum", array, index, what, "use balanced cables, and keep them away from mains cables")
    if noise_over_db is not None and noise_over_db > NOISY_DB:
        what = f"{where} has {noise_over_db:.0f} dB more noise than its neighbours"
        yield _warning("noisy", array, index, what, "check its cable, microphone and gain")


def _mean_square(frames: Float32Array) -> FloatArray:
    """Mean square of each frame (K, F, n) -> (K, F)."""
    return np.asarray(np.einsum("kfi,kfi->kf", frames, frames) / frames.shape[2], dtype=np.float64)


def _line(spectrum: FloatArray, at_hz: float) -> FloatArray:
    """Power of the line at a frequency in each channel of spectra (K, F); 0 where none stands out."""
    off_hz = np.abs(np.arange(spectrum.shape[1]) / _WINDOW_S - at_hz)
    line = spectrum[:, off_hz <= _LINE_HZ].max(axis=1, initial=0.0)
    beside = spectrum[:, (off_hz >= _BESIDE_HZ[0]) & (off_hz <= _BESIDE_HZ[1])]
    floor = np.median(beside, axis=1) if beside.shape[1] else np.zeros(len(spectrum))
    return np.asarray(np.where(line > floor * 10.0 ** (HUM_DB / 10.0), line, 0.0))


def _warning(fault: str, array: str, index: int, message: str, cure: str) -> Finding:
    return Finding(fault, array, index + 1, Severity.WARNING, 0.95, message, cure)
