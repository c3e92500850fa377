"""Steered response power (SRP-PHAT): one array's GCC mapped onto the shared grid, and as a function of position.

SRP(r) = 2/K sum_{i<k} R_ik(tau_ik(r)) with tau_ik(r) = (|r - r_k| - |r - r_i|) / c and the lag's sign of `gcc_phat`.
Of the K(K-1)/2 pairs only K-1 delays are independent; the factor 2/K counts each once, so that an array of 16
microphones does not outweigh one of 4 merely by its number of pairs. Among equal arrays it changes nothing.
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
"""Grid points whose delays are computed at once: as many as fit the second-level cache."""


@dataclass(frozen=True, slots=True)
class LagPlaces:
    """Place on a fine lag axis of a difference of distances d, in metres: the whole part of `d * scale + offset`.

    It is computed in float32 and by this formula everywhere, so that a map and a search agree to the last bit.
    """

    count: int
    scale: np.float32
    offset: np.float32

    @classmethod
    def on(cls, lags_s: FloatArray, c_m_s: float) -> LagPlaces:
        """Return the places on an axis (L,), in seconds, evenly spaced around zero."""
        scale = 1.0 / ((lags_s[1] - lags_s[0]) * c_m_s)
        return cls(len(lags_s), np.float32(scale), np.float32(len(lags_s) // 2 + 0.5))


class SRPMapper:
    """Maps an array's GCC onto the grid by the nearest fine lag: one look-up for each pair and grid point.

    With cut-offs, each look-up uses the GCC of the highest band that is free of spatial aliasing there
    (`alias_free_hz`), or of the lowest band if none is. A narrower band lowers a point's power, which is not
    normalised, because that would raise the noise too.

    Parameters
    ----------
    spec : ArraySpec
        The array.
    grid : Grid
        The shared grid.
    pairs : (P, 2) int64
    lags_s : (L,) float64
        Lag axis of the GCCs to be mapped.
    c_m_s : float
        Speed of sound, m/s.
    cut_offs_hz : sequence of float
        Cut-offs in descending order; the GCC of the whole band is followed by one of the part below each.
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
        self._kernels = kernels.in_use  # the table is in its form
        self._table = self._kernels.look_up_table(table, columns)

    def add(self, power: Float32Array, *gccs: GCC) -> None:
        """Add the power of a GCC, followed by those below each cut-off, to the power (G,) at every grid point."""
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
        One for each array.
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
        """SRP at points (N, 3), in metres: (N,)."""
        return np.asarray(kernels.smooth_power(np.ascontiguousarray(points_m), self.c_m_s, self._rows))

    def pair_terms(self, point_m: FloatArray) -> list[PairTerms]:
        """Return the terms of each array's pairs at one point (3,)."""
        terms = self._terms(point_m)
        parts = zip(self._names, self._first_row[:-1], self._first_row[1:], strict=True)
        return [PairTerms(name, *(part[first:end] for part in terms)) for name, first, end in parts]

    def derivatives(self, point_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Gradient (3,) and Gauss-Newton Hessian (3, 3) at one point: sum R' grad tau, sum R'' grad tau grad tau^T."""
        _, slope, curvature, gradient, _ = self._terms(point_m)
        weight = self._rows.weight
        return (weight * slope) @ gradient, (gradient.T * (weight * curvature)) @ gradient

    def _terms(self, point_m: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
        """R, R', R'', grad tau and tau of all pairs."""
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
    """One array's pairs at one point: R, R' (1/s), R'' (1/s^2), grad tau (P, 3) (s/m) and tau (s), each (P,)."""

    array: str
    values: FloatArray
    slope: FloatArray
    curvature: FloatArray
    gradient_s_m: FloatArray
    lags_s: FloatArray
