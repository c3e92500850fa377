"""Levels of known signals are exact, whatever the blocks in which they come."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from livessl.core.commission.channels import SILENCE_DBFS
from livessl.core.commission.levels import InputLevel, LevelMeter
from livessl.core.types import Float32Array

RATE_HZ = 8000


def sine(frequency_hz: float, amplitude: float, seconds: float = 4.0, constant: float = 0.0) -> Float32Array:
    t = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    return (constant + amplitude * np.sin(2.0 * np.pi * frequency_hz * t)).astype(np.float32)


def hiss(level: float, seconds: float = 4.0, seed: int = 0) -> Float32Array:
    return (level * np.random.default_rng(seed).standard_normal(round(seconds * RATE_HZ))).astype(np.float32)


def metered(samples: Float32Array, block: int = 997, arrays: tuple[tuple[int, ...], ...] = ()) -> LevelMeter:
    meter = LevelMeter(len(samples), RATE_HZ, arrays)
    for first in range(0, samples.shape[1], block):
        meter.push(samples[:, first : first + block])
    return meter


def level_of(samples: Float32Array) -> InputLevel:
    [level] = metered(samples[None, :]).overall()
    return level


@settings(max_examples=25)
@given(
    frequency_hz=st.integers(200, 3900),
    level_db=st.floats(-80.0, -1.0),
    constant=st.floats(-0.1, 0.1),
    block=st.integers(1, 9000).filter(lambda block: block > 100),
)
def test_level_of_a_sine_is_its_amplitude(frequency_hz: int, level_db: float, constant: float, block: int) -> None:
    amplitude = 10.0 ** (level_db / 20.0)
    samples = sine(frequency_hz, amplitude, constant=constant)
    meter = metered(samples[None, :], block)
    for [level] in (meter.recent(), meter.overall()):
        # the constant has rounding errors of float32, 1e-8 at most
        assert level.mean == pytest.approx(constant, abs=0.01 * amplitude + 1e-7)
        assert level.peak_dbfs == pytest.approx(20.0 * math.log10(np.abs(samples).max()), abs=0.8)
        # a block that is not a whole number of periods is off by one part of a period in a second
        assert level.rms_dbfs == pytest.approx(level_db - 10.0 * math.log10(2.0), abs=0.1)
        assert level.clipped == 0
        assert ("dc" in level.faults) == (abs(level.mean or 0.0) > 0.01)
        assert set(level.faults) <= {"dc"}


@settings(max_examples=25)
@given(
    runs=st.lists(st.tuples(st.integers(0, 60), st.sampled_from([1.0, -1.0])), max_size=8),
    block=st.integers(50, 5000),
)
def test_clipped_samples_are_counted_whatever_the_blocks(runs: list[tuple[int, float]], block: int) -> None:
    samples = hiss(0.05, seconds=2.0)
    for number, (length, value) in enumerate(runs):
        first = 37 + 1000 * number
        samples[first : first + length] = value
    [level] = metered(samples[None, :], block).overall()
    # the first sample of a run may have touched full scale without being cut
    assert level.clipped == sum(max(length - 1, 0) for length, _ in runs)
    assert ("clipping" in level.faults) == (level.clipped > 0)


def test_clipping_is_a_fault_of_the_moment_and_a_count_of_the_whole_time() -> None:
    samples = hiss(0.01)
    samples[100:200] = 1.0
    meter = metered(samples[None, :])
    assert [level.faults for level in meter.recent()] == [()]
    assert [level.clipped for level in meter.recent()] == [99]
    assert [level.faults for level in meter.overall()] == [("clipping",)]


@pytest.mark.parametrize("mains_hz", [50, 60])
@pytest.mark.parametrize("amplitude", [0.002, 0.1])
def test_hum_has_frequency_and_level(mains_hz: int, amplitude: float) -> None:
    level = level_of(hiss(1e-4) + sine(mains_hz, amplitude))
    assert level.hum_hz == mains_hz
    assert level.hum_dbfs == pytest.approx(20.0 * math.log10(amplitude / math.sqrt(2.0)), abs=0.5)
    assert level.faults == ("hum",)


def test_hum_is_not_reported_from_a_moment() -> None:
    assert level_of((hiss(1e-4) + sine(50, 0.1))[: 2 * RATE_HZ]).faults == ()


@pytest.mark.parametrize("level_db", [-90.0, -50.0])
def test_noise_floor_is_that_between_the_sounds(level_db: float) -> None:
    samples = hiss(10.0 ** (level_db / 20.0))
    for second in range(4):
        samples[second * RATE_HZ : second * RATE_HZ + RATE_HZ // 2] += sine(700, 0.5, 0.5)
    level = level_of(samples)
    # the quietest fifth of frames of 400 samples is below their mean by 0.6 dB
    assert level.noise_dbfs == pytest.approx(level_db, abs=0.8)
    assert level.rms_dbfs == pytest.approx(20.0 * math.log10(0.5) - 10.0 * math.log10(4.0), abs=0.2)


def test_silence_is_dead_and_nothing_else() -> None:
    level = level_of(np.zeros(4 * RATE_HZ, dtype=np.float32))
    assert (level.peak_dbfs, level.rms_dbfs, level.noise_dbfs) == (SILENCE_DBFS,) * 3
    assert level.faults == ("dead",)


@settings(max_examples=10)
@given(noisy=st.integers(0, 3), dead=st.none() | st.integers(0, 3))
def test_noise_is_compared_within_an_array(noisy: int, dead: int | None) -> None:
    samples = np.stack([hiss(1e-3, seed=seed) for seed in range(4)] + [hiss(1e-5, seed=9), hiss(1e-5, seed=10)])
    samples[noisy] *= 10.0
    if dead is not None and dead != noisy:
        samples[dead] = 0.0
    faults = [level.faults for level in metered(samples, arrays=((0, 1, 2, 3),)).overall()]
    assert [index for index, words in enumerate(faults) if "noisy" in words] == [noisy]
    assert all(level.faults in ((), ("dead",)) for level in metered(samples).overall())


def test_figures_that_need_a_second_are_missing_before_it() -> None:
    meter = LevelMeter(2, RATE_HZ)
    assert meter.recent() == meter.overall() == ()
    meter.push(np.full((2, RATE_HZ // 2), 0.5, dtype=np.float32))
    assert [(level.mean, level.noise_dbfs) for level in meter.recent()] == [(None, None)] * 2


def test_mean_follows_a_plug_within_ten_seconds() -> None:
    samples = np.concatenate([hiss(1e-3, 12.0) + np.float32(0.3), hiss(1e-3, 11.0)])
    [level] = metered(samples[None, :]).recent()
    assert level.faults == ()
