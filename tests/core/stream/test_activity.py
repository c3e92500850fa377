"""Activity: power by its definition, the rule at its very threshold, and the causal form on sounds with a history."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from livessl.core.correlate.band import band_bins, band_power
from livessl.core.stream.activity import THRESHOLD, ActivityParameters, CausalActivity, exact_mask, is_active, runs
from livessl.core.types import FRAME_S, BoolArray, FloatArray

RATE_HZ = 16000.0
BAND_HZ = (100.0, 6000.0)
NOISE = 1e-6
"""Background power, full scale squared: -60 dBFS."""


def sine(frequency_hz: float, amplitude: float, rate_hz: float = RATE_HZ, n: int = 800) -> FloatArray:
    return np.asarray(amplitude * np.sin(2 * np.pi * frequency_hz * np.arange(n) / rate_hz + 0.4))


def causal(power: Iterable[float], parameters: ActivityParameters | None = None) -> BoolArray:
    activity = CausalActivity(parameters or ActivityParameters())
    return np.array([activity.push(float(p)) for p in power])


def noise(frames: int, power: float = NOISE, seed: int = 1) -> FloatArray:
    """Powers of 50 ms frames of white noise: 590 bins from 100 to 6000 Hz, each exponential."""
    return np.asarray(power * np.random.default_rng(seed).gamma(590, 1 / 590, frames))


@pytest.mark.parametrize("rate_hz", [16000.0, 48000.0])
@pytest.mark.parametrize("n", [2400, 2401])
def test_sine_has_half_its_amplitude_squared(rate_hz: float, n: int) -> None:
    frequency_hz = 30 * rate_hz / n  # on a bin, so that nothing leaks
    samples = np.stack([sine(frequency_hz, a, rate_hz, n) for a in (0.8, 0.1)]).astype(np.float32)
    np.testing.assert_allclose(band_power(samples, rate_hz, BAND_HZ), [0.8**2 / 2, 0.1**2 / 2], rtol=1e-5)


def test_sine_outside_the_band_has_no_power() -> None:
    low, high, inside = sine(80.0, 0.5), sine(6020.0, 0.5), sine(1000.0, 0.01)
    samples = np.stack([low + high + 0.3, low + high + 0.3 + inside]).astype(np.float32)
    # what rounding to float32 leaves: (6e-8)^2
    np.testing.assert_allclose(band_power(samples, RATE_HZ, BAND_HZ), [0.0, 0.01**2 / 2], rtol=1e-4, atol=1e-12)


def test_band_includes_its_edges() -> None:
    for frequency_hz, power in ((80.0, 0.0), (100.0, 0.5), (6000.0, 0.5), (6020.0, 0.0)):
        samples = sine(frequency_hz, 1.0)[None].astype(np.float32)
        assert band_power(samples, RATE_HZ, BAND_HZ)[0] == pytest.approx(power, abs=1e-6)


def test_power_of_the_whole_band_is_the_mean_square() -> None:
    samples = (0.1 * np.random.default_rng(5).standard_normal((3, 801))).astype(np.float32)
    samples -= samples.mean(axis=1, keepdims=True)  # the bin at 0 Hz is in no band; an odd n has no Nyquist bin
    np.testing.assert_allclose(band_power(samples, RATE_HZ, (0.0, 8000.0)), (samples**2).mean(axis=1), rtol=1e-4)


def test_no_samples_have_no_power() -> None:
    assert band_power(np.zeros((4, 0), dtype=np.float32), RATE_HZ, BAND_HZ).tolist() == [0.0] * 4


@pytest.mark.parametrize(
    ("band_hz", "expected"),
    [((100.0, 6000.0), (5, 301)), ((0.0, 6000.0), (1, 301)), ((101.0, 5999.0), (6, 300)), ((100.0, 9000.0), (5, 401))],
)
def test_bins_lie_in_the_band_and_never_at_zero(band_hz: tuple[float, float], expected: tuple[int, int]) -> None:
    assert band_bins(800, RATE_HZ, band_hz) == expected  # of 20 Hz


def test_frame_at_the_threshold_is_active() -> None:
    assert THRESHOLD == 0.1  # the paper's
    below = np.nextafter(0.25, 0.0)
    assert is_active(np.array([below, 0.25, 1.0]), 1.0, 0.25).tolist() == [False, True, True]
    assert is_active(np.array([2.0, 2.0]), np.array([20.0, 20.1])).tolist() == [True, False]


def test_frame_without_power_is_never_active() -> None:
    assert is_active(np.zeros(2), 0.0).tolist() == [False, False]
    assert exact_mask(np.zeros(3)).tolist() == [False] * 3
    assert exact_mask(np.zeros(0)).tolist() == []


def test_exact_rule_refers_to_the_maximum_of_the_event() -> None:
    power = np.array([0.05, 0.5, 0.3, 0.019, 0.02, 0.2, 0.01])
    assert exact_mask(power, 0.04).tolist() == [True, True, True, False, True, True, False]
    assert exact_mask(power).tolist() == [True, True, True, False, False, True, False]
    assert exact_mask(1e-6 * power).tolist() == exact_mask(power).tolist()


def test_runs_are_half_open_intervals() -> None:
    assert runs(np.array([True, True, False, True, False, False, True])) == [(0, 2), (3, 4), (6, 7)]
    assert runs(np.array([False, True, False])) == [(1, 2)]
    assert runs(np.zeros(3, dtype=np.bool_)) == runs(np.zeros(0, dtype=np.bool_)) == []


@given(mask=arrays.arrays(np.bool_, st.integers(0, 40)))
def test_runs_cover_exactly_the_active_frames(mask: BoolArray) -> None:
    again = np.zeros_like(mask)
    for start, stop in runs(mask):
        assert not again[max(0, start - 1) : stop].any()  # apart, and in order
        again[start:stop] = True
    np.testing.assert_array_equal(again, mask)


def test_steady_noise_is_not_sound() -> None:
    # the very first frame is: nothing is known yet; the segmenter's warm-up is there for it
    assert not causal(noise(4000))[1:].any()


def test_click_after_noise_is_sound() -> None:
    power = noise(100)
    power[80] += 100 * NOISE
    assert np.flatnonzero(causal(power)[1:]).tolist() == [79]


def test_sound_must_exceed_the_background_by_the_floor_factor() -> None:
    for times, sound in ((3.9, False), (4.0, True)):
        assert causal([NOISE] * 50 + [times * NOISE])[-1] == sound


def test_least_power_is_where_the_rule_begins_to_hold() -> None:
    for parameters in (ActivityParameters(), ActivityParameters(floor_factor=9.0), ActivityParameters(min_power=0.5)):
        least = parameters.least_power(NOISE)
        for times, active in ((0.999, False), (1.001, True)):
            activity = CausalActivity(parameters)
            activity.prime(NOISE)
            assert activity.push(times * least) == active


def test_primed_background_applies_from_the_first_frame() -> None:
    activity = CausalActivity(ActivityParameters())
    activity.prime(NOISE)
    assert activity.floor_power == NOISE
    assert not activity.push(3.9 * NOISE)
    assert activity.push(50 * NOISE)


def test_silence_is_never_sound() -> None:
    assert not causal([0.0] * 100).any()
    assert not causal([9e-10] * 100).any()  # below the least power
    assert causal([0.0] * 50 + [1.1e-9])[-1]


def decay(frames: int, db_per_s: float, start: float = 1e-2) -> FloatArray:
    return np.asarray(start * 10 ** (-db_per_s * FRAME_S * np.arange(frames) / 10))


@pytest.mark.parametrize("rt60_s", [0.5, 1.0, 2.0])
def test_reverberation_ends_the_sound(rt60_s: float) -> None:
    power = np.concatenate([noise(60), decay(100, 60 / rt60_s) + NOISE])
    active = causal(power)[60:]
    # 10 dB below the decaying maximum, which comes down by 10 / ln(10) = 4.34 dB a second itself
    frames = int(np.floor(10 / ((60 / rt60_s - 4.3429) * FRAME_S))) + 1
    assert active.tolist() == [True] * frames + [False] * (100 - frames)


def test_tail_slower_than_the_release_becomes_background() -> None:
    power = np.concatenate([noise(60), decay(400, 3.0)])
    active = np.flatnonzero(causal(power)[60:])
    # When the last frames before the sound have left the 3 s of the minimum and the 5 frames' mean, what is left is at
    # most the tail itself: 4 times that is above it.
    assert active.tolist() == list(range(len(active)))
    assert 40 <= len(active) <= round(3.0 / FRAME_S) + 5


def test_quieter_sound_after_a_pause_is_found() -> None:
    pause = round(3.0 / FRAME_S)
    first, second = [1e-2] * 10, [1e-2 * 10**-2.2] * 10  # 22 dB less: 10 are the rule's, and 3 s release 13 more
    power = np.concatenate([noise(60), first, noise(pause, seed=2), second, noise(20, seed=3)])
    mask = causal(power)[1:]
    assert runs(mask) == [(59, 69), (69 + pause, 79 + pause)]
    # and without a pause it is the first sound's tail
    assert runs(causal(np.concatenate([noise(60), first, second, noise(20)]))[1:]) == [(59, 69)]


def test_background_follows_a_lasting_noise() -> None:
    power = np.concatenate([noise(60), noise(200, 100 * NOISE)])
    active = causal(power)[60:]
    window = round(3.0 / FRAME_S)
    assert active[: window - 5].all()
    assert not active[window + 5 :].any()
    activity = CausalActivity(ActivityParameters())
    for value in power:
        activity.push(float(value))
    assert activity.floor_power == pytest.approx(100 * NOISE, rel=0.1)


@pytest.mark.parametrize("seed", range(10))
def test_exact_and_causal_agree_on_an_isolated_sound(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rise = int(rng.integers(1, 4))  # to its maximum within three frames, as the paper's sounds do
    attack = 1e-2 * np.linspace(0.2, 1.0, rise)
    sound = np.concatenate([attack, decay(60, float(rng.uniform(25, 80)))])
    power = noise(60 + len(sound) + 40, seed=seed)
    power[60 : 60 + len(sound)] += sound
    exact, live = exact_mask(power), causal(power)
    start, stop = runs(exact)[0][0], runs(exact)[-1][1]
    (live_run,) = [run for run in runs(live) if run[0] > 0]
    # Live the maximum is not known before it comes: what is quieter than a tenth of it may start earlier, by no more
    # than the rise. It decays meanwhile: at 25 dB/s a tenth is reached in 0.4 s, 0.08 s later by 4.34 dB/s.
    assert start - rise <= live_run[0] <= start
    assert stop <= live_run[1] <= stop + 2
