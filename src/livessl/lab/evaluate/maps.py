"""Power maps of many recordings at once: a matrix per pair of microphones, made once, times their correlations.

This is fast on coarse grids. Its memory grows with the grid, so fine grids use look-ups (`livessl.core.locate.srp`).
"""

from __future__ import annotations

from typing import Final

import numpy as np

from livessl.core.correlate.gcc_phat import OVERSAMPLING
from livessl.core.geometry import Grid
from livessl.core.locate.map_estimator import third_octaves_below_hz
from livessl.core.locate.srp import SRPMapper
from livessl.core.steering import alias_free_hz, steering_delays_s
from livessl.core.types import GCC, ArraySpec, Float32Array, FloatArray, IntArray

MARGIN_S: Final = 0.02
"""Correlation, in seconds, that is kept beyond the largest delay for the low-pass of a grid point's cut-off.

The error of the maps is then 0.5 % for 0.5 m arrays and 2.5 % for 3 m arrays, which are cut off at a few hundred hertz.
"""

_SLAB_POINTS: Final = 4096
"""Grid points whose matrix rows are made at once, to bound the memory."""


def reach_samples(aperture_m: float, sample_rate_hz: float, c_m_s: float) -> int:
    """Return the number of whole-sample lags to keep on each side of zero."""
    return int(np.ceil((aperture_m / c_m_s + MARGIN_S) * sample_rate_hz)) + 1


class PairMatrices:
    """Interpolation matrices W of pairs of microphones: map = 2/K sum of W r, with r a pair's GCC at whole-sample lags.

    W[g, n] = (2 f/fs) sinc(2 f (tau_g - n/fs)) with f the grid point's cut-off, or fs/2 without one: low-pass and
    fractional delay in one (Dietzen et al. 2021 for the sampling; the cut-off as in `alias_free_hz`).

    Parameters
    ----------
    grid : Grid
    sample_rate_hz, c_m_s : float
    band_limit : bool
        Whether grid points have a cut-off, against spatial aliasing.
    """

    def __init__(self, grid: Grid, sample_rate_hz: float, c_m_s: float, *, band_limit: bool) -> None:
        self._points_m = grid.points_m()
        self._spacing_m = grid.spacing_m
        self._rate_hz = sample_rate_hz
        self._c_m_s = c_m_s
        self._band_limit = band_limit
        self._made: dict[bytes, Float32Array] = {}

    def power(self, spec: ArraySpec, pairs: IntArray, lags: Float32Array) -> Float32Array:
        """Map C recordings of one array.

        Parameters
        ----------
        spec : ArraySpec
        pairs : (P, 2) int64
        lags : (C, P, 2 reach + 1) float32
            Correlations at whole-sample lags; `reach` follows from the array's aperture.

        Returns
        -------
        (G, C) float32
        """
        centre = lags.shape[2] // 2
        total = np.zeros((len(self._points_m), len(lags)), dtype=np.float32)
        for index, (i, k) in enumerate(pairs):
            matrix = self._matrix(spec.microphones_m[[i, k]])
            reach = matrix.shape[1] // 2
            total += matrix @ lags[:, index, centre - reach : centre + reach + 1].T
        return total * np.float32(2.0 / len(spec.microphones_m))

    def _matrix(self, microphones_m: FloatArray) -> Float32Array:
        key = np.round(microphones_m, 9).tobytes()
        if key not in self._made:
            self._made[key] = self._new_matrix(microphones_m)
        return self._made[key]

    def _new_matrix(self, microphones_m: FloatArray) -> Float32Array:
        pairs = np.array([[0, 1]])
        spacing_m = float(np.linalg.norm(microphones_m[1] - microphones_m[0]))
        reach = reach_samples(spacing_m, self._rate_hz, self._c_m_s)
        lags_s = np.arange(-reach, reach + 1) / self._rate_hz
        matrix = np.empty((len(self._points_m), len(lags_s)), dtype=np.float32)
        for first in range(0, len(matrix), _SLAB_POINTS):
            points_m = self._points_m[first : first + _SLAB_POINTS]
            delay_s = steering_delays_s(points_m, microphones_m, pairs, self._c_m_s)[0]
            cut_hz = np.full(len(points_m), self._rate_hz / 2.0)
            if self._band_limit:
                limit_hz = alias_free_hz(points_m, microphones_m, pairs, self._spacing_m, self._c_m_s)[0]
                cut_hz = np.minimum(cut_hz, limit_hz)
            offset_s = delay_s[:, None] - lags_s
            width = 2.0 * cut_hz[:, None]
            matrix[first : first + len(points_m)] = width / self._rate_hz * np.sinc(width * offset_s) * _taper(offset_s)
        return matrix


class PairTables:
    """Maps fine grids by look-ups in tables of finely interpolated correlations, one table for each cut-off.

    The cut-offs are third octaves, rounded down.

    Parameters are those of `PairMatrices`.
    """

    def __init__(self, grid: Grid, sample_rate_hz: float, c_m_s: float, *, band_limit: bool) -> None:
        self._grid = grid
        self._rate_hz = sample_rate_hz
        self._c_m_s = c_m_s
        self._band_limit = band_limit
        self._made: dict[bytes, SRPMapper] = {}

    def power(self, spec: ArraySpec, pairs: IntArray, lags: Float32Array) -> Float32Array:
        """Map C recordings of one array, as `PairMatrices.power` does."""
        cut_offs_hz = third_octaves_below_hz(spec.band_hz) if self._band_limit else ()
        count = lags.shape[2]
        reach = int(np.ceil(spec.aperture_m / self._c_m_s * self._rate_hz)) * OVERSAMPLING + OVERSAMPLING
        lags_s = np.arange(-reach, reach + 1) / (OVERSAMPLING * self._rate_hz)
        mapper = self._mapper(spec, pairs, lags_s, cut_offs_hz)
        offset_s = lags_s - (np.arange(count) - count // 2)[:, None] / self._rate_hz
        taper = _taper(offset_s)
        total = np.empty((self._grid.size, len(lags)), dtype=np.float32)
        tables = []
        for cut_hz in (self._rate_hz / 2.0, *cut_offs_hz):
            kernel = 2.0 * cut_hz / self._rate_hz * np.sinc(2.0 * cut_hz * offset_s) * taper
            tables.append(lags.astype(np.float64) @ kernel)
        for c in range(len(lags)):
            total[:, c] = mapper(*(GCC(pairs.copy(), lags_s.copy(), table[c].copy()) for table in tables))
        return total

    def _mapper(
        self, spec: ArraySpec, pairs: IntArray, lags_s: FloatArray, cut_offs_hz: tuple[float, ...]
    ) -> SRPMapper:
        key = np.round(spec.microphones_m, 9).tobytes()
        if key not in self._made:
            self._made[key] = SRPMapper(spec, self._grid, pairs, lags_s, self._c_m_s, cut_offs_hz)
        return self._made[key]


def _taper(offset_s: FloatArray) -> FloatArray:
    """Return weights that are 1 over half of the margin and then fall to 0 as a cosine: the lags end without a step."""
    return np.asarray(0.5 + 0.5 * np.cos(np.pi * np.clip(2.0 * np.abs(offset_s) / MARGIN_S - 1.0, 0.0, 1.0)))
