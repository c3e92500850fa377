"""The onset front end: frame after frame of one array, a GCC that weighs each moment and band by how direct it is.

Reverberation is the past. In each band of the short-time spectrum the power P that begins now competes with what the
past explains, I = max(N, max_s lambda^s P(t - s)): the stationary noise N, and all that was loud before, decaying. What
exceeds it, S = max(P - I, 0), is taken to come straight from a source, so that the coherence to expect between two
microphones is gamma = S / (S + I), and their phases weigh

    w = gamma^2 / (1 - gamma^2) = S^2 / (I (I + 2 S)),

the maximum-likelihood weight (Knapp and Carter 1976, after Hannan and Thomson). The precedence effect gives gamma
where the textbook would estimate it from long averages, which reverberation spoils. The GCC is
sum_t w conj(U_i) U_k, U = X/sqrt(P), summed over the band and *not* normalised: a moment or a band with more evidence
counts for more, and sums over frames make a window or an event. Where there is noise, P is the power that the
microphones have on average: one that is drowned by noise then counts for less than its phase alone would. Where there
is hardly any, P is each one's own, and only phases are left: else the louder of two sources would hide the other. It
knows no geometry and no other array.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import scipy.fft

from livessl.core.correlate.band import band_bins
from livessl.core.correlate.gcc_phat import CrossSpectra, LagSampling, microphone_pairs, uses_envelope
from livessl.core.correlate.spectra import Spectra, fast_length
from livessl.core.kernels import kernels
from livessl.core.types import ArraySpec, ComplexArray, Float32Array, FloatArray, IntArray

WINDOW_S: Final = 0.032
"""Length of the Hann window; 16 ms and 64 ms did no better, and 16 ms less well for tones in noise."""

HOP_S: Final = 0.005
"""8 ms cost a tenth of the accuracy in noise, 4 ms gain no more."""

PAST_S: Final = 0.1
"""Time constant of the past's decay; between 0.06 and 0.2 s little changes."""

_WINDOW_LAGS: Final = 8
"""A window is at least so many times as long as the array's largest delay, which would else move sound out of it. Where
that makes it longer, one microphone may be much nearer to a source than another, and phases alone count."""

_STRONGEST: Final = np.float32(10.0)
"""Largest weight: above gamma = 0.95 it is the room that limits, not the noise."""

_NOISY: Final = np.float32(30.0)
"""Power below so many times the noise's is whitened by the microphones' mean: 15 dB. 10 and 20 dB did little else."""

_WARM_UP_S: Final = 0.1
"""Quiet to be heard before the noise is known well enough to tell an onset from it."""

_NOISE_S: Final = 1.0
"""Time over which the noise is averaged; after so long a sound without any quiet its least power must do."""

_LOUD: Final = np.float32(3.0)
"""Power above so many times the noise is no noise, quiet though the frame be called: an onset's foot."""

_LEAST_POWER: Final = 2.0**-30 / 12.0
"""Rounding to 16 bits, full scale squared: below it nothing is heard."""


@dataclass(frozen=True, slots=True)
class OnsetGCC:
    """What some frames of one array say of the directions of onsets in them. Those of more frames add up.

    Parameters
    ----------
    lags : (P, C) float32, or complex64 where the envelope is used
        Weighted sums at the near-Nyquist lags of `LagSampling`.
    levels : (K,) float64
        What each microphone with itself would give at lag 0: the sum of the weights times its share of the power.
    """

    lags: ComplexArray | Float32Array
    levels: FloatArray

    def __add__(self, other: OnsetGCC) -> OnsetGCC:
        """Both together."""
        return OnsetGCC(self.lags + other.lags, self.levels + other.levels)

    @property
    def weight(self) -> float:
        """Sum of the weights: a single direct sound in all of them gives `lags` of about this height."""
        return float(self.levels.mean())

    def heights(self, pairs: IntArray) -> Float32Array:
        """What a single direct sound gives each of the pairs (P, 2), however loud their microphones: (P, 1)."""
        heights = np.sqrt(self.levels[pairs].prod(axis=1, keepdims=True))
        return np.asarray(np.maximum(heights, 1.0), dtype=np.float32)


def summed(heard: Sequence[OnsetGCC]) -> OnsetGCC:
    """All together, one at least."""
    lags, levels = heard[0].lags.copy(), heard[0].levels.copy()
    for one in heard[1:]:
        lags += one.lags
        levels += one.levels
    return OnsetGCC(lags, levels)


