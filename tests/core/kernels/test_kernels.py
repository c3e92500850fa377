"""The kernels, compiled and on NumPy, agree with each other and with their definitions."""

from __future__ import annotations

from types import ModuleType

import numpy as np
import pytest

from livessl.core.geometry import microphone_pairs
from livessl.core.kernels import with_numba, with_numpy
from livessl.core.kernels.arguments import NO_LAG, OnsetParameters, OnsetState
from livessl.core.types import ComplexArray, Float32Array

KERNELS = [pytest.param(with_numba, id="numba"), pytest.param(with_numpy, id="NumPy")]
LOW, BINS = 3, 40
PARAMETERS = OnsetParameters(
    least=np.float32(1e-9),
    decay=np.float32(0.95),
    reach=np.float32(2.0),
    loud=np.float32(3.0),
    strongest=np.float32(10.0),
    warm_up=8,
    noise_hops=20,
)


LEARNED = np.array([(0, 1), (0, 2), (1, 2), (0, 0), (1, 1), (2, 2)])


def fresh_state() -> OnsetState:
    zeros = np.zeros((2, BINS), np.float32)
    return OnsetState(np.zeros(2, np.int64), zeros[0], zeros[1], np.zeros((len(LEARNED), BINS), np.complex64))


def spectra_of(frames: int, microphones: int = 3, seed: int = 0) -> ComplexArray:
    rng = np.random.default_rng(seed)
    shape = (frames, microphones, LOW + BINS + 5)
    return (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)).astype(np.complex64)


@pytest.mark.parametrize("kernels", KERNELS)
@pytest.mark.parametrize("noise", [0.0, 3.0, np.inf])
def test_cross_spectra_are_weighed_sums_of_whitened_spectra(kernels: ModuleType, noise: float) -> None:
    spectra = spectra_of(4)
    spectra[:, 0] *= 3.0  # a louder microphone
    spectra[:, 1, LOW + 7] = 0.0  # a silent bin has no phase
    weights = np.random.default_rng(1).random((4, BINS)).astype(np.float32)
    weights[2] = 0.0
    pairs, whitened, levels = microphone_pairs(3), np.empty((3, BINS), np.complex64), np.empty(3)
    noises = np.full((4, BINS), noise, np.float32)
    kernels.cross_spectra(spectra, LOW, pairs, weights, noises, np.empty((0, BINS), np.complex64), whitened, levels)
    inside = spectra[:, :, LOW : LOW + BINS].astype(np.complex128)
    power = np.square(np.abs(inside))
    padded = np.pad(power.mean(axis=1), ((0, 0), (1, 1)), mode="edge")
    mean = ((padded[:, :-2] + padded[:, 1:-1] + padded[:, 2:]) / 3.0)[:, None]
    share = np.minimum(1.0, noise / mean)
    assert noise != 3.0 or 0.05 < (share == 1.0).mean() < 0.95  # some bins are all noise and some are not
    power = (1.0 - share) * power + share * mean
    unit = np.divide(inside, np.sqrt(power), out=np.zeros_like(inside), where=inside != 0)
    for row, (i, k) in enumerate(pairs):
        np.testing.assert_allclose(whitened[row], (weights * np.conj(unit[:, i]) * unit[:, k]).sum(axis=0), atol=2e-5)
    np.testing.assert_allclose(levels, (weights[:, None] * np.square(np.abs(unit))).sum(axis=(0, 2)), rtol=1e-5)
    assert np.abs(whitened.imag).max() > 0.5  # a wrong sign would show
    assert whitened[0, 7] == whitened[2, 7] == 0.0
    if noise == 0.0:
        assert levels[0] == pytest.approx(weights.sum(), rel=1e-5)
    elif noise == np.inf:
        assert levels[0] > 5.0 * levels[2]


