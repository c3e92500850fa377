"""The onset front end: a GCC whose windows and bins are weighed by how direct their sound is (onset weights).

The background noise spectrum of located sounds is learned here; the noise floor of the detector is in
`core/stream/activity.py`.

Reverberation follows from the past. In each bin of the short-time spectrum the power P is compared with what the past
explains, I = max(r N, max_s lambda^s P(t - s)): the stationary noise N, and all earlier power, decaying. The excess
S = max(P - I, 0) is taken to come straight from a source. The expected coherence between two microphones is then
gamma = S / (S + I). Their phases have the weight of maximum likelihood (Knapp and Carter 1976, after Hannan and
Thomson):

    w = gamma^2 / (1 - gamma^2) = S^2 / (I (I + 2 S)).

The usual estimate of gamma, from long averages, fails in reverberation; this one follows the precedence effect.

The GCC is sum_t w conj(U_i) U_k, U = X/sqrt(P), summed over the band and *not* normalised: windows and bins with more
evidence count more, and sums over frames give the GCC of a window or an event. `onset_weights` and `cross_spectra` of
the kernels are the arithmetic. Where noise dominates, P is the mean power of the microphones, so that a noisy
microphone counts less than its phase alone would. Where there is little noise, P is each microphone's own power, and
only phases count: otherwise the louder of two sources would mask the other.

Windows in which the noise happens to be above its mean have a little weight, and there are many of them. If the phases
of the noise are random, their sum stays small; those of a fan add up, and outweigh the sound. The cross-spectrum of the
noise, N_ik, is therefore learned in the quiet frames before a sound. As far as it is coherent, c = 0 to 1, only power
above r N with r = 1 + c can be direct, and 2 c N_ik is subtracted from conj(X_i) X_k: about the noise that there
is in windows which have weight. Nothing here knows geometry or another array.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import scipy

from livessl.core.correlate.band import band_bins
from livessl.core.correlate.decimation import Decimator, decimation
from livessl.core.correlate.gcc_phat import CrossSpectra, LagSampling, uses_envelope
from livessl.core.correlate.spectra import Spectra, fast_length
from livessl.core.geometry import microphone_pairs
from livessl.core.kernels import kernels
from livessl.core.kernels.arguments import OnsetParameters, OnsetState
from livessl.core.types import ArraySpec, ComplexArray, Float32Array, FloatArray, IntArray

WINDOW_S: Final = 0.032
"""Length of the Hann window, in seconds; 16 ms and 64 ms were no better, and 16 ms was worse for tones in noise."""

HOP_S: Final = 0.005
"""Hop between windows, in seconds; 8 ms cost a tenth of the accuracy in noise, 4 ms gain nothing."""

PAST_S: Final = 0.1
"""Time constant of the past's decay, in seconds; between 0.06 and 0.2 s little changes."""

_WINDOW_LAGS: Final = 8
"""Least length of a window in units of the array's largest delay, so that sound stays within the window at all
microphones. If that makes the window longer than usual, levels differ with distance, and only phases count."""

_STRONGEST: Final = np.float32(10.0)
"""Largest weight, reached at gamma = 0.95; above that the room limits the accuracy, not the noise."""

_NOISY: Final = np.float32(30.0)
"""Power relative to the noise, 15 dB, below which whitening uses the microphones' mean. 10 and 20 dB change little."""

_WARM_UP_S: Final = 0.1
"""Quiet, in seconds, after which the noise is known well enough to distinguish an onset from it."""

_NOISE_S: Final = 1.0
"""Time, in seconds, over which the noise is averaged; after so long without quiet the least power is taken as noise."""

_COHERENT: Final = 4.0
"""Weight of the noise's coherence between the microphones, the root of its mean square above that of chance. A fan in a
room has 0.35 to 0.5 and is treated as wholly coherent, diffuse noise has 0.1 to 0.2, sensor noise none."""

_INDEPENDENT: Final = 0.33
"""Number of independent windows in one window of quiet, because they overlap: the square of the coherence of n of them
is 1/n by chance."""

_LOUD: Final = np.float32(3.0)
"""Power relative to the noise above which a window is no noise even in a quiet frame: an onset begins there."""

_LEAST_POWER: Final = 2.0**-30 / 12.0
"""Power of rounding to 16 bits, full scale squared; below it there is no signal."""


