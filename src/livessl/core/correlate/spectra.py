"""Front ends: from a segment of sound to the spectra that are correlated. Each sees one segment, and no geometry."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from livessl.core.types import ComplexArray, Float32Array, FloatArray

AVERAGED_FRAME_S: Final = 0.025
"""Frames of the averaged GCC, Hann-weighted, half overlapping (DiBiase 2000; the paper's 25 ms and 50 %)."""

CEPSTRAL_FRAME_S: Final = 0.6
"""Longest frame of the cepstral front end; a shorter segment is halved instead."""

MEMORY: Final = 0.06
"""Weight of a frame's innovation in the channel's running cepstrum: the paper's "memory parameter"."""

FFT_FACTOR: Final = 16
"""Transforms' lengths are multiples of it, so that lags may lie FFT_FACTOR/m samples apart, m whole."""

_FLOOR: Final = 1e-6
"""Least magnitude whose logarithm is taken, relative to the frame's largest: 120 dB down is no sound."""


@dataclass(frozen=True, slots=True)
class Spectra:
    """Spectra of one segment.

    Parameters
    ----------
    values : (L, K, F) complex64
        L frames, K microphones, F = n_fft/2 + 1 bins.
    n_fft : int
        Length of the transform; what exceeds the frame is room for lags.
    """

    values: ComplexArray
    n_fft: int


class FrontEnd(Protocol):
    """Turns a segment (K, n) into spectra with room for `lags` samples of lag."""

    def __call__(self, samples: Float32Array, sample_rate_hz: float, lags: int) -> Spectra:
        """Spectra of one segment, or of its frames."""
        ...


def fast_length(count: int) -> int:
    """Least length, at least `count`, that is fast to transform and a multiple of `FFT_FACTOR`."""
    return FFT_FACTOR * scipy.fft.next_fast_len(-(-count // FFT_FACTOR), real=True)


def whole_segment(samples: Float32Array, sample_rate_hz: float, lags: int) -> Spectra:  # noqa: ARG001 - a FrontEnd
    """One frame: the segment, as it is."""
    n_fft = fast_length(samples.shape[1] + lags)
    return Spectra(scipy.fft.rfft(samples, n_fft, axis=1)[None], n_fft)


def averaged(samples: Float32Array, sample_rate_hz: float, lags: int) -> Spectra:
    """Hann frames of 25 ms that overlap by half; a segment shorter than a frame is one.

    The segment's last incomplete frame is filled with zeros, so that every sample counts.
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
    """Frames whose channels' running minimum-phase part has been taken out (Stephenne and Champagne 1997).

    Rectangular frames of 0.6 s, or of half the segment where that is shorter, end to end; samples that fill no frame
    are left out. The channel's cepstrum begins as the first frame's and moves by `MEMORY` with each further one.
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
    """Cepstrum of the minimum-phase part of a spectrum, from its magnitude alone: the folded real cepstrum.

    c_mp[0] = c[0], c_mp[n] = c[n] + c[-n] for n > 0, and 0 for n < 0. The phase's part of the complex cepstrum c is
    odd, so it cancels in the sum, and no phase need be unwrapped (Oppenheim and Schafer, Discrete-Time Signal
    Processing, ch. 12).

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
