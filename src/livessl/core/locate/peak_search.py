"""Finds the highest grid points of the summed power maps exactly, by branch and bound, without computing the maps.

`refine` finds the maximum between grid points; `srp` has the map's definition.

Over a cell of the grid each pair's delay lies in an interval. The maximum of its GCC over that interval is an upper
bound of the pair's value at any point of the cell. The sum of these maxima is an upper bound for the cell, and a cell
whose bound is below the best known power can be skipped (in the spirit of Nunes et al., IEEE TSP 2014, but with a bound
that proves the result). Usually about 2000 points out of millions are visited. If nothing stands out, most cells are
visited, and the search takes longer, but never much longer than computing the map. Memory is bounded for every grid
(`livessl.core.locate.search_cubes`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from livessl.core.correlate.gcc_phat import LagSampling
from livessl.core.correlate.onset_gcc import OnsetFrontEnd
from livessl.core.geometry import Grid, microphone_pairs, pair_weight
from livessl.core.kernels import kernels
from livessl.core.kernels.arguments import BLOCKS, NO_LAG, REACHES, RUNS, SearchBounds, SearchCells, SearchRows
from livessl.core.locate.refine import FindPeaks, Peak, box_around, laplace_covariance_m2
from livessl.core.locate.search_cubes import CELLS_PER_CUBE, search_cubes
from livessl.core.locate.srp import LagPlaces, SRPFunctional, SRPMapper
from livessl.core.types import (
    GCC,
    ArraySpec,
    Evidence,
    Float32Array,
    FloatArray,
    IntArray,
    UInt16Array,
)

_ROUNDING: Final = 8e-6
"""Largest difference, relative to the sum of all pairs' greatest values, between sums over at most 64 arrays in
different orders: two times 64 roundings of 6e-8. Large sums have few negative terms."""

_CUBES_AT_ONCE: Final = 512
"""Number of cubes whose tables are computed at one time, to limit the memory that this takes."""


class PeakSearch:
    """Finds the peaks of several arrays' fused power on a grid.

    Parameters
    ----------
    arrays : sequence of ArraySpec
        All arrays that may take part.
    grid : Grid
    c_m_s : float
        Speed of sound, m/s.
    """

    def __init__(self, arrays: Sequence[ArraySpec], grid: Grid, c_m_s: float) -> None:
        self._grid = grid
        self._c_m_s = c_m_s
        x_m, y_m, z_m = (grid.axis_m(axis).astype(np.float32) for axis in range(3))
        self._cubes = cubes = search_cubes(arrays, grid, c_m_s)
        self._is_thinned = bool(cubes.strides.max() > 1)
        self._specs = {spec.name: spec for spec in arrays}
        self._pairs = {spec.name: microphone_pairs(len(spec.microphones_m)) for spec in arrays}
        counts = [len(pairs) for pairs in self._pairs.values()]
        self._first_row = dict(zip(self._pairs, np.cumsum([0, *counts[:-1]]).tolist(), strict=True))
        total, count = sum(counts), len(cubes.corners)
        children = CELLS_PER_CUBE**3
        self._cells = SearchCells(
            axes=(x_m, y_m, z_m),
            corners=cubes.corners,
            strides=cubes.strides,
            edge=cubes.edge,
            per_cube=CELLS_PER_CUBE,
            cell_places=np.zeros((count, total, children), np.uint16),
            reaches=np.zeros((2, count, children, total), np.uint8),
        )
        self._cube_places = np.zeros((total, count), np.uint16)
        self._of_cubes, self._known = np.zeros(count, np.float32), np.zeros(count, np.bool_)
        self._values, self._maxima, self._reaching, self._of_cells = _Buffer(), _Buffer(), _Buffer(), _Buffer()
        self._kernels: Any = None  # what makes the tables, and searches with them, once there are any
        self._lags_s: dict[str, FloatArray] = {}
        self._lags: dict[str, LagPlaces] = {}
        self._sets: dict[tuple[str, ...], _Among] = {}

    def prepare(self, array: str, lags_s: FloatArray) -> None:
        """Compute an array's tables for a lag axis (L,), in seconds, evenly spaced around zero.

        Raises
        ------
        ValueError
            If the axis has more lags than 16 bits can count.
        """
        if len(lags_s) >= NO_LAG:
            raise ValueError(
                f"array {array!r}: expected fewer than {NO_LAG} lags, got {len(lags_s)}; "
                "its microphones are too far apart for its sampling rate"
            )
        if self._kernels is None:
            self._kernels = kernels.in_use
        spec, pairs, first = self._specs[array], self._pairs[array], self._first_row[array]
        places = self._lags[array] = LagPlaces.on(lags_s, self._c_m_s)
        self._lags_s[array] = lags_s
        block, rows = block_lags(len(lags_s)), slice(first, first + len(pairs))
        cells, microphones_m = self._cells, spec.microphones_m.astype(np.float32)
        for begin in range(0, len(cells.corners), _CUBES_AT_ONCE):
            some = slice(begin, begin + _CUBES_AT_ONCE)
            corners = cells.corners[some]
            low, high, reach = (np.empty((len(pairs), len(corners), CELLS_PER_CUBE**3), np.uint16) for _ in range(3))
            of_cubes = cells.axes, corners, cells.strides[some], cells.edge
            of_array = CELLS_PER_CUBE, microphones_m, pairs.astype(np.int32), places.scale, places.offset
            self._kernels.cell_intervals(*of_cubes, *of_array, low, high)
            for number, part in enumerate((cells.edge, (cells.edge + 1) // 2)):
                self._kernels.reaches_of_parts(*of_cubes, part, *of_array, reach)
                cells.reaches[number, some, :, rows] = np.searchsorted(REACHES, reach).transpose(1, 2, 0)
            self._cube_places[rows, some] = run_places(low.min(axis=2), high.max(axis=2), block)
            low = np.minimum(low, high)  # `NO_LAG` and 0 in a cell without points
            cells.cell_places[some, rows] = run_places(low, high, block).swapaxes(0, 1)
        self._sets.clear()

    @property
    def table_bytes(self) -> int:
        """Memory of the tables of all arrays, in bytes."""
        return self._cells.cell_places.nbytes + self._cells.reaches.nbytes + self._cube_places.nbytes

    def among(self, evidence: Sequence[Evidence]) -> FindPeaks:
        """Return a function that finds the peaks of some arrays' evidence; it is valid until the next call.

        Parameters
        ----------
        evidence : sequence of Evidence
            At least one item, in the order in which the maps are summed. Each array must have been prepared.
        """
        if self._kernels is not kernels.in_use:
            self._kernels = kernels.in_use
            for name, lags_s in self._lags_s.items():
                self.prepare(name, lags_s)
        among = self._among(tuple(part.spec.name for part in evidence))
        rows = among.rows
        values = self._values.of(len(rows.site_pair), among.lags)
        maxima = self._maxima.of(len(rows.site_pair), among.runs)
        for array, part in enumerate(evidence):
            own = slice(rows.first_row[array], rows.first_row[array + 1])
            count = part.gcc.values.shape[1]
            values[own, :count], values[own, count:] = part.gcc.values, 0.0
        self._kernels.running_maxima(values, among.block, maxima)
        self._kernels.upper_bounds(maxima, self._cube_places, rows, self._of_cubes)
        self._known[:] = False
        of_cells = self._of_cells.of(len(self._known) * CELLS_PER_CUBE**3, len(evidence) + 1)
        bounds = SearchBounds(
            self._of_cubes,
            of_cells.reshape(len(self._known), -1, len(evidence) + 1),
            self._known,
            self._reaching.of(len(rows.site_pair), among.reaches * among.lags),
            np.zeros(1, np.bool_),
        )
        greatest = np.abs(maxima[:, :BLOCKS].max(axis=1))
        rounding = np.float32(_ROUNDING * (np.add.reduceat(greatest, rows.first_row[:-1]) @ rows.weight))

        def find(count: int, apart_points: int = 1, without: Sequence[IntArray] = ()) -> list[Peak]:
            boxes = list(without)
            found: list[Peak] = []
            for _ in range(count):
                left_out = np.array(boxes, dtype=np.int64).reshape(-1, 3, 2)
                point, power = self._kernels.highest(values, maxima, rows, self._cells, bounds, left_out, rounding)
                if power == -np.inf:
                    break
                stride = self._stride_at(int(point))
                found.append(Peak(int(point), float(power), stride))
                boxes.append(box_around(self._grid, int(point), apart_points * stride))
            return found

        return find

    def _stride_at(self, point: int) -> int:
        if not self._is_thinned:
            return 1
        return self._cubes.stride_at(np.array(np.unravel_index(point, self._grid.shape)))

    def _among(self, arrays: tuple[str, ...]) -> _Among:
        if arrays not in self._sets:
            if len(self._sets) >= _SETS:
                self._sets.clear()
            self._sets[arrays] = self._new_set(arrays)
        return self._sets[arrays]

    def _new_set(self, arrays: tuple[str, ...]) -> _Among:
        specs, places = [self._specs[name] for name in arrays], [self._lags[name] for name in arrays]
        first_row = np.cumsum([0, *(len(self._pairs[name]) for name in arrays)])
        site_pair = np.concatenate([self._first_row[n] + np.arange(len(self._pairs[n])) for n in arrays])
        most = 1 + int(self._cube_places[site_pair].max())
        rows = SearchRows(
            site_pair=site_pair,
            first_row=first_row,
            weight=np.array([pair_weight(len(spec.microphones_m)) for spec in specs], np.float32),
            microphones_m=np.concatenate([spec.microphones_m for spec in specs]).astype(np.float32),
            first_microphone=np.cumsum([0, *(len(spec.microphones_m) for spec in specs)]),
            pairs=np.concatenate([self._pairs[name] for name in arrays]),
            scale=np.array([one.scale for one in places]),
            offset=np.array([one.offset for one in places]),
        )
        return _Among(
            lags=max(one.count for one in places),
            runs=-(-most // BLOCKS) * BLOCKS,
            reaches=1 + int(self._cells.reaches[:, :, :, site_pair].max()),
            block=np.repeat([block_lags(one.count) for one in places], np.diff(first_row)),
            rows=rows,
        )


@dataclass(frozen=True, slots=True)
class _Among:
    """The rows of a search over one set of arrays, and their lengths.

    Parameters
    ----------
    lags : int
        Number of lags of the longest row.
    runs : int
        Number of places among the running maxima of a row to which cells may refer, in whole levels.
    reaches : int
        Number of the `REACHES` to which cells may refer.
    block : (R,) int64
        Number of lags in a block of each row.
    rows : SearchRows
    """

    lags: int
    runs: int
    reaches: int
    block: IntArray
    rows: SearchRows


class _Buffer:
    """Working memory that grows to the largest size requested and is used for every set of arrays."""

    def __init__(self) -> None:
        self._all = np.empty(0, np.float32)

    def of(self, rows: int, columns: int) -> Float32Array:
        """Return an array (rows, columns) with arbitrary content."""
        if self._all.size < rows * columns:
            self._all = np.empty(rows * columns, np.float32)
        return self._all[: rows * columns].reshape(rows, columns)


def block_lags(lags: int) -> int:
    """Return the number of lags in a block of an axis with `lags` lags."""
    return -(-lags // BLOCKS)


def run_places(low: UInt16Array, high: UInt16Array, block: int) -> UInt16Array:
    """Return the place, among the running maxima, of the shortest run from the block of `low` that contains `high`."""
    first = low // block
    return np.asarray(_PLACE_OF_LENGTH[high // block - first + 1] + first)


_PLACE_OF_LENGTH: Final = np.array([BLOCKS * np.searchsorted(RUNS, blocks) for blocks in range(BLOCKS + 1)], np.uint16)
"""Place among the running maxima of the first run of each length, in blocks."""

_SETS: Final = 16
"""Number of sets of arrays whose rows are cached."""


def warm_up() -> None:
    """Run every kernel once, so that no kernel is compiled, or read from the compiler's cache, while a user waits.

    The first call on a machine takes some seconds, later calls a fraction of a second.
    """
    spec = ArraySpec("warm-up", np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]]), (100.0, 6000.0))
    grid = Grid(((0.0, 1.0), (0.0, 1.0), (0.0, 1.0)), 0.5)
    lags_s = np.arange(-200, 201) / 400_000.0
    evidence = Evidence(spec, GCC(np.array([[0, 1]]), lags_s, np.ones((1, len(lags_s)), dtype=np.float32)))
    search = PeakSearch([spec], grid, 343.0)
    search.prepare(spec.name, lags_s)
    search.among([evidence])(2)
    front_end = OnsetFrontEnd(spec, 48_000.0, LagSampling.shared(spec.band_hz, 48_000.0, spec.aperture_m / 343.0))
    front_end.push(np.zeros((2, 4800), dtype=np.float32), quiet=True)
    SRPMapper(spec, grid, evidence.gcc.pairs, lags_s, 343.0)(evidence.gcc)
    functional = SRPFunctional([evidence], 343.0)
    functional.value(np.zeros((1, 3)))
    laplace_covariance_m2(functional, [evidence], np.array([0.5, 0.5, 0.5]), grid)
