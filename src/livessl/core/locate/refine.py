"""Finds peaks in power maps, refines them between grid points, and computes their covariance and margin.

`confidence.py` scales the covariance of the method `onset`, and `set_up_error.py` adds the error of the set-up.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np

from livessl.core.correlate.gcc_phat import mean_square_angular_frequency
from livessl.core.geometry import Grid, pair_weight
from livessl.core.kernels import kernels
from livessl.core.locate.srp import PairTerms, SRPFunctional
from livessl.core.types import BoolArray, Evidence, Float32Array, FloatArray, IntArray

CANDIDATES: Final = 2
"""Number of grid points that are refined. Of two maxima between grid points, the higher one may be near the lower grid
point."""

RIVAL_DISTANCE_M: Final = 1.0
"""Distance, in metres, beyond which a second peak counts as another place."""

_NEWTON_STEPS: Final = 30
"""Largest number of Newton steps of one climb; usually a few suffice."""

_CONVERGED_M: Final = 1e-4
"""Length of a step, in metres, at which a climb ends; shorter steps cannot be measured."""

_SUBDIVISIONS: Final = 4
"""Number of parts into which the edge of a cell is divided to find the start of a climb."""


@dataclass(frozen=True, slots=True)
class Peak:
    """A grid point, its fused power, and its distance to the next examined points, in grid points."""

    point: int
    power: float
    stride: int = 1


class FindPeaks(Protocol):
    """Finds the highest grid points in descending order; each is far enough from all before it."""

    def __call__(self, count: int, apart_points: int = 1, without: Sequence[IntArray] = ()) -> list[Peak]:
        """Find up to `count` peaks outside the boxes `without` that differ by more than `apart_points` along some axis.

        A box (3, 2) has the first and last point along each axis. Of equal points, the first in the grid's order wins.
        """
        ...


def in_map(power: Float32Array, grid: Grid) -> FindPeaks:
    """Return a function that finds the peaks of a whole map (G,)."""

    def find(count: int, apart_points: int = 1, without: Sequence[IntArray] = ()) -> list[Peak]:
        left = power.reshape(grid.shape).copy()
        for box in without:
            left[tuple(slice(max(0, first), last + 1) for first, last in box.tolist())] = -np.inf
        found: list[Peak] = []
        for _ in range(count):
            point = int(left.argmax())
            highest = float(left.flat[point])
            if highest == -np.inf:
                break
            found.append(Peak(point, highest))
            box = box_around(grid, point, apart_points)
            left[tuple(slice(max(0, first), last + 1) for first, last in box.tolist())] = -np.inf
        return found

    return find


def box_around(grid: Grid, point: int, apart_points: int) -> IntArray:
    """Return the box (3, 2), first and last along each axis, of the points at most `apart_points` away from a point."""
    at = np.array(np.unravel_index(point, grid.shape))
    return np.stack([at - apart_points, at + apart_points], axis=1)


def neighbourhood(position_m: FloatArray, grid: Grid) -> IntArray:
    """Return the box (3, 2) of points that count as the same place as a position: first and last along each axis.

    The box reaches `RIVAL_DISTANCE_M` along every axis, or a quarter of the volume's longest edge if that is less.
    Along an axis without such points the box is (1, 0), which is empty.
    """
    reach_m = min(RIVAL_DISTANCE_M, 0.25 * float((grid.upper_m - grid.lower_m).max()))
    box = np.empty((3, 2), dtype=np.int64)
    for axis in range(3):
        near = np.flatnonzero(np.abs(grid.axis_m(axis) - position_m[axis]) <= reach_m)
        box[axis] = (near[0], near[-1]) if len(near) else (1, 0)
    return box


def refine_peaks(functional: SRPFunctional, peaks: Sequence[Peak], grid: Grid) -> tuple[FloatArray, float]:
    """Find the highest maximum near some peaks of a search: see `refine`."""
    starts_m = np.stack([grid.point_m(peak.point) for peak in peaks])
    return refine(functional, starts_m, grid, max(peak.stride for peak in peaks))


def refine(functional: SRPFunctional, starts_m: FloatArray, grid: Grid, stride: int = 1) -> tuple[FloatArray, float]:
    """Find the highest maximum near some grid points.

    A finer local grid around every start is examined. Newton steps then climb from its highest point; a step that does
    not increase the power is shortened.

    Parameters
    ----------
    functional : SRPFunctional
    starts_m : (N, 3) or (3,) float64
        Metres.
    grid : Grid
    stride : int
        Distance between neighbouring points that the search examined, in grid points.

    Returns
    -------
    position_m : (3,) float64
        Inside the grid's bounds.
    value : float
        Value of the functional at the position.
    """
    tops = [_climb(functional, *top, grid, stride) for top in _finer(functional, starts_m, grid, stride)]
    return max(tops, key=lambda top: top[1])


def near_top(functional: SRPFunctional, peak: Peak, grid: Grid) -> tuple[FloatArray, float]:
    """Return the highest point of the finer local grid around a peak, and the value of the functional there.

    This takes a tenth of the time of `refine_peaks`. The error is at most half of the finer spacing along each axis.
    """
    (top,) = _finer(functional, grid.point_m(peak.point), grid, peak.stride)
    return top


def _finer(functional: SRPFunctional, starts_m: FloatArray, grid: Grid, stride: int) -> list[tuple[FloatArray, float]]:
    """Return the highest point of a finer local grid around each start (N, 3) or (3,), and its value."""
    near = np.clip(np.atleast_2d(starts_m)[:, None] + stride * _offsets_m(grid), grid.lower_m, grid.upper_m)
    values = functional.value(near.reshape(-1, 3)).reshape(near.shape[:2])
    return [(near[n, k], float(values[n, k])) for n, k in enumerate(values.argmax(axis=1))]


def _offsets_m(grid: Grid) -> FloatArray:
    """Return the finer local grid of a cell, relative to the cell's centre: (n, 3), metres."""
    fraction = np.linspace(-0.5, 0.5, _SUBDIVISIONS + 1)
    offsets = [fraction * edge if edge > 0 else np.zeros(1) for edge in grid.cell_m]
    return np.stack([o.ravel() for o in np.meshgrid(*offsets, indexing="ij")], axis=1)


