"""Front ends of the paper's methods: spectra of a segment, whole, averaged over frames, or cepstral prefiltering."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
import scipy
from numpy.typing import NDArray

from livessl.core.types import ComplexArray, Float32Array, FloatArray

AVERAGED_FRAME_S: Final = 0.025
"""Length, in seconds, of the frames of the averaged GCC (DiBiase 2000; the paper's 25 ms, which overlap by half)."""

CEPSTRAL_FRAME_S: Final = 0.6
"""Longest frame of the cepstral front end, in seconds; a segment of less than two frames is halved instead."""

MEMORY: Final = 0.06
"""Weight of a frame in the channel's running cepstrum: the paper's "memory parameter"."""

FFT_FACTOR: Final = 16
"""Factor of all transform lengths, so that lags can lie FFT_FACTOR/m samples apart for whole m."""

_FLOOR: Final = 1e-6
"""Least magnitude whose logarithm is taken, relative to the frame's largest; 120 dB below it there is no sound."""


@dataclass(frozen=True, slots=True)
class Spectra:
    """Spectra of one segment.

    Parameters
    ----------
    values : (L, K, F) complex64
        Spectra of L frames and K microphones, with F = n_fft/2 + 1 bins.
    n_fft : int
        Length of the transform; it exceeds the frame by the room for lags.
    """

    values: ComplexArray
    n_fft: int


class FrontEnd(Protocol):
    """Computes the spectra of a segment (K, n) with room for `lags` samples of lag."""

    def __call__(self, samples: Float32Array, sample_rate_hz: float, lags: int) -> Spectra:
        """Return the spectra of one segment, or of its frames."""
        ...


def fast_length(count: int) -> int:
    """Return the least length from `count` on that is fast to transform and a multiple of `FFT_FACTOR`."""
    return FFT_FACTOR * scipy.fft.next_fast_len(-(-count // FFT_FACTOR), real=True)


def whole_segment(samples: Float32Array, sample_rate_hz: float, lags: int) -> Spectra:  # noqa: ARG001 - a FrontEnd
    """Return the spectrum of the whole segment, as one frame."""
    n_fft = fast_length(samples.shape[1] + lags)
    return Spectra(scipy.fft.rfft(samples, n_fft, axis=1)[None], n_fft)


def averaged(samples: Float32Array, sample_rate_hz: float, lags: int) -> Spectra:
    """Return the spectra of Hann frames of 25 ms that overlap by half; a segment shorter than a frame is one frame.

    The last frame is padded with zeros, so that every sample counts.
    """
    count = samples.shape[1]
    length = max(2, round(AVERAGED_FRAME_S * sample_rate_hz))
    hop = length // 2
    frames = max(1, -(-(count - length) // hop) + 1)
    padded = np.zeros((len(samples), (frames - 1) * hop + length), dtype=np.float32)
    padded[:, :count] = samples
    cut = np.lib.stride_tricks.sliding_window_view(padded, length, axis=1)[:, ::hop].swapaxes(0, 1)
    window = (0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(length) / length)).astype(np.float32)
    n_fft = fast_length(length + max(lags, length))
    return Spectra(np.asarray(scipy.fft.rfft(cut * window, n_fft, axis=2), dtype=np.complex64), n_fft)


def cepstral(samples: Float32Array, sample_rate_hz: float, lags: int) -> Spectra:
    """Return the spectra of frames without the channels' minimum-phase part (Stephenne and Champagne 1997).

    Frames are rectangular, end to end, and 0.6 s long, or half the segment if that is shorter; samples that fill no
    frame are left out. A channel's cepstrum begins as the first frame's and moves by `MEMORY` with each further one.
    """
    length = max(1, min(round(CEPSTRAL_FRAME_S * sample_rate_hz), samples.shape[1] // 2))
    count = samples.shape[1] // length
    n_fft = fast_length(length + max(lags, length))
    frames = samples[:, : count * length].reshape(len(samples), count, length)
    channel: NDArray[np.float64] | None = None
    values = np.empty((count, len(samples), n_fft // 2 + 1), dtype=np.complex64)
    for index in range(count):
        spectrum = scipy.fft.rfft(frames[:, index].astype(np.float64), n_fft, axis=1)
        minimum_phase = minimum_phase_cepstrum(np.abs(spectrum), n_fft)
        channel = minimum_phase if channel is None else channel + MEMORY * (minimum_phase - channel)
        values[index] = spectrum * np.exp(-scipy.fft.rfft(channel, axis=1))
    return Spectra(values, n_fft)


def minimum_phase_cepstrum(magnitude: FloatArray, n_fft: int) -> FloatArray:
    """Cepstrum of the minimum-phase part of a spectrum from its magnitude: the folded real cepstrum.

    c_mp[0] = c[0], c_mp[n] = c[n] + c[-n] for n > 0, and 0 for n < 0. The part of the complex cepstrum c that comes
    from the phase is odd, so it cancels in the sum, and no phase needs to be unwrapped (Oppenheim and Schafer,
    Discrete-Time Signal Processing, ch. 12).

    Parameters
    ----------
    magnitude : (K, n_fft/2 + 1) float64
        Silence gives zeros.
    n_fft : int
        Even.

    Returns
    -------
    (K, n_fft) float64
    """
    loudest = magnitude.max(axis=1, keepdims=True)
    loudest[loudest == 0.0] = 1.0 / _FLOOR  # silence: ln(1) everywhere
    cepstrum = np.asarray(scipy.fft.irfft(np.log(np.maximum(magnitude, _FLOOR * loudest)), n_fft, axis=1))
    cepstrum[:, 1 : n_fft // 2] *= 2.0
    cepstrum[:, n_fft // 2 + 1 :] = 0.0
    return cepstrum
