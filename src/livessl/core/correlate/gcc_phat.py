"""GCC-PHAT of one array: cross-correlation with phase transform, interpolated to a fine lag axis.

It is band-limited; the fine lag axis has `OVERSAMPLING` lags a sample, and `LagSampling` interpolates between the whole
lags. `locate/srp.py` takes the nearest fine lag of each grid point.

The sign of a lag is defined here and nowhere else: *positive lag of pair (i, k): the sound reaches channel k later*.
The paper's SRP equation has the opposite sign, which would mirror the map.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Final

import numpy as np
import scipy

from livessl.core.correlate.band import band_bins
from livessl.core.correlate.band import uses_envelope as uses_envelope
from livessl.core.correlate.spectra import FFT_FACTOR, FrontEnd, Spectra, whole_segment
from livessl.core.geometry import microphone_pairs as microphone_pairs
from livessl.core.kernels import kernels
from livessl.core.types import GCC, ArraySpec, ComplexArray, Float32Array, FloatArray, IntArray

OVERSAMPLING: Final = 8
"""Fine lags per sample. The nearest lag is then at most 1/16 sample off: 8 degrees of phase at 6 kHz and 16 kHz
sampling."""

_NYQUIST_MARGIN: Final = 1.25
"""Factor by which near-Nyquist lags are denser than the band's upper edge requires, for accurate
interpolation."""

_BEYOND: Final = 4
"""Near-Nyquist lags beyond the largest fine lag, on each side, for the interpolation there."""

_RIDGE: Final = 1e-10
"""Ridge that keeps the least-squares weights small where lags are nearly dependent, relative to the diagonal."""

_PRODUCT_BINS: Final = 2048
"""Most bins, a third of a second of sound, for which lags are computed by a cached matrix; above it by a short inverse
FFT."""

_TOGETHER_S: Final = 0.25
"""Longest window, in seconds, for which several arrays are correlated in one product: longer spectra would not fit in
the cache."""

_ROUNDING: Final = 1e-6
"""Tolerance, in fine lags, in rounding up the largest lag, so that arrays of one shape share a lag axis despite
rounding errors."""

_SAMPLINGS: Final = 16
"""Lag samplings that are cached; the arrays of a site have few shapes."""

_MATRICES: Final = 16
"""Matrices that each lag sampling caches; the windows of a site have few lengths."""


def require_band(spec: ArraySpec, sample_rate_hz: float) -> None:
    """Check that a sampling rate exceeds twice the upper edge of an array's band.

    Raises
    ------
    ValueError
        If it does not.
    """
    high = spec.band_hz[1]
    if high >= sample_rate_hz / 2:
        raise ValueError(
            f"array {spec.name!r}: band_hz up to {high:g} Hz needs a sample rate above {2 * high:g} Hz, "
            f"got {sample_rate_hz:g} Hz; lower the array's band_hz"
        )


class GCCPhat:
    """GCC-PHAT of one array at one sampling rate.

    R_ik(tau) = 1/B sum_{f in band} Re[ conj(X_i) X_k / |X_i X_k| e^{j 2 pi f tau} ], so that a pure delay gives 1 at
    its lag (Knapp and Carter 1976, PHAT weighting, averaged over the B bins of the band). It is computed at a few
    near-Nyquist lags and interpolated to `OVERSAMPLING` lags a sample (`LagSampling`).

    If the band begins above `ENVELOPE_ABOVE` times its own width, R is the magnitude of the same sum instead of its
    real part. Otherwise the periods of the carrier would be side lobes nearly as high as the peak, and an error of a
    centimetre in a microphone's position would reverse their sign.

    Parameters
    ----------
    spec : ArraySpec
        The array.
    sample_rate_hz : float
        Must exceed twice the band's upper edge.
    c_m_s : float
        Speed of sound, m/s.
    front_end : FrontEnd
        Computes the spectrum of a whole segment, or the spectra of its frames, whose GCCs are averaged.

    Raises
    ------
    ValueError
        If the sampling rate is too low for the band.
    """

    def __init__(
        self, spec: ArraySpec, sample_rate_hz: float, c_m_s: float, front_end: FrontEnd = whole_segment
    ) -> None:
        require_band(spec, sample_rate_hz)
        self.pairs = microphone_pairs(len(spec.microphones_m))
        self._band_hz = spec.band_hz
        self._rate_hz = sample_rate_hz
        self._front_end = front_end
        self._envelope = uses_envelope(spec.band_hz)
        self._sampling = LagSampling.shared(spec.band_hz, sample_rate_hz, spec.aperture_m / c_m_s)
        self.lags_s = self._sampling.fine_lags_s

    def __call__(self, segments: Sequence[Float32Array]) -> GCC:
        """GCC of a sound's segments (K, n): their mean, weighted by length.

        Silence and dead channels give zeros, never NaN.
        """
        return self.below(segments, ())[0]

    def of_each(self, sounds: Sequence[Float32Array]) -> list[GCC]:
        """GCC of each of several arrays' sounds (K, n), by one transform and one matrix product.

        The arrays must be alike (`is_like`) and their sounds equally long. Values differ by rounding from those of each
        array alone.
        """
        count = len(self.pairs)
        first_channels = len(sounds[0]) * np.arange(len(sounds))
        pairs = (first_channels[:, None, None] + self.pairs).reshape(-1, 2)
        spectra = self._front_end(np.concatenate(sounds), self._rate_hz, self._sampling.room)
        cross = CrossSpectra(spectra, pairs, self._rate_hz, self._band_hz)
        values = self._sampling.fine(self._sampling.sample(cross, envelope=self._envelope))
        return [GCC(self.pairs, self.lags_s, values[first : first + count]) for first in range(0, len(pairs), count)]

    def noise_rms(self, segments: Sequence[Float32Array]) -> float:
        """Root mean square of the GCC of segments (K, n), or of its real part, if the phases were random.

        It is the mean over as many independent phases as band width times duration.
        """
        low, high = self._band_hz
        duration_s = sum(segment.shape[1] for segment in segments) / self._rate_hz
        return float(1.0 / np.sqrt(max(1.0, 2.0 * (high - low) * duration_s))) if duration_s else 0.0

    def is_like(self, other: GCCPhat) -> bool:
        """Return whether both use the same matrices."""
        if self._front_end is not other._front_end or len(self.pairs) != len(other.pairs):
            return False
        return self._sampling is other._sampling  # and so band and rate are the same

    def is_short(self, sound: Float32Array) -> bool:
        """Return whether a sound (K, n) is faster to correlate together with others."""
        return bool(sound.shape[1] <= _TOGETHER_S * self._rate_hz)

    def below(self, segments: Sequence[Float32Array], cut_offs_hz: Sequence[float]) -> list[GCC]:
        """GCC of the whole band, and of the part below each cut-off, all divided by the B bins of the whole band."""
        shape = (1 + len(cut_offs_hz), len(self.pairs), self._sampling.count)
        total: ComplexArray | Float32Array
        total = np.zeros(shape, np.complex64) if self._envelope else np.zeros(shape, np.float32)
        for segment in segments:
            spectra = self._front_end(segment, self._rate_hz, self._sampling.room)
            cross = CrossSpectra(spectra, self.pairs, self._rate_hz, self._band_hz)
            for part, cut_off_hz in zip(total, (np.inf, *cut_offs_hz), strict=True):
                part += segment.shape[1] * self._sampling.sample(cross, cut_off_hz, envelope=self._envelope)
        total /= max(1, sum(segment.shape[1] for segment in segments))
        return [GCC(self.pairs, self.lags_s, self._sampling.fine(part)) for part in total]


def correlated(sounds: Sequence[tuple[GCCPhat, Sequence[Float32Array]]]) -> list[GCC]:
    """GCC of each array's segments by its correlator; windows of arrays of one shape are correlated together."""
    (first, segments), *others = sounds
    alike = all(correlate.is_like(first) and len(each) == 1 for correlate, each in sounds)
    if others and alike and first.is_short(segments[0]):
        windows = [each[0] for _, each in sounds]
        if all(window.shape == windows[0].shape for window in windows):
            return first.of_each(windows)
    return [correlate(each) for correlate, each in sounds]


