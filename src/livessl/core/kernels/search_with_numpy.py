"""Kernels of the peak search on NumPy alone: lags of cells, upper bounds, and branch and bound.

All sums run in the same order: over the pairs of an array, then over the arrays. Rounding to float32 keeps the order of
numbers. A sum of maxima is therefore, rounding included, never below the sum of any values under these maxima, and the
bounds are exact. The names of dimensions are explained in `arguments`.

A lag's place on the fine axis is `int((|r - r_k| - |r - r_i|) * scale + offset)` in float32.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from livessl.core.kernels.arguments import BLOCKS, NO_LAG, RUNS, Axes, SearchBounds, SearchCells, SearchRows
from livessl.core.types import BoolArray, Float32Array, IntArray, UInt16Array

_SLAB_POINTS: Final = 1 << 15
"""Number of grid points whose distances are computed at one time: as many as fit into the second-level cache."""

_CELLS_AT_ONCE: Final = 64
"""Largest number of cells whose points are examined at one time. The search begins with one cell, because few are
usually needed."""


def lag_places(
    points_m: Float32Array, microphones_m: Float32Array, pairs: IntArray, scale: np.float32, offset: np.float32
) -> IntArray:
    """Place of each pair's delay on the fine lag axis, for points (N, 3): (P, N) int32."""
    x, y, z = (points_m[:, axis] - microphones_m[:, axis, None] for axis in range(3))
    distance = np.sqrt((x * x + y * y) + z * z)
    return np.asarray(((distance[pairs[:, 1]] - distance[pairs[:, 0]]) * scale + offset).astype(np.int32))


