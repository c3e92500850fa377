"""Channels that leak into each other are named; sounds through the air are no crosstalk."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from livessl.core.commission.crosstalk import CrosstalkMeter
from livessl.core.commission.finding import Finding, Severity
from livessl.core.geometry import tetrahedron
from livessl.core.types import Float32Array, FloatArray

C_M_S = 343.0
RATE_HZ = 16000.0
few = settings(deadline=None, max_examples=6)


def recording(seed: int, sounds: int = 10, microphones_m: FloatArray | None = None) -> Float32Array:
    """Bursts from different directions, each with reverberation that the channels receive independently."""
    rng = np.random.default_rng(seed)
    at_m = tetrahedron(0.5) if microphones_m is None else microphones_m
    length = round(1.5 * RATE_HZ)
    samples = 1e-4 * rng.standard_normal((len(at_m), sounds * length))
    for number in range(sounds):
        direction = rng.standard_normal(3)
        lags = np.rint(at_m @ direction / np.linalg.norm(direction) / C_M_S * RATE_HZ).astype(int)
        burst = rng.standard_normal(round(0.4 * RATE_HZ))
        tail = rng.standard_normal((len(at_m), round(0.6 * RATE_HZ))) * np.exp(-np.arange(round(0.6 * RATE_HZ)) / 2e3)
        first = number * length + 4000
        for channel, lag in enumerate(lags):
            samples[channel, first - lag : first - lag + len(burst)] += 0.05 * burst
            samples[channel, first : first + tail.shape[1]] += 0.05 * tail[channel]
    return samples.astype(np.float32)


def faults_of(samples: Float32Array, microphones_m: FloatArray | None = None) -> list[Finding]:
    meter = CrosstalkMeter(tetrahedron(0.5) if microphones_m is None else microphones_m, RATE_HZ, C_M_S)
    for first in range(0, samples.shape[1], 1237):
        meter.push(samples[:, first : first + 1237])
    return list(meter.faults("south"))


@few
@given(seed=st.integers(0, 10_000))
def test_sounds_through_the_air_are_no_crosstalk(seed: int) -> None:
    assert faults_of(recording(seed)) == []


@few
@given(
    seed=st.integers(0, 10_000),
    pair=st.sampled_from([(0, 1), (0, 3), (1, 2), (2, 3)]),
    level_db=st.floats(-22.0, -10.0),
)
def test_both_channels_of_a_leak_are_named_with_its_level(seed: int, pair: tuple[int, int], level_db: float) -> None:
    samples = recording(seed)
    source, victim = pair
    samples[victim] += np.float32(10.0 ** (level_db / 20.0)) * samples[source]
    found = faults_of(samples)
    assert [(one.fault, one.array, one.channel) for one in found] == [
        ("crosstalk", "south", channel + 1) for channel in sorted(pair)
    ]
    assert {one.severity for one in found} == {Severity.WARNING}
    told_db = float(found[0].message.rpartition("at about ")[2].removesuffix(" dB"))
    assert told_db == pytest.approx(level_db, abs=4.0)


def test_leak_without_the_low_frequencies_is_found_as_well() -> None:
    samples = recording(4)
    samples[2, 1:] += np.float32(0.2) * np.diff(samples[0])
    assert {one.channel for one in faults_of(samples)} == {1, 3}


def test_channel_that_receives_all_others_is_named_alone() -> None:
    samples = recording(5)
    samples[1] += np.float32(0.1) * samples[[0, 2, 3]].sum(axis=0)
    (found,) = faults_of(samples)
    assert found.channel == 2
    assert "channels 1, 3 and 4 leak" in found.message


def test_same_signal_is_another_fault() -> None:
    samples = recording(6)
    samples[3] = samples[0]
    assert faults_of(samples) == []


def test_a_fan_in_the_middle_between_two_microphones_is_no_crosstalk() -> None:
    samples = recording(7)
    samples[2:] += np.float32(2e-3) * np.random.default_rng(8).standard_normal(samples.shape[1], dtype=np.float32)
    assert faults_of(samples) == []


def test_nothing_is_concluded_where_microphones_are_too_near_or_sounds_too_few() -> None:
    at_m = tetrahedron(0.05)
    samples = recording(9, microphones_m=at_m)
    samples[1] += np.float32(0.2) * samples[0]
    assert faults_of(samples, at_m) == []
    assert faults_of(recording(10, sounds=1)) == []
    assert faults_of(np.zeros((4, 40_000), dtype=np.float32)) == []
