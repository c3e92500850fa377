"""Divides the grid for the peak search: every point in a room, fewer points far from all arrays in a large volume.

Far from an array its delays change little from one grid point to the next. In a volume with more points than can be
examined, a cube far from all arrays holds only every second, fourth, … point along each axis. The number of points
then grows with the logarithm of the volume's width rather than with its volume. It knows geometry and no sound.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from livessl.core.geometry import Grid
from livessl.core.types import ArraySpec, FloatArray, IntArray

MOST_POINTS: Final = 5_000_000
"""Largest number of grid points that are all examined. A room of 8 x 10 x 4 m at 0.05 m has half as many. With more
points, a search in noise could not keep up with live sound."""

FAR_PERIODS: Final = 0.25
"""Largest change of an array's delay from one examined point to the next, in periods of the upper edge of its band, if
points are skipped. With a spacing of 0.1 m, the delay changes by this much 7 m away from an array of 0.5 m, and by more
near the array."""

CELL_M: Final = 0.2
"""Approximate edge of a cell, in metres, if all points are examined; it is larger if there would be more than
`MOST_CELLS` cells."""

MOST_CELLS: Final = 100_000
"""Approximate number of cells above which cells become larger, to bound the memory of the tables."""

CELLS_PER_CUBE: Final = 4
"""Number of cells along the edge of a cube."""

_COARSER: Final = 1.25
"""Factor by which `FAR_PERIODS` is increased, repeatedly, while there are more than `MOST_POINTS` points."""


@dataclass(frozen=True, slots=True)
class SearchCubes:
    """Cubes that together contain all points that a search examines.

    Parameters
    ----------
    corners : (T, 3) int64
        First grid point of each cube along x, y and z.
    strides : (T,) int64
        Distance between neighbouring points of each cube, in grid points.
    edge : int
        Number of points along the edge of a cell.
    """

    corners: IntArray
    strides: IntArray
    edge: int

    @property
    def points(self) -> int:
        """Number of points along the edge of a cube."""
        return self.edge * CELLS_PER_CUBE

    def stride_at(self, point: IntArray) -> int:
        """Return the stride of the cube that holds a point (3,)."""
        offset = point - self.corners
        inside = (offset >= 0).all(axis=1) & (offset < (self.points * self.strides)[:, None]).all(axis=1)
        return int(self.strides[inside.argmax()])


def search_cubes(arrays: Sequence[ArraySpec], grid: Grid, c_m_s: float) -> SearchCubes:
    """Divide a grid into cubes: with all points if there are at most `MOST_POINTS`, otherwise with fewer far away."""
    if grid.size <= MOST_POINTS:
        volume = float(np.prod(np.maximum(grid.upper_m - grid.lower_m, CELL_M)))
        edge = max(2, round(max(CELL_M, (volume / MOST_CELLS) ** (1 / 3)) / grid.spacing_m))
        return _divided(arrays, grid, [np.inf] * len(arrays), edge)
    # distance at which the delay changes by a period from one grid point to the next
    period_m = np.array([grid.cell_m.max() * spec.aperture_m * spec.band_hz[1] / c_m_s for spec in arrays])
    periods = FAR_PERIODS
    cubes = _divided(arrays, grid, period_m / periods, 2)
    while len(cubes.corners) * cubes.points**3 > MOST_POINTS:
        periods *= _COARSER
        cubes = _divided(arrays, grid, period_m / periods, 2)
    while len(cubes.corners) * CELLS_PER_CUBE**3 > MOST_CELLS:
        cubes = _divided(arrays, grid, period_m / periods, cubes.edge + 1)
    return cubes


def _divided(arrays: Sequence[ArraySpec], grid: Grid, far_m: Sequence[float] | FloatArray, edge: int) -> SearchCubes:
    """Halve cubes until each has stride 1 or is as many times `far_m` away from every array as its stride."""
    shape, cell_m = np.array(grid.shape), grid.cell_m
    points = edge * CELLS_PER_CUBE
    stride = 1
    if np.isfinite(far_m).all():
        while points * stride < shape.max():
            stride *= 2
    extent = points * stride
    corners = np.stack([axis.ravel() for axis in np.indices(tuple(-(-shape // extent)))], axis=1) * extent
    kept: list[tuple[IntArray, int]] = []
    while stride > 1 and len(corners):
        low_m = grid.lower_m + corners * cell_m
        high_m = grid.lower_m + np.minimum(corners + points * stride, shape) * cell_m
        far = np.ones(len(corners), np.bool_)
        for spec, unit_m in zip(arrays, far_m, strict=True):
            radius_m = np.linalg.norm(spec.microphones_m - spec.centre_m, axis=1).max()
            away = np.maximum(0.0, np.maximum(low_m - spec.centre_m, spec.centre_m - high_m))
            far &= np.linalg.norm(away, axis=1) - radius_m >= stride * unit_m
        kept.append((corners[far], stride))
        stride //= 2
        eighths = np.stack(np.unravel_index(np.arange(8), (2, 2, 2)), axis=1) * (points * stride)
        corners = (corners[~far, None] + eighths).reshape(-1, 3)
        corners = corners[(corners < shape).all(axis=1)]
    kept.append((corners, stride))
    return SearchCubes(
        np.concatenate([some for some, _ in kept]),
        np.repeat([each for _, each in kept], [len(some) for some, _ in kept]),
        edge,
    )
