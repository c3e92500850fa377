"""Faults of single channels show in their samples."""

from __future__ import annotations

import numpy as np
import pytest

from livessl.core.commission.channels import ChannelMeter
from livessl.core.commission.finding import Finding, Severity
from livessl.core.types import Float32Array


def faults_of(samples: Float32Array, rate_hz: float) -> list[Finding]:
    meter = ChannelMeter(len(samples), rate_hz)
    for first in range(0, samples.shape[1], 1237):
        meter.push(samples[:, first : first + 1237])
    return list(meter.faults("north"))


def noise(rate_hz: float, channels: int = 4, seconds: float = 6.0) -> Float32Array:
    rng = np.random.default_rng(1)
    return (1e-3 * rng.standard_normal((channels, round(seconds * rate_hz)))).astype(np.float32)


def time_s(rate_hz: float, samples: Float32Array) -> Float32Array:
    return (np.arange(samples.shape[1]) / rate_hz).astype(np.float32)


@pytest.mark.parametrize("rate_hz", [16000.0, 44100.0])
def test_nothing_is_said_of_good_channels(rate_hz: float) -> None:
    assert faults_of(noise(rate_hz), rate_hz) == []


@pytest.mark.parametrize("mains_hz", [50.0, 60.0])
@pytest.mark.parametrize("rate_hz", [16000.0, 48000.0])
def test_hum_is_named_with_its_frequency(mains_hz: float, rate_hz: float) -> None:
    samples = noise(rate_hz)
    for harmonic in (1, 2, 3):
        samples[2] += 0.01 * np.sin(2.0 * np.pi * harmonic * mains_hz * time_s(rate_hz, samples)) / harmonic
    (found,) = faults_of(samples, rate_hz)
    assert (found.fault, found.array, found.channel, found.severity) == ("hum", "north", 3, Severity.WARNING)
    assert f"hums at {mains_hz:.0f} Hz" in found.message


def test_a_tone_that_is_no_hum_is_left_alone() -> None:
    samples = noise(16000.0)
    samples += 0.05 * np.sin(2.0 * np.pi * 300.0 * time_s(16000.0, samples))
    assert faults_of(samples, 16000.0) == []


@pytest.mark.parametrize("constant", [0.03, -0.2])
def test_a_constant_is_named(constant: float) -> None:
    samples = noise(16000.0)
    samples[0] += constant
    (found,) = faults_of(samples, 16000.0)
    assert (found.fault, found.channel) == ("dc", 1)
    assert f"{constant:+.3f}" in found.message


def test_clipping_is_named() -> None:
    samples = noise(16000.0)
    samples[3, 8000:12000] = np.clip(3.0 * np.sin(2.0 * np.pi * 300.0 * np.arange(4000) / 16000.0), -1.0, 1.0)
    (found,) = faults_of(samples, 16000.0)
    assert (found.fault, found.channel) == ("clipping", 4)


@pytest.mark.parametrize("channel", [0, 3])
def test_a_channel_with_more_noise_is_named(channel: int) -> None:
    samples = noise(16000.0)
    samples[channel] *= 6.0
    (found,) = faults_of(samples, 16000.0)
    assert (found.fault, found.channel) == ("noisy", channel + 1)
    assert "16 dB" in found.message


def test_less_than_a_second_says_nothing() -> None:
    assert faults_of(np.ones((2, 8000), dtype=np.float32), 16000.0) == []
