"""The onset front end: onsets count, and what the past or the noise explains does not."""

from __future__ import annotations

from dataclasses import replace
from functools import reduce
from operator import add

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from free_field import BAND_HZ, C_M_S, RATE_HZ, burst, heard, tetra
from livessl.core.correlate.gcc_phat import LagSampling
from livessl.core.correlate.onset_gcc import OnsetFrontEnd, OnsetGCC
from livessl.core.geometry import Grid, microphone_pairs
from livessl.core.locate import onset
from livessl.core.locate.estimator import Sound
from livessl.core.locate.onset import Onset
from livessl.core.types import ArraySpec, Float32Array, FloatArray

NORTH = tetra("north", [2.7, 4.2, 1.3])
SOUTH = tetra("south", [2.3, 1.1, 1.5], yaw_deg=71.0)
GRID = Grid(((0.0, 4.2), (0.0, 5.1), (0.0, 2.7)), 0.1)
SOURCE_M = np.array([1.13, 3.31, 1.47])
ELSEWHERE_M = np.array([3.71, 2.39, 0.83])
FRAME = 800

# Half a cell of the 0.1 m grid: refined positions are nearer, a wrong peak is much further away.
NEAR_M = 0.05


def front_end(spec: ArraySpec = NORTH, rate_hz: float = RATE_HZ) -> OnsetFrontEnd:
    return OnsetFrontEnd(spec, rate_hz, LagSampling(spec.band_hz, rate_hz, spec.aperture_m / C_M_S))


def noise(count: int, rms: float, seed: int = 0) -> Float32Array:
    return (rms * np.random.default_rng(seed).standard_normal((4, count))).astype(np.float32)


def pushed(front: OnsetFrontEnd, samples: Float32Array, quiet: bool, size: int = FRAME) -> OnsetGCC:
    cut = range(0, samples.shape[1], size)
    return reduce(add, [front.push(samples[:, at : at + size], quiet=quiet) for at in cut])


def echoing(spec: ArraySpec, rms: float = 0.0) -> Float32Array:
    """A click from the source and, 30 ms later, a decaying tail from elsewhere that is stronger in sum."""
    n = 12000
    click = np.zeros(n)
    click[1000:1160] = np.hanning(160) * np.random.default_rng(1).standard_normal(160)
    tail = np.zeros(n)
    t = np.arange(6000) / RATE_HZ
    tail[1480:7480] = 0.5 * np.random.default_rng(2).standard_normal(6000) * np.exp(-t / 0.15)
    sound = heard(spec, SOURCE_M, 0.1 * click) + heard(spec, ELSEWHERE_M, 0.1 * tail)
    return np.asarray(sound + noise(n, rms, seed=len(spec.name) + round(spec.centre_m[1])), dtype=np.float32)


def located(sounds: dict[str, Sound]) -> FloatArray:
    return Onset([NORTH, SOUTH], GRID, C_M_S).locate(sounds).position_m


def sound_of(spec: ArraySpec, samples: Float32Array, quiet: Float32Array) -> Sound:
    front = front_end(spec)
    pushed(front, quiet, quiet=True)
    return Sound((samples,), RATE_HZ, [pushed(front, samples, quiet=False)])


@given(seed=st.integers(0, 1000))
@settings(max_examples=3)
def test_a_click_is_located_and_not_a_steady_source_that_was_there_before(seed: int) -> None:
    rng, before, n = np.random.default_rng(seed), 6400, 22400
    click = np.zeros(n)
    click[before + 1000 : before + 1160] = np.hanning(160) * rng.standard_normal(160)
    steady = rng.standard_normal(n)
    sounds = {}
    for spec in (NORTH, SOUTH):  # over its second, the steady source has five times the energy of the click
        heard_m = heard(spec, SOURCE_M, 0.1 * click) + heard(spec, ELSEWHERE_M, 0.014 * steady)
        samples = np.asarray(heard_m + noise(n, 1e-4, seed), dtype=np.float32)
        sounds[spec.name] = sound_of(spec, samples[:, before:], samples[:, :before])
    assert np.linalg.norm(located(sounds) - SOURCE_M) < NEAR_M


