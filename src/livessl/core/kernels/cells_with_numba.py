"""The tables of the peak search compiled by numba: lags of the cells of a grid, which do not depend on the sound.

`search_with_numpy` has a function of the same name for each kernel, and documents it. Both find the same lags, bit for
bit.
"""

from __future__ import annotations

import numpy as np

from livessl.core.kernels.arguments import NO_LAG
from livessl.core.kernels.jit import jit

_compiled = jit(error_model="numpy")


@_compiled
def _coordinates(axis_m, first, stride, at_m):  # type: ignore[no-untyped-def]
    """Find the coordinates of the points of a box along an axis, and how many there are."""
    count = max(0, min(len(at_m), -(-(len(axis_m) - first) // stride)))
    for n in range(count):
        at_m[n] = axis_m[min(first + n * stride + stride // 2, len(axis_m) - 1)]
    return count


@_compiled
def cell_intervals(  # type: ignore[no-untyped-def]
    axes, corners, strides, edge, along, microphones_m, pairs, scale, offset, low, high
):
    """Find the lowest and highest lag of every pair over the points of every cell of some cubes."""
    points = edge * along
    at_x, at_y, at_z = (np.empty(points, np.float32), np.empty(points, np.float32), np.empty(points, np.float32))
    distance = np.empty((len(microphones_m), points * points), np.float32)
    lag = np.empty(points, np.int32)
    low[:] = NO_LAG
    high[:] = 0
    for t in range(len(corners)):
        n_x = _coordinates(axes[0], corners[t, 0], strides[t], at_x)
        n_y = _coordinates(axes[1], corners[t, 1], strides[t], at_y)
        n_z = _coordinates(axes[2], corners[t, 2], strides[t], at_z)
        for x in range(n_x):
            for m in range(len(microphones_m)):
                to, d_x = distance[m], at_x[x] - microphones_m[m, 0]
                for y in range(n_y):
                    d_y = at_y[y] - microphones_m[m, 1]
                    flat = d_x * d_x + d_y * d_y
                    for z in range(n_z):
                        d_z = at_z[z] - microphones_m[m, 2]
                        to[y * n_z + z] = flat + d_z * d_z
                for n in range(n_y * n_z):
                    to[n] = np.sqrt(to[n])
            for p in range(len(pairs)):
                nearer, further = distance[pairs[p, 0]], distance[pairs[p, 1]]
                for y in range(n_y):
                    for z in range(n_z):
                        lag[z] = np.int32((further[y * n_z + z] - nearer[y * n_z + z]) * scale + offset)
                    cell = (x // edge * along + y // edge) * along
                    for begin in range(0, n_z, edge):
                        least, most = lag[begin], lag[begin]
                        for z in range(begin + 1, min(begin + edge, n_z)):
                            least, most = min(least, lag[z]), max(most, lag[z])
                        low[p, t, cell] = min(low[p, t, cell], np.uint16(least))
                        high[p, t, cell] = max(high[p, t, cell], np.uint16(most))
                        cell += 1


@_compiled
def reaches_of_parts(  # type: ignore[no-untyped-def]
    axes, corners, strides, edge, part, along, microphones_m, pairs, scale, offset, reach
):
    """Find the most lags between the middle of any part of a cell and a point in that part."""
    split = -(-edge // part)
    at_x, at_y, at_z = (np.empty(part, np.float32), np.empty(part, np.float32), np.empty(part, np.float32))
    distance = np.empty((len(microphones_m), part**3 + 1), np.float32)
    parts = split * along
    reach[:] = 0
    for t in range(len(corners)):
        for number in range(parts**3):
            b_x, b_y, b_z = number // (parts * parts), number // parts % parts, number % parts
            cell, stride = (b_x // split * along + b_y // split) * along + b_z // split, strides[t]
            begin_x, begin_y, begin_z = b_x % split * part, b_y % split * part, b_z % split * part
            first = (
                corners[t, 0] + (b_x // split * edge + begin_x) * stride,
                corners[t, 1] + (b_y // split * edge + begin_y) * stride,
                corners[t, 2] + (b_z // split * edge + begin_z) * stride,
            )
            n_x = _coordinates(axes[0], first[0], stride, at_x[: min(part, edge - begin_x)])
            n_y = _coordinates(axes[1], first[1], stride, at_y[: min(part, edge - begin_y)])
            n_z = _coordinates(axes[2], first[2], stride, at_z[: min(part, edge - begin_z)])
            count = n_x * n_y * n_z
            if count == 0:
                continue
            middle_x, middle_y, middle_z = _middle(at_x, n_x), _middle(at_y, n_y), _middle(at_z, n_z)
            for m in range(len(microphones_m)):
                to, m_x, m_y, m_z = distance[m], microphones_m[m, 0], microphones_m[m, 1], microphones_m[m, 2]
                for x in range(n_x):
                    d_x = at_x[x] - m_x
                    for y in range(n_y):
                        d_y = at_y[y] - m_y
                        flat = d_x * d_x + d_y * d_y
                        for z in range(n_z):
                            d_z = at_z[z] - m_z
                            to[(x * n_y + y) * n_z + z] = flat + d_z * d_z
                e_x, e_y, e_z = middle_x - m_x, middle_y - m_y, middle_z - m_z
                to[count] = (e_x * e_x + e_y * e_y) + e_z * e_z
                for n in range(count + 1):
                    to[n] = np.sqrt(to[n])
            for p in range(len(pairs)):
                nearer, further = distance[pairs[p, 0]], distance[pairs[p, 1]]
                at = np.int32((further[count] - nearer[count]) * scale + offset)
                low, high = at, at
                for n in range(count):
                    lag = np.int32((further[n] - nearer[n]) * scale + offset)
                    low, high = min(low, lag), max(high, lag)
                reach[p, t, cell] = max(reach[p, t, cell], np.uint16(max(at - low, high - at)))


@_compiled
def _middle(at_m, count):  # type: ignore[no-untyped-def]
    """Return the middle between the first and the last coordinate."""
    return np.float32(0.5) * (at_m[0] + at_m[count - 1])
