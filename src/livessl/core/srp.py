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
from scipy.sparse import csr_array

from livessl.core.geometry import Grid
from livessl.core.types import GCC, ArraySpec, Float32Array, FloatArray, IntArray

_SLAB_NODES: Final = 1 << 15
"""Nodes whose delays are worked out at once: what fits the second-level cache."""


def steering_delays_s(points_m: FloatArray, microphones_m: FloatArray, pairs: IntArray, c_m_s: float) -> FloatArray:
    """Lag at which a sound from each point peaks in each pair's GCC: (|r - r_k| - |r - r_i|) / c.

    Parameters
    ----------
    points_m : (N, 3) float64
    microphones_m : (K, 3) float64
    pairs : (P, 2) int64
    c_m_s : float

    Returns
    -------
    (P, N) float64
        Seconds.
    """
    delays = np.stack([np.sqrt(((points_m - m) ** 2).sum(axis=1)) for m in microphones_m]) / c_m_s
    return np.asarray(delays[pairs[:, 1]] - delays[pairs[:, 0]])


class SRPMapper:
    """Maps an array's GCC onto the grid by nearest fine lag: one sparse product.

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
    """

    def __init__(self, spec: ArraySpec, grid: Grid, pairs: IntArray, lags_s: FloatArray, c_m_s: float) -> None:
        step = lags_s[1] - lags_s[0]
        row = np.arange(len(pairs))[:, None] * len(lags_s)
        columns = np.empty((grid.size, len(pairs)), dtype=np.int32)
        for first in range(0, grid.size, _SLAB_NODES):
            nodes = grid.nodes_m(slice(first, first + _SLAB_NODES))
            lags = steering_delays_s(nodes, spec.microphones_m, pairs, c_m_s)
            columns[first : first + len(nodes)] = (np.rint((lags - lags_s[0]) / step) + row).T
        weight = np.full(columns.size, pair_weight(len(spec.microphones_m)), dtype=np.float32)
        starts = np.arange(0, columns.size + 1, len(pairs), dtype=np.int32)
        self._look_up = csr_array((weight, columns.ravel(), starts), shape=(grid.size, len(pairs) * len(lags_s)))

    def __call__(self, gcc: GCC) -> Float32Array:
        """Power (G,) at every node, float32."""
        return np.asarray(self._look_up @ gcc.values.astype(np.float32).ravel())


def pair_weight(microphones: int) -> float:
    """2/K: see the module's head."""
    return 2.0 / microphones


@dataclass(frozen=True, slots=True)
class HeardBy:
    """One array's evidence: its geometry and its GCC."""

    spec: ArraySpec
    gcc: GCC


class SRPFunctional:
    """The sum of several arrays' SRP as a smooth function of place, off the grid.

    Parameters
    ----------
    evidence : sequence of HeardBy
        One for each array.
    c_m_s : float
    """

    def __init__(self, evidence: Sequence[HeardBy], c_m_s: float) -> None:
        self._evidence = evidence
        self._c_m_s = c_m_s
        self._tables = [_Tables(heard.gcc) for heard in evidence]

    def value(self, points_m: FloatArray) -> FloatArray:
        """SRP at points (N, 3): (N,)."""
        total = np.zeros(len(points_m))
        for heard, table in zip(self._evidence, self._tables, strict=True):
            lags = steering_delays_s(points_m, heard.spec.microphones_m, heard.gcc.pairs, self._c_m_s)
            total += pair_weight(len(heard.spec.microphones_m)) * table.values(lags).sum(axis=0)
        return total

    def pair_terms(self, point_m: FloatArray) -> list[PairTerms]:
        """For each array, what its pairs say at one point (3,)."""
        terms = []
        for heard, table in zip(self._evidence, self._tables, strict=True):
            microphones, pairs = heard.spec.microphones_m, heard.gcc.pairs
            towards = point_m - microphones
            distance = np.sqrt((towards**2).sum(axis=1))
            unit = towards / np.maximum(distance, 1e-9)[:, None]
            gradient = (unit[pairs[:, 1]] - unit[pairs[:, 0]]) / self._c_m_s
            lags = (distance[pairs[:, 1]] - distance[pairs[:, 0]]) / self._c_m_s
            values, slope, curvature = (one[:, 0] for one in table.derivatives(lags[:, None]))
            weight = pair_weight(len(microphones))
            terms.append(PairTerms(heard.spec.name, weight, values, slope, curvature, gradient, lags))
        return terms

    def derivatives(self, point_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Gradient (3,) and Gauss-Newton Hessian (3, 3) at one point: sum R' grad tau, sum R'' grad tau grad tau^T."""
        gradient, hessian = np.zeros(3), np.zeros((3, 3))
        for term in self.pair_terms(point_m):
            gradient += term.weight * term.slope @ term.gradient_s_m
            hessian += term.weight * (term.gradient_s_m.T * term.curvature) @ term.gradient_s_m
        return gradient, hessian


@dataclass(frozen=True, slots=True)
class PairTerms:
    """One array's pairs at one point: R, R' (1/s), R'' (1/s^2), grad tau (P, 3) (s/m) and tau (s), each (P,)."""

    array: str
    weight: float
    values: FloatArray
    slope: FloatArray
    curvature: FloatArray
    gradient_s_m: FloatArray
    lags_s: FloatArray


class _Tables:
    """R, R' and R'' between the fine lags: differences over four neighbours, R bent by its curvature.

    R must be smooth, for a kink at every fine lag would stop a climb at its ridge. At `OVERSAMPLING` lags a sample the
    highest frequency advances by at most 0.35 rad a step, so the differences err by less than 2 %.
    """

    def __init__(self, gcc: GCC) -> None:
        self._first = gcc.lags_s[0]
        self._step = gcc.lags_s[1] - gcc.lags_s[0]
        self._values = gcc.values
        self._row = np.arange(len(gcc.values))[:, None]

    def values(self, lags_s: FloatArray) -> FloatArray:
        """R at each pair's own lags (P, N): (P, N)."""
        return self.derivatives(lags_s)[0]

    def derivatives(self, lags_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """R, R' (1/s) and R'' (1/s^2) at each pair's own lags (P, N): (P, N) each."""
        place = (lags_s - self._first) / self._step
        left = np.minimum(np.maximum(place.astype(np.int64), 1), self._values.shape[1] - 3)
        after_share = place - left
        here_share = 1.0 - after_share
        before, here, after, beyond = (self._values[self._row, left + k] for k in (-1, 0, 1, 2))
        slope = 0.5 * (here_share * (after - before) + after_share * (beyond - here))
        curvature = here_share * (after - 2.0 * here + before) + after_share * (beyond - 2.0 * after + here)
        value = here_share * here + after_share * after - 0.5 * here_share * after_share * curvature
        return value, slope / self._step, curvature / self._step**2
