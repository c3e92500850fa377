"""GCC-PHAT: sign, unit, band and accuracy of its lags, and zeros for silence."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from free_field import (
    BAND_HZ,
    C_M_S,
    RATE_HZ,
    band_mean_cos,
    burst,
    delayed,
    heard,
    peak_lags_s,
    tetra,
    true_lags_s,
)
from livessl.core.correlate import gcc_phat as module
from livessl.core.correlate.gcc_phat import (
    OVERSAMPLING,
    GCCPhat,
    LagSampling,
    correlated,
    mean_square_angular_frequency,
    microphone_pairs,
)
from livessl.core.correlate.spectra import FrontEnd, averaged, cepstral, fast_length, whole_segment
from livessl.core.geometry import line
from livessl.core.types import GCC, ArraySpec, Float32Array, FloatArray

SOURCE_M = np.array([2.31, 1.17, 0.83])
TETRA = tetra("north", [0.4, 0.2, 1.1])
STEP_S = 1.0 / (OVERSAMPLING * RATE_HZ)

# The parabola through three values of cos(w tau), h apart, is off by at most h (w h)^2 / 24: 0.004 h for 6 kHz at an
# eighth of 16 kHz. The kernel's ripple of 1e-4 moves it by ripple / (curvature h) = 0.004 h more. In all:
PARABOLA = 0.01  # of a fine lag: 0.08 us, or 27 um of sound path


def pair(spacing_m: float = 0.3, band_hz: tuple[float, float] = BAND_HZ) -> ArraySpec:
    return ArraySpec("pair", line(spacing_m, 2), band_hz)


def correlate(spec: ArraySpec, *segments: Float32Array, rate_hz: float = RATE_HZ) -> GCC:
    return GCCPhat(spec, rate_hz, C_M_S)(segments)


def direct_sum(samples: Float32Array, lags_s: FloatArray, low_hz: float, high_hz: float, n_fft: int) -> FloatArray:
    """The definition, for microphones 0 and 1: sum over the bins in the band, in float64, complex."""
    frequency_hz = np.arange(n_fft // 2 + 1) * RATE_HZ / n_fft
    band = (frequency_hz >= low_hz) & (frequency_hz <= high_hz)
    first, second = np.fft.rfft(samples.astype(np.float64), n_fft, axis=1)[:2, band]
    phase = np.conj(first) * second / np.abs(first * second)
    return np.asarray(np.exp(2j * np.pi * np.outer(lags_s, frequency_hz[band])) @ phase / band.sum())


def padded(spec: ArraySpec, n: int) -> int:
    """Length of the FFT for n samples: with enough zeros for every lag."""
    return fast_length(n + LagSampling(spec.band_hz, RATE_HZ, spec.aperture_m / C_M_S).room)


def two_noises(n: int = 3000) -> Float32Array:
    """Two channels, 4 samples apart, each with as much noise of its own, so that R has side lobes everywhere."""
    rng = np.random.default_rng(3)
    sound = delayed(burst(n, 1), [0.0, 4.3 / RATE_HZ])
    return np.asarray(sound + 0.05 * rng.standard_normal((2, n)), dtype=np.float32)


def test_a_positive_lag_means_that_the_sound_reaches_the_second_channel_later() -> None:
    samples = delayed(burst(4000), [0.0, 7.0 / RATE_HZ])
    assert peak_lags_s(correlate(pair(), samples)) == pytest.approx([7.0 / RATE_HZ], abs=PARABOLA * STEP_S)
    mirrored = correlate(pair(), samples[::-1].copy())
    assert peak_lags_s(mirrored) == pytest.approx([-7.0 / RATE_HZ], abs=PARABOLA * STEP_S)


def test_the_sound_reaches_the_nearer_microphone_first() -> None:
    spec = pair()  # microphone 1 at the smaller x, so the nearer one to a source at -x
    samples = heard(spec, [-3.0, 0.4, 0.2], burst(4000))
    assert peak_lags_s(correlate(spec, samples))[0] > 0.2 / C_M_S
    assert peak_lags_s(correlate(spec, heard(spec, [3.0, 0.4, 0.2], burst(4000))))[0] < -0.2 / C_M_S


@settings(deadline=None, max_examples=20)
@given(lag_samples=st.floats(-13.0, 13.0), seed=st.integers(0, 10**6))
def test_lags_of_a_fraction_of_a_sample_are_found(lag_samples: float, seed: int) -> None:
    gcc = correlate(pair(), delayed(burst(2400, seed), [0.0, lag_samples / RATE_HZ]))
    assert peak_lags_s(gcc)[0] == pytest.approx(lag_samples / RATE_HZ, abs=PARABOLA * STEP_S)


def test_a_coherent_sound_gives_the_ideal_peak() -> None:
    lag_s = 4.0 / RATE_HZ + 3 * STEP_S  # on a fine lag, between samples
    gcc = correlate(pair(), delayed(burst(4000), [0.0, lag_s]))
    # 80 dB of the kernel. The band's edges fall on bins: half a bin of the 1500 in the band is 3e-4.
    assert gcc.values.max() == pytest.approx(1.0, abs=2e-4)
    np.testing.assert_allclose(gcc.values[0], band_mean_cos(gcc.lags_s - lag_s, BAND_HZ), atol=1e-3)


def test_loudness_and_colour_do_not_matter() -> None:
    sound = burst(4000)
    coloured = np.fft.irfft(np.fft.rfft(sound) * np.geomspace(1.0, 1e-3, 2001), 4000)
    plain, other = (correlate(pair(), delayed(s, [0.0, 3e-4])) for s in (sound, 50.0 * coloured))
    # float32 keeps 7 digits of the strongest bin, so 4 of one 60 dB below
    np.testing.assert_allclose(other.values, plain.values, atol=1e-3)


def test_unrelated_noises_have_no_peak() -> None:
    samples = 0.1 * np.random.default_rng(8).standard_normal((2, 16000)).astype(np.float32)
    values = correlate(pair(), samples).values
    # Sum of B = 5900 random phases, R ~ N(0, 1/(2B)): s = 0.0092. 5 s over 45 independent lags: once in 4e4 draws.
    assert 0.003 < np.abs(values).max() < 5 * 0.0092


def test_lags_reach_the_aperture_and_little_more() -> None:
    for spec in (pair(0.1), TETRA):
        lags_s = GCCPhat(spec, RATE_HZ, C_M_S).lags_s
        assert spec.aperture_m / C_M_S + 2 * STEP_S <= lags_s[-1] <= spec.aperture_m / C_M_S + 3 / RATE_HZ
        np.testing.assert_allclose(lags_s, -lags_s[::-1], atol=1e-18)
        np.testing.assert_allclose(np.diff(lags_s), STEP_S)


def test_pairs_are_ascending_and_complete() -> None:
    assert microphone_pairs(4).tolist() == [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]]
    assert len(microphone_pairs(16)) == 120


@settings(deadline=None, max_examples=20)
@given(count=st.integers(2, 16), seed=st.integers(0, 10**6))
def test_every_pair_of_two_to_sixteen_microphones_has_its_own_lag(count: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    spec = ArraySpec("any", rng.uniform(-0.2, 0.2, (count, 3)), BAND_HZ)
    source_m = rng.uniform(-3.0, 3.0, 3)
    gcc = correlate(spec, heard(spec, source_m, burst(2400, seed)))
    assert gcc.pairs.tolist() == microphone_pairs(count).tolist()
    np.testing.assert_allclose(peak_lags_s(gcc), true_lags_s(spec.microphones_m, source_m), atol=PARABOLA * STEP_S)


def test_swapped_channels_swap_lags() -> None:
    samples = heard(TETRA, SOURCE_M, burst(3000))
    right = true_lags_s(TETRA.microphones_m, SOURCE_M)
    assert np.abs(peak_lags_s(correlate(TETRA, samples)) - right).max() < PARABOLA * STEP_S
    swapped = peak_lags_s(correlate(TETRA, samples[[1, 0, 2, 3]]))
    assert np.abs(swapped - right).max() > 10 * STEP_S
    np.testing.assert_allclose(swapped, [-right[0], right[3], right[4], right[1], right[2], right[5]], atol=1e-7)


def test_lags_are_seconds_at_any_sampling_rate() -> None:
    sound = burst(12_000, highest=0.32)  # to 7.7 kHz at 48 kHz: every third sample is the same sound at 16 kHz
    fast = heard(TETRA, SOURCE_M, sound, 48_000.0)
    at_48 = peak_lags_s(correlate(TETRA, fast, rate_hz=48_000.0))
    at_16 = peak_lags_s(correlate(TETRA, fast[:, ::3].copy(), rate_hz=16_000.0))
    right = true_lags_s(TETRA.microphones_m, SOURCE_M)
    np.testing.assert_allclose(at_48, right, atol=PARABOLA * STEP_S)
    np.testing.assert_allclose(at_16, right, atol=PARABOLA * STEP_S)
    assert np.abs(right).max() > 10 * STEP_S


TOP_HZ = (6000.0, 7150.0)
"""Band up to 0.447 of the sampling rate, so high that the GCC is the envelope."""


def interpolation_error(samples: Float32Array, band_hz: tuple[float, float]) -> float:
    spec = pair(band_hz=band_hz)
    gcc = correlate(spec, samples)
    chosen = np.random.default_rng(4).choice(len(gcc.lags_s), 100, replace=False)
    expected = direct_sum(samples, gcc.lags_s[chosen], *band_hz, padded(spec, samples.shape[1]))
    assert np.abs(expected).max() > 0.2
    return float(np.abs(gcc.values[0, chosen] - (np.abs(expected) if band_hz == TOP_HZ else expected.real)).max())


@pytest.mark.parametrize("samples", [two_noises(), delayed(burst(3001, 5), [0.0, 3.17 / RATE_HZ]), two_noises(9001)])
@pytest.mark.parametrize("band_hz", [BAND_HZ, TOP_HZ])
def test_fine_lags_agree_with_the_sum_over_the_bins(samples: Float32Array, band_hz: tuple[float, float]) -> None:
    # least squares leave 2e-6 in the mean and 5e-5 at the band's edges; float32 rounds a sum of 6000 to 1e-5
    assert interpolation_error(samples, band_hz) < 3e-5


@pytest.mark.parametrize(("name", "value"), [("_NYQUIST_MARGIN", 0.95), ("_BEYOND", 0), ("_RIDGE", 1e-4)])
def test_the_comparison_with_the_sum_notices_worse_lags(
    monkeypatch: pytest.MonkeyPatch, name: str, value: float
) -> None:
    monkeypatch.setattr(module, name, value)
    module._alike.cache_clear()
    try:
        assert interpolation_error(two_noises(), BAND_HZ) > 2 * 3e-5
    finally:
        module._alike.cache_clear()


@pytest.mark.parametrize("band_hz", [BAND_HZ, TOP_HZ])
def test_lags_by_matrix_and_by_short_fft_agree(monkeypatch: pytest.MonkeyPatch, band_hz: tuple[float, float]) -> None:
    by_matrix = correlate(pair(band_hz=band_hz), two_noises())
    monkeypatch.setattr(module, "_PRODUCT_BINS", 0)
    by_fft = correlate(pair(band_hz=band_hz), two_noises())
    np.testing.assert_allclose(by_matrix.values, by_fft.values, atol=2e-6)
    assert not np.array_equal(by_matrix.values, by_fft.values)  # they are computed in two ways


def test_interpolation_errs_by_two_millionths() -> None:
    """The root mean square error over the band is 2e-6 for the usual array at the usual rate."""
    sampling = LagSampling(BAND_HZ, 44_100.0, 0.5 / C_M_S)
    frequency_hz = np.linspace(*BAND_HZ, 2000)[:, None]
    known, wanted = (np.exp(2j * np.pi * frequency_hz * lags) for lags in (sampling._lags_s, sampling.fine_lags_s))
    error = known @ sampling._weights - wanted
    assert np.sqrt(np.mean(np.abs(error) ** 2)) < 2.5e-6


def test_the_cache_of_matrices_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_MATRICES", 2)
    own_band = pair(band_hz=(101.0, 5901.0))  # matrices are shared by all that correlate in one band
    correlate_again = GCCPhat(own_band, RATE_HZ, C_M_S)
    first, *_ = (correlate_again([two_noises(n)]) for n in (1000, 2000, 3000))
    np.testing.assert_array_equal(correlate_again([two_noises(1000)]).values, first.values)
    assert len(correlate_again._sampling._matrices) == 2


def test_sound_outside_the_band_has_no_effect() -> None:
    low, high = 900.0, 3100.0
    n = 4000
    frequency_hz = np.fft.rfftfreq(n, 1 / RATE_HZ)
    inside = (frequency_hz > low - 50) & (frequency_hz < high + 50)
    spectrum = np.fft.rfft(burst(n, 2))
    wanted = delayed(np.fft.irfft(spectrum * inside, n), [0.0, 5.2 / RATE_HZ])
    other = delayed(np.fft.irfft(spectrum * ~inside, n), [0.0, -9.0 / RATE_HZ])
    both = correlate(pair(band_hz=(low, high)), (wanted + 20.0 * other).astype(np.float32))
    np.testing.assert_allclose(peak_lags_s(both), [5.2 / RATE_HZ], atol=STEP_S)
    all_of_it = correlate(pair(), (wanted + 20.0 * other).astype(np.float32))
    assert peak_lags_s(all_of_it)[0] == pytest.approx(-9.0 / RATE_HZ, abs=STEP_S)


def test_a_band_above_half_the_sampling_rate_is_an_error() -> None:
    with pytest.raises(ValueError, match="array 'pair': band_hz up to 6000 Hz needs a sample rate above 12000 Hz"):
        GCCPhat(pair(), 12_000.0, C_M_S)


def test_silence_gives_zeros() -> None:
    values = correlate(TETRA, np.zeros((4, 800), dtype=np.float32)).values
    assert (values == 0.0).all()


def test_no_segments_give_zeros() -> None:
    assert (correlate(TETRA).values == 0.0).all()


def test_a_dead_channel_gives_zeros_in_its_pairs_only() -> None:
    samples = heard(TETRA, SOURCE_M, burst(2400))
    whole = correlate(TETRA, samples)
    dead = samples.copy()
    dead[1] = 0.0
    gcc = correlate(TETRA, dead)
    touched = (gcc.pairs == 1).any(axis=1)
    assert (gcc.values[touched] == 0.0).all()
    np.testing.assert_array_equal(gcc.values[~touched], whole.values[~touched])
    assert touched.sum() == 3


def test_a_constant_offset_does_not_move_peaks() -> None:
    offset = np.tile(np.array([[0.3], [-0.2], [0.1], [0.5]], dtype=np.float32), 2400)
    sound = heard(TETRA, SOURCE_M, burst(2400))
    gcc = correlate(TETRA, (sound + offset).astype(np.float32))
    # What leaks is the zero padding's edge, 0.1 to 0.5 / (2 pi f / rate) a bin: it is as loud as the sound below some
    # 300 Hz, a twentieth of the band, and in phase at lag 0.
    np.testing.assert_allclose(peak_lags_s(gcc), true_lags_s(TETRA.microphones_m, SOURCE_M), atol=0.1 * STEP_S)


def test_segments_are_weighted_by_their_length() -> None:
    long, short = (heard(TETRA, place, burst(n, n)) for place, n in ((SOURCE_M, 4000), (-SOURCE_M, 1000)))
    both = correlate(TETRA, long, short).values
    expected = 0.8 * correlate(TETRA, long).values + 0.2 * correlate(TETRA, short).values
    np.testing.assert_allclose(both, expected, atol=1e-6)
    assert np.abs(both - correlate(TETRA, long).values).max() > 0.1


def test_one_segment_and_its_two_halves_give_the_same_peak() -> None:
    sound = 0.1 * np.random.default_rng(9).standard_normal(16_000)
    samples = delayed(sound, [0.0, 6.4 / RATE_HZ])
    whole = correlate(pair(), samples)
    halves = correlate(pair(), samples[:, :8000].copy(), samples[:, 8000:].copy())
    right = [6.4 / RATE_HZ]
    np.testing.assert_allclose(peak_lags_s(whole), right, atol=0.1 * STEP_S)
    np.testing.assert_allclose(peak_lags_s(halves), right, atol=0.1 * STEP_S)
    # At either end 6.4 samples of one channel have no partner in the other: an amplitude sqrt(2 * 6.4 / n) of noise, so
    # n = 8000 loses no more of the peak than 4 % and spreads it as noise.
    assert np.abs(halves.values - whole.values).max() < 0.04


HIGH_HZ = (4000.0, 16_000.0)


def high_pair(spacing_m: float = 0.2) -> ArraySpec:
    return ArraySpec("high", line(spacing_m, 2), HIGH_HZ)


@settings(deadline=None, max_examples=20)
@given(lag_samples=st.floats(-25.0, 25.0), seed=st.integers(0, 10**6))
def test_a_high_band_gives_the_envelope(lag_samples: float, seed: int) -> None:
    gcc = correlate(high_pair(), delayed(burst(6000, seed), [0.0, lag_samples / 48_000], 48_000.0), rate_hz=48_000.0)
    assert gcc.values.min() >= 0.0
    # The envelope of 4 to 16 kHz is |sinc(12 kHz tau)|, as wide as a 3.5 kHz tone's crest: bins that round to the
    # band's edges and the kernel's 80 dB move its top by less than a hundredth of an eighth of a sample.
    assert peak_lags_s(gcc)[0] == pytest.approx(lag_samples / 48_000, abs=0.01 / (8 * 48_000))
    ideal = np.abs(np.sinc(12_000.0 * (gcc.lags_s - lag_samples / 48_000)))
    np.testing.assert_allclose(gcc.values[0], ideal, atol=2e-3)


def test_a_low_band_keeps_the_sign() -> None:
    assert correlate(pair(), delayed(burst(4000), [0.0, 0.0])).values.min() < -0.1


def test_the_envelope_begins_at_a_quarter_of_the_band_width() -> None:
    samples = delayed(burst(6000), [0.0, 1e-4], 48_000.0)
    below, above = (
        correlate(ArraySpec("edge", line(0.2, 2), (low, low + 4000.0)), samples, rate_hz=48_000.0).values.min()
        for low in (990.0, 1010.0)
    )
    assert below < -0.1
    assert above >= 0.0


def test_mean_square_angular_frequency_is_the_curvature_of_the_ideal_peak() -> None:
    h_s = 1e-7
    below, at, above = band_mean_cos(np.array([-h_s, 0.0, h_s]), BAND_HZ)
    # the next term is (2 pi 6 kHz h)^2 / 20 = 7e-7; cancellation leaves 1e-16 / 5e-6 of the difference
    assert mean_square_angular_frequency(BAND_HZ) == pytest.approx((2 * at - below - above) / h_s**2, rel=1e-5)


# --- several arrays at once


def noises(count: int, samples: int = 2000, channels: int = 4) -> list[Float32Array]:
    rng = np.random.default_rng(count)
    return [10.0**-k * rng.standard_normal((channels, samples), dtype=np.float32) for k in range(count)]


@pytest.mark.parametrize("front_end", [whole_segment, averaged, cepstral])
@pytest.mark.parametrize("band_hz", [BAND_HZ, (6000.0, 7000.0)])
def test_arrays_correlated_together_give_the_gcc_of_each_alone(
    front_end: FrontEnd, band_hz: tuple[float, float]
) -> None:
    """They differ in level by 20 dB each; rounding of sums of a thousand terms in single precision remains."""
    specs = [ArraySpec(name, TETRA.microphones_m + k, band_hz) for k, name in enumerate(("north", "south", "east"))]
    each = [GCCPhat(spec, RATE_HZ, C_M_S, front_end) for spec in specs]
    sounds = noises(3)
    together = correlated([(one, [sound]) for one, sound in zip(each, sounds, strict=True)])
    for one, sound, gcc in zip(each, sounds, together, strict=True):
        alone = one([sound])
        np.testing.assert_allclose(gcc.values, alone.values, atol=1e-6)
        assert np.abs(alone.values).max() > 0.05
        assert np.array_equal(gcc.pairs, alone.pairs)
        assert np.array_equal(gcc.lags_s, alone.lags_s)


def test_arrays_that_are_not_alike_are_correlated_one_by_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(GCCPhat, "of_each", lambda *_: pytest.fail("these are not alike"))
    tetrahedron, two = GCCPhat(TETRA, RATE_HZ, C_M_S), GCCPhat(pair(), RATE_HZ, C_M_S)
    slower, other = GCCPhat(TETRA, 1.5 * RATE_HZ, C_M_S), GCCPhat(TETRA, RATE_HZ, C_M_S, averaged)
    here, there = noises(2)
    long = noises(2, int(RATE_HZ))
    cases: list[list[tuple[GCCPhat, list[Float32Array]]]] = [
        [(tetrahedron, [here])],
        [(tetrahedron, [here]), (two, [there[:2]])],
        [(tetrahedron, [here]), (slower, [there])],
        [(tetrahedron, [here]), (other, [there])],
        [(tetrahedron, [here]), (tetrahedron, [there[:, 1:]])],
        [(tetrahedron, [here]), (tetrahedron, [here, there])],
        [(tetrahedron, []), (tetrahedron, [])],
        [(tetrahedron, [long[0]]), (tetrahedron, [long[1]])],
    ]
    for sounds in cases:
        for (one, segments), gcc in zip(sounds, correlated(sounds), strict=True):
            assert np.array_equal(gcc.values, one(segments).values)