@dataclass(frozen=True, slots=True)
class OnsetGCC:
    """Unnormalised GCC of the onsets in some frames of one array. Those of several frames add up.

    Parameters
    ----------
    lags : (P, C) float32, or complex64 where the envelope is used
        Weighted sums at the C near-Nyquist lags of `LagSampling`.
    levels : (K,) float64
        Correlation of each microphone with itself at lag 0: the sum of the weights times its share of the power.
    noise_power : float
        Mean square that the real part of `lags` would have if the phases between the microphones were random.
    """

    lags: ComplexArray | Float32Array
    levels: FloatArray
    noise_power: float = 0.0

    def __add__(self, other: OnsetGCC) -> OnsetGCC:
        """Sum of both."""
        return OnsetGCC(self.lags + other.lags, self.levels + other.levels, self.noise_power + other.noise_power)

    @property
    def weight(self) -> float:
        """Sum of the weights; a single direct sound gives `lags` of about this height."""
        return float(np.add.reduce(self.levels)) / len(self.levels)  # the mean, without what `mean` checks

    @property
    def noise_rms(self) -> float:
        """Root mean square of `lags` at random phases, relative to the height that a single direct sound gives."""
        return float(np.sqrt(self.noise_power)) / max(1.0, self.weight)

    def heights(self, pairs: IntArray) -> Float32Array:
        """Height that a single direct sound gives to each of the pairs (P, 2): (P, 1)."""
        heights = np.sqrt(self.levels[pairs].prod(axis=1, keepdims=True))
        return np.asarray(np.maximum(heights, 1.0), dtype=np.float32)


def summed(parts: Sequence[OnsetGCC]) -> OnsetGCC:
    """Sum of one or more."""
    lags, levels = parts[0].lags.copy(), parts[0].levels.copy()
    for one in parts[1:]:
        lags += one.lags
        levels += one.levels
    return OnsetGCC(lags, levels, sum(one.noise_power for one in parts))


def has_long_windows(largest_delay_s: float) -> bool:
    """Return whether windows are longer than `WINDOW_S` where sound takes this long between microphones, in seconds."""
    return _WINDOW_LAGS * largest_delay_s > WINDOW_S