@pytest.mark.parametrize("rms", [0.0, 0.002])
def test_the_first_sound_is_located_and_not_its_louder_tail(rms: float) -> None:
    sounds = {s.name: sound_of(s, echoing(s, rms), noise(6400, rms)) for s in (NORTH, SOUTH)}
    assert np.linalg.norm(located(sounds) - SOURCE_M) < NEAR_M
    late = {s.name: sound_of(s, echoing(s, rms)[:, 1480:], noise(6400, rms)) for s in (NORTH, SOUTH)}
    assert np.linalg.norm(located(late) - ELSEWHERE_M) < 2.0 * NEAR_M  # without the click the tail comes first


def test_identical_channels_give_the_sum_of_the_weights_at_lag_zero() -> None:
    found = pushed(front_end(), heard(NORTH, NORTH.centre_m, burst(9000)), quiet=False)
    assert found.weight == 0.0  # without quiet before it, this may be the middle of a sound
    front = front_end()
    pushed(front, np.zeros((4, 6400), np.float32), quiet=True)
    same = np.repeat(burst(9000).astype(np.float32)[None], 4, axis=0)
    found = pushed(front, same, quiet=False)
    assert found.weight > 100.0
    middle = found.lags.shape[1] // 2
    np.testing.assert_allclose(found.lags[:, middle], found.weight, rtol=1e-4)


def test_stationary_noise_is_no_onset() -> None:
    front = front_end()
    steady = noise(48000, 0.01)
    per_frame = pushed(front, steady, quiet=True).weight / 60.0
    front = front_end()
    pushed(front, steady[:, :32000], quiet=True)
    louder = pushed(front, 10.0 * steady[:, 32000:32800], quiet=False).weight
    assert per_frame < 0.02 * louder


def test_a_hum_does_not_mask_a_sound() -> None:
    hum = (0.3 * np.sin(2 * np.pi * 700.0 * np.arange(18400) / RATE_HZ)).astype(np.float32)
    sounds = {}
    for spec in (NORTH, SOUTH):
        samples = echoing(spec) + hum[6400:] + noise(12000, 1e-4)
        sounds[spec.name] = sound_of(spec, samples, hum[:6400] + noise(6400, 1e-4, 5))
    assert np.linalg.norm(located(sounds) - SOURCE_M) < NEAR_M


@settings(deadline=None, max_examples=15)
@given(size=st.integers(50, 3000))
def test_the_result_does_not_depend_on_how_samples_are_cut(size: int) -> None:
    samples = echoing(NORTH, 0.001)
    quiet = noise(6400, 0.001)
    whole, cut = front_end(), front_end()
    pushed(whole, quiet, quiet=True)
    pushed(cut, quiet, quiet=True)
    one, other = pushed(whole, samples, quiet=False, size=len(samples[0])), pushed(cut, samples, False, size)
    np.testing.assert_allclose(other.lags, one.lags, atol=1e-4 * one.weight)
    assert other.weight == pytest.approx(one.weight, rel=1e-4)
    assert np.abs(pushed(cut, samples[:, ::-1], False).lags - one.lags).max() > 0.1 * one.weight


def test_reset_gives_the_state_of_a_new_front_end() -> None:
    fresh, used = front_end(), front_end()
    pushed(used, noise(20000, 0.1, 3), quiet=False)
    used.reset()
    results = []
    for front in (fresh, used):
        pushed(front, noise(6400, 0.001), quiet=True)
        results.append(pushed(front, echoing(NORTH, 0.001), quiet=False))
    np.testing.assert_array_equal(results[0].lags, results[1].lags)


def test_onsets_count_after_a_second_without_quiet() -> None:
    front = front_end()
    pushed(front, noise(20000, 0.01), quiet=False)
    assert pushed(front, noise(800, 0.1), quiet=False).weight > 100.0


def test_silence_and_dead_channels_give_zeros() -> None:
    front = front_end()
    pushed(front, np.zeros((4, 6400), np.float32), quiet=True)
    silent = pushed(front, np.zeros((4, 6400), np.float32), quiet=False)
    assert silent.weight == 0.0
    assert not silent.lags.any()
    samples = echoing(NORTH)
    samples[2] = 0.0
    found = pushed(front, samples, quiet=False)
    assert np.isfinite(found.lags).all()
    with_dead = [1, 3, 5]  # pairs (0, 2), (1, 2), (2, 3)
    assert not found.lags[with_dead].any()
    assert np.abs(found.lags[0]).max() > 0.1 * found.weight


