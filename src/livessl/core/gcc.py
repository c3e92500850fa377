"""Generalized cross-correlation with phase transform (GCC-PHAT), band-limited, on a fine lag axis.

The sign of a lag is defined here and nowhere else: *positive lag of pair (i, k): channel k hears it later*. The paper's
SRP equation has the opposite one, which would mirror the map.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
import scipy.fft
from scipy.signal import upfirdn
from scipy.special import i0

from livessl.core.activity import band_bins
from livessl.core.frontends import FrontEnd, Spectra, whole_segment
from livessl.core.types import GCC, ArraySpec, ComplexArray, Float32Array, IntArray

OVERSAMPLING: Final = 8
"""Fine lags a sample. Nearest-lag look-up then errs by 1/16 sample: 8 degrees of phase at 6 kHz and 16 kHz sampling."""

_HALF_WIDTH: Final = 24
"""Samples of the interpolation kernel on each side: 80 dB for bands up to 0.45 of the sampling rate."""

_KAISER_BETA: Final = 7.86
"""Kaiser window for 80 dB: 0.1102 (80 - 8.7)."""

ENVELOPE_ABOVE: Final = 0.25
"""Lower band edge over band width from which the envelope is used; 100 to 6000 Hz has 0.017, 4 to 16 kHz 0.33."""

_SILENT: Final = 1e-12
"""Cross-power below this share of the largest carries no phase worth whitening."""


def microphone_pairs(count: int) -> IntArray:
    """All pairs (i, k), i < k, of `count` microphones: (P, 2)."""
    return np.stack(np.triu_indices(count, k=1), axis=1).astype(np.int64)


class GCCPhat:
    """GCC-PHAT of one array at one sampling rate, with its constants worked out once.

    R_ik(tau) = 1/B sum_{f in band} Re[ conj(X_i) X_k / |X_i X_k| e^{j 2 pi f tau} ], so that a pure delay gives 1 at
    its lag (Knapp and Carter 1976, PHAT weighting, averaged over the B bins of the band). The lags around zero are
    taken from one inverse FFT at the sampling rate and interpolated to `OVERSAMPLING` lags a sample by a
    Kaiser-windowed sinc: exact in the band to 80 dB, and far cheaper than a zero-padded FFT.

    Where the band begins above `ENVELOPE_ABOVE` times its own width, R is the magnitude of the same sum instead of its
    real part: a carrier's periods would be side lobes nearly as high as the peak, and a centimetre of error in a
    microphone's place would turn their signs against each other.

    Parameters
    ----------
    spec : ArraySpec
        The array.
    sample_rate_hz : float
        Must exceed twice the band's upper edge.
    c_m_s : float
        Speed of sound.
    front_end : FrontEnd
        What a segment's spectra are: the whole segment's, or those of frames, whose GCCs are averaged.
    """

    def __init__(
        self, spec: ArraySpec, sample_rate_hz: float, c_m_s: float, front_end: FrontEnd = whole_segment
    ) -> None:
        high = spec.band_hz[1]
        if high >= sample_rate_hz / 2:
            raise ValueError(
                f"array {spec.name!r}: band_hz up to {high:g} Hz needs a sample rate above {2 * high:g} Hz, "
                f"got {sample_rate_hz:g} Hz; lower the array's band_hz"
            )
        self.pairs = microphone_pairs(len(spec.microphones_m))
        self._band_hz = spec.band_hz
        self._rate_hz = sample_rate_hz
        self._front_end = front_end
        self._envelope = uses_envelope(spec.band_hz)
        largest = spec.aperture_m / c_m_s * sample_rate_hz
        fine = int(np.ceil(largest * OVERSAMPLING)) + 2 * OVERSAMPLING
        self.lags_s = np.arange(-fine, fine + 1) / (OVERSAMPLING * sample_rate_hz)
        self._coarse = fine // OVERSAMPLING + _HALF_WIDTH
        offset = np.arange(-_HALF_WIDTH * OVERSAMPLING, _HALF_WIDTH * OVERSAMPLING + 1) / OVERSAMPLING
        window = i0(_KAISER_BETA * np.sqrt(1.0 - (offset / _HALF_WIDTH) ** 2)) / i0(_KAISER_BETA)
        self._kernel: Float32Array = (np.sinc(offset) * window).astype(np.float32)

    def __call__(self, segments: Sequence[Float32Array]) -> GCC:
        """GCC of a sound's segments, each (K, n) and without gaps: their mean, weighted by length.

        Silence and dead channels give zeros, never NaN.
        """
        return self.below(segments, ())[0]

    def below(self, segments: Sequence[Float32Array], cut_offs_hz: Sequence[float]) -> list[GCC]:
        """GCC of the whole band, and then of what of it lies below each cut-off, all over the whole band's B."""
        total = np.zeros((1 + len(cut_offs_hz), len(self.pairs), 2 * self._coarse + 1), dtype=np.complex64)
        for segment in segments:
            spectra = self._front_end(segment, self._rate_hz, self._coarse)
            cross = CrossSpectra(spectra, self.pairs, self._rate_hz, self._band_hz)
            for part, cut_off_hz in zip(total, (np.inf, *cut_offs_hz), strict=True):
                part += segment.shape[1] * cross.correlations(self._coarse, cut_off_hz, envelope=self._envelope)
        total /= max(1, sum(segment.shape[1] for segment in segments))
        return [self._fine(part) for part in total]

    def _fine(self, total: ComplexArray) -> GCC:
        correlation = total if self._envelope else total.real
        fine = upfirdn(self._kernel, correlation, up=OVERSAMPLING, axis=1)
        centre = (self._coarse + _HALF_WIDTH) * OVERSAMPLING
        reach = len(self.lags_s) // 2
        fine = fine[:, centre - reach : centre + reach + 1]
        values = np.abs(fine) if self._envelope else fine
        return GCC(self.pairs.copy(), self.lags_s.copy(), values.astype(np.float64))