def _climb(
    functional: SRPFunctional, position_m: FloatArray, value: float, grid: Grid, stride: int
) -> tuple[FloatArray, float]:
    axes = list(grid.free_axes)
    across = np.ix_(axes, axes)
    lower_m, upper_m = grid.lower_m, grid.upper_m
    reach = stride * float(grid.cell_m.max()) / _SUBDIVISIONS
    for _ in range(_NEWTON_STEPS):
        gradient, hessian = functional.derivatives(position_m)
        step = np.zeros(3)
        step[axes] = _ascent(gradient[axes], hessian[across])
        length = math.sqrt(step @ step)
        if length > reach:
            step, length = step * (reach / length), reach
        climbed = False
        while length > _CONVERGED_M:
            trial = np.minimum(np.maximum(position_m + step, lower_m), upper_m)
            trial_value = float(functional.value(trial[None])[0])
            if trial_value > value:
                position_m, value, climbed = trial, trial_value, True
                break
            step, length = step / 2.0, length / 2.0
        if not climbed:
            break
    return position_m, value


def _ascent(gradient: FloatArray, hessian: FloatArray) -> FloatArray:
    """Return the Newton step with every curvature made negative, so that it also leads upwards from a saddle point."""
    eigenvalues, eigenvectors = np.linalg.eigh(hessian)
    strength = np.maximum(np.abs(eigenvalues), 1e-3 * np.abs(eigenvalues).max(initial=0.0) + 1e-12)
    return np.asarray(eigenvectors @ ((eigenvectors.T @ gradient) / strength))


def rival_power(find: FindPeaks, grid: Grid, position_m: FloatArray) -> float:
    """Return the highest power outside the `neighbourhood` of a position; 0 if the neighbourhood is the whole grid."""
    rivals = find(1, without=[neighbourhood(position_m, grid)])
    return rivals[0].power if rivals else 0.0


