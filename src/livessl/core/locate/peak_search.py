"""The highest points of the summed power maps, exactly, without the maps: branch and bound over cells of the grid.

Over a cell of the grid each pair's delay lies in an interval. The maximum of its GCC over that interval bounds what the
pair can add at any point of the cell; the sum of these maxima bounds the cell, and a cell whose bound is below the best
power known can be skipped (in the spirit of Nunes et al., IEEE TSP 2014, but with a bound that proves the answer).
Usually about 2000 points out of millions are visited. The size of a cell in metres is fixed, so memory does not grow
with a finer grid.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from livessl.core.correlate.gcc_phat import LagSampling, microphone_pairs
from livessl.core.correlate.onset_gcc import OnsetFrontEnd
from livessl.core.geometry import Grid
from livessl.core.kernels import kernels
from livessl.core.kernels.arguments import BLOCKS, NO_LAG, RUNS, SearchBounds, SearchCells, SearchRows
from livessl.core.locate.refine import FindPeaks, Peak, box_around, laplace_covariance_m2
from livessl.core.locate.srp import LagPlaces, SRPFunctional, SRPMapper, pair_weight
from livessl.core.types import (
    GCC,
    ArraySpec,
    Evidence,
    Float32Array,
    FloatArray,
    IntArray,
    UInt16Array,
)

CELL_M: Final = 0.2
"""Approximate edge of a cell, in metres; larger where there would be more than `MOST_CELLS`."""

MOST_CELLS: Final = 50_000
"""Approximate number of cells above which cells become larger, to bound the memory of the tables."""

MOST_LOOK_UPS: Final = 3_000_000
"""Look-ups after which a search gives up, some 5 ms compiled. Two arrays never need so many, nor do many arrays with a
clear sound; many arrays with nothing but noise do."""

MOST_HALVES_BYTES: Final = 64_000_000
"""Largest tables, in bytes, with which cells are halved along each axis before their points are examined."""

CELLS_PER_CUBE: Final = 4
"""Cells along the edge of the cubes of cells that are bounded first."""


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
        axes = (x_m, y_m, z_m)
        volume = float(np.prod(np.maximum(grid.upper_m - grid.lower_m, CELL_M)))
        half = max(1, round(max(CELL_M, (volume / MOST_CELLS) ** (1 / 3)) / 2 / grid.spacing_m))
        edge = 2 * half
        self._cubes = [-(-n // (CELLS_PER_CUBE * edge)) for n in grid.shape]
        self._specs = {spec.name: spec for spec in arrays}
        self._pairs = {spec.name: microphone_pairs(len(spec.microphones_m)) for spec in arrays}
        counts = [len(pairs) for pairs in self._pairs.values()]
        self._first_row = dict(zip(self._pairs, np.cumsum([0, *counts[:-1]]).tolist(), strict=True))
        total = sum(counts)
        cubes = int(np.prod(self._cubes))
        children = CELLS_PER_CUBE**3
        self._halves = half > 1 and 2 * 8 * children * cubes * total <= MOST_HALVES_BYTES
        self._cells = SearchCells(
            axes=axes,
            edge=edge,
            per_cube=CELLS_PER_CUBE,
            cell_places=np.zeros((cubes, total, children), np.uint16),
            leaf_places=np.zeros((cubes * children, total, 8 if self._halves else 0), np.uint16),
        )
        self._cube_places = np.zeros((total, cubes), np.uint16)
        self._bounds = SearchBounds(
            of_cubes=np.zeros(cubes, np.float32),
            of_cells=np.zeros((cubes, children), np.float32),
            known=np.zeros(cubes, np.bool_),
        )
        self._values, self._maxima = _Buffer(), _Buffer()
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
        spec, pairs, first = self._specs[array], self._pairs[array], self._first_row[array]
        rows = slice(first, first + len(pairs))
        places = self._lags[array] = LagPlaces.on(lags_s, self._c_m_s)
        cells = self._cells
        edge = cells.edge // 2 if self._halves else cells.edge
        small = [-(-n // edge) for n in self._grid.shape]
        low, high = (np.empty((len(pairs), *small), np.uint16) for _ in range(2))
        kernels.cell_intervals(
            cells.axes, spec.microphones_m.astype(np.float32), pairs.astype(np.int32), places.scale, places.offset,
            edge, low.reshape(len(pairs), -1), high.reshape(len(pairs), -1),
        )  # fmt: skip
        block = block_lags(len(lags_s))
        if self._halves:
            children = CELLS_PER_CUBE * 2
            leaf_places = _by_cube(run_places(low, high, block), self._cubes, children)
            split = leaf_places.reshape(len(pairs), -1, *(n for _ in range(3) for n in (CELLS_PER_CUBE, 2)))
            by_cell = split.transpose(1, 2, 4, 6, 0, 3, 5, 7)
            cells.leaf_places[:, rows] = by_cell.reshape(len(cells.leaf_places), len(pairs), 8)
            low, high = _extreme(low, 2, np.minimum), _extreme(high, 2, np.maximum)
        places_of_cells = _by_cube(run_places(low, high, block), self._cubes, CELLS_PER_CUBE)
        cells.cell_places[:, rows] = places_of_cells.swapaxes(0, 1)
        low, high = _extreme(low, CELLS_PER_CUBE, np.minimum), _extreme(high, CELLS_PER_CUBE, np.maximum)
        self._cube_places[rows] = run_places(low, high, block).reshape(len(pairs), -1)
        self._sets.clear()

    @property
    def table_bytes(self) -> int:
        """Memory of the tables of all arrays, in bytes."""
        return self._cells.cell_places.nbytes + self._cells.leaf_places.nbytes + self._cube_places.nbytes

    def among(self, evidence: Sequence[Evidence], most_look_ups: int = MOST_LOOK_UPS) -> FindPeaks:
        """Return a function that finds the peaks of some arrays' evidence; it is valid until the next call.

        Parameters
        ----------
        evidence : sequence of Evidence
            At least one, in the order in which the maps are to be summed. Each array must have been prepared.
        most_look_ups : int
            Look-ups for each peak after which the search gives up; the peak is then not proven to be the highest.
        """
        among = self._among(tuple(part.spec.name for part in evidence))
        rows = among.rows
        values = self._values.of(len(rows.site_pair), among.lags)
        maxima = self._maxima.of(len(rows.site_pair), among.runs)
        for array, part in enumerate(evidence):
            own = slice(rows.first_row[array], rows.first_row[array + 1])
            count = part.gcc.values.shape[1]
            values[own, :count], values[own, count:] = part.gcc.values, 0.0
        kernels.running_maxima(values, among.block, maxima)
        kernels.upper_bounds(maxima, self._cube_places, rows, self._bounds.of_cubes)
        self._bounds.known[:] = False

        def find(count: int, apart_points: int = 1, without: Sequence[IntArray] = ()) -> list[Peak]:
            boxes = list(without)
            found: list[Peak] = []
            for _ in range(count):
                left_out = np.array(boxes, dtype=np.int64).reshape(-1, 3, 2)
                point, power, proven = kernels.highest(
                    values, maxima, rows, self._cells, self._bounds, left_out, most_look_ups
                )
                if power == -np.inf:
                    break
                found.append(Peak(int(point), float(power), bool(proven)))
                boxes.append(box_around(self._grid, int(point), apart_points))
            return found

        return find

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
            block=np.repeat([block_lags(one.count) for one in places], np.diff(first_row)),
            rows=rows,
        )


@dataclass(frozen=True, slots=True)
class _Among:
    """The rows of a search over one set of arrays, and their lengths.

    Parameters
    ----------
    lags : int
        Lags of the longest row.
    runs : int
        Places among the running maxima of a row that cells may refer to, in whole levels.
    block : (R,) int64
        Lags in a block of each row.
    rows : SearchRows
    """

    lags: int
    runs: int
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
    """Lags in a block of an axis with so many lags."""
    return -(-lags // BLOCKS)


def run_places(low: UInt16Array, high: UInt16Array, block: int) -> UInt16Array:
    """Place among the running maxima of the shortest run that begins in the block of `low` and holds `high`."""
    first = low // block
    return np.asarray(_PLACE_OF_LENGTH[high // block - first + 1] + first)


def _extreme(ends: UInt16Array, count: int, extreme: np.ufunc) -> UInt16Array:
    """Extremes of intervals' ends (P, X, Y, Z) over cubes with `count` along an edge."""
    for axis in (1, 2, 3):
        ends = extreme.reduceat(ends, np.arange(0, ends.shape[axis], count), axis=axis)
    return ends


def _by_cube(table: UInt16Array, cubes: Sequence[int], count: int) -> UInt16Array:
    """Reorder a table (P, X, Y, Z) cube after cube, (P, T, count^3), with zeros for what lies outside the table."""
    padded = np.zeros((len(table), *(count * n for n in cubes)), table.dtype)
    padded[:, : table.shape[1], : table.shape[2], : table.shape[3]] = table
    split = padded.reshape(len(table), *(n for along in cubes for n in (along, count)))
    return split.transpose(0, 1, 3, 5, 2, 4, 6).reshape(len(table), -1, count**3)


_PLACE_OF_LENGTH: Final = np.array([BLOCKS * np.searchsorted(RUNS, blocks) for blocks in range(BLOCKS + 1)], np.uint16)
"""Place among the running maxima of the first run of each length, in blocks."""

_SETS: Final = 16
"""Sets of arrays whose rows are kept ready."""


def warm_up() -> None:
    """Run every kernel once, so that nothing is compiled, or read from the compiler's cache, while a user waits.

    The first time on a machine this takes some seconds, later a fraction of one.
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
