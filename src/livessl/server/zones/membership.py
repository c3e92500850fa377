"""Probability that a position lies in a zone, from its covariance. Pure numerics."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from scipy.special import ndtr, ndtri

from livessl.core.types import FloatArray

HEIGHT_NODES: Final = 48
"""Nodes of the quadrature over the height."""

SLAB_NODES: Final = 16
"""Nodes of the quadrature across each slab between neighbouring corners of a polygon, from its least probable side."""

LEAST_STD_M: Final = 1e-3
"""Least standard deviation in any direction, in metres: covariances are singular in a flat search volume, and published
ones are rounded, which can make them slightly indefinite."""

LEAST_INSIDE: Final = 1e-3
"""Least probability of the search volume; below it the position is outside, and in none of its parts."""

FAR: Final = 6.0
"""Distance on an axis, in standard deviations, beyond which the probability of a zone counts as zero."""

_EDGE: Final = 1e-15
"""Distance of probabilities from 0 and 1, so that quantiles stay finite."""


class Prism(NamedTuple):
    """A part of space: a polygon on the floor plan, and a range of heights.

    Parameters
    ----------
    corners_m : (n, 2) float64
        Corners in order around the polygon, in metres.
    low_m, high_m : float
        Lowest and highest z in metres; infinite for all heights.
    """

    corners_m: FloatArray
    low_m: float
    high_m: float


def box_prism(box_m: FloatArray) -> Prism:
    """Return the prism of a box, (3, 2): its lowest and highest coordinate on each axis, in metres."""
    (x0, x1), (y0, y1), (low, high) = box_m
    return Prism(np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]]), float(low), float(high))


def probability_in(position_m: FloatArray, covariance_m2: FloatArray, zone: Prism, volume_m: FloatArray) -> float:
    """Return the probability that the source is in a zone, given that it is in the search volume.

    The condition matters at walls: half of the ellipsoid of a source at the wall lies behind it, where no source is.

    Parameters
    ----------
    position_m : (3,) float64
        Mean of the normal distribution of the position, in metres.
    covariance_m2 : (3, 3) float64
        Its covariance, in square metres.
    zone : Prism
    volume_m : (3, 2) float64
        Lowest and highest coordinate of the search volume on each axis, in metres.
    """
    flat = volume_m[:, 1] - volume_m[:, 0] < LEAST_STD_M  # an axis that is not searched, along which nothing varies
    low, high = max(zone.low_m, volume_m[2, 0]), min(zone.high_m, volume_m[2, 1])
    if low > high or (low == high and not flat[2]):
        return 0.0
    if flat.any():
        anywhere = position_m[:, None] + np.array([-1.0, 1.0])
        volume_m = np.where(flat[:, None], anywhere, volume_m)
    if flat[2]:
        low, high = volume_m[2]
    covariance_m2 = _positive_definite(covariance_m2)
    if _is_far(position_m, covariance_m2, zone, volume_m):
        return 0.0
    whole = box_prism(volume_m)
    inside = _in_prism(position_m, covariance_m2, whole)
    if inside < LEAST_INSIDE:
        return 0.0
    part = Prism(_clipped(zone.corners_m, volume_m), low, high)
    if len(part.corners_m) < 3:
        return 0.0
    return min(1.0, max(0.0, _in_prism(position_m, covariance_m2, part) / inside))


def _is_far(position_m: FloatArray, covariance_m2: FloatArray, zone: Prism, volume_m: FloatArray) -> bool:
    """Return whether both zone and position are such that nearly nothing of the distribution is in the zone.

    A position beyond the search volume is judged by its tail, which may be anywhere.
    """
    if ((position_m < volume_m[:, 0]) | (position_m > volume_m[:, 1])).any():
        return False
    low = np.array([*zone.corners_m.min(axis=0), zone.low_m])
    high = np.array([*zone.corners_m.max(axis=0), zone.high_m])
    away = np.maximum(np.maximum(low - position_m, position_m - high), 0.0)
    return bool((away > FAR * np.sqrt(np.diag(covariance_m2))).any())


def _in_prism(mean_m: FloatArray, covariance_m2: FloatArray, prism: Prism) -> float:
    """Return the probability of a prism under a normal distribution.

    The height comes first; its limits depend on nothing else. Given the height, the polygon is cut into slabs at its
    corners, across the direction in which the distribution is narrow; in each slab the section is bounded by the same
    edges, which makes the integrand smooth. Along the other direction the integral is exact: each edge adds its
    normal probability, with a sign by the side of the polygon on which it lies.
    """
    _, axes = np.linalg.eigh(covariance_m2[:2, :2])  # narrow first
    turn = np.eye(3)
    turn[:2, :2] = axes
    turned = (turn.T @ covariance_m2 @ turn)[np.ix_((2, 0, 1), (2, 0, 1))]  # height, across, along
    factor = np.linalg.cholesky(turned)
    mean = np.array([mean_m[2], *(mean_m[:2] @ axes)])
    heights, height_weights = _nodes(
        np.array([(prism.low_m - mean[0]) / factor[0, 0]]),
        np.array([(prism.high_m - mean[0]) / factor[0, 0]]),
        _HEIGHTS,
    )
    corners = prism.corners_m @ axes - mean[1:]  # (m, 2)
    cuts = np.unique(corners[:, 0])
    shifts = factor[1, 0] * heights[:, None]  # (h, 1)
    edges = (cuts - shifts) / factor[1, 1]  # (h, cuts)
    across, weights = _nodes(edges[:, :-1], edges[:, 1:], _SLABS)  # (h, s * n)
    at = shifts + factor[1, 1] * across
    means = factor[2, 0] * heights[:, None] + factor[2, 1] * across
    section = np.zeros_like(at)
    for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if x0 == x1:
            continue
        crosses = (at > min(x0, x1)) & (at < max(x0, x1))
        side = ndtr((y0 + (at[crosses] - x0) * ((y1 - y0) / (x1 - x0)) - means[crosses]) / factor[2, 2])
        section[crosses] += side if x1 < x0 else -side
    total = float(height_weights @ (weights * section).sum(axis=1))
    return abs(total)  # negative if the corners run clockwise


def _nodes(low: FloatArray, high: FloatArray, rule: tuple[FloatArray, FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Return nodes and weights of a standard normal variable between limits; those of all limits in one last axis."""
    nodes, weights = rule
    # of two tails alike, the left one has the better resolution
    mirrored = (low + high) > 0.0
    low, high = np.where(mirrored, -high, low), np.where(mirrored, -low, high)
    begin, width = ndtr(low)[..., None], (ndtr(high) - ndtr(low))[..., None]
    values = ndtri(np.clip(begin + nodes * width, _EDGE, 1.0 - _EDGE))
    values = np.where(mirrored[..., None], -values, values)
    shape = (*low.shape[:-1], -1)
    return values.reshape(shape), (width * weights).reshape(shape)