def cell_intervals(
    axes: Axes,
    corners: IntArray,
    strides: IntArray,
    edge: int,
    along: int,
    microphones_m: Float32Array,
    pairs: IntArray,
    scale: np.float32,
    offset: np.float32,
    low: UInt16Array,
    high: UInt16Array,
) -> None:
    """Find the lowest and highest lag of every pair of one array over the points of every cell of some cubes.

    Parameters
    ----------
    axes : three of (n,) float32
        The grid's axes.
    corners, strides : (T, 3) int64, (T,) int64
        The cubes, as in `SearchCells`.
    edge : int
        Points along the edge of a cell.
    along : int
        Cells along the edge of a cube.
    microphones_m : (K, 3) float32
    pairs : (P, 2) int32
    scale, offset : float32
        From a difference of distances, in metres, to a place on the lag axis.
    low, high : (P, T, along^3) uint16
        Output: `NO_LAG` and 0 for cells without points.
    """
    inner = _corners(along * edge)
    step = max(1, _SLAB_POINTS // len(inner))
    for first in range(0, len(corners), step):
        some = slice(first, first + step)
        at, inside = _points_of(corners[some, None], strides[some, None], inner, tuple(map(len, axes)))
        points_m = np.stack([axis_m[at[..., axis].ravel()] for axis, axis_m in enumerate(axes)], axis=1)
        place = lag_places(points_m, microphones_m, pairs, scale, offset)
        place = place.reshape(len(pairs), *inside.shape)
        for extreme, out, without in ((np.min, low, NO_LAG), (np.max, high, 0)):
            split = np.where(inside, place, without).reshape(
                *place.shape[:2], *(n for _ in range(3) for n in (along, edge))
            )
            out[:, some] = extreme(split, axis=(3, 5, 7)).reshape(*place.shape[:2], -1)


def reaches_of_parts(
    axes: Axes,
    corners: IntArray,
    strides: IntArray,
    edge: int,
    part: int,
    along: int,
    microphones_m: Float32Array,
    pairs: IntArray,
    scale: np.float32,
    offset: np.float32,
    reach: UInt16Array,
) -> None:
    """Find the most lags between the middle of any part of a cell, `part` points long, and a point in that part.

    The other arguments are those of `cell_intervals`, and `reach` (P, T, along^3) uint16 is the output. On NumPy it is
    0: there the search examines all points of a cell at once.
    """
    del axes, corners, strides, edge, part, along, microphones_m, pairs, scale, offset
    reach[:] = 0


def running_maxima(values: Float32Array, block: IntArray, maxima: Float32Array) -> None:
    """Find the maxima of each row over runs of blocks of lags.

    Parameters
    ----------
    values : (R, L) float32
    block : (R,) int64
        Lags in a block.
    maxima : (R, levels * `BLOCKS`) float32
        Output: at `level * BLOCKS + b` of each row, the greatest value in the `RUNS[level]` blocks from b on.
    """
    padded = np.full((len(values), int(block.max()) * BLOCKS), -np.inf, dtype=np.float32)
    for size in np.unique(block):
        which, width = block == size, min(values.shape[1], size * BLOCKS)
        padded[which, :width] = values[which, :width]
        maxima[which, :BLOCKS] = padded[which, : size * BLOCKS].reshape(-1, BLOCKS, size).max(axis=2)
    levels = maxima.reshape(len(maxima), -1, BLOCKS)
    for level in range(1, levels.shape[1]):
        further = RUNS[level] - RUNS[level - 1]
        levels[:, level] = levels[:, level - 1]
        np.maximum(levels[:, level - 1, :-further], levels[:, level - 1, further:], out=levels[:, level, :-further])


def upper_bounds(maxima: Float32Array, places: UInt16Array, rows: SearchRows, bound: Float32Array) -> None:
    """Bound the power of the points of each of some cells by the sum of the pairs' maxima over the cell's lags.

    Parameters
    ----------
    maxima : (R, levels * `BLOCKS`) float32
        `running_maxima` of the rows.
    places : (site's pairs, C) uint16
        Place among a row's maxima of the run of lags that holds all of the cell's.
    rows : SearchRows
    bound : (C,) float32
        Output.
    """
    bound[:] = 0.0
    for a, weight in enumerate(rows.weight):
        total = np.zeros(len(bound), dtype=np.float32)
        for r in range(rows.first_row[a], rows.first_row[a + 1]):
            total += maxima[r, places[rows.site_pair[r]]]
        bound += weight * total


def bounds_of_rest(
    maxima: Float32Array,
    places: UInt16Array,
    rows: SearchRows,
    rounding: np.float32,
    cubes: IntArray,
    bound: Float32Array,
) -> None:
    """Bound what the arrays from each on add to the power of the points of the cells of some cubes.

    Parameters
    ----------
    maxima : (R, levels * `BLOCKS`) float32
        `running_maxima` of the rows.
    places : (T, site's pairs, C) uint16
        As `SearchCells.cell_places`.
    rows : SearchRows
    rounding : float32
        Largest difference between sums of the same powers of arrays in different orders; every bound includes it.
    cubes : (N,) int64
        Which of the T cubes.
    bound : (T, C, A + 1) float32
        Output for these cubes: bounds of the arrays from the first on, from the second on, …, and of none.
    """
    bound[cubes, :, -1] = rounding
    for a in range(len(rows.weight) - 1, -1, -1):
        total = np.zeros((len(cubes), places.shape[2]), dtype=np.float32)
        for r in range(rows.first_row[a], rows.first_row[a + 1]):
            total += maxima[r, places[cubes, rows.site_pair[r]]]
        bound[cubes, :, a] = bound[cubes, :, a + 1] + rows.weight[a] * total


def highest(
    values: Float32Array,
    maxima: Float32Array,
    rows: SearchRows,
    cells: SearchCells,
    bounds: SearchBounds,
    boxes: IntArray,
    rounding: np.float32,
) -> tuple[int, float]:
    """Find the highest grid point outside some boxes, exactly as in the whole map, by branch and bound.

    Cubes of cells are examined in the order of their bounds, and of their cells those whose bound reaches the best
    power known. Of equal points the first in the grid's order is returned.

    Parameters
    ----------
    values : (R, L) float32
        GCCs.
    maxima : (R, levels * `BLOCKS`) float32
        `running_maxima` of the rows.
    rows : SearchRows
    cells : SearchCells
    bounds : SearchBounds
        Those of cells are filled in as they become known.
    boxes : (E, 3, 2) int64
        First and last point along each axis of boxes that are left out.
    rounding : float32
        Largest difference between sums of the same powers of arrays in different orders.

    Returns
    -------
    point : int
    power : float
        -inf if there is no point outside the boxes.
    """
    search = _Search(values, maxima, rows, cells, bounds, boxes, rounding)
    search.run()
    return search.best_point, float(search.best)


class _Search:
    """One search: the best point so far."""

    def __init__(
        self,
        values: Float32Array,
        maxima: Float32Array,
        rows: SearchRows,
        cells: SearchCells,
        bounds: SearchBounds,
        boxes: IntArray,
        rounding: np.float32,
    ) -> None:
        self._values = values
        self._maxima = maxima
        self._rows = rows
        self._cells = cells
        self._bounds = bounds
        self._boxes = boxes
        self._rounding = rounding
        self._shape = tuple(len(axis_m) for axis_m in cells.axes)
        self.best = np.float32(-np.inf)
        self.best_point = int(np.prod(self._shape))

    def run(self) -> None:
        """Examine cubes."""
        per_cube, edge = self._cells.per_cube, self._cells.edge
        of_cubes, of_cells, known, *_ = self._bounds
        inner = _corners(per_cube) * edge
        every = np.arange(len(of_cubes))
        cubes = self._promising(every, self._cells.corners, self._cells.strides, per_cube * edge, of_cubes)
        while (chosen := cubes.take(self.best, self.best_point)) is not None:
            which, first, stride = chosen
            new = which[~known[which]]
            bounds_of_rest(self._maxima, self._cells.cell_places, self._rows, self._rounding, new, of_cells)
            known[new] = True
            children = (which[:, None] * per_cube**3 + np.arange(per_cube**3)).ravel()
            firsts = (first[:, None] + inner * stride[:, None, None]).reshape(-1, 3)
            strides = np.repeat(stride, per_cube**3)
            self._examine(self._promising(children, firsts, strides, edge, of_cells[which, :, 0].ravel()))

    def _examine(self, cells: _InOrder) -> None:
        """Examine all cells that may hold a better point."""
        inmost = _corners(self._cells.edge)
        while (chosen := cells.take(self.best, self.best_point)) is not None:
            _, first, stride = chosen
            at, inside = _points_of(first[:, None], stride[:, None], inmost, self._shape)
            self._compare(at[inside])

    def _compare(self, at: IntArray) -> None:
        """Compare points, given by their indices (N, 3), with the best one."""
        for box in self._boxes:
            at = at[~((at >= box[:, 0]) & (at <= box[:, 1])).all(axis=1)]
        points_m = np.stack([axis_m[at[:, axis]] for axis, axis_m in enumerate(self._cells.axes)], axis=1)
        power = _power(points_m, self._values, self._rows)
        peak = power.max(initial=-np.inf)
        if peak >= self.best and len(power):
            point = int(np.ravel_multi_index(tuple(at[power == peak].T), self._shape).min())
            self.best_point = point if peak > self.best else min(point, self.best_point)
            self.best = peak

    def _promising(
        self, which: IntArray, first: IntArray, stride: IntArray, points: int, bound: Float32Array
    ) -> _InOrder:
        """Put cubes with `points` along an edge in the order of their bounds, without those that cannot be best."""
        last = np.minimum(first + points * stride[:, None], self._shape) - 1
        out = (first >= self._shape).any(axis=1)
        for box in self._boxes:
            out |= ((first >= box[:, 0]) & (last <= box[:, 1])).all(axis=1)
        bound = np.where(out, np.float32(-np.inf), bound)
        order = np.argsort(-bound, kind="stable")
        order = order[(bound[order] > -np.inf) & (bound[order] >= self.best)]
        corner = np.ravel_multi_index(tuple(first[order].T), self._shape)
        return _InOrder(which[order], first[order], stride[order], bound[order], corner)


@dataclass
class _InOrder:
    """Cubes of grid points in the order of their bounds, taken a few at a time: first one, then twice as many."""

    which: IntArray
    first: IntArray
    stride: IntArray
    bound: Float32Array
    corner: IntArray
    _done: int = 0
    _some: int = 1

    def take(self, best: np.float32, best_point: int) -> tuple[IntArray, IntArray, IntArray] | None:
        """Take the next ones that may hold a point better than the best, or an equal one before it; None at the end."""
        while self._done < len(self.which) and self.bound[self._done] >= best:
            now = slice(self._done, self._done + self._some)
            self._done, self._some = now.stop, min(2 * self._some, _CELLS_AT_ONCE)
            bound, corner = self.bound[now], self.corner[now]
            may_hold = (bound > best) | ((bound == best) & (corner < best_point))
            if may_hold.any():
                return self.which[now][may_hold], self.first[now][may_hold], self.stride[now][may_hold]
        return None


def _points_of(
    first: IntArray, stride: IntArray, inner: IntArray, shape: tuple[int, ...]
) -> tuple[IntArray, BoolArray]:
    """Points of cells that begin at `first` (..., 3), and which of them are inside the grid."""
    begin = first + inner * stride[..., None]
    return np.minimum(begin + stride[..., None] // 2, np.array(shape) - 1), np.all(begin < shape, axis=-1)


def _corners(count: int) -> IntArray:
    """Indices (count^3, 3) of a cube's parts, z fastest."""
    return np.stack(np.unravel_index(np.arange(count**3), (count,) * 3), axis=1)


def _power(points_m: Float32Array, values: Float32Array, rows: SearchRows) -> Float32Array:
    """Summed power at points (N, 3): (N,)."""
    power = np.zeros(len(points_m), dtype=np.float32)
    for a, weight in enumerate(rows.weight):
        own = slice(rows.first_row[a], rows.first_row[a + 1])
        microphones_m = rows.microphones_m[rows.first_microphone[a] : rows.first_microphone[a + 1]]
        places = lag_places(points_m, microphones_m, rows.pairs[own], rows.scale[a], rows.offset[a])
        total = np.zeros(len(points_m), dtype=np.float32)
        for row, place in zip(values[own], places, strict=True):
            total += row[place]
        power += weight * total
    return power
