"""The kernels on NumPy alone: what always works, and what the compiled ones are held against.

Sums run in one order everywhere, over the pairs of an array and then over the arrays. Rounding to float32 keeps the
order of numbers, so a sum of maxima is never below the sum of any of the numbers that they are maxima of, rounding
included: the bounds are exact.

Throughout, R is the rows (all pairs of all arrays of a search, one after the other), L the lags, A the arrays, M their
microphones, C the cells. Lags are places on the fine axis: `int((|r - r_k| - |r - r_i|) * scale + offset)` in float32.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from livessl.core.types import BoolArray, ComplexArray, Float32Array, FloatArray, IntArray, RealArray, UInt16Array

if TYPE_CHECKING:
    from scipy.sparse import csr_array

NAME: Final = "NumPy"

SUM: Final = 0
PRODUCT: Final = 1
MINIMUM: Final = 2

BLOCKS: Final = 256
"""Blocks that a lag axis is divided into, at most, for the bounds."""

RUNS: Final = np.array([1, 2, 3, *(q << k for k in range(6) for q in (4, 5, 6, 7)), BLOCKS])
"""Lengths, in blocks, of the runs whose maxima are kept: none is more than a quarter longer than the one before."""

NO_LAG: Final = 65535
"""Above every lag: what a cell without nodes begins with."""

SILENT_POWER: Final = np.float32(1e-12)
"""A channel's bins 120 dB below its loudest in the band carry no phase worth whitening: they are rounding."""

_SLAB_NODES: Final = 1 << 15
"""Nodes whose distances are worked out at once: what fits the second-level cache."""

_CELLS_AT_ONCE: Final = 64
"""Most cells whose nodes are looked at together; it begins with few, for mostly few are needed."""


def cut_windows(samples: Float32Array, hop: int, window: Float32Array, windows: Float32Array) -> None:
    """Windows (T, K, n) of sound (K, N), `hop` samples apart: weighed by `window`, and zeros after it."""
    length = len(window)
    cut = np.lib.stride_tricks.sliding_window_view(samples, length, axis=1)[:, ::hop][:, : len(windows)]
    np.multiply(cut.swapaxes(0, 1), window, out=windows[:, :, :length])
    windows[:, :, length:] = 0.0


def cross_spectra(
    spectra: ComplexArray,
    low: int,
    pairs: IntArray,
    weights: Float32Array,
    noise: Float32Array,
    whitened: ComplexArray,
    levels: FloatArray,
) -> None:
    """Whitened cross spectra, sum_t w conj(U_i) U_k, and the microphones' own sums over all bins, sum_t,f w |U_m|^2.

    Whitened is each microphone by its own magnitude, U = X/|X|, or, where there is noise, more and more by the mean
    power P of all: U = X/sqrt((1 - k)|X|^2 + kP), k = min(1, noise/P).

    Parameters
    ----------
    spectra : (T, K, F) complex64
        Of T frames and K microphones.
    low : int
        The first of the band's bins.
    pairs : (P, 2) int64
        Microphones (i, k).
    weights : (T, B) float32
        Of each frame's bins in the band.
    noise : (T, B) float32
        Power up to which only the mean counts; zeros leave phases alone.
    whitened : (P, B) complex64
        The answer.
    levels : (K,) float64
        The microphones' own sums.
    """
    whitened[:], levels[:] = 0.0, 0.0
    first, second = pairs.T
    for spectrum, weight, below in zip(spectra[:, :, low : low + whitened.shape[1]], weights, noise, strict=True):
        power = spectrum.real**2 + spectrum.imag**2
        heard = power > SILENT_POWER * power.max(axis=1, initial=0.0, keepdims=True)
        mean = _smoothed(power.mean(axis=0)[None])
        share = np.divide(np.minimum(below, mean), mean, out=np.zeros_like(mean), where=mean > 0.0)
        power = power + share * (mean - power)
        unit = np.divide(spectrum, np.sqrt(power), out=np.zeros_like(spectrum), where=heard)
        levels += np.square(np.abs(unit)) @ weight
        whitened += (np.conj(unit) * weight)[first] * unit[second]


