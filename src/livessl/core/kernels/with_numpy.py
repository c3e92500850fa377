"""The kernels on NumPy alone, the reference for numba's: decimation, PHAT, onset weights, maps, power off the grid.

The kernels of the search are in `search_with_numpy`. Names of dimensions are those of `arguments`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from livessl.core.kernels.arguments import SILENT_POWER, OnsetParameters, OnsetState, SmoothRows
from livessl.core.kernels.search_with_numpy import bounds_of_rest as bounds_of_rest
from livessl.core.kernels.search_with_numpy import cell_intervals as cell_intervals
from livessl.core.kernels.search_with_numpy import highest as highest
from livessl.core.kernels.search_with_numpy import reaches_of_parts as reaches_of_parts
from livessl.core.kernels.search_with_numpy import running_maxima as running_maxima
from livessl.core.kernels.search_with_numpy import upper_bounds as upper_bounds
from livessl.core.types import ComplexArray, Float32Array, FloatArray, IntArray, RealArray, UInt16Array

if TYPE_CHECKING:
    from scipy.sparse import csr_array

NAME: Final = "NumPy"


def decimate(samples: Float32Array, taps: Float32Array, factor: int, lower: Float32Array) -> None:
    """Filter samples (K, N) by taps and keep every value in `factor`: lower (K, m), m >= 1 only where all taps fit."""
    reach = (lower.shape[1] - 1) * factor + 1
    lower[:] = 0.0
    if lower.shape[1]:
        for t, tap in enumerate(taps):
            lower += tap * samples[:, t : t + reach : factor]


def cut_windows(samples: Float32Array, hop: int, window: Float32Array, windows: Float32Array) -> None:
    """Cut windows (T, K, n) out of samples (K, N), `hop` samples apart: weighed by `window`, then zeros."""
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
    background: ComplexArray,
    whitened: ComplexArray,
    levels: FloatArray,
) -> None:
    """Sum whitened cross spectra over frames, sum_t w conj(U_i) U_k, and each microphone's own, sum_t,f w |U_m|^2.

    The background's part, whitened alike, is subtracted; of a microphone's own power at most all is.

    Each microphone is whitened by its own magnitude, U = X/|X|, or, the more noise there is, by the mean power P of
    all: U = X/sqrt((1 - k)|X|^2 + kP), k = min(1, noise/P).

    Parameters
    ----------
    spectra : (T, K, F) complex64
        Spectra of T frames and K microphones.
    low : int
        First bin of the band.
    pairs : (P, 2) int64
        Microphones (i, k).
    weights : (T, B) float32
        Weights of each frame's bins in the band.
    noise : (T, B) float32
        Power up to which only the mean counts; zeros leave phases alone.
    background : (P + K, B) complex64
        Cross-spectra conj(X_i) X_k of the background, and then the power at each microphone; (0, B) subtracts nothing.
    whitened : (P, B) complex64
        Output: the cross spectra.
    levels : (K,) float64
        Output: the microphones' own sums.
    """
    whitened[:], levels[:] = 0.0, 0.0
    first, second = pairs.T
    for spectrum, weight, below in zip(spectra[:, :, low : low + whitened.shape[1]], weights, noise, strict=True):
        power = spectrum.real**2 + spectrum.imag**2
        has_phase = power > SILENT_POWER * power.max(axis=1, initial=0.0, keepdims=True)
        mean = _smoothed(power.mean(axis=0)[None])
        share = np.divide(np.minimum(below, mean), mean, out=np.zeros_like(mean), where=mean > 0.0)
        power = power + share * (mean - power)
        factor = np.divide(1.0, np.sqrt(power), out=np.zeros_like(power), where=has_phase)
        unit = spectrum * factor
        whitened += (np.conj(unit) * weight)[first] * unit[second]
        own = np.square(np.abs(unit))
        if len(background):
            whitened -= weight * factor[first] * factor[second] * background[: len(pairs)]
            own = np.maximum(own - np.square(factor) * background[len(pairs) :].real, 0.0)
        levels += own @ weight


def onset_weights(
    spectra: ComplexArray,
    low: int,
    pairs: IntArray,
    quiet: bool,
    parameters: OnsetParameters,
    state: OnsetState,
    weights: Float32Array,
    noises: Float32Array,
) -> None:
    """Weigh the next windows of one array by how direct their sound is (`livessl.core.correlate.onset_gcc`).

    Parameters
    ----------
    spectra : (T, K, F) complex64
        Spectra of T windows and K microphones.
    low : int
        First bin of the band.
    pairs : (P + K, 2) int64
        Microphones (i, k) of each row of `state.cross`.
    quiet : bool
        Whether there is no sound in the windows, so that the noise is learned from them.
    parameters : OnsetParameters
    state : OnsetState
        Updated in place.
    weights : (T, B) float32
        Output: the weights.
    noises : (T, B) float32
        Output: power of the noise as it was known before each window.
    """
    windows, noise, past, cross = state
    inside = spectra[:, :, low : low + len(noise)]
    powers = _smoothed((inside.real**2 + inside.imag**2).mean(axis=1))
    weights[:] = 0.0
    for spectrum, power, weight, before in zip(inside, powers, weights, noises, strict=True):
        if windows[0] == 0:
            noise[:], past[:] = power, power
        if windows[1] >= parameters.warm_up or windows[0] >= parameters.noise_hops:
            interference = np.maximum(np.maximum(parameters.reach * noise, past), parameters.least)
            direct = np.maximum(power - interference, 0.0)
            weight[:] = np.minimum(direct**2 / (interference * (interference + 2.0 * direct)), parameters.strongest)
        before[:] = noise
        past[:] = np.maximum(past * parameters.decay, power)
        windows += (1, quiet)
        if not quiet:
            noise += (np.minimum(power, noise) - noise) / np.float32(parameters.noise_hops)
            continue
        kept = power
        if windows[1] > parameters.warm_up:
            kept = np.minimum(power, parameters.loud * np.maximum(noise, parameters.least))
        share = np.float32(1.0) / np.float32(min(int(windows[1]), parameters.noise_hops))
        noise += (kept - noise) * share
        scale = np.divide(kept, power, out=np.zeros_like(power), where=power > 0.0)
        cross += (scale * np.conj(spectrum[pairs[:, 0]]) * spectrum[pairs[:, 1]] - cross) * share


def _smoothed(powers: Float32Array) -> Float32Array:
    """Mean over three bins, the resolution of the transform before its zero padding."""
    padded = np.pad(powers, ((0, 0), (1, 1)), mode="edge")
    return np.asarray((padded[:, :-2] + padded[:, 1:-1] + padded[:, 2:]) / np.float32(3.0))


def look_up(values: Float32Array, places: UInt16Array, out: Float32Array) -> None:
    """Look values up, `out = values[places]`, all (N,): the least that a map can cost, for benchmarks."""
    np.take(values, places, out=out, mode="clip")


def look_up_table(places: UInt16Array, columns: int) -> csr_array:
    """Return the table that `add_power` needs for the places (G, P) of points in a pair's values, `columns` long."""
    from scipy.sparse import csr_array  # slow to load, and only needed where numba is missing

    points, pairs = places.shape
    flat = places + np.arange(pairs, dtype=np.int32) * np.int32(columns)
    starts = np.arange(0, places.size + 1, pairs, dtype=np.int32)
    ones = np.ones(places.size, dtype=np.float32)
    return csr_array((ones, flat.astype(np.int32).ravel(), starts), shape=(points, pairs * columns))


