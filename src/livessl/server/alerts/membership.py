"""Probability that a position lies in a box, from its covariance. Pure numerics."""

from __future__ import annotations

from typing import Final

import numpy as np
from scipy.special import ndtr, ndtri

from livessl.core.types import FloatArray

NODES: Final = 48
"""Nodes of the quadrature on each of its two axes; for covariances of events it is right to within 0.002."""

LEAST_STD_M: Final = 1e-3
"""Least standard deviation in any direction, in metres: covariances are singular in a flat search volume, and published
ones are rounded, which can make them slightly indefinite."""

LEAST_INSIDE: Final = 1e-3
"""Least probability of the search volume; below it the position is outside, and in none of its parts."""

_EDGE: Final = 1e-15
"""Distance of probabilities from 0 and 1, so that quantiles stay finite."""


def probability_in(position_m: FloatArray, covariance_m2: FloatArray, box_m: FloatArray, volume_m: FloatArray) -> float:
    """Return the probability that the source is in a box, given that it is in the search volume.

    The condition matters at walls: half of the ellipsoid of a source at the wall lies behind it, where no source is.

    Parameters
    ----------
    position_m : (3,) float64
        Mean of the normal distribution of the position, in metres.
    covariance_m2 : (3, 3) float64
        Its covariance, in square metres.
    box_m, volume_m : (3, 2) float64
        Lowest and highest coordinate of the box and of the search volume on each axis, in metres.
    """
    flat = volume_m[:, 1] - volume_m[:, 0] < LEAST_STD_M  # an axis that is not searched, along which nothing varies
    covered = (box_m[:, 0] <= volume_m[:, 0]) & (volume_m[:, 1] <= box_m[:, 1])
    if (flat & ~covered).any():
        return 0.0
    anywhere = position_m[:, None] + np.array([-1.0, 1.0])
    volume_m, box_m = np.where(flat[:, None], anywhere, volume_m), np.where(flat[:, None], anywhere, box_m)
    covariance_m2 = _positive_definite(covariance_m2)
    inside = _in_box(position_m, covariance_m2, volume_m)
    if inside < LEAST_INSIDE:
        return 0.0
    low = np.maximum(box_m[:, 0], volume_m[:, 0])
    high = np.minimum(box_m[:, 1], volume_m[:, 1])
    if (low >= high).any():
        return 0.0
    return min(1.0, _in_box(position_m, covariance_m2, np.stack([low, high], axis=1)) / inside)


def _in_box(mean_m: FloatArray, covariance_m2: FloatArray, box_m: FloatArray) -> float:
    """Return the probability of a box under a normal distribution.

    Genz (1992), "Numerical computation of multivariate normal probabilities": the box is mapped to the unit cube by the
    Cholesky factor, which makes the integrand smooth; here with a Gauss-Legendre rule. The axis on which the box
    excludes most comes first.
    """
    edges = box_m - mean_m[:, None]
    widths = np.diff(ndtr(edges / np.sqrt(np.diag(covariance_m2))[:, None]), axis=1)[:, 0]
    order = np.argsort(widths)
    factor = np.linalg.cholesky(covariance_m2[np.ix_(order, order)])
    low, high = edges[order].T
    nodes, weights = _RULE
    d0, e0 = ndtr(low[0] / factor[0, 0]), ndtr(high[0] / factor[0, 0])
    y0 = _quantile(d0 + nodes * (e0 - d0))  # (n,)
    shift = factor[1, 0] * y0
    d1, e1 = ndtr((low[1] - shift) / factor[1, 1]), ndtr((high[1] - shift) / factor[1, 1])
    y1 = _quantile(d1[:, None] + nodes * (e1 - d1)[:, None])  # (n, n)
    shift = factor[2, 0] * y0[:, None] + factor[2, 1] * y1
    width = ndtr((high[2] - shift) / factor[2, 2]) - ndtr((low[2] - shift) / factor[2, 2])
    return float((e0 - d0) * (weights @ ((e1 - d1) * (width @ weights))))


def _positive_definite(covariance_m2: FloatArray) -> FloatArray:
    """Return the covariance with a standard deviation of at least `LEAST_STD_M` in every direction."""
    variances_m2, axes = np.linalg.eigh((covariance_m2 + covariance_m2.T) / 2.0)
    definite: FloatArray = (axes * np.maximum(variances_m2, LEAST_STD_M**2)) @ axes.T
    return definite


def _quantile(probability: FloatArray) -> FloatArray:
    quantiles: FloatArray = ndtri(np.clip(probability, _EDGE, 1.0 - _EDGE))
    return quantiles


def _rule() -> tuple[FloatArray, FloatArray]:
    """Return nodes and weights of the Gauss-Legendre rule on [0, 1]."""
    nodes, weights = np.polynomial.legendre.leggauss(NODES)
    return (nodes + 1.0) / 2.0, weights / 2.0


_RULE: Final = _rule()
