"""The highest places of the summed power maps, exactly, without the maps: branch and bound over cells of the grid.

Over a cell of the grid each pair's delay lies in an interval. The maximum of its GCC over that interval bounds what the
pair can add at any node of the cell; their sum bounds the cell, and a cell below the best node known need not be looked
into (in the spirit of Nunes et al., IEEE TSP 2014, but with a bound that proves the answer). Mostly some two thousand
of millions of nodes are visited. The cells are of one size in metres, so memory does not grow with a finer grid.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

import numpy as np

from livessl.core.correlate.gcc_phat import LagSampling, microphone_pairs
from livessl.core.correlate.onset_gcc import OnsetFrontEnd
from livessl.core.geometry import Grid
from livessl.core.kernels import kernels, with_numpy
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
"""Edge of a cell, about; more where there would be more than `MOST_CELLS`."""

MOST_CELLS: Final = 50_000

MOST_LOOK_UPS: Final = 3_000_000
"""After so many a search is given up, some 5 ms compiled. Two arrays never need so many, nor do many that hear a sound
well; many that hear nothing but noise do."""

MOST_HALVES_BYTES: Final = 64_000_000
"""Cells are halved along each axis, before nodes are looked at, where the tables of that take no more."""

CELLS_PER_TOP: Final = 4
"""Cells along an edge of the cubes of cells that are bounded first."""


class Rule(IntEnum):
    """How the arrays' maps are joined. All are monotone in every map, which is what the bounds ask for."""

    SUM = with_numpy.SUM
    PRODUCT = with_numpy.PRODUCT
    """Of the positive parts."""
    MINIMUM = with_numpy.MINIMUM


