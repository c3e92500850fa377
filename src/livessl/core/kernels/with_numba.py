"""Kernels that numba compiles: decimation, PHAT, onset weights, maps, power off the grid. `with_numpy` documents them.

Kernels of maps and of the search give the same bits as those functions; the other kernels differ only by rounding.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from livessl.core.kernels.arguments import SILENT_POWER
from livessl.core.kernels.cells_with_numba import cell_intervals as cell_intervals
from livessl.core.kernels.cells_with_numba import reaches_of_parts as reaches_of_parts
from livessl.core.kernels.jit import jit
from livessl.core.kernels.search_with_numba import bounds_of_rest as bounds_of_rest
from livessl.core.kernels.search_with_numba import highest as highest
from livessl.core.kernels.search_with_numba import running_maxima as running_maxima
from livessl.core.kernels.search_with_numba import upper_bounds as upper_bounds

NAME: Final = "numba"

_compiled = jit(error_model="numpy")


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
    spectra, low, pairs, weights, noise, background, whitened, levels
):
    """Sum whitened cross spectra over frames, and each microphone's own, without the background's part."""
    microphones, bins = spectra.shape[1], whitened.shape[1]
    real, imaginary = np.empty((microphones, bins), np.float32), np.empty((microphones, bins), np.float32)
    power = np.empty((microphones, bins), np.float32)
    mean, share = np.empty(bins, np.float32), np.empty(bins, np.float32)
    subtracts = len(background) > 0
    factors = np.empty((microphones, bins), np.float32)
    gains = np.zeros((len(pairs) if subtracts else 0, bins), np.float32)
    below = np.zeros((microphones, bins), np.float32)
    if subtracts:
        below[:] = background[len(pairs) :].real
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
            of_noise, kept = below[m], factors[m]
            for b in range(bins):
                over = square[b] + share[b] * (mean[b] - square[b])
                factor = one / np.sqrt(over) if square[b] > floor else zero
                u[b] *= factor
                v[b] *= factor
                kept[b] = factor
                own[m, b] += weight[b] * (factor * factor * max(square[b] - of_noise[b], zero))
        for p in range(len(pairs)):
            u_i, v_i, u_k, v_k = real[pairs[p, 0]], imaginary[pairs[p, 0]], real[pairs[p, 1]], imaginary[pairs[p, 1]]
            of_real, of_imaginary = summed[0, p], summed[1, p]
            for b in range(bins):
                of_real[b] += weight[b] * (u_i[b] * u_k[b] + v_i[b] * v_k[b])
                of_imaginary[b] += weight[b] * (u_i[b] * v_k[b] - v_i[b] * u_k[b])
            if subtracts:
                gain, f_i, f_k = gains[p], factors[pairs[p, 0]], factors[pairs[p, 1]]
                for b in range(bins):
                    gain[b] += weight[b] * f_i[b] * f_k[b]
    for p in range(len(pairs)):
        for b in range(bins):
            whitened[p, b] = complex(summed[0, p, b], summed[1, p, b])
            if subtracts:
                whitened[p, b] -= gains[p, b] * background[p, b]
    for m in range(microphones):
        levels[m] = own[m].sum()


@_compiled
def onset_weights(  # type: ignore[no-untyped-def]  # noqa: C901 - loops
    spectra, low, pairs, quiet, parameters, state, weights, noises
):
    """Weigh the next windows by how direct their sound is."""
    windows, noise, past, cross = state
    least, reach = parameters.least, parameters.reach
    warm_up, noise_hops = parameters.warm_up, parameters.noise_hops
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
                interference = max(max(reach * noise[b], past[b]), least)
                direct = max(smooth[b] - interference, zero)
                weight[b] = min(direct * direct / (interference * (interference + two * direct)), parameters.strongest)
        else:
            weight[:] = zero
        noises[t] = noise
        windows[0] += 1
        windows[1] += quiet
        share = one / np.float32(min(windows[1], noise_hops)) if quiet else one / every
        settled = quiet and windows[1] > warm_up
        if quiet:
            for p in range(len(pairs)):
                one_m, other_m = spectra[t, pairs[p, 0], low : low + bins], spectra[t, pairs[p, 1], low : low + bins]
                for b in range(bins):
                    now = min(smooth[b], parameters.loud * max(noise[b], least)) if settled else smooth[b]
                    scale = now / smooth[b] if smooth[b] > zero else zero
                    cross[p, b] += (scale * np.conj(one_m[b]) * other_m[b] - cross[p, b]) * share
        for b in range(bins):
            now = smooth[b]
            past[b] = max(past[b] * parameters.decay, now)
            if settled:
                now = min(now, parameters.loud * max(noise[b], least))
            elif not quiet:
                now = min(now, noise[b])
            noise[b] += (now - noise[b]) * share


def look_up_table(places, columns):  # type: ignore[no-untyped-def]  # noqa: ARG001 - as in `with_numpy`
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
