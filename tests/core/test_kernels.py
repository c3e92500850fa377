"""The listening kernels: compiled and on NumPy they say the same, and what their definitions say."""

from __future__ import annotations

from types import ModuleType

import numpy as np
import pytest

from livessl.core import compiled, vectorised
from livessl.core.gcc import microphone_pairs
from livessl.core.types import ComplexArray, Float32Array

KERNELS = [pytest.param(compiled, id="numba"), pytest.param(vectorised, id="NumPy")]
LOW, BINS = 3, 40
LEAST, DECAY = np.float32(1e-9), np.float32(0.95)
LOUD, STRONGEST = np.float32(3.0), np.float32(10.0)


def spectra_of(frames: int, microphones: int = 3, seed: int = 0) -> ComplexArray:
    rng = np.random.default_rng(seed)
    shape = (frames, microphones, LOW + BINS + 5)
    return (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)).astype(np.complex64)


@pytest.mark.parametrize("kernels", KERNELS)
@pytest.mark.parametrize("phases", [True, False])
def test_cross_spectra_are_weighed_sums_of_what_is_whitened(kernels: ModuleType, phases: bool) -> None:
    spectra = spectra_of(4)
    spectra[:, 0] *= 3.0  # a louder microphone
    spectra[:, 1, LOW + 7] = 0.0  # where a channel is silent nothing is known
    weights = np.random.default_rng(1).random((4, BINS)).astype(np.float32)
    weights[2] = 0.0
    pairs, whitened, levels = microphone_pairs(3), np.empty((3, BINS), np.complex64), np.empty(3)
    kernels.cross_spectra(spectra, LOW, pairs, weights, phases, whitened, levels)
    inside = spectra[:, :, LOW : LOW + BINS].astype(np.complex128)
    power = np.square(np.abs(inside))
    if not phases:
        padded = np.pad(power.mean(axis=1), ((0, 0), (1, 1)), mode="edge")
        power = np.broadcast_to(((padded[:, :-2] + padded[:, 1:-1] + padded[:, 2:]) / 3.0)[:, None], power.shape)
    unit = np.divide(inside, np.sqrt(power), out=np.zeros_like(inside), where=inside != 0)
    for row, (i, k) in enumerate(pairs):
        np.testing.assert_allclose(whitened[row], (weights * np.conj(unit[:, i]) * unit[:, k]).sum(axis=0), atol=2e-5)
    np.testing.assert_allclose(levels, (weights[:, None] * np.square(np.abs(unit))).sum(axis=(0, 2)), rtol=1e-5)
    assert np.abs(whitened.imag).max() > 0.5  # a sign that is turned is seen
    assert whitened[0, 7] == whitened[2, 7] == 0.0
    if phases:
        assert levels[0] == pytest.approx(weights.sum(), rel=1e-5)
    else:
        assert levels[0] > 5.0 * levels[2]


def weighed(kernels: ModuleType, quiet: list[bool], level: list[float]) -> tuple[Float32Array, ...]:
    """Weights of some windows, six to a frame, and what is known after them."""
    heard, noise, past = np.zeros(2, np.int64), np.zeros(BINS, np.float32), np.zeros(BINS, np.float32)
    all_weights = []
    for number, (still, loud) in enumerate(zip(quiet, level, strict=True)):
        weights = np.full((6, BINS), np.nan, np.float32)
        spectra = np.float32(loud) * spectra_of(6, seed=number)
        kernels.onset_weights(spectra, LOW, still, heard, LEAST, DECAY, 8, 20, LOUD, STRONGEST, noise, past, weights)
        all_weights.append(weights)
    return np.concatenate(all_weights), noise, past, heard.astype(np.float32)


def test_weights_are_the_same_by_both() -> None:
    quiet, level = [True, True, False, False, True, True], [0.01, 0.02, 1.0, 0.1, 0.5, 0.01]
    said = [weighed(kernels, quiet, level) for kernels in (compiled, vectorised)]
    for one, other in zip(*said, strict=True):
        np.testing.assert_allclose(one, other, rtol=2e-4, atol=1e-6)
    weights = said[0][0]
    assert not weights[:8].any()  # before the noise is known
    assert weights[12:18].mean() > 10.0 * weights[18:24].mean()  # what comes first, and what comes after it
    assert weights.max() == STRONGEST


@pytest.mark.parametrize("kernels", KERNELS)
def test_windows_are_cut_a_hop_apart_and_filled_up(kernels: ModuleType) -> None:
    samples = np.random.default_rng(0).standard_normal((2, 100)).astype(np.float32)
    window, windows = np.hanning(30).astype(np.float32), np.full((4, 2, 64), np.nan, np.float32)
    kernels.cut_windows(samples, 20, window, windows)
    for t in range(4):
        np.testing.assert_array_equal(windows[t, :, :30], samples[:, 20 * t : 20 * t + 30] * window)
    assert not windows[:, :, 30:].any()


@pytest.mark.parametrize("kernels", KERNELS)
def test_mean_square_leaves_out_what_is_near(kernels: ModuleType) -> None:
    lags_s = np.arange(-20, 21) / 1000.0
    values = np.ones((2, 41), np.float32)
    values[0, 18:23] = 5.0  # within 2.5 ms of zero
    at_s = np.array([0.0, 1.0])
    assert kernels.mean_square(values, lags_s, at_s, 2.5e-3) == pytest.approx(1.0)
    assert kernels.mean_square(values, lags_s, at_s, -1.0) == pytest.approx((5 * 25 + 77) / 82)
    assert kernels.mean_square(values, lags_s, at_s, 3.0) == 0.0
