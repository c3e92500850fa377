"""The kernels compiled by numba. Each has a twin of the same name and arguments in `with_numpy`, which documents it.

Kernels of maps and of the search match their twins bit for bit; the other kernels differ only by rounding.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from livessl.core.kernels.arguments import BLOCKS, NO_LAG, RUNS, SILENT_POWER
from livessl.core.kernels.jit import jit

NAME: Final = "numba"

_PASSES: Final = 4
"""Passes in which the cells that are left are examined, from the highest bounds down."""

_compiled = jit(error_model="numpy")


@_compiled
def cell_intervals(  # type: ignore[no-untyped-def]  # noqa: C901 - loops
    axes, corners, strides, edge, along, microphones_m, pairs, scale, offset, low, high
):
    """Find the lowest and highest lag of every pair over the points of every cell of some cubes."""
    x_m, y_m, z_m = axes
    points = edge * along
    distance = np.empty((len(microphones_m), points * points), np.float32)
    lag = np.empty(points * points, np.int32)
    low[:] = NO_LAG
    high[:] = 0
    for t in range(len(corners)):
        stride = strides[t]
        n_x = min(points, -(-(len(x_m) - corners[t, 0]) // stride))
        n_y = min(points, -(-(len(y_m) - corners[t, 1]) // stride))
        n_z = min(points, -(-(len(z_m) - corners[t, 2]) // stride))
        for x in range(n_x):
            at_x = x_m[min(corners[t, 0] + x * stride + stride // 2, len(x_m) - 1)]
            for m in range(len(microphones_m)):
                to, d_x, n = distance[m], at_x - microphones_m[m, 0], 0
                for y in range(n_y):
                    d_y = y_m[min(corners[t, 1] + y * stride + stride // 2, len(y_m) - 1)] - microphones_m[m, 1]
                    flat = d_x * d_x + d_y * d_y
                    for z in range(n_z):
                        d_z = z_m[min(corners[t, 2] + z * stride + stride // 2, len(z_m) - 1)] - microphones_m[m, 2]
                        to[n] = flat + d_z * d_z
                        n += 1
                for k in range(n):
                    to[k] = np.sqrt(to[k])
            for p in range(len(pairs)):
                nearer, further = distance[pairs[p, 0]], distance[pairs[p, 1]]
                for k in range(n_y * n_z):
                    lag[k] = np.int32((further[k] - nearer[k]) * scale + offset)
                least, most, n = low[p, t], high[p, t], 0
                for y in range(n_y):
                    first = (x // edge * along + y // edge) * along
                    for z in range(n_z):
                        cell, here = first + z // edge, np.uint16(lag[n])
                        least[cell], most[cell] = min(least[cell], here), max(most[cell], here)
                        n += 1


@_compiled
def decimate(samples, taps, factor, lower):  # type: ignore[no-untyped-def]
    """Filter samples by taps and keep every value in `factor`."""
    count, length = lower.shape[1], samples.shape[1]
    phases = np.empty((factor, -(-length // factor)), np.float32)
    for k in range(len(samples)):
        row, out = samples[k], lower[k]
        for p in range(factor):  # apart, so that the loop over the values has no gaps
            phase = phases[p]
            for n in range((length - p + factor - 1) // factor):
                phase[n] = row[p + n * factor]
        out[:] = np.float32(0.0)
        for t in range(len(taps)):
            tap, phase = taps[t], phases[t % factor][t // factor :]
            for n in range(count):
                out[n] += tap * phase[n]


@_compiled
def cut_windows(samples, hop, window, windows):  # type: ignore[no-untyped-def]
    """Cut weighed windows out of samples, with zeros after them."""
    length = len(window)
    for t in range(len(windows)):
        for m in range(len(samples)):
            cut, out = samples[m, t * hop : t * hop + length], windows[t, m]
            for n in range(length):
                out[n] = cut[n] * window[n]
            out[length:] = np.float32(0.0)


@_compiled
def cross_spectra(  # type: ignore[no-untyped-def]  # noqa: C901 - loops
    spectra, low, pairs, weights, noise, whitened, levels
):
    """Sum whitened cross spectra over frames, and each microphone's own."""
    microphones, bins = spectra.shape[1], whitened.shape[1]
    real, imaginary = np.empty((microphones, bins), np.float32), np.empty((microphones, bins), np.float32)
    power = np.empty((microphones, bins), np.float32)
    mean, share = np.empty(bins, np.float32), np.empty(bins, np.float32)
    own, summed = np.zeros((microphones, bins), np.float32), np.zeros((2, len(pairs), bins), np.float32)
    together = np.zeros(bins + 2, np.float32)
    one, zero = np.float32(1.0), np.float32(0.0)
    for t in range(len(spectra)):
        weight = weights[t]
        if not weight.any():
            continue
        together[:] = zero
        for m in range(microphones):
            spectrum, u, v, square = spectra[t, m, low : low + bins], real[m], imaginary[m], power[m]
            for b in range(bins):
                u[b], v[b] = spectrum[b].real, spectrum[b].imag
                square[b] = u[b] * u[b] + v[b] * v[b]
                together[b + 1] += square[b]
        together[0], together[bins + 1] = together[1], together[bins]
        for b in range(bins):
            mean[b] = (together[b] + together[b + 1] + together[b + 2]) / np.float32(3 * microphones)
            share[b] = min(noise[t, b], mean[b]) / mean[b] if mean[b] > zero else zero
        for m in range(microphones):
            u, v, square, floor = real[m], imaginary[m], power[m], SILENT_POWER * power[m].max()
            for b in range(bins):
                over = square[b] + share[b] * (mean[b] - square[b])
                factor = one / np.sqrt(over) if square[b] > floor else zero
                u[b] *= factor
                v[b] *= factor
                own[m, b] += weight[b] * (u[b] * u[b] + v[b] * v[b])
        for p in range(len(pairs)):
            u_i, v_i, u_k, v_k = real[pairs[p, 0]], imaginary[pairs[p, 0]], real[pairs[p, 1]], imaginary[pairs[p, 1]]
            of_real, of_imaginary = summed[0, p], summed[1, p]
            for b in range(bins):
                of_real[b] += weight[b] * (u_i[b] * u_k[b] + v_i[b] * v_k[b])
                of_imaginary[b] += weight[b] * (u_i[b] * v_k[b] - v_i[b] * u_k[b])
    for p in range(len(pairs)):
        for b in range(bins):
            whitened[p, b] = complex(summed[0, p, b], summed[1, p, b])
    for m in range(microphones):
        levels[m] = own[m].sum()