def onset_weights(
    spectra: ComplexArray, low: int, quiet: bool, heard: IntArray, least: np.float32, decay: np.float32,
    warm_up: int, noise_hops: int, loud: np.float32, strongest: np.float32, noise: Float32Array, past: Float32Array,
    weights: Float32Array, noises: Float32Array,
) -> None:  # fmt: skip
    """Weights of the next windows of one array by how direct they are: `livessl.core.correlate.onset_gcc` says why.

    Parameters
    ----------
    spectra : (T, K, F) complex64
        Of T windows and K microphones.
    low : int
        The first of the band's bins.
    quiet : bool
        Whether the noise is learned from them.
    heard : (2,) int64
        Windows so far, and those of them that were quiet; moves on.
    least, decay, loud, strongest : float32
        Power below which nothing is heard; of the past, from one window to the next; of noise, above which there is
        sound; greatest weight.
    warm_up, noise_hops : int
        Quiet windows, and any windows, after which weights are given; the noise is a mean over `noise_hops`.
    noise, past : (B,) float32
        What is known of the array; changed.
    weights, noises : (T, B) float32
        The answer, and the noise as it was known before each window.
    """
    inside = spectra[:, :, low : low + len(noise)]
    powers = _smoothed((inside.real**2 + inside.imag**2).mean(axis=1))
    weights[:] = 0.0
    for power, weight, below in zip(powers, weights, noises, strict=True):
        if heard[0] == 0:
            noise[:], past[:] = power, power
        if heard[1] >= warm_up or heard[0] >= noise_hops:
            interference = np.maximum(np.maximum(noise, past), least)
            direct = np.maximum(power - interference, 0.0)
            weight[:] = np.minimum(direct**2 / (interference * (interference + 2.0 * direct)), strongest)
        below[:] = noise
        past[:] = np.maximum(past * decay, power)
        heard += (1, quiet)
        if not quiet:
            noise += (np.minimum(power, noise) - noise) / np.float32(noise_hops)
            continue
        if heard[1] > warm_up:
            power = np.minimum(power, loud * np.maximum(noise, least))
        noise += (power - noise) / np.float32(min(int(heard[1]), noise_hops))


def _smoothed(powers: Float32Array) -> Float32Array:
    """Mean over three bins, the transform's resolution before its zero padding."""
    padded = np.pad(powers, ((0, 0), (1, 1)), mode="edge")
    return np.asarray((padded[:, :-2] + padded[:, 1:-1] + padded[:, 2:]) / np.float32(3.0))


def lag_places(
    nodes_m: Float32Array, microphones_m: Float32Array, pairs: IntArray, scale: np.float32, offset: np.float32
) -> IntArray:
    """Place of each pair's delay on the fine lag axis, of nodes (N, 3): (P, N) int32."""
    x, y, z = (nodes_m[:, axis] - microphones_m[:, axis, None] for axis in range(3))
    distance = np.sqrt((x * x + y * y) + z * z)
    return np.asarray(((distance[pairs[:, 1]] - distance[pairs[:, 0]]) * scale + offset).astype(np.int32))


