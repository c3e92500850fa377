"""Steered response power (SRP-PHAT): one array's GCC mapped onto the shared grid, and the same as a function of place.

SRP(r) = 2/K sum_{i<k} R_ik(tau_ik(r)) with tau_ik(r) = (|r - r_k| - |r - r_i|) / c, the lag's sign as in `gcc`. Of the
K(K-1)/2 pairs only K-1 delays are independent; the factor 2/K counts each once, so that an array of 16 microphones
does not outvote one of 4 merely by its number of pairs. Among equal arrays it changes nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from livessl.core.geometry import Grid
from livessl.core.kernels import kernels
from livessl.core.kernels.with_numpy import interpolated, lag_places, neighbours
from livessl.core.steering import NEAREST_M, alias_free_hz
from livessl.core.types import GCC, ArraySpec, Evidence, Float32Array, FloatArray, IntArray

_SLAB_NODES: Final = 1 << 15
"""Nodes whose delays are worked out at once: what fits the second-level cache."""


@dataclass(frozen=True, slots=True)
class LagPlaces:
    """From a difference of distances, metres, to a place on a fine lag axis: the whole part of `d * scale + offset`.

    In float32, and by the same formula wherever a node's lag is looked up: a map and a search then agree to the last
    bit.
    """

    count: int
    scale: np.float32
    offset: np.float32

    @classmethod
    def on(cls, lags_s: FloatArray, c_m_s: float) -> LagPlaces:
        """Of an axis (L,), evenly spaced around zero."""
        scale = 1.0 / ((lags_s[1] - lags_s[0]) * c_m_s)
        return cls(len(lags_s), np.float32(scale), np.float32(len(lags_s) // 2 + 0.5))


class SRPMapper:
    """Maps an array's GCC onto the grid by nearest fine lag: one look-up a pair and node.

    With cut-offs, each pair and node looks its lag up in the GCC of the highest band that is free of spatial aliasing
    there (`alias_free_hz`), or of the lowest where none is. What is left out lowers a node's power: it is not
    normalised, for noise would be raised with it.

    Parameters
    ----------
    spec : ArraySpec
        The array.
    grid : Grid
        The shared grid.
    pairs : (P, 2) int64
    lags_s : (L,) float64
        Of the GCCs to come.
    c_m_s : float
    cut_offs_hz : sequence of float
        Descending; a GCC of what lies below each follows that of the whole band.
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
        for first in range(0, grid.size, _SLAB_NODES):
            nodes = grid.nodes_m(slice(first, first + _SLAB_NODES))
            place = lag_places(nodes.astype(np.float32), microphones_m, pairs, on_axis.scale, on_axis.offset)
            if len(cut_offs_hz):
                limit = alias_free_hz(nodes, spec.microphones_m, pairs, grid.spacing_m, c_m_s)
                free = np.searchsorted(ascending_hz, limit, side="right")  # bands that are free of aliasing
                place = place + len(lags_s) * np.minimum(len(ascending_hz) - free, len(cut_offs_hz))
            table[first : first + len(nodes)] = place.T
        self._weight = np.float32(pair_weight(len(spec.microphones_m)))
        self._table = kernels.look_up_table(table, columns)

    def add(self, power: Float32Array, *gccs: GCC) -> None:
        """Add to the power (G,) at every node that of the GCC of the whole band and those below each cut-off."""
        values = gccs[0].values if len(gccs) == 1 else np.concatenate([gcc.values for gcc in gccs], axis=1)
        kernels.add_power(np.ascontiguousarray(values, dtype=np.float32), self._table, self._weight, power)

    def __call__(self, *gccs: GCC) -> Float32Array:
        """Power (G,) at every node."""
        power = np.zeros(self._table.shape[0], dtype=np.float32)
        self.add(power, *gccs)
        return power


def pair_weight(microphones: int) -> float:
    """2/K: see the module's head."""
    return 2.0 / microphones


class SRPFunctional:
    """The sum of several arrays' SRP as a smooth function of place, off the grid.

    Parameters
    ----------
    evidence : sequence of Evidence
        One for each array.
    c_m_s : float
    """

    def __init__(self, evidence: Sequence[Evidence], c_m_s: float) -> None:
        self._names = [heard.spec.name for heard in evidence]
        counts = [len(heard.spec.microphones_m) for heard in evidence]
        rows = [len(heard.gcc.pairs) for heard in evidence]
        self._first_row = np.cumsum([0, *rows])
        self._microphones_m = np.concatenate([heard.spec.microphones_m for heard in evidence])
        shift = np.repeat(np.cumsum([0, *counts[:-1]]), rows)
        self._pairs = np.concatenate([heard.gcc.pairs for heard in evidence]) + shift[:, None]
        self._weight = np.repeat([pair_weight(count) for count in counts], rows)
        self._c_m_s = c_m_s
        self._first_s = np.repeat([heard.gcc.lags_s[0] for heard in evidence], rows)
        self._step_s = np.repeat([heard.gcc.lags_s[1] - heard.gcc.lags_s[0] for heard in evidence], rows)
        self._last = np.repeat([len(heard.gcc.lags_s) - 3 for heard in evidence], rows)
        lengths = np.repeat([len(heard.gcc.lags_s) for heard in evidence], rows)
        self._start = np.cumsum(lengths) - lengths
        self._values = np.concatenate([heard.gcc.values.ravel() for heard in evidence])

    def value(self, points_m: FloatArray) -> FloatArray:
        """SRP at points (N, 3): (N,)."""
        return np.asarray(
            kernels.smooth_power(
                np.ascontiguousarray(points_m), self._microphones_m, self._pairs, self._c_m_s, self._first_s,
                self._step_s, self._start, self._last, self._weight, self._values,
            )
        )  # fmt: skip

    def pair_terms(self, point_m: FloatArray) -> list[PairTerms]:
        """For each array, what its pairs say at one point (3,)."""
        terms = self._terms(point_m)
        parts = zip(self._names, self._first_row[:-1], self._first_row[1:], strict=True)
        return [PairTerms(name, *(part[first:end] for part in terms)) for name, first, end in parts]

    def derivatives(self, point_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Gradient (3,) and Gauss-Newton Hessian (3, 3) at one point: sum R' grad tau, sum R'' grad tau grad tau^T."""
        _, slope, curvature, gradient, _ = self._terms(point_m)
        return (self._weight * slope) @ gradient, (gradient.T * (self._weight * curvature)) @ gradient

    def _terms(self, point_m: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
        """Of all pairs R, R', R'', grad tau and tau."""
        towards = point_m - self._microphones_m
        distance = np.sqrt((towards**2).sum(axis=1))
        unit = towards / np.maximum(distance, NEAREST_M)[:, None]
        i, k = self._pairs.T
        lags = (distance[k] - distance[i]) / self._c_m_s
        place = (lags - self._first_s) / self._step_s
        left, around = neighbours(place, self._start, self._last, self._values)
        value, slope, curvature = interpolated(place - left, *around)
        return value, slope / self._step_s, curvature / self._step_s**2, (unit[k] - unit[i]) / self._c_m_s, lags


@dataclass(frozen=True, slots=True)
class PairTerms:
    """One array's pairs at one point: R, R' (1/s), R'' (1/s^2), grad tau (P, 3) (s/m) and tau (s), each (P,)."""

    array: str
    values: FloatArray
    slope: FloatArray
    curvature: FloatArray
    gradient_s_m: FloatArray
    lags_s: FloatArray