@_compiled
def onset_weights(  # type: ignore[no-untyped-def]
    spectra, low, quiet, parameters, state, weights, noises
):
    """Weigh the next windows by how direct their sound is."""
    windows, noise, past = state
    least, warm_up, noise_hops = parameters.least, parameters.warm_up, parameters.noise_hops
    microphones, bins = spectra.shape[1], len(noise)
    one, zero, two, every = np.float32(1.0), np.float32(0.0), np.float32(2.0), np.float32(noise_hops)
    power = np.empty(bins + 2, np.float32)
    smooth = np.empty(bins, np.float32)
    for t in range(len(spectra)):
        weight = weights[t]
        power[:] = zero
        for m in range(microphones):
            spectrum = spectra[t, m, low : low + bins]
            for b in range(bins):
                power[b + 1] += spectrum[b].real * spectrum[b].real + spectrum[b].imag * spectrum[b].imag
        power[0], power[bins + 1] = power[1], power[bins]
        for b in range(bins):
            smooth[b] = (power[b] + power[b + 1] + power[b + 2]) / np.float32(3 * microphones)
        if windows[0] == 0:
            noise[:], past[:] = smooth, smooth
        if windows[1] >= warm_up or windows[0] >= noise_hops:
            for b in range(bins):
                interference = max(max(noise[b], past[b]), least)
                direct = max(smooth[b] - interference, zero)
                weight[b] = min(direct * direct / (interference * (interference + two * direct)), parameters.strongest)
        else:
            weight[:] = zero
        noises[t] = noise
        windows[0] += 1
        windows[1] += quiet
        share = one / np.float32(min(windows[1], noise_hops)) if quiet else one / every
        settled = quiet and windows[1] > warm_up
        for b in range(bins):
            now = smooth[b]
            past[b] = max(past[b] * parameters.decay, now)
            if settled:
                now = min(now, parameters.loud * max(noise[b], least))
            elif not quiet:
                now = min(now, noise[b])
            noise[b] += (now - noise[b]) * share