class CrossSpectra:
    """Whitened cross-spectra of all pairs in the band, averaged over frames.

    Parameters
    ----------
    spectra : Spectra
        With `n_fft` above the frames' length by the lags wanted.
    pairs : (P, 2) int64
    sample_rate_hz : float
    band_hz : (float, float)
    """

    def __init__(self, spectra: Spectra, pairs: IntArray, sample_rate_hz: float, band_hz: tuple[float, float]) -> None:
        self._n_fft = spectra.n_fft
        self._rate_hz = sample_rate_hz
        self._low, self._high = band_bins(spectra.n_fft, sample_rate_hz, band_hz)
        inside = spectra.values[:, :, self._low : self._high]
        first, second = pairs.T
        self._whitened = np.zeros((len(pairs), self._high - self._low), dtype=np.complex64)
        for frame in inside:
            self._whitened += _phase_only(np.conj(frame[first]) * frame[second])
        self._share = max(1, self._high - self._low) * max(1, len(inside))

    def correlations(self, reach: int, cut_off_hz: float = np.inf, *, envelope: bool = False) -> ComplexArray:
        """GCC-PHAT at whole-sample lags around zero: the mean over frames and over the bins of the band.

        Parameters
        ----------
        reach : int
            Lags from -reach to reach samples.
        cut_off_hz : float
            Bins above it count as zero.
        envelope : bool
            Whether the analytic signal of the correlation is wanted; else its imaginary part is zero.

        Returns
        -------
        (P, 2 reach + 1) complex64
        """
        n_fft = self._n_fft
        kept = int(np.clip(cut_off_hz * n_fft / self._rate_hz + 1 - self._low, 0, self._whitened.shape[1]))
        spectrum = np.zeros((len(self._whitened), n_fft if envelope else n_fft // 2 + 1), dtype=np.complex64)
        spectrum[:, self._low : self._low + kept] = self._whitened[:, :kept]
        if envelope:
            correlation = scipy.fft.ifft(spectrum, axis=1) * n_fft
        else:
            correlation = (scipy.fft.irfft(spectrum, n_fft, axis=1) * (n_fft / 2.0)).astype(np.complex64)
        around = np.concatenate([correlation[:, -reach:], correlation[:, : reach + 1]], axis=1)
        return np.asarray(around / self._share, dtype=np.complex64)


def uses_envelope(band_hz: tuple[float, float]) -> bool:
    """Whether R is the magnitude instead of the real part: see `GCCPhat`."""
    low, high = band_hz
    return low > ENVELOPE_ABOVE * (high - low)


def mean_square_angular_frequency(band_hz: tuple[float, float]) -> float:
    """Curvature of an ideal band-limited GCC at its peak: (2 pi)^2 (f2^3 - f1^3) / (3 (f2 - f1)), 1/s^2."""
    low, high = band_hz
    return float(4.0 * np.pi**2 * (high**3 - low**3) / (3.0 * (high - low)))


def _phase_only(cross: ComplexArray) -> ComplexArray:
    magnitude = np.abs(cross)
    audible = magnitude > _SILENT * magnitude.max(initial=0.0)
    return np.divide(cross, magnitude, out=np.zeros_like(cross), where=audible)