def test_a_high_band_uses_the_envelope() -> None:
    high = ArraySpec("high", NORTH.microphones_m, (4000.0, 16000.0))
    assert np.iscomplexobj(front_end(high, 44100.0).nothing.lags)
    assert not np.iscomplexobj(front_end().nothing.lags)
    assert NORTH.band_hz == BAND_HZ


def test_of_many_arrays_those_with_the_strongest_onsets_are_used(monkeypatch: pytest.MonkeyPatch) -> None:
    east = tetra("east", [3.9, 4.8, 1.2])
    estimator = Onset([NORTH, SOUTH, east], GRID, C_M_S)
    loudness = {"north": 1.0, "south": 1.0, "east": 0.02}
    sounds = {
        spec.name: sound_of(
            spec, np.float32(loudness[spec.name]) * echoing(spec) + noise(12000, 0.002), noise(6400, 0.002)
        )
        for spec in (NORTH, SOUTH, east)
    }
    everyone = estimator.locate(sounds)
    assert not everyone.unneeded
    assert [heard.spec.name for heard in everyone.evidence] == ["east", "north", "south"]
    monkeypatch.setattr(onset, "MOST_ARRAYS", 2)
    found = estimator.locate(sounds)
    assert set(found.unneeded) == {"east"}
    assert [heard.spec.name for heard in found.evidence] == ["north", "south"]
    without = estimator.locate({name: sounds[name] for name in ("north", "south")})
    assert found.position_m.tobytes() == without.position_m.tobytes()
    assert found.outliers == without.outliers


def test_gains_of_microphones_do_not_change_the_position() -> None:
    gain = np.array([[1.0], [5.0], [0.3], [1.0]], np.float32)
    even = {s.name: sound_of(s, echoing(s, 0.002), noise(6400, 0.002)) for s in (NORTH, SOUTH)}
    odd = {s.name: sound_of(s, gain * echoing(s, 0.002), gain * noise(6400, 0.002)) for s in (NORTH, SOUTH)}
    assert np.linalg.norm(located(odd) - SOURCE_M) < NEAR_M
    pairs = microphone_pairs(4)
    heights = []
    for sounds in (even, odd):
        onsets = sounds["north"].onsets[0]
        heights.append((onsets.lags / onsets.heights(pairs)).max(axis=1))
    np.testing.assert_allclose(
        heights[1], heights[0], rtol=0.3
    )  # without normalisation they would differ by up to 17 times


def test_microphones_far_apart_count_the_same() -> None:
    wide = ArraySpec("wide", 10.0 * NORTH.microphones_m, BAND_HZ)
    for spec, same in ((wide, True), (NORTH, False)):
        front = front_end(spec)
        pushed(front, noise(6400, 0.001), quiet=True)
        found = pushed(front, np.array([[5.0], [1.0], [1.0], [1.0]], np.float32) * echoing(NORTH, 0.001), quiet=False)
        assert (found.levels.max() < 1.01 * found.levels.min()) == same


@pytest.mark.parametrize("ended", [True, False])
def test_whole_segments_locate_an_ended_sound_without_onsets(ended: bool) -> None:
    estimator = Onset([NORTH, SOUTH], GRID, C_M_S)
    sounds = {}
    for seed, spec in enumerate((NORTH, SOUTH)):
        front = front_end(spec)
        pushed(front, noise(6400, 0.01, seed), quiet=True)
        only_noise = pushed(front, noise(6400, 0.01, seed + 2), quiet=False)
        segment = heard(spec, SOURCE_M, burst(9000)) + noise(9000, 0.01, seed + 4)
        sounds[spec.name] = Sound((segment,), RATE_HZ, (only_noise,), ended=ended)
    found = estimator.locate(sounds)
    assert (found.refused is None) == ended
    assert found.features is not None
    assert found.features.whole == ended
    if ended:
        assert np.linalg.norm(found.position_m - SOURCE_M) < NEAR_M


def test_segments_are_not_used_where_onsets_are_sure() -> None:
    sounds = {s.name: sound_of(s, echoing(s), noise(6400, 0.0)) for s in (NORTH, SOUTH)}
    other = {name: replace(sound, segments=(noise(9000, 0.1),)) for name, sound in sounds.items()}
    found = [Onset([NORTH, SOUTH], GRID, C_M_S).locate(each) for each in (sounds, other)]
    np.testing.assert_array_equal(found[0].position_m, found[1].position_m)
