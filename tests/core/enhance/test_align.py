"""Signals on one time axis, and the lag between them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sound_at import BAND_HZ, RATE_HZ, burst

from livessl.core.enhance.align import (
    LEAST_PROMINENCE,
    MOST_LAG_S,
    lag_between,
    resampled,
    resampled_mask,
    shifted,
    shifted_mask,
)


@settings(max_examples=20)
@given(lag_s=st.floats(-0.98 * MOST_LAG_S, 0.98 * MOST_LAG_S), seed=st.integers(0, 100), noise=st.floats(0.0, 0.02))
def test_lag_is_found_to_a_quarter_of_a_sample_with_its_sign(lag_s: float, seed: int, noise: float) -> None:
    sound, rng = burst(seed), np.random.default_rng(seed)
    later = shifted(sound, lag_s * RATE_HZ, len(sound))
    first, other = (signal + noise * rng.standard_normal(len(sound)) for signal in (sound, later))
    found = lag_between(first, other, RATE_HZ, BAND_HZ)
    assert found.lag_s == pytest.approx(lag_s, abs=0.25 / RATE_HZ)
    assert found.prominence > LEAST_PROMINENCE


@given(seed=st.integers(0, 200))
@settings(max_examples=20)
def test_lag_of_independent_noise_is_not_believed(seed: int) -> None:
    first, other = np.random.default_rng(seed).standard_normal((2, 12000))
    assert lag_between(first, other, RATE_HZ, BAND_HZ).prominence < LEAST_PROMINENCE


def test_silence_has_no_lag() -> None:
    assert lag_between(np.zeros(100), np.zeros(100), RATE_HZ, BAND_HZ).prominence == 0.0


@given(first=st.floats(-50.0, 250.0))
def test_shift_moves_a_smooth_signal_also_between_samples(first: float) -> None:
    at = np.arange(100.0)

    def bump(at: np.ndarray[tuple[int], np.dtype[np.float64]]) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
        return np.exp(-(((at - 50.0) / 8.0) ** 2))

    moved = shifted(bump(at), first, 200)
    inside = (np.arange(200) > first + 2) & (np.arange(200) < first + 98)
    np.testing.assert_allclose(moved[inside], bump(np.arange(200.0) - first)[inside], atol=1e-6)


@given(first=st.integers(-150, 250), seed=st.integers(0, 9))
def test_mask_moves_with_its_signal(first: int, seed: int) -> None:
    mask = np.random.default_rng(seed).random(100) < 0.5
    moved = shifted_mask(mask, float(first), 200)
    np.testing.assert_array_equal(moved, shifted(mask.astype(float), float(first), 200) > 0.5)


@pytest.mark.parametrize(("from_hz", "to_hz"), [(48000.0, 44100.0), (16000.0, 48000.0), (44100.0, 44100.0)])
def test_another_rate_keeps_a_tone_and_its_time(from_hz: float, to_hz: float) -> None:
    count = round(0.2 * from_hz)
    tone = np.sin(2.0 * np.pi * 440.0 * np.arange(count) / from_hz)
    found = resampled(tone, from_hz, to_hz)
    expected = np.sin(2.0 * np.pi * 440.0 * np.arange(len(found)) / to_hz)
    middle = slice(len(found) // 4, 3 * len(found) // 4)
    np.testing.assert_allclose(found[middle], expected[middle], atol=0.01)
    mask = resampled_mask(np.arange(count) >= count // 2, from_hz, to_hz, len(found))
    assert int(mask.argmax()) == pytest.approx(len(found) // 2, abs=2)
