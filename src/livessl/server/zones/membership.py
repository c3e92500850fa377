"""Probability that a position lies in a zone, from its covariance. Pure numerics."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
import scipy

from livessl.core.types import FloatArray

HEIGHT_NODES: Final = 40
"""Nodes of the quadrature over the height."""

SLAB_NODES: Final = 12
"""Nodes of the quadrature across each slab between neighbouring corners of a polygon."""

LEAST_STD_M: Final = 1e-3
"""Least standard deviation in any direction, in metres: covariances are singular in a flat search volume, and published
ones are rounded, which can make them slightly indefinite."""

LEAST_INSIDE: Final = 1e-3
"""Least probability of the search volume; below it the position is outside, and in none of its parts."""

FAR: Final = 4.5
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
    zone = Prism(zone.corners_m, low, high)
    certain = _certain(position_m, covariance_m2, zone, volume_m)
    if certain is not None:
        return certain
    reach_m = FAR * np.sqrt(np.diag(covariance_m2))
    is_amid = ((position_m - volume_m[:, 0] > reach_m) & (volume_m[:, 1] - position_m > reach_m)).all()
    inside = 1.0 if is_amid else _in_prism(position_m, covariance_m2, box_prism(volume_m))
    if inside < LEAST_INSIDE:
        return 0.0
    part = zone._replace(corners_m=_clipped(zone.corners_m, volume_m))
    if len(part.corners_m) < 3:
        return 0.0
    return min(1.0, max(0.0, _in_prism(position_m, covariance_m2, part) / inside))


def _certain(position_m: FloatArray, covariance_m2: FloatArray, zone: Prism, volume_m: FloatArray) -> float | None:
    """Return 0 or 1 for a position whose zone has no boundary within `FAR` standard deviations, otherwise None.

    Walls of the search volume are no boundaries. A position beyond them is judged by its tail, which may be anywhere.
    """
    if ((position_m < volume_m[:, 0]) | (position_m > volume_m[:, 1])).any():
        return None
    begins = zone.corners_m - position_m[:2]
    along = np.roll(begins, -1, axis=0) - begins
    shares = np.clip(-(begins * along).sum(axis=1) / np.maximum((along * along).sum(axis=1), _EDGE), 0.0, 1.0)
    off_edges_m = float(np.hypot(*(begins + shares[:, None] * along).T).min())
    reach_m = FAR * float(np.sqrt(np.linalg.eigvalsh(covariance_m2[:2, :2])[1]))
    height_m = FAR * float(np.sqrt(covariance_m2[2, 2]))
    below_m = position_m[2] - zone.low_m if zone.low_m > volume_m[2, 0] else np.inf
    above_m = zone.high_m - position_m[2] if zone.high_m < volume_m[2, 1] else np.inf
    within_m = min(below_m, above_m)
    is_around = _winds_around(begins)
    if within_m < -height_m or (off_edges_m > reach_m and not is_around):
        return 0.0
    return 1.0 if off_edges_m > reach_m and within_m > height_m else None


def _winds_around(corners_m: FloatArray) -> bool:
    """Return whether a polygon holds the origin, by the edges that cross the axis to the right of it."""
    ends = np.roll(corners_m, -1, axis=0)
    crossing = (corners_m[:, 1] > 0.0) != (ends[:, 1] > 0.0)
    (x0, y0), (x1, y1) = corners_m[crossing].T, ends[crossing].T
    return bool((x0 - y0 * (x1 - x0) / (y1 - y0) > 0.0).sum() % 2)


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
        side = scipy.special.ndtr((y0 + (at[crosses] - x0) * ((y1 - y0) / (x1 - x0)) - means[crosses]) / factor[2, 2])
        section[crosses] += side if x1 < x0 else -side
    total = float(height_weights @ (weights * section).sum(axis=1))
    return abs(total)  # negative if the corners run clockwise


def _nodes(low: FloatArray, high: FloatArray, rule: tuple[FloatArray, FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Return nodes and weights of a standard normal variable between limits; those of all limits in one last axis."""
    nodes, weights = rule
    # of two tails alike, the left one has the better resolution
    mirrored = (low + high) > 0.0
    low, high = np.where(mirrored, -high, low), np.where(mirrored, -low, high)
    begin, width = scipy.special.ndtr(low)[..., None], (scipy.special.ndtr(high) - scipy.special.ndtr(low))[..., None]
    values = scipy.special.ndtri(np.clip(begin + nodes * width, _EDGE, 1.0 - _EDGE))
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
