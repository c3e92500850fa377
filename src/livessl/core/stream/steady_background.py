"""Removes steady hum, tones and rumble from a frame's power before its activity is judged. It reads no clock.

Mains hum, the tone of a fan or rumble can be far above everything else in the band. A sound that is 30 dB above the
rest of the background then hardly raises the level. The background is therefore tracked in every bin of the frames'
spectra, as the smallest power of a few seconds. Bins whose background is far above that of the others are *loud*. In a
loud bin, only power far above the usual power counts. Bins outside the band may also be loud and leak into the band, so
a Hann window is used if there are loud bins. It reduces sounds at the edges of a frame and raises those in the middle.
Without loud bins, and where a frame is far above all that is steady, the level is the plain power in the band.
"""

from __future__ import annotations

from collections import deque
from itertools import islice
from typing import Final

import numpy as np
import scipy

from livessl.core.correlate.band import band_bins
from livessl.core.types import FRAME_S, BoolArray, ComplexArray, Float32Array, FloatArray

LOUD: Final = 30.0
"""Ratio of a bin's background to the median over the band, 15 dB, above which the bin is loud. A tone that fills three
of 300 bins must be about that far above the others to double the level."""

EXCESS: Final = 25.0
"""Ratio of a frame's power to the usual power, 14 dB, above which sound counts in a loud bin. The usual power is the
smallest mean of half a second, which is 0.6 of the mean for rumble. A bin with rumble exceeds this ratio in one of
three million frames."""

CLEAR: Final = 100.0
"""Ratio of a frame's plain power to that of the quietest quarter of a second, 20 dB, from which on the level is the
plain power. What is changing must exceed its quietest quarter of a second by `EXCESS`, too: rumble that fades does
not."""

BEYOND: Final = 1.25
"""Highest frequency at which a tone may leak into the band, relative to the upper edge of the band."""

NEW_HUM: Final = 0.25
"""Ratio of two usual levels below which a new hum is recognized: the level without the bins that are loud now, over the
level without the bins that were loud before."""

_SMOOTHING: Final = 5
"""Number of frames averaged before the minimum is taken; `livessl.core.stream.activity` uses the same number."""

_BLOCK: Final = 10
"""Number of frames that share one stored minimum, so that not every frame has to be stored."""

_LEAST_BINS: Final = 16
"""Least number of bins in the band from which their median is used as background."""


