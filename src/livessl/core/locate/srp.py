"""SRP-PHAT: maps a GCC onto the grid by the nearest fine lag, with the weight 2/K of an array of K microphones.

GCCs are interpolated to fine lags in `gcc_phat`; between fine lags, for places off the grid, by `interpolated` of
`kernels/with_numpy.py`. `contributing` decides which arrays count at all.

SRP(r) = 2/K sum_{i<k} R_ik(tau_ik(r)) with tau_ik(r) = (|r - r_k| - |r - r_i|) / c and the lag's sign of `gcc_phat`.
Of the delays of K(K-1)/2 pairs only K-1 are independent. The factor 2/K gives every array the weight of its independent
delays, so that an array of 16 microphones does not outweigh an array of 4 by its number of pairs. For arrays with the
same number of microphones, the factor changes nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from livessl.core.geometry import Grid, pair_weight
from livessl.core.kernels import kernels
from livessl.core.kernels.arguments import SmoothRows
from livessl.core.kernels.search_with_numpy import lag_places
from livessl.core.kernels.with_numpy import interpolated, neighbours
from livessl.core.steering import NEAREST_M, alias_free_hz
from livessl.core.types import GCC, ArraySpec, Evidence, Float32Array, FloatArray, IntArray

_SLAB_POINTS: Final = 1 << 15
"""Number of grid points whose delays are computed at one time: as many as fit into the second-level cache."""


@dataclass(frozen=True, slots=True)
class LagPlaces:
    """Formula for the index on a fine lag axis that belongs to a difference of distances d in metres.

    The index is the integer part of `d * scale + offset`. Maps and the search all compute it by this formula in
    float32, so that they agree to the last bit.
    """

    count: int
    scale: np.float32
    offset: np.float32

    @classmethod
    def on(cls, lags_s: FloatArray, c_m_s: float) -> LagPlaces:
        """Return the formula for a lag axis (L,), in seconds, with even spacing around zero."""
        scale = 1.0 / ((lags_s[1] - lags_s[0]) * c_m_s)
        return cls(len(lags_s), np.float32(scale), np.float32(len(lags_s) // 2 + 0.5))


class SRPMapper:
    """Maps an array's GCC onto the grid by the nearest fine lag, with one look-up for each pair and grid point.

    With cut-offs, each look-up uses the GCC of the widest band that is free of spatial aliasing at that point
    (`alias_free_hz`), or of the narrowest band if none is free of it. A narrower band lowers the power of a point. The
    power is not normalised, because normalising would also raise the noise.

    Parameters
    ----------
    spec : ArraySpec
        The array.
    grid : Grid
        Grid that all arrays use.
    pairs : (P, 2) int64
    lags_s : (L,) float64
        Lag axis of the GCCs to be mapped.
    c_m_s : float
        Speed of sound, m/s.
    cut_offs_hz : sequence of float
        Cut-offs in descending order. The GCC of the whole band is followed by one GCC for the band below each cut-off.
    """

    def __init__(
        self,
        spec: ArraySpec,
        grid: Grid,
        pairs: IntArray,
        lags_s: FloatArray,
        c_m_s: float,
        cut_offs_hz: Sequence[float] = (),
    ) -> None:
        on_axis = LagPlaces.on(lags_s, c_m_s)
        microphones_m = spec.microphones_m.astype(np.float32)
        ascending_hz = np.array([spec.band_hz[1], *cut_offs_hz])[::-1]
        columns = len(lags_s) * len(ascending_hz)
        table = np.empty((grid.size, len(pairs)), dtype=np.uint16 if columns < 1 << 16 else np.uint32)
        for first in range(0, grid.size, _SLAB_POINTS):
            points_m = grid.points_m(slice(first, first + _SLAB_POINTS))
            place = lag_places(points_m.astype(np.float32), microphones_m, pairs, on_axis.scale, on_axis.offset)
            if len(cut_offs_hz):
                limit = alias_free_hz(points_m, spec.microphones_m, pairs, grid.spacing_m, c_m_s)
                free = np.searchsorted(ascending_hz, limit, side="right")  # bands that are free of aliasing
                place = place + len(lags_s) * np.minimum(len(ascending_hz) - free, len(cut_offs_hz))
            table[first : first + len(points_m)] = place.T
        self._weight = np.float32(pair_weight(len(spec.microphones_m)))
        self._kernels = kernels.in_use  # the table has the form that these kernels need
        self._table = self._kernels.look_up_table(table, columns)

    def add(self, power: Float32Array, *gccs: GCC) -> None:
        """Add the power of a GCC and of the GCCs below each cut-off to `power` (G,), the power at every grid point."""
        values = gccs[0].values if len(gccs) == 1 else np.concatenate([gcc.values for gcc in gccs], axis=1)
        self._kernels.add_power(np.ascontiguousarray(values, dtype=np.float32), self._table, self._weight, power)

    def __call__(self, *gccs: GCC) -> Float32Array:
        """Return the power (G,) at every grid point."""
        power = np.zeros(self._table.shape[0], dtype=np.float32)
        self.add(power, *gccs)
        return power


class SRPFunctional:
    """The sum of several arrays' SRP as a smooth function of position, off the grid.

    Parameters
    ----------
    evidence : sequence of Evidence
        One item for each array.
    c_m_s : float
        Speed of sound, m/s.
    """

    def __init__(self, evidence: Sequence[Evidence], c_m_s: float) -> None:
        self._names = [part.spec.name for part in evidence]
        self.c_m_s = c_m_s
        """Speed of sound, m/s."""
        counts = [len(part.spec.microphones_m) for part in evidence]
        rows = [len(part.gcc.pairs) for part in evidence]
        self._first_row = np.cumsum([0, *rows])
        self.pair_weights = tuple(pair_weight(count) for count in counts)
        """Weight of each array's pairs."""
        shift = np.repeat(np.cumsum([0, *counts[:-1]]), rows)
        lengths = np.repeat([len(part.gcc.lags_s) for part in evidence], rows)
        self._rows = SmoothRows(
            microphones_m=np.concatenate([part.spec.microphones_m for part in evidence]),
            pairs=np.concatenate([part.gcc.pairs for part in evidence]) + shift[:, None],
            first_s=np.repeat([part.gcc.lags_s[0] for part in evidence], rows),
            step_s=np.repeat([part.gcc.lags_s[1] - part.gcc.lags_s[0] for part in evidence], rows),
            start=np.cumsum(lengths) - lengths,
            last=np.repeat([len(part.gcc.lags_s) - 3 for part in evidence], rows),
            weight=np.repeat(self.pair_weights, rows),
            values=np.concatenate([part.gcc.values.ravel() for part in evidence]),
        )

    def value(self, points_m: FloatArray) -> FloatArray:
        """Return the SRP (N,) at points (N, 3), in metres."""
        return np.asarray(kernels.smooth_power(np.ascontiguousarray(points_m), self.c_m_s, self._rows))

    def pair_terms(self, point_m: FloatArray) -> list[PairTerms]:
        """Return the terms of each array's pairs at one point (3,)."""
        terms = self._terms(point_m)
        parts = zip(self._names, self._first_row[:-1], self._first_row[1:], strict=True)
        return [PairTerms(name, *(part[first:end] for part in terms)) for name, first, end in parts]

    def derivatives(self, point_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return gradient (3,) and Gauss-Newton Hessian (3, 3): sum R' grad tau, sum R'' grad tau grad tau^T."""
        _, slope, curvature, gradient, _ = self._terms(point_m)
        weight = self._rows.weight
        return (weight * slope) @ gradient, (gradient.T * (weight * curvature)) @ gradient

    def _terms(self, point_m: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return R, R', R'', grad tau and tau of all pairs."""
        rows = self._rows
        towards = point_m - rows.microphones_m
        distance = np.sqrt((towards**2).sum(axis=1))
        unit = towards / np.maximum(distance, NEAREST_M)[:, None]
        i, k = rows.pairs.T
        lags = (distance[k] - distance[i]) / self.c_m_s
        place = (lags - rows.first_s) / rows.step_s
        left, around = neighbours(place, rows.start, rows.last, rows.values)
        value, slope, curvature = interpolated(place - left, *around)
        return value, slope / rows.step_s, curvature / rows.step_s**2, (unit[k] - unit[i]) / self.c_m_s, lags


@dataclass(frozen=True, slots=True)
class PairTerms:
    """Terms of an array's pairs at a point: R, R' (1/s), R'' (1/s^2), grad tau (P, 3) (s/m) and tau (s), each (P,)."""

    array: str
    values: FloatArray
    slope: FloatArray
    curvature: FloatArray
    gradient_s_m: FloatArray
    lags_s: FloatArray
