"""The peak of a power map: found on the grid, refined below it, with a covariance and a confidence."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from livessl.core.gcc import mean_square_angular_frequency
from livessl.core.geometry import Grid
from livessl.core.srp import PairTerms, SRPFunctional
from livessl.core.types import Float32Array, FloatArray, HeardBy

CANDIDATES: Final = 8
"""Nodes looked at more closely: between two nodes a lower one on the grid may be the higher one in truth."""

CLIMBED: Final = 2
"""Of them, how many are followed to the top."""

RIVAL_DISTANCE_M: Final = 1.0
"""A second peak is another place if it is further away than this."""

_NEWTON_STEPS: Final = 30
_CONVERGED_M: Final = 1e-5
"""Steps below a hundredth of a millimetre change nothing that anyone could measure."""

_SUBDIVISIONS: Final = 4


def highest_nodes(power: Float32Array, grid: Grid, count: int = CANDIDATES) -> list[int]:
    """Indices of the highest nodes, best first, no two of them neighbours (not even at a corner)."""
    pool = min(len(power), 64 * count)
    best = np.argpartition(power, len(power) - pool)[-pool:]
    best = best[np.lexsort((best, -power[best]))]  # by power, ties by index: the same on every machine
    cells = np.stack(np.unravel_index(best, grid.shape), axis=1)
    chosen: list[int] = []
    for candidate in range(len(best)):
        if all(np.abs(cells[candidate] - cells[other]).max() > 1 for other in chosen):
            chosen.append(candidate)
        if len(chosen) == count:
            break
    return [int(best[candidate]) for candidate in chosen]


def refine(functional: SRPFunctional, starts_m: FloatArray, grid: Grid) -> tuple[FloatArray, float]:
    """From nodes to the highest top near any of them.

    A finer local grid around every start, all looked at in one go; from the best of them Newton steps that only ever
    go up.

    Parameters
    ----------
    functional : SRPFunctional
    starts_m : (N, 3) or (3,) float64
    grid : Grid

    Returns
    -------
    position_m : (3,) float64
        Inside the grid's bounds.
    value : float
        The functional there.
    """
    near = np.atleast_2d(starts_m)[:, None] + _offsets_m(grid)
    values = functional.value(near.reshape(-1, 3)).reshape(near.shape[:2])
    highest = values.argmax(axis=1)
    order = np.argsort(-values.max(axis=1), kind="stable")[:CLIMBED]
    tops = [_climb(functional, near[k, highest[k]], float(values[k, highest[k]]), grid) for k in order]
    return max(tops, key=lambda top: top[1])


def _offsets_m(grid: Grid) -> FloatArray:
    """A cell's finer local grid, relative to its node: (n, 3)."""
    fraction = np.linspace(-0.5, 0.5, _SUBDIVISIONS + 1)
    offsets = [fraction * edge if edge > 0 else np.zeros(1) for edge in grid.cell_m]
    return np.stack([o.ravel() for o in np.meshgrid(*offsets, indexing="ij")], axis=1)


def _climb(functional: SRPFunctional, position_m: FloatArray, value: float, grid: Grid) -> tuple[FloatArray, float]:
    axes = list(grid.free_axes)
    reach = float(grid.cell_m.max()) / _SUBDIVISIONS
    for _ in range(_NEWTON_STEPS):
        gradient, hessian = functional.derivatives(position_m)
        step = np.zeros(3)
        step[axes] = _ascent(gradient[axes], hessian[np.ix_(axes, axes)])
        step *= min(1.0, reach / max(float(np.linalg.norm(step)), 1e-12))
        climbed = False
        while np.linalg.norm(step) > _CONVERGED_M:
            trial = np.clip(position_m + step, grid.lower_m, grid.upper_m)
            trial_value = float(functional.value(trial[None])[0])
            if trial_value > value:
                position_m, value, climbed = trial, trial_value, True
                break
            step /= 2.0
        if not climbed:
            break
    return position_m, value


def _ascent(gradient: FloatArray, hessian: FloatArray) -> FloatArray:
    """Newton step with every curvature taken as a hill's, so that it leads up from a saddle, too."""
    eigenvalues, eigenvectors = np.linalg.eigh(hessian)
    strength = np.maximum(np.abs(eigenvalues), 1e-3 * np.abs(eigenvalues).max(initial=0.0) + 1e-12)
    return np.asarray(eigenvectors @ ((eigenvectors.T @ gradient) / strength))


def confidence(power: Float32Array, grid: Grid, position_m: FloatArray) -> float:
    """How far the peak stands out: 1 - (highest power elsewhere) / (highest power), 0 to 1.

    Elsewhere is more than `RIVAL_DISTANCE_M` away along some axis (a quarter of the volume's size where that is less).
    """
    reach = min(RIVAL_DISTANCE_M, 0.25 * float((grid.upper_m - grid.lower_m).max()))
    box = []
    for axis in range(3):
        near = np.flatnonzero(np.abs(grid.axis_m(axis) - position_m[axis]) <= reach)
        box.append(slice(int(near[0]), int(near[-1]) + 1) if len(near) else slice(0, 0))
    elsewhere = power.reshape(grid.shape).copy()
    elsewhere[tuple(box)] = -np.inf
    first, second = float(power.max()), float(elsewhere.max())
    return 0.0 if first <= 0 else float(np.clip(1.0 - max(second, 0.0) / first, 0.0, 1.0))


def laplace_covariance_m2(
    functional: SRPFunctional, evidence: Sequence[HeardBy], position_m: FloatArray, grid: Grid
) -> FloatArray:
    """Covariance (3, 3) from the map's curvature at the peak: C = (sum lambda (-Hess SRP) + prior)^-1.

    The scale lambda = g / s^2 of each array makes the map a log-likelihood: g is the mean height of its GCCs at the
    peak, s^2 their mean square over the other lags, which holds noise and reflections alike. It follows from
    var(tau) = s^2 kappa / (g kappa)^2, kappa the mean square angular frequency: noise of power s^2 and slope variance
    s^2 kappa moves a peak of curvature g kappa. The prior is the search volume's own variance, L^2/12 along each axis,
    so that what the arrays cannot tell stays as wide as the volume and no wider.
    """
    axes = list(grid.free_axes)
    information = np.diag(12.0 / np.maximum(grid.upper_m - grid.lower_m, 1e-9) ** 2)
    for heard, term in zip(evidence, functional.pair_terms(position_m), strict=True):
        hill = np.maximum(-term.curvature, 0.0)
        curvature = term.weight * (term.gradient_s_m.T * hill) @ term.gradient_s_m
        information += _scale(heard, term) * curvature
    covariance = np.zeros((3, 3))
    if axes:
        covariance[np.ix_(axes, axes)] = np.linalg.inv(information[np.ix_(axes, axes)])
    return covariance


def _scale(heard: HeardBy, term: PairTerms) -> float:
    lags, values = heard.gcc.lags_s, heard.gcc.values
    lobe_s = 2.0 * np.pi / np.sqrt(mean_square_angular_frequency(heard.spec.band_hz))
    elsewhere = np.abs(lags[None] - term.lags_s[:, None]) > lobe_s
    noise = float((values**2)[elsewhere].mean()) if elsewhere.any() else 0.0
    height = float(term.values.mean())
    return max(height, 0.0) / noise if noise > 0 else 0.0