def _clipped(corners_m: FloatArray, volume_m: FloatArray) -> FloatArray:
    """Return the part of a polygon inside the search volume's floor (Sutherland and Hodgman 1974).

    Of a polygon that is not convex, parts may stay joined by edges along the walls, which enclose nothing.
    """
    for axis in (0, 1):
        for limit, sign in ((volume_m[axis, 0], 1.0), (volume_m[axis, 1], -1.0)):
            if len(corners_m) == 0:
                return corners_m
            depths = sign * (corners_m[:, axis] - limit)
            kept: list[FloatArray] = []
            for k in range(len(corners_m)):
                i = k - 1
                if (depths[i] >= 0.0) != (depths[k] >= 0.0):
                    share = depths[i] / (depths[i] - depths[k])
                    kept.append(corners_m[i] + share * (corners_m[k] - corners_m[i]))
                if depths[k] >= 0.0:
                    kept.append(corners_m[k])
            corners_m = np.array(kept).reshape(-1, 2)
    return corners_m


def _positive_definite(covariance_m2: FloatArray) -> FloatArray:
    """Return the covariance with a standard deviation of at least `LEAST_STD_M` in every direction."""
    variances_m2, axes = np.linalg.eigh((covariance_m2 + covariance_m2.T) / 2.0)
    definite: FloatArray = (axes * np.maximum(variances_m2, LEAST_STD_M**2)) @ axes.T
    return definite


def _rule(count: int) -> tuple[FloatArray, FloatArray]:
    """Return nodes and weights of the Gauss-Legendre rule on [0, 1]."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return (nodes + 1.0) / 2.0, weights / 2.0


_HEIGHTS: Final = _rule(HEIGHT_NODES)
_SLABS: Final = _rule(SLAB_NODES)
