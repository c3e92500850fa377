"""Sounds that are no short onsets: steady ones, tones, a single click, rumble and music. All are synthesised."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Final

import numpy as np
from scipy.signal import butter, sosfilt

from livessl.core.types import Float32Array, FloatArray
from livessl.simulation.noise import music, pink

RAMP_S: Final = 0.01
"""Time, in seconds, in which steady sounds begin and end."""


def machine(rng: np.random.Generator, sample_rate_hz: float) -> Float32Array:
    """A machine that runs for 4 s: harmonics of its speed up to 4 kHz, and broadband noise."""
    times_s = _times_s(4.0, sample_rate_hz)
    first_hz = rng.uniform(70.0, 130.0)
    orders = np.arange(2, int(4000.0 / first_hz))
    tones = sum(np.sin(2.0 * np.pi * n * first_hz * times_s + rng.uniform(0.0, 6.28)) / n**0.5 for n in orders)
    hiss = pink(rng, len(times_s), sample_rate_hz)[0]
    return _ramped(tones / np.std(tones) + hiss, sample_rate_hz)


def water(rng: np.random.Generator, sample_rate_hz: float) -> Float32Array:
    """Water that runs for 4 s: noise from 500 Hz to 6 kHz."""
    hiss = rng.standard_normal(round(4.0 * sample_rate_hz))
    return _ramped(sosfilt(_band_pass(500.0, 6000.0, sample_rate_hz), hiss), sample_rate_hz)


def tone(rng: np.random.Generator, sample_rate_hz: float) -> Float32Array:
    """A pure tone of 1.5 s, between 600 Hz and 3 kHz."""
    times_s = _times_s(1.5, sample_rate_hz)
    return _ramped(np.sin(2.0 * np.pi * rng.uniform(600.0, 3000.0) * times_s), sample_rate_hz)


def alarm(rng: np.random.Generator, sample_rate_hz: float) -> Float32Array:
    """An alarm: six beeps of 0.15 s in 1.8 s, of one frequency between 2 and 3.5 kHz and its weak harmonic."""
    times_s = _times_s(1.8, sample_rate_hz)
    pitch_hz = rng.uniform(2000.0, 3500.0)
    phase = 2.0 * np.pi * pitch_hz * times_s
    on = np.clip(np.minimum(times_s % 0.3, 0.15 - times_s % 0.3) / 0.002, 0.0, 1.0)
    return _ramped(on * (np.sin(phase) + 0.1 * np.sin(2.0 * phase)), sample_rate_hz)


def click(rng: np.random.Generator, sample_rate_hz: float) -> Float32Array:
    """One click: noise that decays in 1 ms."""
    times_s = _times_s(0.06, sample_rate_hz)
    return _unit_peak(rng.standard_normal(len(times_s)) * np.exp(-times_s / 0.001))


def rumble(rng: np.random.Generator, sample_rate_hz: float) -> Float32Array:
    """Rumble of 3 s: noise from 100 to 300 Hz."""
    hiss = rng.standard_normal(round(3.0 * sample_rate_hz))
    return _ramped(sosfilt(_band_pass(100.0, 300.0, sample_rate_hz), hiss), sample_rate_hz)


def tune(rng: np.random.Generator, sample_rate_hz: float) -> Float32Array:
    """Music of 4 s."""
    return _ramped(music(rng, round(4.0 * sample_rate_hz), sample_rate_hz), sample_rate_hz)


OTHER_SOUNDS: Final[Mapping[str, Callable[[np.random.Generator, float], Float32Array]]] = MappingProxyType(
    {each.__name__: each for each in (machine, water, tune, tone, alarm, click, rumble)}
)
"""Every sound by its name."""


def _times_s(duration_s: float, sample_rate_hz: float) -> FloatArray:
    return np.arange(round(duration_s * sample_rate_hz)) / sample_rate_hz


def _band_pass(low_hz: float, high_hz: float, sample_rate_hz: float) -> FloatArray:
    return np.asarray(butter(3, (low_hz, high_hz), "bandpass", fs=sample_rate_hz, output="sos"))


def _ramped(sound: FloatArray | Float32Array, sample_rate_hz: float) -> Float32Array:
    times_s = np.arange(len(sound)) / sample_rate_hz
    return _unit_peak(sound * np.clip(np.minimum(times_s, times_s[::-1]) / RAMP_S, 0.0, 1.0))


def _unit_peak(sound: FloatArray | Float32Array) -> Float32Array:
    return np.asarray(sound / np.abs(sound).max(), dtype=np.float32)
