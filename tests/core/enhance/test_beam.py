"""The beam of one array: it passes what comes from the place, and noise less."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sound_at import C_M_S, NORTH, PLACE_M, RATE_HZ, burst, hiss, received, recorded

from livessl.core.enhance.beam import Method, steer, steering_vector
from livessl.core.types import FloatArray

METHODS = get_args(Method)
AT_CENTRE_M = float(np.linalg.norm(NORTH.centre_m - PLACE_M))
coordinate = st.floats(-6.0, 6.0)


def at_centre(sound: FloatArray) -> FloatArray:
    """What a microphone at the array's centre would receive, (n,)."""
    frequencies_hz = np.fft.rfftfreq(len(sound), 1.0 / RATE_HZ)
    delay = np.exp(-2j * np.pi * frequencies_hz * AT_CENTRE_M / C_M_S) / AT_CENTRE_M
    return np.fft.irfft(np.fft.rfft(sound) * delay, len(sound))


def power(signal: FloatArray) -> float:
    return float(np.square(signal[8000:15000]).mean())


@given(x=coordinate, y=coordinate, z=coordinate)
def test_responses_have_the_delays_and_amplitudes_of_the_distances(x: float, y: float, z: float) -> None:
    place_m, frequencies_hz = np.array([x, y, z]), np.array([0.0, 100.0, 150.0])
    response = steering_vector(NORTH, place_m, frequencies_hz, C_M_S)
    far_m = np.linalg.norm(NORTH.microphones_m - place_m, axis=1)
    centre_m = np.linalg.norm(NORTH.centre_m - place_m)
    np.testing.assert_allclose(np.abs(response), np.tile(centre_m / far_m, (3, 1)), rtol=1e-4)
    # a microphone that is further away is later, and a later signal has a falling phase
    slope_rad_s = np.angle(response[2] / response[1]) / (2.0 * np.pi * 50.0)
    np.testing.assert_allclose(slope_rad_s, -(far_m - centre_m) / C_M_S, atol=1e-6)


@pytest.mark.parametrize("method", METHODS)
def test_sound_from_the_place_passes_unchanged_as_at_the_centre(method: Method) -> None:
    sound = burst()
    samples = received(NORTH, sound) + hiss(NORTH, len(sound), 1, 1e-5)
    beam = steer(recorded(NORTH, samples), PLACE_M, C_M_S, method)
    error = beam.apply(np.asarray(samples, dtype=np.float32)) - at_centre(sound)
    assert power(error) < 1e-3 * power(at_centre(sound))  # -30 dB


@pytest.mark.parametrize("method", METHODS)
@settings(max_examples=8)
@given(seed=st.integers(0, 1000), level=st.sampled_from([0.003, 0.01, 0.03]))
def test_noise_of_the_microphones_falls_by_nearly_their_number(method: Method, seed: int, level: float) -> None:
    sound = burst(seed)
    clean, noise = received(NORTH, sound), hiss(NORTH, len(sound), seed, level)
    beam = steer(recorded(NORTH, clean + noise), PLACE_M, C_M_S, method)
    kept, left = (beam.apply(np.asarray(part, dtype=np.float32)) for part in (clean, noise))
    gain = power(kept) / power(left) / np.mean([power(c) / power(n) for c, n in zip(clean, noise, strict=True)])
    assert 10.0 * np.log10(gain) > (5.5 if method == "delay-and-sum" else 4.5)  # of 6.0 for four microphones


def test_minimum_variance_turns_away_from_a_fan_and_delay_and_sum_does_not() -> None:
    sound, fan_m = burst(), np.array([3.5, 0.5, 1.3])
    fan = received(NORTH, np.random.default_rng(5).standard_normal(len(sound)) * 0.02, fan_m)
    clean = received(NORTH, sound)
    samples = clean + fan + hiss(NORTH, len(sound), 2, 1e-4)
    left = {}
    for method in METHODS:
        beam = steer(recorded(NORTH, samples), PLACE_M, C_M_S, method)
        kept, noise = (beam.apply(np.asarray(part, dtype=np.float32)) for part in (clean, fan))
        left[method] = power(noise) / power(kept)
    assert left["mvdr"] < left["delay-and-sum"] / 1.5


def test_without_quiet_the_beam_is_delay_and_sum_and_says_so() -> None:
    samples = received(NORTH, burst())
    sound = recorded(NORTH, samples, hole=slice(0, 6400))
    beam, plain = (steer(sound, PLACE_M, C_M_S, method) for method in ("mvdr", "delay-and-sum"))
    assert not beam.noise_is_known
    np.testing.assert_array_equal(beam.weights, plain.weights)


def test_digital_silence_before_a_sound_is_no_error() -> None:
    samples = received(NORTH, burst())
    samples[:, :6300] = 0.0
    beam = steer(recorded(NORTH, samples), PLACE_M, C_M_S)
    assert np.isfinite(beam.weights).all()
    assert power(beam.apply(np.asarray(samples, dtype=np.float32))) > 0.0


def test_samples_of_another_number_of_channels_are_an_error() -> None:
    with pytest.raises(ValueError, match=r"array 'north': expected samples .* = \(4, 100\), got \(3, 100\)"):
        recorded(NORTH, np.zeros((3, 100)))