class CrossSpectra:
    """Whitened cross spectra of all pairs in the band, summed over frames.

    Parameters
    ----------
    spectra : Spectra
        `n_fft` exceeds the frames' length by the largest lag.
    pairs : (P, 2) int64
    sample_rate_hz : float
    band_hz : (float, float)
    weights : (L, B) float32 or None
        Weights of each frame's bins in the band. Given weights make correlations weighted sums; None makes them means.
    noise : (L, B) float32 or None
        Power of the noise in each frame's bins in the band; magnitudes count where it dominates. None uses phases only.
    background : (P + K, B) complex64 or None
        Cross-spectra of the background in the band, and its power at each microphone, which are subtracted.

    Attributes
    ----------
    levels : (K,) float64
        Correlation of each microphone with itself at lag 0, as a sum.
    """

    def __init__(
        self,
        spectra: Spectra,
        pairs: IntArray,
        sample_rate_hz: float,
        band_hz: tuple[float, float],
        weights: Float32Array | None = None,
        *,
        noise: Float32Array | None = None,
        background: ComplexArray | None = None,
    ) -> None:
        self.n_fft = spectra.n_fft
        self.sample_rate_hz = sample_rate_hz
        self.low, high = band_bins(spectra.n_fft, sample_rate_hz, band_hz)
        frames, bins = len(spectra.values), max(0, high - self.low)
        self.whitened = np.empty((len(pairs), bins), dtype=np.complex64)
        self.share = 1
        if weights is None:
            self.share = max(1, bins) * max(1, frames)
            weights = np.ones((frames, bins), dtype=np.float32)
        if noise is None:
            noise = np.zeros((frames, bins), dtype=np.float32)
        if background is None:
            background = np.empty((0, bins), dtype=np.complex64)
        self.levels = np.zeros(spectra.values.shape[1])
        kernels.cross_spectra(spectra.values, self.low, pairs, weights, noise, background, self.whitened, self.levels)

    def bins_below(self, cut_off_hz: float) -> int:
        """Number of the band's bins at or below a cut-off."""
        bins = self.whitened.shape[1]
        return max(0, int(min(bins, cut_off_hz * self.n_fft / self.sample_rate_hz + 1 - self.low)))

    def correlations(self, reach: int, cut_off_hz: float = np.inf, *, envelope: bool = False) -> ComplexArray:
        """GCC-PHAT at whole-sample lags around zero: the mean over frames and over the bins of the band.

        Parameters
        ----------
        reach : int
            Largest lag in samples.
        cut_off_hz : float
            Bins above it count as zero.
        envelope : bool
            Whether to return the analytic signal; otherwise the imaginary part is zero.

        Returns
        -------
        (P, 2 reach + 1) complex64
        """
        return self.around_zero(self.n_fft, reach, cut_off_hz, envelope=envelope).astype(np.complex64)

    def around_zero(self, count: int, reach: int, cut_off_hz: float, *, envelope: bool) -> ComplexArray | Float32Array:
        """Compute the same as `correlations`, at lags n_fft/count samples apart, by an inverse FFT of `count` points.

        Returns
        -------
        (P, 2 reach + 1)
            float32, or complex64 for the analytic signal.
        """
        kept = self.bins_below(cut_off_hz)
        spectrum = np.zeros((len(self.whitened), count if envelope else count // 2 + 1), dtype=np.complex64)
        spectrum[:, self.low : self.low + kept] = self.whitened[:, :kept]
        transform, gain = (scipy.fft.ifft, float(count)) if envelope else (scipy.fft.irfft, count / 2.0)
        correlation = transform(spectrum, count, axis=1, overwrite_x=True)
        around = np.concatenate([correlation[:, -reach:], correlation[:, : reach + 1]], axis=1)
        return np.asarray(around * np.float32(gain / self.share))


class LagSampling:
    """The lags at which a band-limited GCC is computed, and the interpolation from these to fine lags.

    A GCC without content above f2 is determined by lags 1/(2 f2) apart (Dietzen et al. 2021). With lags a quarter
    denser than that, and some beyond the largest, a fixed matrix interpolates to the fine lags. Its weights minimise
    the mean square error over the frequencies of the band, which is 2e-6 of the GCC.

    Parameters
    ----------
    band_hz : (float, float)
    sample_rate_hz : float
    largest_lag_s : float
        Largest lag of any direction, in seconds.
    """

    def __init__(self, band_hz: tuple[float, float], sample_rate_hz: float, largest_lag_s: float) -> None:
        self._rate_hz = sample_rate_hz
        fine = _fine_lags(sample_rate_hz, largest_lag_s)
        self.fine_lags_s = np.arange(-fine, fine + 1) / (OVERSAMPLING * sample_rate_hz)
        least = _NYQUIST_MARGIN * 2.0 * band_hz[1] / sample_rate_hz * FFT_FACTOR
        self._per_factor = scipy.fft.next_fast_len(int(np.ceil(least)), real=True)  # lags in FFT_FACTOR samples
        step = FFT_FACTOR / self._per_factor
        self._reach = int(np.ceil(fine / OVERSAMPLING / step)) + _BEYOND
        self.count = 2 * self._reach + 1
        self.room = int(np.ceil(self._reach * step))
        self._lags_s = np.arange(-self._reach, self._reach + 1) * np.float64(step / sample_rate_hz)
        self._weights = _least_squares(self._lags_s, self.fine_lags_s, band_hz)
        self._matrices: dict[tuple[int, float, bool], Float32Array] = {}

    @classmethod
    def shared(cls, band_hz: tuple[float, float], sample_rate_hz: float, largest_lag_s: float) -> LagSampling:
        """Return a cached sampling, the same for arrays of one shape, so that their matrices stay in the CPU cache."""
        return _alike(band_hz, sample_rate_hz, _fine_lags(sample_rate_hz, largest_lag_s))

    def sample(
        self, cross: CrossSpectra, cut_off_hz: float = np.inf, *, envelope: bool = False
    ) -> ComplexArray | Float32Array:
        """GCC at the near-Nyquist lags, (P, count) float32, or its analytic signal, complex64."""
        kept, bins = cross.bins_below(cut_off_hz), cross.whitened.shape[1]
        if bins > _PRODUCT_BINS and cross.sample_rate_hz == self._rate_hz:
            count = cross.n_fft // FFT_FACTOR * self._per_factor
            return cross.around_zero(count, self._reach, cut_off_hz, envelope=envelope)
        matrix = self._matrix(cross, envelope=envelope)
        samples = cross.whitened[:, :kept].view(np.float32) @ matrix[: 2 * kept]
        samples /= np.float32(cross.share)
        return samples.view(np.complex64) if envelope else samples

    def fine(self, samples: ComplexArray | Float32Array) -> Float32Array:
        """Interpolate from the near-Nyquist to the fine lags, (P, L); for an analytic signal, return the magnitude."""
        if np.iscomplexobj(samples):
            return np.asarray(np.hypot(samples.real @ self._weights, samples.imag @ self._weights), dtype=np.float32)
        return np.asarray(samples @ self._weights)

    def _matrix(self, cross: CrossSpectra, *, envelope: bool) -> Float32Array:
        """Real form of e^{j 2 pi f tau}: rows (Re, Im) for each bin, columns for the lags, or (Re, Im) of them."""
        key = (cross.n_fft, cross.sample_rate_hz, envelope)
        if key not in self._matrices:
            frequency_hz = (cross.low + np.arange(cross.whitened.shape[1])) * (cross.sample_rate_hz / cross.n_fft)
            phase = 2.0 * np.pi * frequency_hz[:, None] * self._lags_s
            cosine, sine = np.cos(phase), np.sin(phase)
            real = np.stack([cosine, -sine], axis=1).reshape(-1, self.count)
            matrix = real
            if envelope:
                imaginary = np.stack([sine, cosine], axis=1).reshape(-1, self.count)
                matrix = np.stack([real, imaginary], axis=2).reshape(-1, 2 * self.count)
            while len(self._matrices) >= _MATRICES:
                del self._matrices[next(iter(self._matrices))]
            self._matrices[key] = matrix.astype(np.float32)
        return self._matrices[key]


def _fine_lags(sample_rate_hz: float, largest_lag_s: float) -> int:
    """Fine lags on each side of zero; a sampling depends on them, the band and the rate alone."""
    return int(np.ceil(largest_lag_s * sample_rate_hz * OVERSAMPLING - _ROUNDING)) + 2 * OVERSAMPLING


@lru_cache(_SAMPLINGS)
def _alike(band_hz: tuple[float, float], sample_rate_hz: float, fine_lags: int) -> LagSampling:
    largest_lag_s = (fine_lags - 2 * OVERSAMPLING) / (OVERSAMPLING * sample_rate_hz)
    return LagSampling(band_hz, sample_rate_hz, largest_lag_s)


def _least_squares(lags_s: FloatArray, fine_lags_s: FloatArray, band_hz: tuple[float, float]) -> Float32Array:
    """Weights (count, L) that minimise the mean over the band of |sum_c w_c e^{j 2 pi f t_c} - e^{j 2 pi f t}|^2."""

    def mean_cosine(lag_s: FloatArray) -> FloatArray:
        low, high = band_hz
        return np.asarray((high * np.sinc(2.0 * high * lag_s) - low * np.sinc(2.0 * low * lag_s)) / (high - low))

    gram = mean_cosine(lags_s[:, None] - lags_s) + _RIDGE * np.eye(len(lags_s))
    return np.linalg.solve(gram, mean_cosine(lags_s[:, None] - fine_lags_s)).astype(np.float32)


def mean_square_angular_frequency(band_hz: tuple[float, float]) -> float:
    """Curvature of an ideal band-limited GCC at its peak: (2 pi)^2 (f2^3 - f1^3) / (3 (f2 - f1)), 1/s^2."""
    low, high = band_hz
    return float(4.0 * np.pi**2 * (high**3 - low**3) / (3.0 * (high - low)))
