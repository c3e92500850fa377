"""The short-time spectrum and its inverse."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from livessl.core.enhance.stft import WINDOW_S, Stft


@given(length=st.integers(1, 3000), half=st.integers(4, 200), seed=st.integers(0, 99))
def test_inverse_returns_the_samples_at_every_length(length: int, half: int, seed: int) -> None:
    samples = np.random.default_rng(seed).standard_normal(length)
    stft = Stft(2 * half)
    spectra = stft.forward(samples)
    assert spectra.shape[1] == half + 1
    np.testing.assert_allclose(stft.inverse(spectra, length), samples, atol=1e-5)


@given(length=st.integers(200, 3000), begin=st.integers(0, 3000), seed=st.integers(0, 99))
def test_share_is_one_inside_a_mask_and_zero_outside(length: int, begin: int, seed: int) -> None:
    stft, mask = Stft(64), np.arange(length) >= begin
    share = stft.share(mask)
    firsts = (np.arange(len(share)) - 1) * stft.hop
    inside = (firsts >= begin) & (firsts + stft.size <= length)
    np.testing.assert_allclose(share[inside], 1.0)
    np.testing.assert_allclose(share[firsts + stft.size <= begin], 0.0)
    assert np.all((share >= 0.0) & (share <= 1.0 + 1e-12))


@pytest.mark.parametrize("rate_hz", [8000.0, 16000.0, 44100.0, 48000.0, 11025.5])
def test_windows_have_nearly_the_same_length_in_seconds_at_every_rate(rate_hz: float) -> None:
    stft = Stft.of(rate_hz)
    assert stft.size % 2 == 0
    assert stft.size / rate_hz == pytest.approx(WINDOW_S, rel=0.05)
    assert stft.frequencies_hz(rate_hz)[-1] == pytest.approx(rate_hz / 2)
