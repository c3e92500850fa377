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
from livessl.core.types import GCC, ArraySpec, Float32Array, FloatArray, HeardBy, IntArray

_NEAREST_M: Final = 1e-9
"""A point in a microphone has no direction from it; one so far away has."""

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


def delay_gradients_s_m(points_m: FloatArray, microphones_m: FloatArray, pairs: IntArray, c_m_s: float) -> FloatArray:
    """Gradient of each pair's delay at each point: (u_k - u_i) / c, u the unit vector from a microphone to the point.

    Exact, near and far; its length is 2 sin(gamma/2)/c, gamma the angle that the pair subtends.

    Parameters
    ----------
    points_m : (N, 3) float64
    microphones_m : (K, 3) float64
    pairs : (P, 2) int64
    c_m_s : float

    Returns
    -------
    (P, N, 3) float64
        Seconds a metre.
    """
    towards = points_m - microphones_m[:, None]
    unit = towards / np.maximum(np.sqrt((towards**2).sum(axis=2, keepdims=True)), _NEAREST_M)
    return np.asarray((unit[pairs[:, 1]] - unit[pairs[:, 0]]) / c_m_s)


def alias_free_hz(
    points_m: FloatArray, microphones_m: FloatArray, pairs: IntArray, spacing_m: float, c_m_s: float
) -> FloatArray:
    """Frequency up to which a pair's map has no spatial aliasing on a grid: f_max = 1 / (2 D |grad tau|).

    With D the grid's spacing, the phase 2 pi f tau of every kept frequency turns by less than pi from node to node
    (García-Barrios, Gutiérrez-Arriola et al., IEEE Access 2021, arXiv 2402.06586). It is infinite where the delay does
    not change.

    Parameters
    ----------
    points_m : (N, 3) float64
    microphones_m : (K, 3) float64
    pairs : (P, 2) int64
    spacing_m, c_m_s : float

    Returns
    -------
    (P, N) float64
        Hertz.

    Raises
    ------
    ValueError
        Where the spacing is not above 0.
    """
    if not spacing_m > 0:
        raise ValueError(f"grid spacing: expected metres above 0, got {spacing_m}")
    steepness = np.sqrt((delay_gradients_s_m(points_m, microphones_m, pairs, c_m_s) ** 2).sum(axis=2))
    limit = np.full(steepness.shape, np.inf)
    return np.asarray(np.divide(1.0 / (2.0 * spacing_m), steepness, out=limit, where=steepness > 0.0))


class SRPMapper:
    """Maps an array's GCC onto the grid by nearest fine lag: one sparse product.

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
        step = lags_s[1] - lags_s[0]
        row = np.arange(len(pairs))[:, None] * len(lags_s)
        band = len(pairs) * len(lags_s)
        ascending_hz = np.array([spec.band_hz[1], *cut_offs_hz])[::-1]
        columns = np.empty((grid.size, len(pairs)), dtype=np.int32)
        for first in range(0, grid.size, _SLAB_NODES):
            nodes = grid.nodes_m(slice(first, first + _SLAB_NODES))
            lags = steering_delays_s(nodes, spec.microphones_m, pairs, c_m_s)
            place = np.rint((lags - lags_s[0]) / step) + row
            if len(cut_offs_hz):
                limit = alias_free_hz(nodes, spec.microphones_m, pairs, grid.spacing_m, c_m_s)
                free = np.searchsorted(ascending_hz, limit, side="right")  # bands that are free of aliasing
                place += band * np.minimum(len(ascending_hz) - free, len(cut_offs_hz))
            columns[first : first + len(nodes)] = place.T
        weight = np.full(columns.size, pair_weight(len(spec.microphones_m)), dtype=np.float32)
        starts = np.arange(0, columns.size + 1, len(pairs), dtype=np.int32)
        self._look_up = csr_array((weight, columns.ravel(), starts), shape=(grid.size, len(ascending_hz) * band))

    def __call__(self, *gccs: GCC) -> Float32Array:
        """Power (G,) at every node, float32, from the GCC of the whole band and those below each cut-off."""
        values = [gcc.values.astype(np.float32).ravel() for gcc in gccs]
        return np.asarray(self._look_up @ (values[0] if len(values) == 1 else np.concatenate(values)))


def pair_weight(microphones: int) -> float:
    """2/K: see the module's head."""
    return 2.0 / microphones


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