class OnsetFrontEnd:
    """Computes the onset GCC of one array at one sampling rate, frame after frame.

    Parameters
    ----------
    spec : ArraySpec
    sample_rate_hz : float
    sampling : LagSampling
        Lags for the array's band, rate and size.
    """

    def __init__(self, spec: ArraySpec, sample_rate_hz: float, sampling: LagSampling) -> None:
        self.sample_rate_hz = sample_rate_hz
        self._sampling = sampling
        self._band_hz = spec.band_hz
        self._pairs = microphone_pairs(len(spec.microphones_m))
        itself = np.arange(len(spec.microphones_m))
        self._learned = np.concatenate([self._pairs, np.stack([itself, itself], axis=1)])
        self._envelope = uses_envelope(spec.band_hz)
        factor = decimation(sample_rate_hz, spec.band_hz)
        self._rate_hz = sample_rate_hz / factor  # of what is correlated
        self._decimator = (
            Decimator(len(spec.microphones_m), factor, sample_rate_hz, spec.band_hz[1]) if factor > 1 else None
        )
        room = -(-sampling.room // factor)
        usual, least = round(WINDOW_S * self._rate_hz), _WINDOW_LAGS * room
        self._wide, length = least > usual, max(least, usual)
        self._hop = round(HOP_S / WINDOW_S * length)
        self._n_fft = fast_length(length + room)
        self._window = (0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(length) / length)).astype(np.float32)
        self._band = slice(*band_bins(self._n_fft, self._rate_hz, spec.band_hz))
        # Windows overlap, and bins lie closer than a window resolves. Each product of two phases is thus shared by
        # n_fft/hop cells: the sum of the squared ambiguity function of any window over such a grid.
        self._shared_cells = 0.5 * self._n_fft / self._hop
        hop_s = self._hop / self._rate_hz
        self._parameters = OnsetParameters(
            least=np.float32(_LEAST_POWER / factor * np.square(self._window).sum()),
            decay=np.float32(np.exp(-hop_s / PAST_S)),
            reach=np.float32(1.0),
            loud=_LOUD,
            strongest=_STRONGEST,
            warm_up=round(_WARM_UP_S / hop_s),
            noise_hops=round(_NOISE_S / hop_s),
        )
        self._tail: Float32Array = np.zeros((len(spec.microphones_m), 0), dtype=np.float32)
        self._coherent: tuple[int, float] | None = None  # quiet windows, and how coherent the noise was after them
        bins = self._band.stop - self._band.start
        self._state = OnsetState(
            windows=np.zeros(2, dtype=np.int64),
            noise=np.zeros(bins, dtype=np.float32),
            past=np.zeros(bins, dtype=np.float32),
            cross=np.zeros((len(self._learned), bins), dtype=np.complex64),
        )

    @property
    def nothing(self) -> OnsetGCC:
        """Sum of no frames: zeros."""
        shape = (len(self._pairs), self._sampling.count)
        lags = np.zeros(shape, np.complex64) if self._envelope else np.zeros(shape, np.float32)
        return OnsetGCC(lags, np.zeros(len(self._tail)))

    def reset(self) -> None:
        """Start over after a gap: the next frame does not continue the last one."""
        self._tail = self._tail[:, :0]
        self._state.windows[:] = 0
        self._coherent = None
        if self._decimator is not None:
            self._decimator.reset()

    def push(self, samples: Float32Array, *, quiet: bool) -> OnsetGCC:
        """Return the onset GCC of the windows that the next frame completes.

        Parameters
        ----------
        samples : (K, n) float32
            The next frame, without a gap to the last one.
        quiet : bool
            Whether there is no sound in it; the noise is learned from quiet frames.
        """
        kept = samples if self._decimator is None else self._decimator.push(samples)
        joined = np.concatenate([self._tail, kept], axis=1)
        length = len(self._window)
        hops = max(0, (joined.shape[1] - length) // self._hop + 1)
        self._tail = joined[:, hops * self._hop :].copy()
        if hops == 0:
            return self.nothing
        windows = np.empty((hops, len(samples), self._n_fft), dtype=np.float32)
        kernels.cut_windows(joined, self._hop, self._window, windows)
        spectra = np.asarray(scipy.fft.rfft(windows, axis=2), dtype=np.complex64)
        weights, noises = np.empty((2, hops, len(self._state.noise)), dtype=np.float32)
        state, coherent = self._state, self._coherent_share()
        parameters = self._parameters._replace(reach=np.float32(1.0 + coherent))
        background = np.float32(2.0 * coherent) * state.cross if coherent > 0.0 else None
        kernels.onset_weights(spectra, self._band.start, self._learned, quiet, parameters, state, weights, noises)
        cross = self._cross(Spectra(spectra, self._n_fft), weights, noises, background)
        noise_power = self._shared_cells * float(np.vdot(weights, weights))
        return OnsetGCC(self._sampling.sample(cross, envelope=self._envelope), cross.levels, noise_power)

    def _coherent_share(self) -> float:
        """Return how coherent the noise is between the microphones, 0 to 1; 0 before it is known.

        It is 0 for wide arrays, too: their windows are so long that the pre-roll has hardly any independent ones.
        """
        windows = int(self._state.windows[1])
        if self._wide or windows <= self._parameters.warm_up:
            return 0.0
        if self._coherent is None or self._coherent[0] != windows:
            cross, own = np.split(self._state.cross, [len(self._pairs)])
            powers = own.real[self._pairs].prod(axis=1)
            squares = cross.real**2 + cross.imag**2
            square = np.divide(squares, powers, out=np.zeros_like(powers), where=powers > 0.0).mean()
            excess = float(square) - 1.0 / (_INDEPENDENT * min(windows, self._parameters.noise_hops))
            self._coherent = windows, min(1.0, _COHERENT * max(0.0, excess) ** 0.5)
        return self._coherent[1]

    def _cross(
        self, spectra: Spectra, weights: Float32Array, noises: Float32Array, background: ComplexArray | None = None
    ) -> CrossSpectra:
        noisy = None if self._wide else _NOISY * noises
        return CrossSpectra(
            spectra, self._pairs, self._rate_hz, self._band_hz, weights, noise=noisy, background=background
        )

    def push_segments(self, segments: Iterable[Float32Array]) -> OnsetGCC:
        """Return the sum over segments (K, n) whose context is unknown: each is taken to begin after silence."""
        total = self.nothing
        silence = np.zeros((len(self._tail), round(2.0 * _WARM_UP_S * self.sample_rate_hz)), dtype=np.float32)
        for segment in segments:
            self.reset()
            self.push(silence, quiet=True)
            total += self.push(segment, quiet=False)
        return total