class PeakSearch:
    """Finds the peaks of several arrays' fused power on a grid.

    Parameters
    ----------
    arrays : sequence of ArraySpec
        All that may take part.
    grid : Grid
    c_m_s : float
    """

    def __init__(self, arrays: Sequence[ArraySpec], grid: Grid, c_m_s: float) -> None:
        self._grid = grid
        self._c_m_s = c_m_s
        self._axes = [grid.axis_m(axis).astype(np.float32) for axis in range(3)]
        volume = float(np.prod(np.maximum(grid.upper_m - grid.lower_m, CELL_M)))
        half = max(1, round(max(CELL_M, (volume / MOST_CELLS) ** (1 / 3)) / 2 / grid.spacing_m))
        self._edge = 2 * half
        self._cells = [-(-n // self._edge) for n in grid.shape]
        self._tops = [-(-n // CELLS_PER_TOP) for n in self._cells]
        self._specs = {spec.name: spec for spec in arrays}
        self._pairs = {spec.name: microphone_pairs(len(spec.microphones_m)) for spec in arrays}
        counts = [len(pairs) for pairs in self._pairs.values()]
        self._first_row = dict(zip(self._pairs, np.cumsum([0, *counts[:-1]]).tolist(), strict=True))
        total = sum(counts)
        tops = int(np.prod(self._tops))
        children = CELLS_PER_TOP**3
        self._halves = half > 1 and 2 * 8 * children * tops * total <= MOST_HALVES_BYTES
        self._cell_places = np.zeros((tops, total, children), np.uint16)
        self._leaf_places = np.zeros((tops * children, total, 8 if self._halves else 0), np.uint16)
        self._top_places = np.zeros((total, tops), np.uint16)
        self._top_bound = np.zeros(tops, np.float32)
        self._cell_bound = np.zeros((tops, children), np.float32)
        self._bounded = np.zeros(tops, np.bool_)
        self._values, self._maxima = _Room(), _Room()
        self._lags: dict[str, LagPlaces] = {}
        self._sets: dict[tuple[str, ...], _Rows] = {}

    def prepare(self, array: str, lags_s: FloatArray) -> None:
        """Work out an array's intervals for a lag axis (L,), evenly spaced around zero.

        Raises
        ------
        ValueError
            Where the axis is longer than 16 bits can count.
        """
        if len(lags_s) >= with_numpy.NO_LAG:
            raise ValueError(
                f"array {array!r}: expected fewer than {with_numpy.NO_LAG} lags, got {len(lags_s)}; "
                "its microphones are too far apart for its sampling rate"
            )
        spec, pairs, first = self._specs[array], self._pairs[array], self._first_row[array]
        rows = slice(first, first + len(pairs))
        places = self._lags[array] = LagPlaces.on(lags_s, self._c_m_s)
        edge = self._edge // 2 if self._halves else self._edge
        small = [-(-len(axis_m) // edge) for axis_m in self._axes]
        low, high = (np.empty((len(pairs), *small), np.uint16) for _ in range(2))
        kernels.cell_intervals(
            *self._axes, spec.microphones_m.astype(np.float32), pairs.astype(np.int32), places.scale, places.offset,
            edge, low.reshape(len(pairs), -1), high.reshape(len(pairs), -1),
        )  # fmt: skip
        block = _block(len(lags_s))
        if self._halves:
            children = CELLS_PER_TOP * 2
            leaf_places = _by_cube(_run_places(low, high, block), self._tops, children)
            split = leaf_places.reshape(len(pairs), -1, *(n for _ in range(3) for n in (CELLS_PER_TOP, 2)))
            by_cell = split.transpose(1, 2, 4, 6, 0, 3, 5, 7)
            self._leaf_places[:, rows] = by_cell.reshape(len(self._leaf_places), len(pairs), 8)
            low, high = _extreme(low, 2, np.minimum), _extreme(high, 2, np.maximum)
        places_of_cells = _by_cube(_run_places(low, high, block), self._tops, CELLS_PER_TOP)
        self._cell_places[:, rows] = places_of_cells.swapaxes(0, 1)
        low, high = _extreme(low, CELLS_PER_TOP, np.minimum), _extreme(high, CELLS_PER_TOP, np.maximum)
        self._top_places[rows] = _run_places(low, high, block).reshape(len(pairs), -1)
        self._sets.clear()

    def among(
        self, evidence: Sequence[Evidence], rule: Rule = Rule.SUM, most_look_ups: int = MOST_LOOK_UPS
    ) -> FindPeaks:
        """What finds the peaks of some arrays' evidence; good until the next call.

        Parameters
        ----------
        evidence : sequence of Evidence
            At least one, in the order in which the maps are to be joined. Each array must have been prepared.
        rule : Rule
        most_look_ups : int
            For each peak: the search is then given up, and the peak not proven to be the highest.
        """
        rows = self._rows(tuple(heard.spec.name for heard in evidence))
        values = self._values.of(len(rows.rows), rows.lags)
        maxima = self._maxima.of(len(rows.rows), rows.runs)
        for array, heard in enumerate(evidence):
            own = slice(rows.first_row[array], rows.first_row[array + 1])
            count = heard.gcc.values.shape[1]
            values[own, :count], values[own, count:] = heard.gcc.values, 0.0
        kernels.running_maxima(values, rows.block, maxima)
        kernels.bounds(maxima, self._top_places, rows.rows, rows.first_row, rows.weight, int(rule), self._top_bound)
        self._bounded[:] = False

        def find(count: int, apart_nodes: int = 1, without: Sequence[IntArray] = ()) -> list[Peak]:
            boxes = list(without)
            found: list[Peak] = []
            for _ in range(count):
                node, power, proven = kernels.highest(
                    values, maxima, rows.rows, rows.first_row, rows.weight, int(rule), self._cell_places,
                    self._leaf_places, self._top_bound, self._cell_bound, self._bounded,
                    *self._axes, self._edge, CELLS_PER_TOP,
                    rows.microphones_m, rows.first_microphone, rows.pairs, rows.scale, rows.offset,
                    np.array(boxes, dtype=np.int64).reshape(-1, 3, 2), most_look_ups,
                )  # fmt: skip
                if power == -np.inf:
                    break
                found.append(Peak(int(node), float(power), bool(proven)))
                boxes.append(box_around(self._grid, int(node), apart_nodes))
            return found

        return find

    def _rows(self, arrays: tuple[str, ...]) -> _Rows:
        if arrays not in self._sets:
            if len(self._sets) >= _SETS:
                self._sets.clear()
            self._sets[arrays] = self._new_rows(arrays)
        return self._sets[arrays]

    def _new_rows(self, arrays: tuple[str, ...]) -> _Rows:
        specs, places = [self._specs[name] for name in arrays], [self._lags[name] for name in arrays]
        first_row = np.cumsum([0, *(len(self._pairs[name]) for name in arrays)])
        rows = np.concatenate([self._first_row[n] + np.arange(len(self._pairs[n])) for n in arrays])
        most = 1 + int(self._top_places[rows].max())
        return _Rows(
            lags=max(one.count for one in places),
            runs=-(-most // with_numpy.BLOCKS) * with_numpy.BLOCKS,
            block=np.repeat([_block(one.count) for one in places], np.diff(first_row)),
            rows=rows,
            first_row=first_row,
            weight=np.array([pair_weight(len(spec.microphones_m)) for spec in specs], np.float32),
            microphones_m=np.concatenate([spec.microphones_m for spec in specs]).astype(np.float32),
            first_microphone=np.cumsum([0, *(len(spec.microphones_m) for spec in specs)]),
            pairs=np.concatenate([self._pairs[name] for name in arrays]),
            scale=np.array([one.scale for one in places]),
            offset=np.array([one.offset for one in places]),
        )


class _Room:
    """Memory to work in, the same for every set of arrays: as much as the largest asked for."""

    def __init__(self) -> None:
        self._all = np.empty(0, np.float32)

    def of(self, rows: int, columns: int) -> Float32Array:
        """An array (rows, columns) with anything in it."""
        if self._all.size < rows * columns:
            self._all = np.empty(rows * columns, np.float32)
        return self._all[: rows * columns].reshape(rows, columns)


def _block(lags: int) -> int:
    """How many lags of an axis make one of its blocks."""
    return -(-lags // with_numpy.BLOCKS)


def _run_places(low: UInt16Array, high: UInt16Array, block: int) -> UInt16Array:
    """Where among the running maxima the shortest run is that begins in the block of `low` and holds `high`."""
    first = low // block
    return np.asarray(_PLACE_OF_LENGTH[high // block - first + 1] + first)


def _extreme(ends: UInt16Array, count: int, extreme: np.ufunc) -> UInt16Array:
    """Of intervals' ends (P, X, Y, Z), the extremes over cubes with `count` an edge."""
    for axis in (1, 2, 3):
        ends = extreme.reduceat(ends, np.arange(0, ends.shape[axis], count), axis=axis)
    return ends


def _by_cube(table: UInt16Array, cubes: Sequence[int], count: int) -> UInt16Array:
    """A table (P, X, Y, Z) as (P, T, count^3): cube after cube, filled up with zeros where one reaches out."""
    padded = np.zeros((len(table), *(count * n for n in cubes)), table.dtype)
    padded[:, : table.shape[1], : table.shape[2], : table.shape[3]] = table
    split = padded.reshape(len(table), *(n for along in cubes for n in (along, count)))
    return split.transpose(0, 1, 3, 5, 2, 4, 6).reshape(len(table), -1, count**3)


_PLACE_OF_LENGTH: Final = np.array(
    [with_numpy.BLOCKS * np.searchsorted(with_numpy.RUNS, blocks) for blocks in range(with_numpy.BLOCKS + 1)], np.uint16
)

_SETS: Final = 16
"""Sets of arrays that are kept ready."""


@dataclass(frozen=True, slots=True)
class _Rows:
    """What a search over one set of arrays needs: see `with_numpy.highest`."""

    lags: int
    runs: int
    block: IntArray
    rows: IntArray
    first_row: IntArray
    weight: Float32Array
    microphones_m: Float32Array
    first_microphone: IntArray
    pairs: IntArray
    scale: Float32Array
    offset: Float32Array


def warm_up() -> None:
    """Run every kernel once, so that nothing is compiled, or read from the compiler's cache, while somebody waits.

    Without a cache, the first time on a machine, it takes some seconds; else a fraction of one.
    """
    spec = ArraySpec("warm-up", np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]]), (100.0, 6000.0))
    grid = Grid(((0.0, 1.0), (0.0, 1.0), (0.0, 1.0)), 0.5)
    lags_s = np.arange(-200, 201) / 400_000.0
    heard = Evidence(spec, GCC(np.array([[0, 1]]), lags_s, np.ones((1, len(lags_s)), dtype=np.float32)))
    search = PeakSearch([spec], grid, 343.0)
    search.prepare(spec.name, lags_s)
    search.among([heard])(2)
    ear = OnsetFrontEnd(spec, 16_000.0, LagSampling.shared(spec.band_hz, 16_000.0, spec.aperture_m / 343.0))
    ear.push(np.zeros((2, 1600), dtype=np.float32), quiet=True)
    SRPMapper(spec, grid, heard.gcc.pairs, lags_s, 343.0)(heard.gcc)
    functional = SRPFunctional([heard], 343.0)
    functional.value(np.zeros((1, 3)))
    laplace_covariance_m2(functional, [heard], np.array([0.5, 0.5, 0.5]), grid)