def margin(power: float, rival_power: float) -> float:
    """Return the margin of a place over the best other place: 1 - `rival_power` / `power`, 0 to 1."""
    return float(np.clip(1.0 - max(rival_power, 0.0) / power, 0.0, 1.0)) if power > 0.0 else 0.0


def confidence(find: FindPeaks, first: Peak, grid: Grid, position_m: FloatArray) -> float:
    """Return the `margin` of a peak over the highest power outside its `neighbourhood`; it is not a probability."""
    return margin(first.power, rival_power(find, grid, position_m))


def laplace_covariance_m2(
    functional: SRPFunctional, evidence: Sequence[Evidence], position_m: FloatArray, grid: Grid
) -> FloatArray:
    """Covariance (3, 3) from the map's curvature at the peak: C = (sum lambda (-Hess SRP) + prior)^-1.

    The scale lambda = g / s^2 of each array makes the map a log-likelihood: g is the mean height of its GCCs at the
    peak, s^2 their mean square over the other lags, which contain noise and reflections. The scale follows from
    var(tau) = s^2 kappa / (g kappa)^2, kappa the mean square angular frequency: noise of power s^2 and slope variance
    s^2 kappa moves a peak of curvature g kappa. The prior is the search volume's own variance, L^2/12 along each axis,
    so that a coordinate that the arrays do not determine is as uncertain as the volume is wide.
    """
    axes = list(grid.free_axes)
    information = np.diag(12.0 / np.maximum(grid.upper_m - grid.lower_m, 1e-9) ** 2)
    for part, term in zip(evidence, functional.pair_terms(position_m), strict=True):
        hill = np.maximum(-term.curvature, 0.0)
        weight = pair_weight(len(part.spec.microphones_m))
        curvature = weight * (term.gradient_s_m.T * hill) @ term.gradient_s_m
        information += _scale(part, term) * curvature
    covariance = np.zeros((3, 3))
    if axes:
        covariance[np.ix_(axes, axes)] = np.linalg.inv(information[np.ix_(axes, axes)])
    return covariance


def placement_covariance_m2(
    functional: SRPFunctional, position_m: FloatArray, placed_m: float, grid: Grid
) -> FloatArray:
    """Covariance (3, 3) due to errors of the microphones' positions: (sum 2/K grad tau grad tau^T / s^2 + prior)^-1.

    An error of `placed_m` in each coordinate of each microphone changes a pair's delay by s = sqrt(2) `placed_m` / c,
    however little noise there is. The prior is that of `laplace_covariance_m2`.
    """
    axes = list(grid.free_axes)
    information = np.diag(12.0 / np.maximum(grid.upper_m - grid.lower_m, 1e-9) ** 2)
    for term, weight in zip(functional.pair_terms(position_m), functional.pair_weights, strict=True):
        information += weight * (term.gradient_s_m.T @ term.gradient_s_m) * functional.c_m_s**2 / (2.0 * placed_m**2)
    covariance = np.zeros((3, 3))
    if axes:
        covariance[np.ix_(axes, axes)] = np.linalg.inv(information[np.ix_(axes, axes)])
    return covariance


def noise(evidence: Evidence, term: PairTerms, live: BoolArray) -> float:
    """Return the mean square of an array's GCCs away from the peak, over the pairs that are `live` (P,)."""
    lobe_s = 2.0 * np.pi / math.sqrt(mean_square_angular_frequency(evidence.spec.band_hz))
    return float(kernels.mean_square(evidence.gcc.values[live], evidence.gcc.lags_s, term.lags_s[live], lobe_s))


def _scale(evidence: Evidence, term: PairTerms) -> float:
    elsewhere = noise(evidence, term, np.ones(len(evidence.gcc.values), dtype=np.bool_))
    height = float(term.values.mean())
    return max(height, 0.0) / elsewhere if elsewhere > 0 else 0.0