def weighed(kernels: ModuleType, quiet: list[bool], level: list[float]) -> tuple[Float32Array | ComplexArray, ...]:
    """Weights of some windows, six to a frame, and the state after them."""
    state = fresh_state()
    all_weights, all_noises = [], []
    for number, (still, loud) in enumerate(zip(quiet, level, strict=True)):
        weights, noises = np.full((2, 6, BINS), np.nan, np.float32)
        spectra = np.float32(loud) * spectra_of(6, seed=number)
        kernels.onset_weights(spectra, LOW, LEARNED, still, PARAMETERS, state, weights, noises)
        all_weights.append(weights)
        all_noises.append(noises)
    return (
        np.concatenate(all_weights),
        np.concatenate(all_noises),
        state.noise,
        state.past,
        state.windows.astype(np.float32),
        state.cross,
    )


def test_both_kinds_of_kernels_give_the_same_weights() -> None:
    quiet, level = [True, True, False, False, True, True], [0.01, 0.02, 1.0, 0.1, 0.5, 0.01]
    said = [weighed(kernels, quiet, level) for kernels in (with_numba, with_numpy)]
    for one, other in zip(*said, strict=True):
        np.testing.assert_allclose(one, other, rtol=2e-4, atol=1e-6)
    weights, noises, last = said[0][:3]
    assert (noises[2] != noises[1]).any()  # the noise as known before each window
    np.testing.assert_allclose(noises[-1], last, rtol=0.2)
    assert not weights[:8].any()  # before the noise is known
    assert weights[12:18].mean() > 10.0 * weights[18:24].mean()  # the onset, and what follows it
    assert weights.max() == PARAMETERS.strongest


@pytest.mark.parametrize("kernels", KERNELS)
def test_the_noise_that_was_learned_is_subtracted(kernels: ModuleType) -> None:
    state, rng = fresh_state(), np.random.default_rng(4)
    mixing = rng.standard_normal((3, 2)) + 1j * rng.standard_normal((3, 2))  # two sources of noise
    drawn = rng.standard_normal((2, 4000, LOW + BINS + 5)) + 1j * rng.standard_normal((2, 4000, LOW + BINS + 5))
    spectra = np.einsum("ms,stf->tmf", mixing, drawn).astype(np.complex64, order="C")
    parameters = PARAMETERS._replace(noise_hops=4000, loud=np.float32(1e9))
    weights, noises = np.empty((2, 4000, BINS), np.float32)
    kernels.onset_weights(spectra, LOW, LEARNED, True, parameters, state, weights, noises)
    first, second = LEARNED.T
    expected = 2.0 * np.conj(mixing) @ mixing.T  # the variance of a draw is 2
    # a mean of 4000 draws of relative deviation 1 is off by 1.6 %, the largest of 240 by some 6 %
    np.testing.assert_allclose(
        state.cross, np.tile(expected[first, second, None], BINS), atol=0.12 * np.abs(expected).max()
    )
    # once the noise's share is subtracted, its windows have no sum left, and hardly any power of their own
    pairs, levels = microphone_pairs(3), np.empty((2, 3))
    whitened = np.empty((2, 3, BINS), np.complex64)
    even, phases_only = np.ones((4000, BINS), np.float32), np.full((4000, BINS), np.inf, np.float32)
    nothing = np.empty((0, BINS), np.complex64)
    kernels.cross_spectra(spectra, LOW, pairs, even, phases_only, nothing, whitened[0], levels[0])
    kernels.cross_spectra(spectra, LOW, pairs, even, phases_only, state.cross, whitened[1], levels[1])
    assert np.abs(whitened[1]).mean() < 0.6 * np.abs(whitened[0]).mean()
    assert (levels[1] < levels[0]).all()
    assert (levels[1] >= 0.0).all()


