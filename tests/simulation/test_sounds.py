"""The synthesised sounds: where their energy is, how they start, and that a seed says all about them."""

from __future__ import annotations

import numpy as np
import pytest

from livessl.core.types import Float32Array
from livessl.simulation.sounds import SOUNDS

LENGTHS_S = {"door_slam": 0.4, "dropped_keys": 0.6, "phone": 1.2, "voice": 1.5}


def make(name: str, seed: int = 3, sample_rate_hz: float = 44100.0) -> Float32Array:
    return SOUNDS[name](np.random.default_rng(seed), sample_rate_hz)


def test_there_are_four() -> None:
    assert SOUNDS.keys() == LENGTHS_S.keys()


@pytest.mark.parametrize("sample_rate_hz", [16000.0, 44100.0, 48000.0])
@pytest.mark.parametrize("name", LENGTHS_S)
def test_length_level_and_band(name: str, sample_rate_hz: float) -> None:
    sound = make(name, sample_rate_hz=sample_rate_hz)
    assert sound.dtype == np.float32
    assert len(sound) == round(LENGTHS_S[name] * sample_rate_hz)
    assert np.abs(sound).max() == pytest.approx(0.9)
    assert sound[-1] == 0.0
    power = np.abs(np.fft.rfft(sound)) ** 2
    frequency_hz = np.fft.rfftfreq(len(sound), 1 / sample_rate_hz)
    share = {
        edges: power[(frequency_hz >= edges[0]) & (frequency_hz < edges[1])].sum() / power.sum()
        for edges in [(100, 6000), (100, 2000), (2000, 6000)]
    }
    assert share[100, 6000] > 0.9
    assert min(share.values()) > 0.003  # 25 dB down is still heard: nothing is a pure hum or a pure hiss


@pytest.mark.parametrize("name", LENGTHS_S)
def test_seed_decides(name: str) -> None:
    np.testing.assert_array_equal(make(name, seed=5), make(name, seed=5))
    assert np.abs(make(name, seed=5) - make(name, seed=6)).max() > 0.1


@pytest.mark.parametrize("name", LENGTHS_S)
def test_starts_at_once_and_changes_with_time(name: str) -> None:
    sound = make(name).astype(np.float64)
    frames = sound[: len(sound) // 882 * 882].reshape(-1, 882)  # 20 ms
    power = (frames**2).mean(axis=1)
    assert (power[:8] > 1e-3 * power.max()).any()  # within 160 ms
    spectra = np.abs(np.fft.rfft(frames[power > 1e-3 * power.max()], axis=1)) ** 2
    spectra /= spectra.sum(axis=1, keepdims=True)
    # Bhattacharyya coefficient of neighbours: 1 where sound is stationary
    alike = np.sqrt(spectra[1:] * spectra[:-1]).sum(axis=1)
    assert alike.min() < 0.9