class SteadyBackground:
    """Tracks the background of one array's frames, and returns their power without loud and steady parts.

    Parameters
    ----------
    sample_rate_hz : float
    band_hz : (float, float)
    window_s : float
        Length of the window whose smallest power is the background.
    keep : float
        Factor by which the maximum of the level decays from frame to frame.
    """

    def __init__(self, sample_rate_hz: float, band_hz: tuple[float, float], window_s: float, keep: float) -> None:
        self._keep = keep
        self._count = round(FRAME_S * sample_rate_hz)
        window = 0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(self._count) / self._count)
        self._window = window.astype(np.float32)
        self._scale = 2.0 / (self._count**2 * float(np.square(window).mean()))
        self._band = slice(*band_bins(self._count, sample_rate_hz, band_hz))
        self._bins = slice(0, min(self._count // 2 + 1, round(BEYOND * self._band.stop)))
        values = self._bins.stop + 1  # of a spectrum; the last one is the plain power in the band
        self._latest: deque[FloatArray] = deque(maxlen=_SMOOTHING)
        self._blocks: deque[FloatArray] = deque(maxlen=max(1, round(window_s / FRAME_S / _BLOCK) - 1))
        self._of_blocks: FloatArray | None = None  # the least of all of them
        self._least: FloatArray | None = None  # of the block that goes on
        self._sum: FloatArray | None = None
        self._means: deque[FloatArray] = deque(maxlen=self._blocks.maxlen)
        self._frames = 0
        self._loud: BoolArray = np.zeros(values, dtype=np.bool_)  # another array only where other bins are loud
        self._is_any_loud = False
        self._usual: FloatArray = np.zeros(values)
        self._maximum: FloatArray = np.zeros(values)
        self._quietest: FloatArray = np.zeros(values)

    def spectra(self, samples: Float32Array, plain: ComplexArray, power: FloatArray) -> FloatArray:
        """Return the power of some frames in each bin, mean over the channels, full scale squared: (C, F + 1).

        The last value of each frame is its plain in-band power.

        Parameters
        ----------
        samples : (C, K, n) float32
        plain : (C, K, n // 2 + 1) complex64
            Spectra without a window. The spectra with a Hann window follow from them, because this window is the sum of
            a constant and a cosine.
        power : (C,) float64
            Plain in-band power of each frame, mean over the channels.
        """
        if samples.shape[2] == self._count:
            spectra = _windowed(plain, self._bins.stop, self._count)
        else:
            frames = samples[:, :, : self._count]
            spectra = scipy.fft.rfft(frames * self._window[: frames.shape[2]], self._count, axis=2)[:, :, self._bins]
        of_bins = np.add.reduce(spectra.real**2 + spectra.imag**2, axis=1, dtype=np.float64)
        return np.column_stack([of_bins * (self._scale / samples.shape[1]), power])

    def learn(self, spectrum: FloatArray) -> bool:
        """Take in the spectrum of the next frame; return whether it shows a hum that was not known before.

        In that case the usual level without the bins that are loud now is far below the usual level without the bins
        that were loud before, and earlier levels are no longer valid. The current sound does not affect this.
        """
        loud = self._loud
        self._learn(spectrum)
        return loud is not self._loud and self._usual_power(self._loud) < NEW_HUM * self._usual_power(loud)

    def learn_silence(self, bins: int) -> None:
        """Take in as much silence as shows that no bin, of so many, is steady and loud."""
        for _ in range(_SMOOTHING):
            self._learn(np.zeros(bins))

    def _learn(self, spectrum: FloatArray) -> None:
        self._maximum = np.maximum(self._keep * self._maximum, spectrum)
        self._latest.append(spectrum)
        if len(self._latest) < _SMOOTHING:
            return
        smoothed = sum(islice(self._latest, 1, None), start=self._latest[0]) / _SMOOTHING
        self._least = smoothed if self._least is None else np.minimum(self._least, smoothed)
        self._sum = smoothed if self._sum is None else self._sum + smoothed
        self._frames += 1
        background = self._least if self._of_blocks is None else np.minimum(self._of_blocks, self._least)
        self._quietest = background
        inside = background[self._band]
        if len(inside) >= _LEAST_BINS:
            loud = background > LOUD * _median(inside)
            loud[[0, -1]] = False
            if (loud != self._loud).any():
                self._loud, self._is_any_loud = loud, bool(loud.any())
        if self._frames % _BLOCK == 0:
            self._blocks.append(self._least)
            self._of_blocks = np.minimum.reduce(list(self._blocks))
            self._means.append(self._sum / _BLOCK)
            self._least = self._sum = None
            self._usual = np.minimum.reduce(list(self._means))
        elif not self._means:
            self._usual = self._sum / self._frames

    @property
    def usual_power(self) -> float:
        """Usual level, full scale squared, without the parts that are loud and steady now."""
        return self._usual_power(self._loud)

    def _usual_power(self, loud: BoolArray) -> float:
        return float(self._usual[self._band][~loud[self._band]].sum())

    @property
    def changing_maximum(self) -> float:
        """Decaying maximum of the level, full scale squared, without the parts that are loud and steady now.

        It is an upper bound: the sum of the maxima of the bins.
        """
        return self.changing_power(self._maximum)

    def changing_power(self, spectrum: FloatArray) -> float:
        """Return the in-band power of a frame without its loud and steady parts.

        It is the plain power if no bin is loud, or if the frame is far above all that is steady.

        Parameters
        ----------
        spectrum : (F + 1,) float64
            As `spectra` returns it.
        """
        plain_power = float(spectrum[-1])
        if not self._is_any_loud:
            return plain_power
        inside, loud = spectrum[self._band], self._loud[self._band]
        excess = np.maximum(inside - EXCESS * self._usual[self._band], 0.0)
        changing = float(np.where(loud, excess, inside).sum())
        quietest = float(self._quietest[self._band][~loud].sum())
        is_clear = plain_power >= CLEAR * self._quietest[-1] and changing >= EXCESS * quietest
        return plain_power if is_clear else changing


def _windowed(plain: ComplexArray, bins: int, count: int) -> ComplexArray:
    """Return the first bins of the spectra of `count` samples with a Hann window, from plain spectra (C, K, F)."""
    above = plain[..., bins : bins + 1]
    if not above.size:
        above = np.conj(plain[..., count - bins : count - bins + 1])
    around = np.concatenate([np.conj(plain[..., 1:2]), plain[..., :bins], above], axis=-1)
    return np.asarray(0.5 * around[..., 1:-1] - 0.25 * (around[..., :-2] + around[..., 2:]))


def _median(values: FloatArray) -> float:
    """Return the median; `numpy.median` takes ten times as long for a few hundred values."""
    middle = len(values) // 2
    if len(values) % 2:
        return float(np.partition(values, middle)[middle])
    below, above = np.partition(values, (middle - 1, middle))[middle - 1 : middle + 1]
    return float(0.5 * (below + above))
