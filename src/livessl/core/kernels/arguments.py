"""Groups of arguments and constants that kernels share: lag blocks, search rows, cells and bounds.

In all kernels L is the number of lags, P of an array's pairs, A of arrays, M of their microphones together, R of rows
(all pairs of all arrays, array after array), C of cells. A grid's points are in its own order, z fastest. Of a cube
with stride s only the points `corner + n s + s // 2` along each axis are examined, n = 0, 1, …; where such a point lies
beyond the grid's end, the last point is examined instead.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from livessl.core.types import (
    BoolArray,
    ComplexArray,
    Float32Array,
    FloatArray,
    IntArray,
    RealArray,
    UInt8Array,
    UInt16Array,
)

BLOCKS: Final = 256
"""Most blocks into which a lag axis is divided for the bounds of the search."""

RUNS: Final = np.array([1, 2, 3, *(q << k for k in range(6) for q in (4, 5, 6, 7)), BLOCKS])
"""Lengths, in blocks, of the runs whose maxima are kept: none is more than a quarter longer than the one before."""

REACHES: Final = np.array([*range(1, 8), *(q << k for k in range(1, 15) for q in (4, 5, 6, 7))])
"""Lags on either side of a place over which `reaching_maxima` are kept: none is more than a quarter more than the one
before, and the last is longer than any lag axis."""

NO_LAG: Final = 65535
"""Place above every place on a lag axis: the lowest place in a cell without points."""

SILENT_POWER: Final = np.float32(1e-12)
"""Power of a bin, relative to its channel's loudest in the band, below which it is rounding and has no phase."""

Axes = tuple[Float32Array, Float32Array, Float32Array]
"""Coordinates of a grid's points along x, y and z, in metres."""


class OnsetParameters(NamedTuple):
    """Constants of the onset weights: `livessl.core.correlate.onset_gcc` gives their reasons."""

    least: np.float32
    """Power below which nothing is measured."""
    decay: np.float32
    """Decay of the past's power from one window to the next."""
    reach: np.float32
    """Power, relative to the noise, that noise reaches by chance; only power above it can be direct."""
    loud: np.float32
    """Power, relative to the noise, above which a quiet window holds sound."""
    strongest: np.float32
    """Largest weight."""
    warm_up: int
    """Quiet windows after which weights are computed."""
    noise_hops: int
    """Windows over which the noise is averaged; after so many, quiet or not, weights are computed."""


class OnsetState(NamedTuple):
    """State of an array's noise; the kernel updates the arrays in place."""

    windows: IntArray
    """Windows so far, and quiet ones of them: (2,)."""
    noise: Float32Array
    """Power of the noise in each bin of the band: (B,)."""
    past: Float32Array
    """Decaying power of what was before: (B,)."""
    cross: ComplexArray
    """Cross-spectra of the noise, conj(X_i) X_k, of all pairs, and then the power at each microphone: (P + K, B)."""


class SmoothRows(NamedTuple):
    """GCCs of several arrays for interpolation between lags."""

    microphones_m: FloatArray
    """Positions of all microphones: (M, 3)."""
    pairs: IntArray
    """Microphones (i, k) of each row, among all: (R, 2)."""
    first_s: FloatArray
    """First lag of each row: (R,)."""
    step_s: FloatArray
    """Step between lags of each row: (R,)."""
    start: IntArray
    """Index in `values` at which each row begins: (R,)."""
    last: IntArray
    """Last place on each row that has two more to its right: (R,)."""
    weight: FloatArray
    """Weight of each row: (R,)."""
    values: RealArray
    """All lags of all rows, one row after another."""


class SearchRows(NamedTuple):
    """Pairs of the arrays of a search."""

    site_pair: IntArray
    """Which of the site's pairs each row is: (R,)."""
    first_row: IntArray
    """Index at which each array's rows begin, and the end: (A + 1,)."""
    weight: Float32Array
    """Weight of each array: (A,)."""
    microphones_m: Float32Array
    """Positions of all microphones: (M, 3)."""
    first_microphone: IntArray
    """Index at which each array's microphones begin, and the end: (A + 1,)."""
    pairs: IntArray
    """Microphones (i, k) of each row, within its array: (R, 2)."""
    scale: Float32Array
    """Lags per metre of path difference, of each array: (A,)."""
    offset: Float32Array
    """Place of lag 0 plus a half, of each array: (A,)."""


class SearchCells(NamedTuple):
    """Cells of a grid, in cubes of `per_cube`^3, and the lags that their points may have.

    A place among a row's `running_maxima` stands for a run of lags that holds all of a cell's lags of that pair.
    """

    axes: Axes
    corners: IntArray
    """First grid point of each of T cubes along x, y and z: (T, 3)."""
    strides: IntArray
    """Distance between neighbouring points of each cube, in grid points: (T,)."""
    edge: int
    """Points along the edge of a cell."""
    per_cube: int
    """Cells along the edge of a cube."""
    cell_places: UInt16Array
    """Places for the cells of each cube: (T, site's pairs, per_cube^3)."""
    reaches: UInt8Array
    """Index in `REACHES` of two numbers of lags: (2, T, per_cube^3, site's pairs). The first is the most between the
    middle of a cell and any of its points, the second the most between the middle of any half, along each axis, and a
    point in that half."""


class SearchBounds(NamedTuple):
    """Upper bounds of the power; the search fills in those of cells in place."""

    of_cubes: Float32Array
    """Bounds of the cubes: (T,)."""
    of_cells: Float32Array
    """Bounds of what the arrays from each on add in the cells of each cube: (T, per_cube^3, A + 1)."""
    known: BoolArray
    """Cubes whose cells' bounds are known: (T,)."""
    reaching: Float32Array
    """Maxima of each row over the lags within each of some of the first `REACHES`, one after another, where they are
    known: (R, any number times L)."""
    reaching_known: BoolArray
    """True if `reaching` is known: (1,)."""