def cell_intervals(
    x_m: Float32Array, y_m: Float32Array, z_m: Float32Array, microphones_m: Float32Array, pairs: IntArray,
    scale: np.float32, offset: np.float32, edge: int, low: UInt16Array, high: UInt16Array,
) -> None:  # fmt: skip
    """Lowest and highest lag of every pair of one array over the nodes of every cell.

    Parameters
    ----------
    x_m, y_m, z_m : (n,) float32
        The grid's axes.
    microphones_m : (K, 3) float32
    pairs : (P, 2) int32
    scale, offset : float32
        From a difference of distances, m, to a place on the lag axis.
    edge : int
        Nodes along an edge of a cell.
    low, high : (P, C) uint16
        The answer; the cells in the grid's order, z fastest.
    """
    step = max(1, _SLAB_NODES // (len(y_m) * len(z_m) * edge)) * edge
    cells_yz = -(-len(y_m) // edge) * -(-len(z_m) // edge)
    for first in range(0, len(x_m), step):
        slab = x_m[first : first + step]
        place = lag_places(_nodes(slab, y_m, z_m), microphones_m, pairs, scale, offset)
        place = place.reshape(len(pairs), len(slab), len(y_m), len(z_m))
        cells = slice(first // edge * cells_yz, (first // edge + -(-len(slab) // edge)) * cells_yz)
        for extreme, out in ((np.minimum, low), (np.maximum, high)):
            reduced = place
            for axis in (1, 2, 3):
                reduced = extreme.reduceat(reduced, np.arange(0, reduced.shape[axis], edge), axis=axis)
            out[:, cells] = reduced.reshape(len(pairs), -1)


def look_up(values: Float32Array, places: UInt16Array, out: Float32Array) -> None:
    """Bare look-ups, `out = values[places]`, all (N,): how fast a map could be at best."""
    np.take(values, places, out=out, mode="clip")


def look_up_table(places: UInt16Array, columns: int) -> csr_array:
    """What `add_power` wants of the places (G, P) that nodes look up in a pair's values, `columns` long."""
    from scipy.sparse import csr_array  # dear to load, and only needed where numba is missing

    nodes, pairs = places.shape
    flat = places + np.arange(pairs, dtype=np.int32) * np.int32(columns)
    starts = np.arange(0, places.size + 1, pairs, dtype=np.int32)
    ones = np.ones(places.size, dtype=np.float32)
    return csr_array((ones, flat.astype(np.int32).ravel(), starts), shape=(nodes, pairs * columns))


def add_power(values: Float32Array, table: csr_array, weight: np.float32, power: Float32Array) -> None:
    """Add one array's power at every node.

    Parameters
    ----------
    values : (P, L) float32
        The array's GCC.
    table
        `look_up_table` of each node's lags.
    weight : float32
    power : (G,) float32
        Added to.
    """
    power += weight * (table @ values.ravel())


def mean_square(values: RealArray, lags_s: FloatArray, but_s: FloatArray, apart_s: float) -> float:
    """Mean square of a GCC (P, L) at lags further than `apart_s` from one of each pair (P,); 0 for no lags."""
    elsewhere = np.abs(lags_s[None] - but_s[:, None]) > apart_s
    return float((values**2)[elsewhere].mean(dtype=np.float64)) if elsewhere.any() else 0.0


def smooth_power(
    points_m: FloatArray, microphones_m: FloatArray, pairs: IntArray, c_m_s: float, first_s: FloatArray,
    step_s: FloatArray, start: IntArray, last: IntArray, weight: FloatArray, values: RealArray,
) -> FloatArray:  # fmt: skip
    """Summed power at points off the grid, from values between the fine lags.

    Parameters
    ----------
    points_m : (N, 3) float64
    microphones_m : (M, 3) float64
        Of all arrays.
    pairs : (R, 2) int64
        Of rows: into all microphones.
    c_m_s : float
    first_s, step_s : (R,) float64
        The rows' lag axes.
    start : (R,) int64
        Where a row begins among the values.
    last : (R,) int64
        The last place on a row that has two more to its right.
    weight : (R,) float64
    values : (all lags of all rows,) float32 or float64

    Returns
    -------
    (N,) float64
    """
    x, y, z = (points_m[:, axis] - microphones_m[:, axis, None] for axis in range(3))
    distance = np.sqrt((x * x + y * y) + z * z)
    lag_s = (distance[pairs[:, 1]] - distance[pairs[:, 0]]) / c_m_s
    place = (lag_s - first_s[:, None]) / step_s[:, None]
    left, around = neighbours(place, start[:, None], last[:, None], values)
    return np.asarray(weight @ interpolated(place - left, *around)[0])


def neighbours(
    place: FloatArray, start: IntArray, last: IntArray, values: RealArray
) -> tuple[IntArray, tuple[RealArray, ...]]:
    """The lag to the left of a place, and the values before it, at it, after it and after that."""
    left = np.minimum(np.maximum(place.astype(np.int64), 1), last)
    return left, tuple(values[start + left + k] for k in (-1, 0, 1, 2))


def interpolated(
    after_share: FloatArray, before: RealArray, here: RealArray, after: RealArray, beyond: RealArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """R, R' and R'' between fine lags, a lag being 1: differences over four neighbours, R bent by its curvature.

    R must be smooth, for a kink at every fine lag would stop a climb at its ridge. At `OVERSAMPLING` lags a sample the
    highest frequency advances by at most 0.35 rad a lag, so the differences err by less than 2 %.
    """
    here_share = 1.0 - after_share
    slope = 0.5 * (here_share * (after - before) + after_share * (beyond - here))
    curvature = here_share * (after - 2.0 * here + before) + after_share * (beyond - 2.0 * after + here)
    value = here_share * here + after_share * after - 0.5 * here_share * after_share * curvature
    return value, slope, curvature


def running_maxima(values: Float32Array, block: IntArray, maxima: Float32Array) -> None:
    """Maxima of each row over runs of blocks of lags.

    Parameters
    ----------
    values : (R, L) float32
    block : (R,) int64
        Lags in a block.
    maxima : (R, levels * `BLOCKS`) float32
        The answer: of each row, at `level * BLOCKS + b`, the greatest value in the `RUNS[level]` blocks from b on.
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


def bounds(
    maxima: Float32Array, places: UInt16Array, rows: IntArray, first_row: IntArray, weight: Float32Array, rule: int,
    bound: Float32Array,
) -> None:  # fmt: skip
    """What no node of each of some cells exceeds: the fusion of the pairs' highest values over the cell's lags.

    Parameters
    ----------
    maxima : (R, levels * `BLOCKS`) float32
        See `running_maxima`.
    places : (site's pairs, C) uint16
        Where among a row's maxima the one over a run of lags is that holds all of the cell's.
    rows, first_row, weight, rule
        As for `highest`.
    bound : (C,) float32
        The answer.
    """
    joined = _start(rule, len(bound))
    for a in range(len(weight)):
        total = np.zeros(len(bound), dtype=np.float32)
        for r in range(first_row[a], first_row[a + 1]):
            total += maxima[r, places[rows[r]]]
        joined = _joined(rule, joined, weight[a] * total)
    bound[:] = joined


def highest(
    values: Float32Array, maxima: Float32Array, rows: IntArray, first_row: IntArray, weight: Float32Array, rule: int,
    places: UInt16Array, leaf_places: UInt16Array, top_bound: Float32Array, cell_bound: Float32Array,
    bounded: BoolArray, x_m: Float32Array, y_m: Float32Array, z_m: Float32Array, edge: int, per_top: int,
    microphones_m: Float32Array, first_microphone: IntArray, pairs: IntArray, scale: Float32Array,
    offset: Float32Array, boxes: IntArray, most: int,
) -> tuple[int, float, bool]:  # fmt: skip
    """The highest node outside some boxes, by branch and bound: the very one that the whole map would give.

    Cubes of cells are looked into in the order of their bounds, and of their cells those whose bound reaches what is
    known already. Of nodes that are equal the first in the grid's order is taken. With no node outside the boxes the
    value is -inf.

    Parameters
    ----------
    values : (R, L) float32
        GCCs.
    maxima : (R, levels * `BLOCKS`) float32
    rows : (R,) int64
        Which of the site's pairs the search's rows are.
    first_row : (A + 1,) int64
        Where each array's rows begin.
    weight : (A,) float32
    rule : int
        `SUM`, `PRODUCT` of the positive parts or `MINIMUM` over the arrays.
    places : (T, site's pairs, per_top^3) uint16
        Of the cells of each cube: see `bounds`.
    leaf_places : (T per_top^3, site's pairs, 8 or 0) uint16
        Of the halves, along each axis, of each cell; 0 where the nodes of a whole cell are looked at together.
    top_bound : (T,) float32
        Bounds of the cubes.
    cell_bound : (T, per_top^3) float32
    bounded : (T,) bool
        Of which cubes the cells' bounds are known already; both are filled in.
    x_m, y_m, z_m, edge
        As for `cell_intervals`.
    microphones_m : (M, 3) float32
    first_microphone : (A + 1,) int64
    pairs : (R, 2) int64
        Of each row, within its array.
    scale, offset : (A,) float32
    boxes : (E, 3, 2) int64
        First and last node along each axis of what is left out.
    most : int
        Look-ups after which the search gives up: where nothing stands out, and many arrays take part, there is hardly a
        cell that can be left out.

    Returns
    -------
    node : int
    value : float
    proven : bool
        Whether it is the highest; else it is the best of what was looked at.
    """
    shape = (len(x_m), len(y_m), len(z_m))
    tops = tuple(-(-n // (per_top * edge)) for n in shape)
    best, best_node, spent = np.float32(-np.inf), int(np.prod(shape)), 0

    def promising(which: IntArray, first: IntArray, nodes: int, bound: Float32Array) -> _Cells:
        """Of cubes with `nodes` an edge, those that may be better than what is known."""
        last = np.minimum(first + nodes, shape) - 1
        out = (first >= shape).any(axis=1)
        for box in boxes:
            out |= ((first >= box[:, 0]) & (last <= box[:, 1])).all(axis=1)
        bound = np.where(out, np.float32(-np.inf), bound)
        order = np.argsort(-bound, kind="stable")
        order = order[(bound[order] > -np.inf) & (bound[order] >= best)]
        return _Cells(which[order], first[order], bound[order], np.ravel_multi_index(tuple(first[order].T), shape))

    inner = np.stack(np.unravel_index(np.arange(per_top**3), (per_top,) * 3), axis=1) * edge
    halves = leaf_places.shape[2] > 0
    leaf_edge = edge // 2 if halves else edge
    leaf_bound = np.empty((_CELLS_AT_ONCE, 8), dtype=np.float32)
    leaves = np.stack(np.unravel_index(np.arange(8), (2, 2, 2)), axis=1) * leaf_edge
    inmost = np.stack(np.unravel_index(np.arange(leaf_edge**3), (leaf_edge,) * 3), axis=1)
    every = np.arange(len(top_bound))
    corners = np.stack(np.unravel_index(every, tops), axis=1) * (per_top * edge)
    cubes = promising(every, corners, per_top * edge, top_bound)
    while (chosen := cubes.take(best, best_node)) is not None:
        which, first = chosen
        for top in which[~bounded[which]]:
            if spent > most and best > -np.inf:
                return best_node, float(best), False
            spent += per_top**3 * len(rows)
            bounds(maxima, places[top], rows, first_row, weight, rule, cell_bound[top])
            bounded[top] = True
        children = (which[:, None] * per_top**3 + np.arange(per_top**3)).ravel()
        cells = promising(children, (first[:, None] + inner).reshape(-1, 3), edge, cell_bound[which].ravel())
        while (chosen := cells.take(best, best_node)) is not None:
            if spent > most and best > -np.inf:
                return best_node, float(best), False
            which, first = chosen
            for cell in range(len(which) if halves else 0):
                bounds(maxima, leaf_places[which[cell]], rows, first_row, weight, rule, leaf_bound[cell])
            if halves:
                spent += leaf_bound[: len(which)].size * len(rows)
                hopeful = leaf_bound[: len(which)] >= best
                first = (first[:, None] + leaves)[hopeful]
            spent += len(first) * leaf_edge**3 * len(rows)
            at = (first[:, None] + inmost).reshape(-1, 3)
            at = at[(at < shape).all(axis=1)]
            for box in boxes:
                at = at[~((at >= box[:, 0]) & (at <= box[:, 1])).all(axis=1)]
            nodes_m = np.stack([axis_m[at[:, axis]] for axis, axis_m in enumerate((x_m, y_m, z_m))], axis=1)
            fused = _fused(
                nodes_m, values, microphones_m, first_microphone, pairs, scale, offset, first_row, weight, rule
            )
            peak = fused.max(initial=-np.inf)
            if peak >= best and len(fused):
                node = int(np.ravel_multi_index(tuple(at[fused == peak].T), shape).min())
                best_node = node if peak > best else min(node, best_node)
                best = peak
    return best_node, float(best), True


@dataclass
class _Cells:
    """Cubes of nodes in the order of their bounds, taken a few at a time: first one, then twice as many each time."""

    which: IntArray
    first: IntArray
    bound: Float32Array
    corner: IntArray
    _done: int = 0
    _some: int = 1

    def take(self, best: np.float32, best_node: int) -> tuple[IntArray, IntArray] | None:
        """The next ones that may hold a node better than the best or, if equal, before it; None where none is left."""
        while self._done < len(self.which) and self.bound[self._done] >= best:
            now = slice(self._done, self._done + self._some)
            self._done, self._some = now.stop, min(2 * self._some, _CELLS_AT_ONCE)
            bound, corner = self.bound[now], self.corner[now]
            may_hold = (bound > best) | ((bound == best) & (corner < best_node))
            if may_hold.any():
                return self.which[now][may_hold], self.first[now][may_hold]
        return None


def _fused(
    nodes_m: Float32Array, values: Float32Array, microphones_m: Float32Array, first_microphone: IntArray,
    pairs: IntArray, scale: Float32Array, offset: Float32Array, first_row: IntArray, weight: Float32Array, rule: int,
) -> Float32Array:  # fmt: skip
    """Fused power of nodes (N, 3): (N,)."""
    joined = _start(rule, len(nodes_m))
    for a in range(len(weight)):
        own = slice(first_row[a], first_row[a + 1])
        microphones = microphones_m[first_microphone[a] : first_microphone[a + 1]]
        total = np.zeros(len(nodes_m), dtype=np.float32)
        for row, lag in zip(
            values[own], lag_places(nodes_m, microphones, pairs[own], scale[a], offset[a]), strict=True
        ):
            total += row[lag]
        joined = _joined(rule, joined, weight[a] * total)
    return joined


def _start(rule: int, count: int) -> Float32Array:
    return np.full(count, {SUM: 0.0, PRODUCT: 1.0, MINIMUM: np.inf}[rule], dtype=np.float32)


def _joined(rule: int, total: Float32Array, power: Float32Array) -> Float32Array:
    if rule == MINIMUM:
        return np.minimum(total, power)
    if rule == PRODUCT:
        return np.asarray(total * np.maximum(power, np.float32(0.0)))
    return np.asarray(total + power)


def _nodes(x_m: Float32Array, y_m: Float32Array, z_m: Float32Array) -> Float32Array:
    return np.stack([part.ravel() for part in np.meshgrid(x_m, y_m, z_m, indexing="ij")], axis=1)
