"""The peak search compiled by numba: branch and bound over the cells of the grid.

`search_with_numpy` has a function of the same name and arguments for each kernel, with the documentation. Both
implementations find the same points and powers, bit for bit. Kernels that call each other stand in one file, because
numba does not compile a function again when a function of another file changes.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from livessl.core.kernels.arguments import BLOCKS, REACHES, RUNS
from livessl.core.kernels.jit import jit

_CUBES_AT_ONCE: Final = 1
"""Number of cubes whose cells get their upper bounds at one time."""

_CELLS_AT_ONCE: Final = 64
"""Number of cells whose halves get their upper bounds at one time."""

_MANY: Final = 100
"""Number of remaining cells from which the halves get upper bounds before any points are examined."""

_PASSES: Final = 4
"""Number of passes over the remaining cells, which are examined in descending order of their bounds."""

_compiled = jit(error_model="numpy")


@_compiled
def reaching_maxima(values, maxima):  # type: ignore[no-untyped-def]
    """Find the maxima of each row over the lags within each of the first `REACHES` of every lag."""
    length = values.shape[1]
    for r in range(len(values)):
        before, reach = values[r], 0
        for level in range(maxima.shape[1] // length):
            now, further = maxima[r, level * length : (level + 1) * length], REACHES[level] - reach
            after, earlier = before[further:], before[: length - further]  # these and `before` cover the whole reach
            for n in range(further):
                now[n] = max(before[n], after[n])
            for n in range(further, length - further):
                now[n] = max(max(earlier[n - further], after[n]), before[n])
            for n in range(length - further, length):
                now[n] = max(earlier[n - further], before[n])
            before, reach = now, REACHES[level]


@_compiled
def running_maxima(values, block, maxima):  # type: ignore[no-untyped-def]
    """Find the maxima of each row over runs of blocks of lags."""
    length = values.shape[1]
    for r in range(len(values)):
        row, of_blocks, size = values[r], maxima[r], block[r]
        of_blocks[:BLOCKS] = -np.inf
        for b in range(min(BLOCKS, -(-length // size))):
            most = row[b * size]
            for lag in range(b * size + 1, min((b + 1) * size, length)):
                most = max(most, row[lag])
            of_blocks[b] = most
        for level in range(1, maxima.shape[1] // BLOCKS):
            further = RUNS[level] - RUNS[level - 1]
            before, now = of_blocks[(level - 1) * BLOCKS : level * BLOCKS], of_blocks[level * BLOCKS :]
            shifted = before[further:]
            for b in range(len(shifted)):
                now[b] = max(before[b], shifted[b])
            for b in range(BLOCKS - further, BLOCKS):
                now[b] = before[b]


@_compiled
def upper_bounds(maxima, places, rows, bound):  # type: ignore[no-untyped-def]
    """Bound the power of the points of each of some cells."""
    site_pair, first_row, weight = rows.site_pair, rows.first_row, rows.weight
    bound[:] = np.float32(0.0)
    total = np.empty(len(bound), np.float32)
    for a in range(len(weight)):
        total[:] = np.float32(0.0)
        for r in range(first_row[a], first_row[a + 1]):
            row, of_cells = maxima[r], places[site_pair[r]]
            for c in range(len(bound)):
                total[c] += row[of_cells[c]]
        for c in range(len(bound)):
            bound[c] += weight[a] * total[c]


@_compiled
def bounds_of_rest(maxima, places, rows, rounding, cubes, bound):  # type: ignore[no-untyped-def]
    """Bound what the arrays from each on add to the power of the points of the cells of some cubes.

    Rows are the outer loop, so that a row's maxima stay in the first-level cache.
    """
    site_pair, first_row, weight = rows.site_pair, rows.first_row, rows.weight
    cells, arrays = places.shape[2], len(weight)
    total = np.empty((len(cubes), cells), np.float32)
    for cube in cubes:
        bound[cube, :, arrays] = rounding
    for a in range(arrays - 1, -1, -1):
        total[:] = np.float32(0.0)
        for r in range(first_row[a], first_row[a + 1]):
            row = maxima[r]
            for n in range(len(cubes)):
                at, sums = places[cubes[n], site_pair[r]], total[n]
                for c in range(cells):
                    sums[c] += row[at[c]]
        for n in range(len(cubes)):
            of_cells = bound[cubes[n]]
            for c in range(cells):
                of_cells[c, a] = of_cells[c, a + 1] + weight[a] * total[n, c]


@_compiled
def _covered(first, extent, shape, boxes):  # type: ignore[no-untyped-def]
    """Return whether a cube of grid points lies wholly in one of the boxes."""
    for box in boxes:
        inside = True
        for axis in range(3):
            last = min(first[axis] + extent, shape[axis]) - 1
            inside = inside and first[axis] >= box[axis, 0] and last <= box[axis, 1]
        if inside:
            return True
    return False


@_compiled
def _best_of_cell(  # type: ignore[no-untyped-def]  # noqa: C901 - loops
    first, stride, edge, axes, rows, values, boxes, rest, best, best_point, scratch
):
    """Find the best point of one cell, if it is better than the best so far.

    `rest` (A + 1,) bounds what the arrays from each on add: points are dropped once these cannot make up for what is
    missing.
    """
    point, place, floats, distance = scratch
    at_x, at_y, at_z, power, total = floats
    x_m, y_m, z_m = axes
    microphones_m, first_microphone, pairs = rows.microphones_m, rows.first_microphone, rows.pairs
    n_y, n_z, middle, count = len(y_m), len(z_m), stride // 2, 0
    for begin_x in range(first[0], min(first[0] + edge * stride, len(x_m)), stride):
        x = min(begin_x + middle, len(x_m) - 1)
        for begin_y in range(first[1], min(first[1] + edge * stride, n_y), stride):
            y = min(begin_y + middle, n_y - 1)
            for begin_z in range(first[2], min(first[2] + edge * stride, n_z), stride):
                z = min(begin_z + middle, n_z - 1)
                at_x[count], at_y[count], at_z[count], power[count] = x_m[x], y_m[y], z_m[z], np.float32(0.0)
                point[count] = (x * n_y + y) * n_z + z
                count += 1
    for a in range(len(rows.weight)):
        for m in range(first_microphone[a], first_microphone[a + 1]):
            m_x, m_y, m_z = microphones_m[m, 0], microphones_m[m, 1], microphones_m[m, 2]
            to = distance[m - first_microphone[a]]
            for n in range(count):
                d_x, d_y, d_z = at_x[n] - m_x, at_y[n] - m_y, at_z[n] - m_z
                to[n] = np.sqrt((d_x * d_x + d_y * d_y) + d_z * d_z)
        total[:count] = np.float32(0.0)
        scale, offset, weight = rows.scale[a], rows.offset[a], rows.weight[a]
        for r in range(rows.first_row[a], rows.first_row[a + 1]):
            nearer, further, row = distance[pairs[r, 0]], distance[pairs[r, 1]], values[r]
            for n in range(count):
                place[n] = np.int32((further[n] - nearer[n]) * scale + offset)
            for n in range(count):
                total[n] += row[place[n]]
        left, others = 0, rest[a + 1]
        for n in range(count):
            power[n] += weight * total[n]
            left += power[n] + others >= best
        if left == 0:
            return best, best_point
        if 2 * left < count:
            kept = 0
            for n in range(count):
                if power[n] + others >= best:
                    at_x[kept], at_y[kept], at_z[kept], power[kept] = at_x[n], at_y[n], at_z[n], power[n]
                    point[kept] = point[n]
                    kept += 1
            count = kept
    for n in range(count):
        if power[n] > best or (power[n] == best and point[n] < best_point):
            at = (point[n] // (n_y * n_z), point[n] // n_z % n_y, point[n] % n_z)
            if not _covered(at, 1, (len(x_m), n_y, n_z), boxes):
                best, best_point = power[n], point[n]
    return best, best_point


@_compiled
def _best_of_cells(  # type: ignore[no-untyped-def]
    which, values, reaching, rows, cells, of_cells, boxes, best, best_point, lanes, scratch
):
    """Find the best point of many cells, if it is better than the best so far, after bounding them and their halves.

    `which` (N, 5) has the cube, the cell and its first point along each axis. It is changed.
    """
    half, bound = (cells.edge + 1) // 2, lanes[0][3]
    count = _promising(1, which, values.shape[1], reaching, rows, cells, of_cells, best, lanes)
    count = _promising(8, which[:count], values.shape[1], reaching, rows, cells, of_cells, best, lanes)
    for i in range(count):
        stride, of_cell = cells.strides[which[i, 0]], of_cells[which[i, 0], which[i, 1]]
        for h in range(8):
            if bound[8 * i + h] >= best:
                first = (
                    which[i, 2] + h // 4 * half * stride,
                    which[i, 3] + h // 2 % 2 * half * stride,
                    which[i, 4] + h % 2 * half * stride,
                )
                best, best_point = _best_of_cell(
                    first, stride, half, cells.axes, rows, values, boxes, of_cell, best, best_point, scratch
                )
    return best, best_point


@_compiled
def _promising(  # type: ignore[no-untyped-def]  # noqa: C901 - loops
    parts, which, lags, reaching, rows, cells, of_cells, best, lanes
):
    """Bound the parts of cells, all of it or 8 halves, keep the cells of which one may be best, and count them."""
    floats, place, distance = lanes
    x_m, y_m, z_m = cells.axes
    edge, reaches = cells.edge, cells.reaches[0 if parts == 1 else 1]
    at_x, at_y, at_z, bound, total = floats
    microphones_m, first_microphone, pairs = rows.microphones_m, rows.first_microphone, rows.pairs
    count, middle = len(which), np.empty((3, 2), np.float32)
    for i in range(count):
        stride = cells.strides[which[i, 0]]
        part = edge if parts == 1 else (edge + 1) // 2
        for h in range(2):
            middle[0, h] = _middle_of_part(x_m, which[i, 2], h, part, edge, stride)
            middle[1, h] = _middle_of_part(y_m, which[i, 3], h, part, edge, stride)
            middle[2, h] = _middle_of_part(z_m, which[i, 4], h, part, edge, stride)
        for h in range(parts):
            n = parts * i + h
            at_x[n], at_y[n], at_z[n] = middle[0, h >> 2], middle[1, (h >> 1) & 1], middle[2, h & 1]
            bound[n] = np.float32(0.0)
    for a in range(len(rows.weight)):
        for m in range(first_microphone[a], first_microphone[a + 1]):
            m_x, m_y, m_z = microphones_m[m, 0], microphones_m[m, 1], microphones_m[m, 2]
            to = distance[m - first_microphone[a]]
            for n in range(parts * count):
                d_x, d_y, d_z = at_x[n] - m_x, at_y[n] - m_y, at_z[n] - m_z
                to[n] = np.sqrt((d_x * d_x + d_y * d_y) + d_z * d_z)
        total[: parts * count] = np.float32(0.0)
        scale, offset, weight = rows.scale[a], rows.offset[a], rows.weight[a]
        for r in range(rows.first_row[a], rows.first_row[a + 1]):
            nearer, further, row, p = distance[pairs[r, 0]], distance[pairs[r, 1]], reaching[r], rows.site_pair[r]
            for n in range(parts * count):
                place[n] = np.int32((further[n] - nearer[n]) * scale + offset)
            if parts == 1:
                for i in range(count):
                    place[i] += reaches[which[i, 0], which[i, 1], p] * lags
            else:
                for i in range(count):
                    base = np.uint32(reaches[which[i, 0], which[i, 1], p] * lags)
                    for n in range(8 * i, 8 * i + 8):
                        place[n] += base
            for n in range(parts * count):
                total[n] += row[place[n]]
        kept = 0
        for i in range(count):
            rest, left = of_cells[which[i, 0], which[i, 1], a + 1], 0
            for n in range(parts * i, parts * (i + 1)):
                bound[n] += weight * total[n]
                left += bound[n] + rest >= best
            if left:
                if kept < i:
                    for h in range(parts):
                        k, n = parts * kept + h, parts * i + h
                        at_x[k], at_y[k], at_z[k], bound[k] = at_x[n], at_y[n], at_z[n], bound[n]
                    for k in range(5):
                        which[kept, k] = which[i, k]
                kept += 1
        count = kept
        if count == 0:
            break
    return count


@_compiled
def _middle_of_part(axis_m, first, number, part, edge, stride):  # type: ignore[no-untyped-def]
    """Return the middle of a part of a cell, `part` points long, along an axis; any point if it has none."""
    begin, points, end = first + number * part * stride, min(part, edge - number * part), len(axis_m) - 1
    last = begin + (points - 1) * stride
    if last > end:
        last = begin + max(0, end - begin) // stride * stride
    return np.float32(0.5) * (axis_m[min(begin + stride // 2, end)] + axis_m[min(last + stride // 2, end)])


@_compiled
def highest(values, maxima, rows, cells, bounds, boxes, rounding):  # type: ignore[no-untyped-def]  # noqa: C901 - loops
    """Find the highest point outside some boxes, by branch and bound.

    Of every cube only the most promising cell is examined at first. When cells of all cubes are known, those that are
    left are examined from the highest bounds down.
    """
    shape = (len(cells.axes[0]), len(cells.axes[1]), len(cells.axes[2]))
    of_cubes, of_cells, known, reaching, reaching_known = bounds
    per_cube, edge = cells.per_cube, cells.edge
    scratch = (
        np.empty(edge**3, np.int64), np.empty(edge**3, np.uint32), np.empty((5, edge**3), np.float32),
        np.empty((np.diff(rows.first_microphone).max(), edge**3), np.float32),
    )  # fmt: skip
    lanes = (
        np.empty((5, 8 * _CELLS_AT_ONCE), np.float32), np.empty(8 * _CELLS_AT_ONCE, np.uint32),
        np.empty((np.diff(rows.first_microphone).max(), 8 * _CELLS_AT_ONCE), np.float32),
    )  # fmt: skip
    which, chosen, many = np.empty((_CELLS_AT_ONCE, 5), np.int64), 0, False
    best, best_point = np.float32(-np.inf), np.int64(shape[0] * shape[1] * shape[2])
    first_cube = np.argmax(of_cubes)
    order = np.array([first_cube])
    opened, waiting = np.empty(len(of_cubes), np.int64), np.empty((len(of_cubes), per_cube**3), np.float32)
    count, top = 0, np.float32(-np.inf)
    for turn in range(2 + _PASSES):  # the most promising cube first: with its best point few others are left
        if turn == 1:
            others = np.flatnonzero((of_cubes >= best) & (np.arange(len(of_cubes)) != first_cube))
            order = others[np.argsort(-of_cubes[others])]
        elif turn >= 2:
            order = opened[:count]
            if turn == 2:
                left = 0
                for cube in order:
                    top = max(top, waiting[cube].max())
                    left += (waiting[cube] >= best).sum()
                many = left >= _MANY
                if many and not reaching_known[0]:
                    reaching_maxima(values, reaching)
                    reaching_known[0] = True
        share = np.float32(1 + _PASSES - turn) / np.float32(_PASSES)
        for number in range(len(order)):
            cube = order[number]
            if turn < 2:
                if of_cubes[cube] < best:
                    break
                step = edge * cells.strides[cube]
                if _covered(cells.corners[cube], per_cube * step, shape, boxes):
                    continue
                if not known[cube]:
                    some = order[number : number + _CUBES_AT_ONCE]
                    some = some[(of_cubes[some] >= best) & ~known[some]]
                    bounds_of_rest(maxima, cells.cell_places, rows, rounding, some, of_cells)
                    known[some] = True
                opened[count] = cube
                count += 1
                waiting[cube] = of_cells[cube, :, 0]
            while True:
                cell = np.argmax(waiting[cube])
                bound = waiting[cube, cell]
                threshold = best if turn < 2 else best + share * max(top - best, np.float32(0.0))
                if bound < threshold or bound == -np.inf:
                    break
                waiting[cube, cell] = -np.inf
                step = edge * cells.strides[cube]
                first = (
                    cells.corners[cube, 0] + cell // (per_cube * per_cube) * step,
                    cells.corners[cube, 1] + cell // per_cube % per_cube * step,
                    cells.corners[cube, 2] + cell % per_cube * step,
                )
                if first[0] >= shape[0] or first[1] >= shape[1] or first[2] >= shape[2]:
                    continue  # a cube at the volume's edge has cells outside it
                if bound == best and (first[0] * shape[1] + first[1]) * shape[2] + first[2] > best_point:
                    continue
                if _covered(first, step, shape, boxes):
                    continue
                if many:
                    which[chosen, 0], which[chosen, 1] = cube, cell
                    which[chosen, 2], which[chosen, 3], which[chosen, 4] = first
                    chosen += 1
                else:
                    best, best_point = _best_of_cell(
                        first, cells.strides[cube], edge, cells.axes, rows, values, boxes, of_cells[cube, cell], best,
                        best_point, scratch,
                    )  # fmt: skip
                if chosen == _CELLS_AT_ONCE:
                    best, best_point = _best_of_cells(
                        which, values, reaching, rows, cells, of_cells, boxes, best, best_point, lanes, scratch
                    )
                    chosen = 0
                if turn == 1:
                    break
        if chosen:
            best, best_point = _best_of_cells(
                which[:chosen], values, reaching, rows, cells, of_cells, boxes, best, best_point, lanes, scratch
            )
            chosen = 0
    return best_point, best