def look_up_table(places, columns):  # type: ignore[no-untyped-def]  # noqa: ARG001 - as its twin
    """Return the table that `add_power` needs for the places of points: the places themselves."""
    return places


@_compiled
def look_up(values, places, out):  # type: ignore[no-untyped-def]
    """Look values up: the least that a map can cost, for benchmarks."""
    for n in range(len(places)):
        out[n] = values[places[n]]


@_compiled
def add_power(values, table, weight, power):  # type: ignore[no-untyped-def]
    """Add one array's power at every grid point."""
    for point in range(len(table)):
        total = np.float32(0.0)
        for p in range(table.shape[1]):
            total += values[p, table[point, p]]
        power[point] += weight * total


@_compiled
def mean_square(values, lags_s, but_s, apart_s):  # type: ignore[no-untyped-def]
    """Mean square of a GCC away from one lag of each pair."""
    total, count = 0.0, 0
    for p in range(len(values)):
        row, square = values[p], np.float32(0.0)
        for lag in range(len(lags_s)):
            if abs(lags_s[lag] - but_s[p]) > apart_s:
                square += row[lag] * row[lag]
                count += 1
        total += float(square)
    return total / count if count else 0.0


@_compiled
def smooth_power(points_m, c_m_s, rows):  # type: ignore[no-untyped-def]
    """Summed power at points off the grid."""
    microphones_m, pairs, first_s, step_s, start, last, weight, values = rows
    power = np.zeros(len(points_m))
    distance = np.empty(len(microphones_m))
    for n in range(len(points_m)):
        for m in range(len(microphones_m)):
            x, y = points_m[n, 0] - microphones_m[m, 0], points_m[n, 1] - microphones_m[m, 1]
            z = points_m[n, 2] - microphones_m[m, 2]
            distance[m] = np.sqrt((x * x + y * y) + z * z)
        for r in range(len(pairs)):
            lag_s = (distance[pairs[r, 1]] - distance[pairs[r, 0]]) / c_m_s
            place = (lag_s - first_s[r]) / step_s[r]
            left = min(max(np.int64(place), 1), last[r])
            at = np.uint64(start[r] + left)
            one = np.uint64(1)
            before, here, after, beyond = values[at - one], values[at], values[at + one], values[at + one + one]
            share = place - left
            rest = 1.0 - share
            curvature = rest * (after - 2.0 * here + before) + share * (beyond - 2.0 * after + here)
            power[n] += weight[r] * (rest * here + share * after - 0.5 * rest * share * curvature)
    return power


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
def bounds_of_rest(maxima, places, rows, rounding, bound):  # type: ignore[no-untyped-def]
    """Bound what the arrays from each on add to the power of the points of some cells."""
    site_pair, first_row, weight = rows.site_pair, rows.first_row, rows.weight
    cells, arrays = len(bound), len(weight)
    total = np.empty(cells, np.float32)
    bound[:, arrays] = rounding
    for a in range(arrays - 1, -1, -1):
        total[:] = np.float32(0.0)
        for r in range(first_row[a], first_row[a + 1]):
            p = site_pair[r]
            for c in range(cells):
                total[c] += maxima[r, places[p, c]]
        for c in range(cells):
            bound[c, a] = bound[c, a + 1] + weight[a] * total[c]