@pytest.mark.parametrize("kernels", KERNELS)
@pytest.mark.parametrize("reach", [1.0, 1.5, 4.0])
def test_power_that_noise_reaches_by_chance_has_no_weight(kernels: ModuleType, reach: float) -> None:
    parameters = PARAMETERS._replace(reach=np.float32(reach), decay=np.float32(0.0))  # without a past
    levels, power = np.array([0.5, 0.9, 1.1, 2.0, 8.0]) * reach, 3.0
    for level in levels:
        state = fresh_state()
        weights, noises = np.empty((2, 20, BINS), np.float32)
        spectra = np.full((20, 3, LOW + BINS + 5), np.sqrt(power), np.complex64)
        kernels.onset_weights(spectra, LOW, LEARNED, True, parameters, state, weights, noises)
        louder = np.sqrt(np.float32(level)) * spectra[:1]
        kernels.onset_weights(louder, LOW, LEARNED, False, parameters, state, weights[:1], noises[:1])
        direct = max(level - reach, 0.0)  # in units of the noise
        expected = direct**2 / (reach * (reach + 2.0 * direct))
        np.testing.assert_allclose(weights[0], min(expected, parameters.strongest), rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize("kernels", KERNELS)
def test_windows_are_a_hop_apart_and_padded_with_zeros(kernels: ModuleType) -> None:
    samples = np.random.default_rng(0).standard_normal((2, 100)).astype(np.float32)
    window, windows = np.hanning(30).astype(np.float32), np.full((4, 2, 64), np.nan, np.float32)
    kernels.cut_windows(samples, 20, window, windows)
    for t in range(4):
        np.testing.assert_array_equal(windows[t, :, :30], samples[:, 20 * t : 20 * t + 30] * window)
    assert not windows[:, :, 30:].any()


@pytest.mark.parametrize("kernels", KERNELS)
@pytest.mark.parametrize(("factor", "length", "count"), [(1, 50, 42), (3, 50, 14), (3, 9, 1), (4, 8, 0)])
def test_every_so_many_filtered_values_are_kept(kernels: ModuleType, factor: int, length: int, count: int) -> None:
    rng = np.random.default_rng(1)
    samples, taps = rng.standard_normal((2, length)).astype(np.float32), rng.standard_normal(9).astype(np.float32)
    lower = np.full((2, count), np.nan, np.float32)
    kernels.decimate(samples, taps, factor, lower)
    expected = [[samples[k, factor * n : factor * n + 9] @ taps for n in range(count)] for k in range(2)]
    np.testing.assert_allclose(lower, np.reshape(expected, (2, count)), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("kernels", KERNELS)
def test_mean_square_excludes_lags_near_the_peak(kernels: ModuleType) -> None:
    lags_s = np.arange(-20, 21) / 1000.0
    values = np.ones((2, 41), np.float32)
    values[0, 18:23] = 5.0  # within 2.5 ms of zero
    at_s = np.array([0.0, 1.0])
    assert kernels.mean_square(values, lags_s, at_s, 2.5e-3) == pytest.approx(1.0)
    assert kernels.mean_square(values, lags_s, at_s, -1.0) == pytest.approx((5 * 25 + 77) / 82)
    assert kernels.mean_square(values, lags_s, at_s, 3.0) == 0.0


def test_both_kinds_of_kernels_give_the_same_cell_intervals() -> None:
    axes = tuple(np.arange(count, dtype=np.float32) * np.float32(0.11) for count in (7, 9, 5))
    microphones_m = np.random.default_rng(0).uniform(0.0, 1.0, (4, 3)).astype(np.float32)
    pairs = microphone_pairs(4).astype(np.int32)
    corners, strides = np.array([[0, 0, 0], [0, 4, 0], [4, 0, 4]]), np.array([1, 2, 1])
    places = np.float32(300.0), np.float32(500.5)
    ends = []
    for kernels in (with_numba, with_numpy):
        low, high = np.empty((2, len(pairs), 3, 8), np.uint16)
        kernels.cell_intervals(axes, corners, strides, 2, 2, microphones_m, pairs, *places, low, high)
        without = low == NO_LAG
        assert (high[without] == 0).all()
        assert without.any()
        assert (low <= high)[~without].all()
        assert (low < high).any()
        assert high.max() < NO_LAG
        ends.append((low, high))
    np.testing.assert_array_equal(ends[0], ends[1])
