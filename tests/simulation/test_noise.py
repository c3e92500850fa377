"""The noise of rooms: its level, its spectrum, and how alike it is at two microphones."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from livessl.core.types import Float32Array, FloatArray
from livessl.simulation.noise import (
    BLADES_HZ,
    LOWEST_HZ,
    MAINS_HZ,
    OFF_S,
    ON_S,
    diffuse,
    fan,
    from_one_side,
    hum,
    intermittent,
    music,
    pink,
)

RATE_HZ = 16000.0
C_M_S = 343.0
COUNT = 1 << 17


def power_in(noise: Float32Array, low_hz: float, high_hz: float) -> float:
    frequencies_hz = np.fft.rfftfreq(len(noise), 1.0 / RATE_HZ)
    spectrum = np.abs(np.fft.rfft(noise)) ** 2
    return float(spectrum[(frequencies_hz >= low_hz) & (frequencies_hz < high_hz)].sum() / spectrum.sum())


def coherence(one: Float32Array, other: Float32Array, low_hz: float, high_hz: float) -> float:
    """Real part of the coherence, averaged over a band."""
    spectra = np.fft.rfft(np.stack([one, other]), axis=1)
    frequencies_hz = np.fft.rfftfreq(one.size, 1.0 / RATE_HZ)
    inside = spectra[:, (frequencies_hz >= low_hz) & (frequencies_hz < high_hz)]
    inside = inside / np.sqrt(np.mean(np.abs(inside) ** 2, axis=1, keepdims=True))
    return float(np.mean(inside[0] * np.conj(inside[1])).real)


@pytest.mark.parametrize("octaves", [1, 2, 3])
def test_pink_noise_has_equal_power_in_every_octave(octaves: int) -> None:
    (noise,) = pink(np.random.default_rng(octaves), COUNT, RATE_HZ)
    low_hz = LOWEST_HZ * 2.0**octaves
    # an octave from 200 Hz holds 1600 independent bins, whose sum scatters by 1/sqrt(1600) = 2.5 %
    assert power_in(noise, low_hz, 2.0 * low_hz) == pytest.approx(power_in(noise, 1600.0, 3200.0), rel=0.12)
    assert power_in(noise, 0.0, LOWEST_HZ) < 1e-6
    assert np.square(noise).mean() == pytest.approx(1.0, rel=1e-3)


@given(seed=st.integers(0, 1000))
@settings(max_examples=5)
def test_a_fan_has_half_of_its_power_in_harmonics_of_one_speed(seed: int) -> None:
    noise = fan(np.random.default_rng(seed), COUNT, RATE_HZ)
    assert np.square(noise).mean() == pytest.approx(1.0, rel=1e-3)
    frequencies_hz = np.fft.rfftfreq(COUNT, 1.0 / RATE_HZ)
    spectrum = np.abs(np.fft.rfft(noise)) ** 2

    def near_harmonics(blades_hz: float) -> float:
        """Share of the power that is within 2 % of a harmonic."""
        order = np.maximum(1.0, np.round(frequencies_hz / blades_hz))
        is_near = (np.abs(frequencies_hz - order * blades_hz) < 0.02 * order * blades_hz) & (order <= 8)
        return float(spectrum[is_near].sum() / spectrum.sum())

    speeds_hz = np.arange(BLADES_HZ[0], BLADES_HZ[1] + 1.0)
    shares = [near_harmonics(float(blades_hz)) for blades_hz in speeds_hz]
    assert max(shares) > 0.5
    assert np.median(shares) < 0.4  # at other speeds, there is little but hiss


@given(distance_m=st.floats(0.05, 0.6), seed=st.integers(0, 1000))
@settings(max_examples=8)
def test_microphones_in_a_diffuse_field_have_the_coherence_of_their_distance(distance_m: float, seed: int) -> None:
    microphones_m: FloatArray = np.array([[1.0, 2.0, 1.5], [1.0 + distance_m, 2.0, 1.5], [4.0, 1.0, 2.0]])
    noise = diffuse(np.random.default_rng(seed), microphones_m, COUNT, RATE_HZ, C_M_S)
    assert noise.shape == (3, COUNT)
    np.testing.assert_allclose(np.square(noise).mean(axis=1), 1.0, rtol=1e-3)
    for low_hz in (200.0, 800.0):
        frequencies_hz = np.linspace(low_hz, low_hz + 50.0, 20)
        expected = np.sinc(2.0 * frequencies_hz * distance_m / C_M_S).mean()
        # 50 Hz hold 410 bins: a coherence scatters by at most 1/sqrt(410) = 0.05
        assert coherence(noise[0], noise[1], low_hz, low_hz + 50.0) == pytest.approx(expected, abs=0.2)


def test_noise_is_the_same_for_the_same_seed_and_another_for_another() -> None:
    microphones_m = np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0]])

    def made(seed: int) -> list[Float32Array]:
        rng = np.random.default_rng(seed)
        return [pink(rng, 4000, RATE_HZ), fan(rng, 4000, RATE_HZ), diffuse(rng, microphones_m, 4000, RATE_HZ, C_M_S)]

    for one, same, other in zip(made(1), made(1), made(2), strict=True):
        np.testing.assert_array_equal(one, same)
        assert np.abs(one - other).max() > 0.1


@given(seed=st.integers(0, 1000))
@settings(max_examples=4)
def test_hum_is_harmonics_of_twice_the_mains(seed: int) -> None:
    noise = hum(np.random.default_rng(seed), COUNT, RATE_HZ)
    assert np.square(noise).mean() == pytest.approx(1.0, rel=0.05)
    frequencies_hz = np.fft.rfftfreq(COUNT, 1.0 / RATE_HZ)
    spectrum = np.abs(np.fft.rfft(noise)) ** 2
    near = [
        (np.abs(frequencies_hz - 2.0 * mains_hz * np.maximum(1.0, np.round(frequencies_hz / (2.0 * mains_hz)))) < 1.0)
        for mains_hz in MAINS_HZ
    ]
    shares = [float(spectrum[each].sum() / spectrum.sum()) for each in near]
    assert max(shares) > 0.95  # cutting the tones off spreads them a little
    assert min(shares) < 0.5


@given(seed=st.integers(0, 1000))
@settings(max_examples=4)
def test_intermittent_noise_goes_on_and_off(seed: int) -> None:
    noise = intermittent(np.random.default_rng(seed), COUNT, RATE_HZ)
    assert np.square(noise).mean() == pytest.approx(1.0, rel=1e-3)
    silent = noise == 0.0
    changes = int(np.count_nonzero(np.diff(silent.astype(np.int8))))
    seconds = COUNT / RATE_HZ
    assert 2.0 * seconds / (ON_S[1] + OFF_S[1]) - 3.0 <= changes <= 2.0 * seconds / (ON_S[0] + OFF_S[0]) + 3.0
    assert 0.2 < silent.mean() < 0.9


@given(seed=st.integers(0, 1000))
@settings(max_examples=2, deadline=None)
def test_music_has_notes_and_beats(seed: int) -> None:
    noise = music(np.random.default_rng(seed), 3 * round(RATE_HZ), RATE_HZ)
    assert np.square(noise).mean() == pytest.approx(1.0, rel=1e-3)
    spectrum = np.sort(np.abs(np.fft.rfft(noise)) ** 2)[::-1]
    assert spectrum[: len(spectrum) // 50].sum() > 0.5 * spectrum.sum()  # a fiftieth of the bins: tones
    quarter = round(0.1 * RATE_HZ)
    levels = np.square(noise[: len(noise) // quarter * quarter].reshape(-1, quarter)).mean(axis=1)
    assert levels.max() > 2.0 * levels.min()


@given(seed=st.integers(0, 1000))
@settings(max_examples=8)
def test_noise_from_one_side_arrives_there_first(seed: int) -> None:
    """In the middle of a cross of microphones, one arm hears it before the opposite one, by almost the whole way."""
    arm_m, centre = 0.4, np.array([2.0, 2.0, 1.5])
    ways = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], dtype=np.float64)
    noise = from_one_side(np.random.default_rng(seed), centre + arm_m * ways, 1 << 15, RATE_HZ, C_M_S)
    np.testing.assert_allclose(np.square(noise).mean(axis=1), 1.0, rtol=1e-3)
    spectra = np.fft.rfft(noise, axis=1)
    frequencies_hz = np.fft.rfftfreq(noise.shape[1], 1.0 / RATE_HZ)
    low = (frequencies_hz > LOWEST_HZ) & (frequencies_hz < 200.0)  # the way is less than half a period
    early_s = []
    for first, opposite in ((0, 1), (2, 3), (4, 5)):
        cross = np.vdot(spectra[opposite][low], spectra[first][low])
        early_s.append(float(np.angle(cross)) / (2.0 * np.pi * 150.0))
    ahead = np.abs(early_s) * C_M_S / (2.0 * arm_m)
    # waves within 40 degrees of the side: cos 40 = 0.77 at least, but the level of each wave is drawn
    assert 0.6 < ahead.max() < 1.4
    assert np.sort(ahead)[1] < 0.6
    assert early_s[2] > -0.3 * arm_m / C_M_S  # never from below the floor