@_compiled
def _covered(first, extent, shape, boxes):  # type: ignore[no-untyped-def]
    """Whether a cube of grid points lies wholly in one of the boxes."""
    for box in boxes:
        inside = True
        for axis in range(3):
            last = min(first[axis] + extent, shape[axis]) - 1
            inside = inside and first[axis] >= box[axis, 0] and last <= box[axis, 1]
        if inside:
            return True
    return False


@_compiled
def _best_of_leaf(  # type: ignore[no-untyped-def]  # noqa: C901 - loops
    first, stride, edge, axes, rows, values, boxes, rest, best, best_point, scratch
):
    """Find the best point of one leaf, if it is better than the best so far.

    `rest` (A + 1,) bounds what the arrays from each on add: the others are skipped once they cannot make up for what is
    missing.
    """
    x_m, y_m, z_m = axes
    distance, total, power = scratch
    microphones_m, first_microphone, pairs = rows.microphones_m, rows.first_microphone, rows.pairs
    n_x = min(edge, -(-(len(x_m) - first[0]) // stride))
    n_y = min(edge, -(-(len(y_m) - first[1]) // stride))
    n_z = min(edge, -(-(len(z_m) - first[2]) // stride))
    count, middle = n_x * n_y * n_z, stride // 2
    power[:count] = np.float32(0.0)
    for a in range(len(rows.weight)):
        for m in range(first_microphone[a], first_microphone[a + 1]):
            to = distance[m - first_microphone[a]]
            n = 0
            for x in range(n_x):
                d_x = x_m[min(first[0] + x * stride + middle, len(x_m) - 1)] - microphones_m[m, 0]
                for y in range(n_y):
                    d_y = y_m[min(first[1] + y * stride + middle, len(y_m) - 1)] - microphones_m[m, 1]
                    flat = d_x * d_x + d_y * d_y
                    for z in range(n_z):
                        d_z = z_m[min(first[2] + z * stride + middle, len(z_m) - 1)] - microphones_m[m, 2]
                        to[n] = flat + d_z * d_z
                        n += 1
            for n in range(count):
                to[n] = np.sqrt(to[n])
        total[:count] = np.float32(0.0)
        scale, offset, weight = rows.scale[a], rows.offset[a], rows.weight[a]
        for r in range(rows.first_row[a], rows.first_row[a + 1]):
            nearer, further, row = distance[pairs[r, 0]], distance[pairs[r, 1]], values[r]
            for n in range(count):
                total[n] += row[np.uint32(np.int32((further[n] - nearer[n]) * scale + offset))]
        highest = np.float32(-np.inf)
        for n in range(count):
            power[n] += weight * total[n]
            highest = max(highest, power[n])
        if highest + rest[a + 1] < best:
            return best, best_point
    for n in range(count):
        if power[n] >= best:
            x = min(first[0] + n // (n_y * n_z) * stride + middle, len(x_m) - 1)
            y = min(first[1] + n // n_z % n_y * stride + middle, len(y_m) - 1)
            z = min(first[2] + n % n_z * stride + middle, len(z_m) - 1)
            point = (x * len(y_m) + y) * len(z_m) + z
            better = power[n] > best or point < best_point
            if better and not _covered((x, y, z), 1, (len(x_m), len(y_m), len(z_m)), boxes):
                best, best_point = power[n], point
    return best, best_point


@_compiled
def _best_of_cell(  # type: ignore[no-untyped-def]
    first, cube, cell, values, maxima, rows, cells, boxes, rest, best, best_point, parts, rest_of_half, scratch
):
    """Find the best point of one cell, if it is better than the best so far."""
    stride, site_pair, first_row, weight = cells.strides[cube], rows.site_pair, rows.first_row, rows.weight
    count = len(weight)
    if cells.leaf_places.shape[2] == 0:
        return _best_of_leaf(
            first, stride, cells.edge, cells.axes, rows, values, boxes, rest, best, best_point, scratch
        )
    bound, total = parts[count], parts[count + 1]
    bound[:] = np.float32(0.0)
    places = cells.leaf_places[cube * cells.per_cube**3 + cell]
    for a in range(count):
        total[:] = np.float32(0.0)
        for r in range(first_row[a], first_row[a + 1]):
            p = site_pair[r]
            for h in range(8):
                total[h] += maxima[r, places[p, h]]
        highest = np.float32(-np.inf)
        for h in range(8):
            parts[a, h] = weight[a] * total[h]
            bound[h] += parts[a, h]
            highest = max(highest, bound[h])
        if highest + rest[a + 1] < best:
            return best, best_point
    shape, edge = (len(cells.axes[0]), len(cells.axes[1]), len(cells.axes[2])), cells.edge // 2
    rest_of_half[count] = rest[count]
    while True:
        h = np.argmax(bound)
        if bound[h] < best or bound[h] == -np.inf:
            return best, best_point
        bound[h] = -np.inf
        step = edge * stride
        corner = (first[0] + h // 4 * step, first[1] + h // 2 % 2 * step, first[2] + h % 2 * step)
        if corner[0] >= shape[0] or corner[1] >= shape[1] or corner[2] >= shape[2]:
            continue
        for a in range(count - 1, -1, -1):
            rest_of_half[a] = rest_of_half[a + 1] + parts[a, h]
        best, best_point = _best_of_leaf(
            corner, stride, edge, cells.axes, rows, values, boxes, rest_of_half, best, best_point, scratch
        )


@_compiled
def highest(values, maxima, rows, cells, bounds, boxes, rounding):  # type: ignore[no-untyped-def]
    """Find the highest point outside some boxes, by branch and bound.

    Of every cube only the most promising cell is examined at first. When cells of all cubes are known, those that are
    left are examined from the highest bounds down.
    """
    shape = (len(cells.axes[0]), len(cells.axes[1]), len(cells.axes[2]))
    of_cubes, of_cells, known = bounds
    per_cube, edge = cells.per_cube, cells.edge
    arrays, leaf = len(rows.weight), (edge // 2 if cells.leaf_places.shape[2] else edge) ** 3
    scratch = (
        np.empty((np.diff(rows.first_microphone).max(), leaf), np.float32),
        np.empty(leaf, np.float32),
        np.empty(leaf, np.float32),
    )
    parts, rest = np.empty((arrays + 2, 8), np.float32), np.empty(arrays + 1, np.float32)
    best, best_point = np.float32(-np.inf), np.int64(shape[0] * shape[1] * shape[2])
    opened, waiting = np.empty(len(of_cubes), np.int64), np.empty((len(of_cubes), per_cube**3), np.float32)
    count = 0
    first_cube = np.argmax(of_cubes)
    order = np.array([first_cube])
    top = np.float32(-np.inf)
    for turn in range(2 + _PASSES):  # the most promising cube first: with its best point few others are left
        if turn == 1:
            others = np.flatnonzero(of_cubes >= best)
            order = others[np.argsort(-of_cubes[others])]
        elif turn >= 2:
            order = opened[:count]
            if turn == 2:
                for cube in order:
                    top = max(top, waiting[cube].max())
        share = np.float32(1 + _PASSES - turn) / np.float32(_PASSES)
        for cube in order:
            if turn < 2:
                if of_cubes[cube] < best:
                    break
                if (turn == 1 and cube == first_cube) or _covered(
                    cells.corners[cube], per_cube * edge * cells.strides[cube], shape, boxes
                ):
                    continue
                if not known[cube]:
                    bounds_of_rest(maxima, cells.cell_places[cube], rows, rounding, of_cells[cube])
                    known[cube] = True
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
                best, best_point = _best_of_cell(
                    first, cube, cell, values, maxima, rows, cells, boxes, of_cells[cube, cell], best, best_point,
                    parts, rest, scratch,
                )  # fmt: skip
                if turn == 1:
                    break
    return best_point, best
