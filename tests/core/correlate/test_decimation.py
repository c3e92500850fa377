"""A lower sampling rate for a band: nothing of the band is lost, and nothing is folded into it."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.signal
from hypothesis import given, settings
from hypothesis import strategies as st

from free_field import tetra
from livessl.core.correlate.decimation import STOP_DB, Decimator, decimation, low_pass
from livessl.core.correlate.gcc_phat import LagSampling
from livessl.core.correlate.onset_gcc import OnsetFrontEnd
from livessl.core.types import Float32Array

RATES_HZ = (32_000.0, 44_100.0, 48_000.0, 96_000.0, 192_000.0)


@pytest.mark.parametrize(
    ("rate_hz", "high_hz", "factor"),
    [(16e3, 6e3, 1), (44.1e3, 6e3, 3), (48e3, 6e3, 3), (96e3, 6e3, 6), (48e3, 2e3, 10), (48e3, 20e3, 1)],
)
def test_the_rate_is_lowered_as_far_as_the_band_permits(rate_hz: float, high_hz: float, factor: int) -> None:
    assert decimation(rate_hz, (100.0, high_hz)) == factor


@settings(max_examples=25, deadline=None)
@given(rate_hz=st.sampled_from(RATES_HZ), high_hz=st.floats(1500.0, 6000.0))
def test_the_band_passes_and_what_would_be_folded_into_it_does_not(rate_hz: float, high_hz: float) -> None:
    factor = decimation(rate_hz, (100.0, high_hz))
    lower_hz = rate_hz / factor
    frequency_hz, response = scipy.signal.freqz(low_pass(factor, high_hz / rate_hz), worN=8192, fs=rate_hz)
    level_db = 20.0 * np.log10(np.maximum(np.abs(response), 1e-9))
    assert np.abs(level_db[frequency_hz <= high_hz]).max() < 0.1
    assert level_db[frequency_hz >= lower_hz - high_hz].max() < -(STOP_DB - 3.0)  # the length is an estimate


@settings(max_examples=20, deadline=None)
@given(lengths=st.lists(st.integers(0, 900), min_size=1, max_size=8), factor=st.integers(2, 6))
def test_pieces_give_what_the_whole_gives(lengths: list[int], factor: int) -> None:
    samples = np.random.default_rng(sum(lengths)).standard_normal((3, sum(lengths))).astype(np.float32)
    rate_hz = factor * 2.5 * 6000.0
    decimator = Decimator(3, factor, rate_hz, 6000.0)
    pieces = np.split(samples, np.cumsum(lengths)[:-1], axis=1)
    taps = low_pass(factor, 6000.0 / rate_hz)
    expected = scipy.signal.upfirdn(taps, samples, 1, factor, axis=1)
    got = np.concatenate([decimator.push(piece) for piece in pieces], axis=1)
    assert got.shape[1] == -(-samples.shape[1] // factor)
    np.testing.assert_allclose(got, expected[:, : got.shape[1]], atol=2e-6)
    decimator.reset()
    np.testing.assert_array_equal(decimator.push(pieces[0]), got[:, : -(-lengths[0] // factor)])


@pytest.mark.parametrize("rate_hz", RATES_HZ)
@pytest.mark.parametrize("delay_s", [-2e-4, 3e-5, 1.3e-4])
def test_the_correlation_peaks_at_the_delay_whatever_the_rate(rate_hz: float, delay_s: float) -> None:
    """Within 12 µs, 4 mm of the way: the onset of a noise is short, and without decimation it scatters as much."""
    spec = tetra("north", [2.0, 2.0, 1.0], edge_m=0.5)
    sampling = LagSampling.shared(spec.band_hz, rate_hz, spec.aperture_m / 343.0)
    front_end = OnsetFrontEnd(spec, rate_hz, sampling)
    count = round(0.4 * rate_hz)
    sound = _delayed(_noise(count), delay_s, rate_hz)
    time_s = np.arange(count) / rate_hz
    sound += np.float32(2.0) * np.cos(2.0 * np.pi * 0.46 * rate_hz * time_s).astype(np.float32)
    quiet = np.zeros((4, round(0.2 * rate_hz)), np.float32)
    front_end.push(quiet, quiet=True)
    onsets = front_end.push(sound, quiet=False)
    fine = sampling.fine(onsets.lags)
    # pairs of the first microphone, which is not delayed, with the second, which is
    assert sampling.fine_lags_s[int(np.argmax(fine[0]))] == pytest.approx(delay_s, abs=12e-6)


def _noise(count: int) -> Float32Array:
    return np.random.default_rng(4).standard_normal(count).astype(np.float32)


def _delayed(sound: Float32Array, delay_s: float, rate_hz: float) -> Float32Array:
    """Four channels of a sound within 100 to 6000 Hz, the second one delayed."""
    frequency_hz = np.fft.rfftfreq(len(sound), 1.0 / rate_hz)
    spectrum = np.fft.rfft(sound) * ((frequency_hz > 100.0) & (frequency_hz < 6000.0))
    delays_s = np.array([0.0, delay_s, 0.0, 0.0])
    shifted = spectrum * np.exp(-2j * np.pi * frequency_hz * delays_s[:, None])
    return np.fft.irfft(shifted, len(sound), axis=1).astype(np.float32)
