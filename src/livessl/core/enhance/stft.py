"""The short-time Fourier transform of clips and its inverse, with windows that add up to one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import scipy
from numpy.typing import NDArray

from livessl.core.types import BoolArray, FloatArray, RealArray

Spectra = NDArray[np.complexfloating[Any, Any]]
"""Complex arrays of either precision."""

WINDOW_S: Final = 0.064
"""Length of a window, in seconds: long against the delays within an array and against early reflections, but short
enough for twenty windows in the pre-roll."""


@dataclass(frozen=True, slots=True)
class Stft:
    """Short-time spectra with windows of `size` samples and a hop of half a window.

    The square root of a Hann window is applied before and after, so that `inverse(forward(x))` is x.

    Parameters
    ----------
    size : int
        Even number of samples.
    """

    size: int

    @classmethod
    def of(cls, sample_rate_hz: float) -> Stft:
        """Return the transform for a sampling rate: windows of about `WINDOW_S`."""
        return cls(2 * scipy.fft.next_fast_len(max(8, round(WINDOW_S * sample_rate_hz / 2.0)), real=True))

    @property
    def hop(self) -> int:
        """Samples from one window to the next."""
        return self.size // 2

    @property
    def window(self) -> FloatArray:
        """The square root of a Hann window (size,)."""
        return np.asarray(np.sin(np.pi * (np.arange(self.size) + 0.5) / self.size), dtype=np.float64)

    def frequencies_hz(self, sample_rate_hz: float) -> FloatArray:
        """Frequencies (F,) of the bins, hertz."""
        return np.asarray(np.fft.rfftfreq(self.size, 1.0 / sample_rate_hz))

    def forward(self, samples: RealArray) -> Spectra:
        """Return the spectra (..., T, F) of samples (..., n); half of the first and last window is padding."""
        windows = self._cut(samples) * self.window.astype(np.float32)
        return np.asarray(scipy.fft.rfft(windows, axis=-1), dtype=np.complex64)

    def inverse(self, spectra: Spectra, length: int) -> FloatArray:
        """Return the samples (length,) of spectra (T, F)."""
        windows = scipy.fft.irfft(spectra, self.size, axis=-1) * self.window
        halves = windows.reshape(-1, 2, self.hop)
        padded = np.zeros((len(halves) + 1, self.hop))
        padded[:-1] += halves[:, 0]
        padded[1:] += halves[:, 1]
        return np.asarray(padded.ravel()[self.hop : self.hop + length])

    def share(self, mask: BoolArray) -> FloatArray:
        """Return the share (T,) of each window's energy where a mask (n,) is true; beyond its ends it is false."""
        return np.asarray(self._cut(mask.astype(np.float64)) @ (self.window**2) / (self.window**2).sum())

    def _cut(self, samples: RealArray) -> RealArray:
        """Return the windows (..., T, size) of samples (..., n), padded by half a window on both sides."""
        count = -(-samples.shape[-1] // self.hop) + 1
        tail = count * self.hop - samples.shape[-1]
        padding = [(0, 0)] * (samples.ndim - 1) + [(self.hop, tail)]
        padded = np.pad(samples, padding)
        return np.lib.stride_tricks.sliding_window_view(padded, self.size, axis=-1)[..., :: self.hop, :]
