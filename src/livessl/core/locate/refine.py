"""Peaks of power maps: found in a whole map, refined below the grid, with a covariance and a margin."""

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
"""Grid points that are refined: of two tops between grid points, the one with the lower grid point may be higher."""

RIVAL_DISTANCE_M: Final = 1.0
"""Distance, in metres, beyond which a second peak is another place."""

_NEWTON_STEPS: Final = 30
"""Most Newton steps of one climb; a few suffice."""

_CONVERGED_M: Final = 1e-4
"""Shortest step, in metres: a tenth of a millimetre cannot be measured."""

_SUBDIVISIONS: Final = 4
"""Parts into which a cell's edge is divided to find the start of a climb."""


@dataclass(frozen=True, slots=True)
class Peak:
    """A grid point, the fused power there, and the distance to the next points that were examined, in grid points."""

    point: int
    power: float
    stride: int = 1


class FindPeaks(Protocol):
    """Finds the highest grid points, best first: each is the highest of those far enough from the ones before it."""

    def __call__(self, count: int, apart_points: int = 1, without: Sequence[IntArray] = ()) -> list[Peak]:
        """Find up to `count` peaks that differ by more than `apart_points` along some axis, none of them in a box.

        A box (3, 2) is the first and last point along each axis. The first of equal points in the grid's order wins.
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
    """Return the box (3, 2) of points at most `apart_points` from one along each axis: the first and last of each."""
    at = np.array(np.unravel_index(point, grid.shape))
    return np.stack([at - apart_points, at + apart_points], axis=1)


def neighbourhood(position_m: FloatArray, grid: Grid) -> IntArray:
    """Return the box (3, 2) of points that are the same place as a position: the first and last along each axis.

    It reaches `RIVAL_DISTANCE_M` along every axis, or a quarter of the volume's longest edge if that is less. Along an
    axis without such points it is (1, 0).
    """
    reach_m = min(RIVAL_DISTANCE_M, 0.25 * float((grid.upper_m - grid.lower_m).max()))
    box = np.empty((3, 2), dtype=np.int64)
    for axis in range(3):
        near = np.flatnonzero(np.abs(grid.axis_m(axis) - position_m[axis]) <= reach_m)
        box[axis] = (near[0], near[-1]) if len(near) else (1, 0)
    return box


def refine_peaks(functional: SRPFunctional, peaks: Sequence[Peak], grid: Grid) -> tuple[FloatArray, float]:
    """Find the highest top near any of some peaks of a search: see `refine`."""
    starts_m = np.stack([grid.point_m(peak.point) for peak in peaks])
    return refine(functional, starts_m, grid, max(peak.stride for peak in peaks))


def refine(functional: SRPFunctional, starts_m: FloatArray, grid: Grid, stride: int = 1) -> tuple[FloatArray, float]:
    """Find the highest top near any of some grid points.

    Around every start a finer local grid is examined; from its best point Newton steps climb, and only upwards.

    Parameters
    ----------
    functional : SRPFunctional
    starts_m : (N, 3) or (3,) float64
        Metres.
    grid : Grid
    stride : int
        Distance between points that were examined, in grid points.

    Returns
    -------
    position_m : (3,) float64
        Inside the grid's bounds.
    value : float
        The functional there.
    """
    near = np.clip(np.atleast_2d(starts_m)[:, None] + stride * _offsets_m(grid), grid.lower_m, grid.upper_m)
    values = functional.value(near.reshape(-1, 3)).reshape(near.shape[:2])
    best = values.argmax(axis=1)
    tops = [_climb(functional, near[n, k], float(values[n, k]), grid, stride) for n, k in enumerate(best)]
    return max(tops, key=lambda top: top[1])


def _offsets_m(grid: Grid) -> FloatArray:
    """Finer local grid of a cell, relative to its centre: (n, 3), metres."""
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
    """Newton step with every curvature taken as negative, so that it leads up from a saddle as well."""
    eigenvalues, eigenvectors = np.linalg.eigh(hessian)
    strength = np.maximum(np.abs(eigenvalues), 1e-3 * np.abs(eigenvalues).max(initial=0.0) + 1e-12)
    return np.asarray(eigenvectors @ ((eigenvectors.T @ gradient) / strength))


def rival_power(find: FindPeaks, grid: Grid, position_m: FloatArray) -> float:
    """Highest power outside a position's `neighbourhood`; 0 where there is no outside."""
    rivals = find(1, without=[neighbourhood(position_m, grid)])
    return rivals[0].power if rivals else 0.0


def margin(power: float, rival_power: float) -> float:
    """Margin of a place over the best other one: 1 - (power there) / (power here), 0 to 1."""
    return float(np.clip(1.0 - max(rival_power, 0.0) / power, 0.0, 1.0)) if power > 0.0 else 0.0


def confidence(find: FindPeaks, first: Peak, grid: Grid, position_m: FloatArray) -> float:
    """Confidence that is no probability: the peak's `margin` over the highest power outside its `neighbourhood`."""
    return margin(first.power, rival_power(find, grid, position_m))


def laplace_covariance_m2(
    functional: SRPFunctional, evidence: Sequence[Evidence], position_m: FloatArray, grid: Grid
) -> FloatArray:
    """Covariance (3, 3) from the map's curvature at the peak: C = (sum lambda (-Hess SRP) + prior)^-1.

    The scale lambda = g / s^2 of each array makes the map a log-likelihood: g is the mean height of its GCCs at the
    peak, s^2 their mean square over the other lags, which holds noise and reflections alike. It follows from
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
    """Mean square of an array's GCCs away from the peak, of the pairs that are `live` (P,)."""
    lobe_s = 2.0 * np.pi / math.sqrt(mean_square_angular_frequency(evidence.spec.band_hz))
    return float(kernels.mean_square(evidence.gcc.values[live], evidence.gcc.lags_s, term.lags_s[live], lobe_s))


def _scale(evidence: Evidence, term: PairTerms) -> float:
    elsewhere = noise(evidence, term, np.ones(len(evidence.gcc.values), dtype=np.bool_))
    height = float(term.values.mean())
    return max(height, 0.0) / elsewhere if elsewhere > 0 else 0.0