class OnsetFrontEnd:
    """Listens to one array at one sampling rate, frame after frame, each transformed once.

    Parameters
    ----------
    spec : ArraySpec
    sample_rate_hz : float
    sampling : LagSampling
        For the array's band, rate and size.
    """

    def __init__(self, spec: ArraySpec, sample_rate_hz: float, sampling: LagSampling) -> None:
        self.sample_rate_hz = sample_rate_hz
        self._sampling = sampling
        self._band_hz = spec.band_hz
        self._pairs = microphone_pairs(len(spec.microphones_m))
        self._envelope = uses_envelope(spec.band_hz)
        usual, least = round(WINDOW_S * sample_rate_hz), _WINDOW_LAGS * sampling.room
        self._wide, length = least > usual, max(least, usual)
        self._hop = round(HOP_S / WINDOW_S * length)
        self._n_fft = fast_length(length + sampling.room)
        self._window = (0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(length) / length)).astype(np.float32)
        self._band = slice(*band_bins(self._n_fft, sample_rate_hz, spec.band_hz))
        self._least = np.float32(_LEAST_POWER * np.square(self._window).sum())
        hop_s = self._hop / sample_rate_hz
        self._decay = np.float32(np.exp(-hop_s / PAST_S))
        self._warm_up = round(_WARM_UP_S / hop_s)
        self._noise_hops = round(_NOISE_S / hop_s)
        self._tail: Float32Array = np.zeros((len(spec.microphones_m), 0), dtype=np.float32)
        bins = self._band.stop - self._band.start
        self._noise, self._past = np.zeros(bins, dtype=np.float32), np.zeros(bins, dtype=np.float32)
        self._hops = np.zeros(2, dtype=np.int64)  # heard so far, and those of them that were quiet

    @property
    def nothing(self) -> OnsetGCC:
        """The sum of no frames."""
        shape = (len(self._pairs), self._sampling.count)
        lags = np.zeros(shape, np.complex64) if self._envelope else np.zeros(shape, np.float32)
        return OnsetGCC(lags, np.zeros(len(self._tail)))

    def reset(self) -> None:
        """Forget all: samples are missing, and what comes does not continue what was."""
        self._tail = self._tail[:, :0]
        self._hops[:] = 0

    def push(self, samples: Float32Array, *, quiet: bool) -> OnsetGCC:
        """Take the next frame and give what its windows say; a window that it does not complete waits for the next.

        Parameters
        ----------
        samples : (K, n) float32
            Continuing those before.
        quiet : bool
            Whether there is no sound in it; the noise is learned from such frames.
        """
        heard = np.concatenate([self._tail, samples], axis=1)
        length = len(self._window)
        hops = max(0, (heard.shape[1] - length) // self._hop + 1)
        self._tail = heard[:, hops * self._hop :].copy()
        if hops == 0:
            return self.nothing
        windows = np.empty((hops, len(samples), self._n_fft), dtype=np.float32)
        kernels.cut_windows(heard, self._hop, self._window, windows)
        spectra = np.asarray(scipy.fft.rfft(windows, axis=2), dtype=np.complex64)
        weights, noises = np.empty((2, hops, len(self._noise)), dtype=np.float32)
        kernels.onset_weights(
            spectra, self._band.start, quiet, self._hops, self._least, self._decay, self._warm_up, self._noise_hops,
            _LOUD, _STRONGEST, self._noise, self._past, weights, noises,
        )  # fmt: skip
        cross = self._cross(Spectra(spectra, self._n_fft), weights, noises)
        return OnsetGCC(self._sampling.sample(cross, envelope=self._envelope), cross.levels)

    def _cross(self, spectra: Spectra, weights: Float32Array, noises: Float32Array) -> CrossSpectra:
        noisy = None if self._wide else _NOISY * noises
        return CrossSpectra(spectra, self._pairs, self.sample_rate_hz, self._band_hz, weights, noise=noisy)

    def listen(self, pieces: Iterable[Float32Array]) -> OnsetGCC:
        """Sum over pieces (K, n) of sound without their context: each is taken to begin out of silence."""
        total = self.nothing
        silence = np.zeros((len(self._tail), round(2.0 * _WARM_UP_S * self.sample_rate_hz)), dtype=np.float32)
        for piece in pieces:
            self.reset()
            self.push(silence, quiet=True)
            total += self.push(piece, quiet=False)
        return total