def add_power(values: Float32Array, table: csr_array, weight: np.float32, power: Float32Array) -> None:
    """Add one array's power at every grid point.

    Parameters
    ----------
    values : (P, L) float32
        The array's GCC.
    table
        `look_up_table` of each point's lags.
    weight : float32
    power : (G,) float32
        Increased in place.
    """
    power += weight * (table @ values.ravel())


def mean_square(values: RealArray, lags_s: FloatArray, but_s: FloatArray, apart_s: float) -> float:
    """Mean square of a GCC (P, L) at lags further than `apart_s` from each pair's lag `but_s` (P,); 0 without any."""
    elsewhere = np.abs(lags_s[None] - but_s[:, None]) > apart_s
    return float((values**2)[elsewhere].mean(dtype=np.float64)) if elsewhere.any() else 0.0


def smooth_power(points_m: FloatArray, c_m_s: float, rows: SmoothRows) -> FloatArray:
    """Summed power at points (N, 3) off the grid, interpolated between lags: (N,) float64."""
    x, y, z = (points_m[:, axis] - rows.microphones_m[:, axis, None] for axis in range(3))
    distance = np.sqrt((x * x + y * y) + z * z)
    lag_s = (distance[rows.pairs[:, 1]] - distance[rows.pairs[:, 0]]) / c_m_s
    place = (lag_s - rows.first_s[:, None]) / rows.step_s[:, None]
    left, around = neighbours(place, rows.start[:, None], rows.last[:, None], rows.values)
    return np.asarray(rows.weight @ interpolated(place - left, *around)[0])


def neighbours(
    place: FloatArray, start: IntArray, last: IntArray, values: RealArray
) -> tuple[IntArray, tuple[RealArray, ...]]:
    """Return the lag to the left of each place, and the values one before it, at it, and one and two after it."""
    left = np.minimum(np.maximum(place.astype(np.int64), 1), last)
    return left, tuple(values[start + left + k] for k in (-1, 0, 1, 2))


def interpolated(
    after_share: FloatArray, before: RealArray, here: RealArray, after: RealArray, beyond: RealArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """R, R' and R'' between lags, per lag, from differences of four neighbours, with R curved by R''.

    R must be smooth, for a kink at every lag would stop a climb at its ridge. At `OVERSAMPLING` lags a sample the
    highest frequency advances by at most 0.35 rad a lag, so the differences err by less than 2 %.
    """
    here_share = 1.0 - after_share
    slope = 0.5 * (here_share * (after - before) + after_share * (beyond - here))
    curvature = here_share * (after - 2.0 * here + before) + after_share * (beyond - 2.0 * after + here)
    value = here_share * here + after_share * after - 0.5 * here_share * after_share * curvature
    return value, slope, curvature
