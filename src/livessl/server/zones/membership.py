"""Computes the probability that an uncertain position lies in a zone, from its covariance. Pure numerics."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from livessl.core.types import BoolArray, FloatArray

LEAST_STD_M: Final = 1e-3
"""Least standard deviation in any direction, in metres: covariances are singular in a flat search volume, and published
ones are rounded, which can make them slightly indefinite."""

LEAST_INSIDE: Final = 1e-3
"""Least probability of the search volume; below it the position is outside, and in none of its parts."""

FAR: Final = 4.5
"""Distance on an axis, in standard deviations, beyond which nothing is integrated: it holds 7e-6."""

NODES_PER_STD: Final = 1.25
"""Nodes of the quadrature over the height, for each standard deviation on which the integrand changes."""

NODE_COUNTS: Final = (*range(6, 25, 2), 32, 48, 64, 96, 128, 192)
"""Numbers of nodes from which the quadrature takes the next larger one; the last one is the most."""

_EDGE_M: Final = 1e-12
"""Length of an edge, in metres, below which it is a point; and least distance from an edge, in standard deviations."""


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


class _Edges(NamedTuple):
    """The edges of polygons, one polygon after the other.

    Parameters
    ----------
    begins_m, ends_m : (e, 2) float64
        In metres.
    owner : (e,) int
        Number of the polygon of each edge.
    """

    begins_m: FloatArray
    ends_m: FloatArray
    owner: NDArray[np.intp]


def box_prism(box_m: FloatArray) -> Prism:
    """Return the prism of a box, (3, 2): its lowest and highest coordinate on each axis, in metres."""
    (x0, x1), (y0, y1), (low, high) = box_m
    return Prism(np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]]), float(low), float(high))


class PreparedZones:
    """Zones in a search volume, with all that does not depend on a position computed once. It never changes.

    Parameters
    ----------
    zones : sequence of Prism
    volume_m : (3, 2) float64
        Lowest and highest coordinate of the search volume on each axis, in metres. An axis on which both are equal is
        not searched, and does not count.
    """

    def __init__(self, zones: Sequence[Prism], volume_m: FloatArray) -> None:
        flat = volume_m[:, 1] - volume_m[:, 0] < LEAST_STD_M  # nothing varies along such an axis
        self._volume_m = np.where(flat[:, None], volume_m + np.array([-1.0, 1.0]), volume_m)
        self._count = len(zones)
        self._kept: list[int] = []  # of the zones, those that have a part in the search volume
        whole, parts, heights_m = [], [], []
        for number, zone in enumerate(zones):
            low, high = max(zone.low_m, volume_m[2, 0]), min(zone.high_m, volume_m[2, 1])
            part = _clipped(zone.corners_m, self._volume_m)
            if low > high or (low == high and not flat[2]) or len(_edges([part]).owner) < 3:
                continue
            self._kept.append(number)
            whole.append(zone.corners_m)
            parts.append(part)
            heights_m.append(self._volume_m[2] if flat[2] else (low, high))
        volume = box_prism(self._volume_m)
        self._whole = _edges(whole)
        self._parts = _edges([*parts, volume.corners_m])
        self._heights_m = np.array([*heights_m, self._volume_m[2]], dtype=np.float64)  # (zones + 1, 2), volume last

    def probabilities(self, position_m: FloatArray, covariance_m2: FloatArray) -> FloatArray:
        """Return the probability of each zone that the source is there, given that it is in the search volume.

        The condition matters at walls: half of the ellipsoid of a source at the wall lies behind it, where no source
        is.

        Parameters
        ----------
        position_m : (3,) float64
            Mean of the normal distribution of the position, in metres.
        covariance_m2 : (3, 3) float64
            Its covariance, in square metres.

        Returns
        -------
        (n,) float64
        """
        found = np.zeros(self._count)
        if not self._kept:
            return found
        covariance_m2 = _positive_definite(covariance_m2)
        shares = self._certain(position_m, covariance_m2)
        unsure = np.isnan(shares)
        if unsure.any():
            reach_m = FAR * np.sqrt(np.diag(covariance_m2))
            low_m, high_m = self._volume_m.T
            is_amid = bool(((position_m - low_m > reach_m) & (high_m - position_m > reach_m)).all())
            masses = self._masses(position_m, covariance_m2, np.append(unsure, not is_amid))
            inside = 1.0 if is_amid else masses[-1]
            shares[unsure] = 0.0
            if inside >= LEAST_INSIDE:
                shares[unsure] = np.clip(masses[:-1][unsure] / inside, 0.0, 1.0)
        found[self._kept] = shares
        return found

    def _certain(self, position_m: FloatArray, covariance_m2: FloatArray) -> FloatArray:
        """Return 0 or 1 for each zone that has no boundary within `FAR` standard deviations, NaN for the others.

        Walls of the search volume are no boundaries. A position beyond them is judged by its tail, which may be
        anywhere.
        """
        found = np.full(len(self._kept), np.nan)
        low_m, high_m = self._volume_m.T
        if ((position_m < low_m) | (position_m > high_m)).any():
            return found
        begins_m, ends_m = self._whole.begins_m - position_m[:2], self._whole.ends_m - position_m[:2]
        along_m = ends_m - begins_m
        shares = np.clip(-_dot(begins_m, along_m) / _dot(along_m, along_m), 0.0, 1.0)
        firsts = _firsts(self._whole.owner)
        off_m2 = np.minimum.reduceat(((begins_m + shares[:, None] * along_m) ** 2).sum(axis=1), firsts)
        is_off = off_m2 > FAR**2 * np.linalg.eigvalsh(covariance_m2[:2, :2])[1]
        # a polygon holds the position if an odd number of its edges cross the axis to the right of it
        crosses = (begins_m[:, 1] > 0.0) != (ends_m[:, 1] > 0.0)
        rise_m = np.where(crosses, along_m[:, 1], 1.0)
        crosses &= begins_m[:, 0] - begins_m[:, 1] * along_m[:, 0] / rise_m > 0.0
        is_around = np.add.reduceat(crosses.astype(np.int64), firsts) % 2 == 1
        below_m, above_m = position_m[2] - self._heights_m[:-1, 0], self._heights_m[:-1, 1] - position_m[2]
        below_m[self._heights_m[:-1, 0] <= low_m[2]] = np.inf
        above_m[self._heights_m[:-1, 1] >= high_m[2]] = np.inf
        within_m, height_m = np.minimum(below_m, above_m), FAR * np.sqrt(covariance_m2[2, 2])
        found[is_off & (within_m > height_m)] = 1.0
        found[(within_m < -height_m) | (is_off & ~is_around)] = 0.0
        return found

    def _masses(self, position_m: FloatArray, covariance_m2: FloatArray, wanted: BoolArray) -> FloatArray:
        """Return the probability of each part under a normal distribution, NaN for those that are not wanted.

        Parameters
        ----------
        position_m : (3,) float64
        covariance_m2 : (3, 3) float64
        wanted : (zones + 1,) bool
            The last part is the search volume.
        """
        std_m = float(np.sqrt(covariance_m2[2, 2]))
        limits = np.clip((self._heights_m - position_m[2]) / std_m, -FAR, FAR)
        is_open = (limits[:, 1] - limits[:, 0]) >= 2.0 * FAR  # the height does not matter there
        masses = np.full(len(wanted), np.nan)
        horizontal_m2, slope_m = covariance_m2[:2, :2], covariance_m2[:2, 2] / std_m
        chosen = wanted & is_open
        if chosen.any():
            turn = np.linalg.inv(np.linalg.cholesky(horizontal_m2))
            one = np.ones((int(chosen.sum()), 1))
            masses[chosen] = self._integrated(position_m[:2], chosen, turn, np.zeros(2), 0.0 * one, one)
        chosen = wanted & ~is_open
        if chosen.any():
            turn = np.linalg.inv(np.linalg.cholesky(horizontal_m2 - np.outer(slope_m, slope_m)))
            drift = turn @ slope_m
            nodes = _nodes(limits[chosen], float(np.hypot(*drift)))
            masses[chosen] = self._integrated(position_m[:2], chosen, turn, drift, *nodes)
        return masses

    def _integrated(
        self,
        mean_m: FloatArray,
        chosen: BoolArray,
        turn: FloatArray,
        drift: FloatArray,
        heights: FloatArray,
        weights: FloatArray,
    ) -> FloatArray:
        """Return the probabilities of the chosen parts.

        At each height the horizontal distribution is turned and stretched into the standard normal one. There the
        probability of the triangle between the mean and an edge follows from its angle and Owen's function (Owen 1956,
        "Tables for computing bivariate normal probabilities"), and the signed triangles of a polygon's edges add up to
        the polygon, convex or not.

        Parameters
        ----------
        mean_m : (2,) float64
        chosen : (parts,) bool
        turn : (2, 2) float64
            Makes the horizontal distribution at a given height a standard normal one.
        drift : (2,) float64
            Shift of its mean for each standard deviation of the height, after that.
        heights, weights : (chosen, n) float64
            Nodes in standard deviations, and their weights.
        """
        here = chosen[self._parts.owner]
        begins = (self._parts.begins_m[here] - mean_m) @ turn.T
        along = (self._parts.ends_m[here] - self._parts.begins_m[here]) @ turn.T
        lengths = np.sqrt(_dot(along, along))
        along /= lengths[:, None]
        owner = (np.cumsum(chosen) - 1)[self._parts.owner[here]]
        at = heights[owner]  # (e, n)
        # signed distance of the line of each edge from the mean, and places of both ends along it
        off = (begins[:, 0] * along[:, 1] - begins[:, 1] * along[:, 0])[:, None]
        off = off - at * (drift[0] * along[:, 1] - drift[1] * along[:, 0])[:, None]
        off[np.abs(off) < _EDGE_M] = _EDGE_M
        first = _dot(begins, along)[:, None] - at * (along @ drift)[:, None]
        first, last = first / off, (first + lengths[:, None]) / off
        triangles = (np.arctan(last) - np.arctan(first)) / (2.0 * np.pi)
        near = np.abs(off) < FAR
        owen = scipy.special.owens_t
        triangles[near] += owen(off[near], first[near]) - owen(off[near], last[near])
        masses: FloatArray = np.abs(np.add.reduceat((weights[owner] * triangles).sum(axis=1), _firsts(owner)))
        return masses  # the sums are negative where the corners run clockwise


def _nodes(limits: FloatArray, drift: float) -> tuple[FloatArray, FloatArray]:
    """Return nodes and weights of a standard normal variable between limits, (k, 2), each (k, n).

    The polygons move by `drift` standard deviations for each one of the variable, so the integrand changes faster.
    """
    widest = float((limits[:, 1] - limits[:, 0]).max())
    needed = NODES_PER_STD * widest * np.hypot(1.0, drift)
    count = next((count for count in NODE_COUNTS if count >= needed), NODE_COUNTS[-1])
    nodes, weights = _RULES[count]
    half = (limits[:, 1:] - limits[:, :1]) / 2.0
    values = limits[:, :1] + half * (nodes + 1.0)
    return values, half * weights * np.exp(-(values**2) / 2.0) / np.sqrt(2.0 * np.pi)


def _edges(polygons: Sequence[FloatArray]) -> _Edges:
    """Return the edges of polygons without those that are points."""
    begins_m = np.concatenate([np.asarray(corners_m, dtype=np.float64) for corners_m in polygons] or [np.empty((0, 2))])
    ends_m = np.concatenate([np.roll(corners_m, -1, axis=0) for corners_m in polygons] or [np.empty((0, 2))])
    owner = np.repeat(np.arange(len(polygons)), [len(corners_m) for corners_m in polygons])
    is_edge = np.abs(ends_m - begins_m).max(axis=1, initial=0.0) > _EDGE_M
    return _Edges(begins_m[is_edge], ends_m[is_edge], owner[is_edge])


def _firsts(owner: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return where the edges of each polygon begin."""
    return np.flatnonzero(np.diff(owner, prepend=-1))


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the scalar products of the rows of two arrays, (n, 2) each."""
    return np.asarray(a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1])


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


_RULES: Final = {count: np.polynomial.legendre.leggauss(count) for count in NODE_COUNTS}
"""Nodes and weights of the Gauss-Legendre rules on [-1, 1]."""
