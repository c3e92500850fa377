"""Synthesises sounds (door, keys, telephone, voice, hand clap), without room or position."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Final

import numpy as np
from scipy.signal import butter, lfilter, sosfilt

from livessl.core.types import Float32Array, FloatArray

BAND_HZ: Final = (100.0, 6000.0)
"""Band, in hertz, that contains the energy of every sound."""

PEAK: Final = 0.9
"""Largest absolute sample of every sound."""

FADE_S: Final = 0.01
"""Every sound ends in a fade of this length, so that cutting it makes no click."""

VOWELS_HZ: Final = ((730, 1090, 2440, 3400), (530, 1840, 2480, 3500), (270, 2290, 3010, 3700), (570, 840, 2410, 3300))
"""Formants of the vowels in father, bet, beet and bought (Peterson & Barney, JASA 24(2), 1952); the 4th is typical."""

FORMANT_WIDTHS_HZ: Final = (70, 100, 140, 220)


def door_slam(rng: np.random.Generator, sample_rate_hz: float) -> Float32Array:
    """Synthesise a door that falls shut (0.4 s): the latch, then the leaf's thud and crack.

    Parameters
    ----------
    rng : numpy.random.Generator
        Source of randomness; every draw is another door.
    sample_rate_hz : float
        Sample rate, above 200 Hz.

    Returns
    -------
    (n,) float32
        Mono, peak 0.9.
    """
    t = _times(0.4, sample_rate_hz)
    slam_s = rng.uniform(0.05, 0.08)
    latch = _struck(t, 0.0, rng.uniform(1500, 4500, 4), rng.uniform(0.004, 0.01, 4), rng)
    thud = _struck(t, slam_s, rng.uniform(110, 700, 8), rng.uniform(0.03, 0.08, 8), rng)
    crack = _burst(t, slam_s, 0.025, rng) + 0.3 * _burst(t, slam_s + rng.uniform(0.02, 0.04), 0.04, rng)
    return _finished(0.3 * latch + thud + 2.0 * crack, sample_rate_hz)


def dropped_keys(rng: np.random.Generator, sample_rate_hz: float) -> Float32Array:
    """Synthesise a bunch of keys that falls and bounces (0.6 s): ever weaker clinks, irregular in time.

    Parameters and result are those of `door_slam`.
    """
    t = _times(0.6, sample_rate_hz)
    sound = np.zeros_like(t)
    for start_s in np.sort(0.48 * rng.uniform(0, 1, 14) ** 1.5):
        level = np.exp(-start_s / 0.25) * rng.uniform(0.4, 1.0)
        ring = _struck(t, start_s, rng.uniform(1800, 5800, 7), rng.uniform(0.006, 0.03, 7), rng)
        sound += level * (ring + 0.8 * _burst(t, start_s, 0.003, rng))
    return _finished(sound, sample_rate_hz)


def phone(rng: np.random.Generator, sample_rate_hz: float) -> Float32Array:
    """Synthesise a telephone that rings once (1.2 s): two tones in quick turn, rich in harmonics, with clicks between.

    Parameters and result are those of `door_slam`.
    """
    t = _times(1.2, sample_rate_hz)
    low_hz = rng.uniform(700, 850)
    turns_hz = rng.uniform(14, 18)
    turn = np.floor(t * turns_hz).astype(np.int64)
    pitch_hz = np.where(turn % 2 == 0, low_hz, 1.25 * low_hz)
    phase = 2.0 * np.pi * np.cumsum(pitch_hz) / sample_rate_hz
    tone = np.sum([np.sin(n * phase + rng.uniform(0, 2 * np.pi)) / n for n in range(1, 7)], axis=0)
    since_turn_s = t - turn / turns_hz
    clicks = _noise(t, rng) * np.exp(-since_turn_s / 0.004)
    envelope = np.minimum(t / 0.002, 1.0) * (0.6 + 0.4 * np.exp(-since_turn_s / 0.03)) * np.exp(-t / 2.0)
    return _finished(envelope * (tone + 1.2 * clicks), sample_rate_hz)


def voice(rng: np.random.Generator, sample_rate_hz: float) -> Float32Array:
    """Synthesise a few syllables of a voice (1.5 s) with gliding pitch, changing vowels, hisses and pauses.

    Parameters and result are those of `door_slam`.
    """
    t = _times(1.5, sample_rate_hz)
    pitch_hz = rng.uniform(105, 135) * (1.15 - 0.2 * t) * (1.0 + 0.06 * np.sin(2.0 * np.pi * 2.3 * t))
    glottis = _glottal_flow_rate(np.cumsum(pitch_hz) / sample_rate_hz % 1.0)
    sound = np.zeros_like(t)
    start_s = 0.0
    for vowel in (*rng.permutation(len(VOWELS_HZ)), rng.integers(len(VOWELS_HZ))):
        hiss_s = rng.uniform(0.03, 0.07)
        stop_s = start_s + hiss_s + rng.uniform(0.14, 0.19)
        hiss = _window(t, start_s, start_s + hiss_s) * _noise(t, rng)
        voiced = _window(t, start_s + hiss_s, stop_s) * (glottis + 0.02 * _noise(t, rng))
        sound += _unit_peak(_formants(voiced, vowel, sample_rate_hz)) * rng.uniform(0.7, 1.0)
        sound += 0.25 * sosfilt(_band_pass(2000.0, 5500.0, sample_rate_hz), hiss)
        start_s = stop_s + rng.uniform(0.02, 0.05)
    return _finished(sound, sample_rate_hz)


def hand_clap(rng: np.random.Generator, sample_rate_hz: float) -> Float32Array:
    """Synthesise one clap of two hands (0.12 s): a burst that decays within milliseconds, and the hollow of the hands.

    Parameters and result are those of `door_slam`.
    """
    t = _times(0.12, sample_rate_hz)
    hollow = _struck(t, 0.0, rng.uniform(500, 2200, 3), rng.uniform(0.003, 0.006, 3), rng)
    return _finished(_burst(t, 0.0, rng.uniform(0.004, 0.008), rng) + 0.5 * hollow, sample_rate_hz)


SOUNDS: Final[Mapping[str, Callable[[np.random.Generator, float], Float32Array]]] = MappingProxyType(
    {"door_slam": door_slam, "dropped_keys": dropped_keys, "phone": phone, "voice": voice}
)
"""Every sound of the demo by its name; claps are simulated on request only."""


def _times(duration_s: float, sample_rate_hz: float) -> FloatArray:
    return np.arange(round(duration_s * sample_rate_hz)) / sample_rate_hz


def _since(t: FloatArray, start_s: float) -> FloatArray:
    """Return the seconds since a start, infinite before it, so that any decay is 0 there."""
    return np.where(t >= start_s, t - start_s, np.inf)


def _noise(t: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Draw white noise of the same density at every sample rate: RMS 1 if sampled at twice the band's upper edge."""
    return np.asarray(rng.standard_normal(len(t)) / np.sqrt(2.0 * BAND_HZ[1] * t[1]))


def _burst(t: FloatArray, start_s: float, decay_s: float, rng: np.random.Generator) -> FloatArray:
    return np.asarray(_noise(t, rng) * np.exp(-_since(t, start_s) / decay_s))


def _struck(
    t: FloatArray, start_s: float, modes_hz: FloatArray, decays_s: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """Return the modes of a struck body: damped sines that start at zero, with random levels."""
    levels = rng.uniform(0.3, 1.0, len(modes_hz))
    since_s = _since(t, start_s)
    return np.asarray(
        sum(
            level * np.exp(-since_s / decay_s) * np.sin(2.0 * np.pi * mode_hz * (t - start_s))
            for level, mode_hz, decay_s in zip(levels, modes_hz, decays_s, strict=True)
        )
    )


def _glottal_flow_rate(phase: FloatArray) -> FloatArray:
    """Return the rate of change of the glottal flow: slow opening, abrupt closure (Rosenberg, JASA 49(2B), 1971)."""
    flow = np.select(
        [phase < 0.4, phase < 0.56],
        [0.5 - 0.5 * np.cos(np.pi * phase / 0.4), np.cos(np.pi / 2.0 * (phase - 0.4) / 0.16)],
    )
    return np.diff(flow, prepend=0.0)


def _formants(sound: FloatArray, vowel: int, sample_rate_hz: float) -> FloatArray:
    """Pass a sound through a vowel's resonances, one after the other."""
    for centre_hz, width_hz in zip(VOWELS_HZ[vowel], FORMANT_WIDTHS_HZ, strict=True):
        radius = np.exp(-np.pi * width_hz / sample_rate_hz)
        poles = [1.0, -2.0 * radius * np.cos(2.0 * np.pi * centre_hz / sample_rate_hz), radius**2]
        sound = lfilter([sum(poles)], poles, sound)
    return sound


def _window(t: FloatArray, start_s: float, stop_s: float) -> FloatArray:
    """Return a window that rises from 0 to 1 and falls back, with ramps of at most 15 ms."""
    return np.clip(np.minimum(t - start_s, stop_s - t) / 0.015, 0.0, 1.0)


def _band_pass(low_hz: float, high_hz: float, sample_rate_hz: float) -> FloatArray:
    return np.asarray(
        butter(3, (low_hz, min(high_hz, 0.45 * sample_rate_hz)), "bandpass", fs=sample_rate_hz, output="sos")
    )


def _unit_peak(sound: FloatArray) -> FloatArray:
    return np.asarray(sound / np.abs(sound).max())


def _finished(sound: FloatArray, sample_rate_hz: float) -> Float32Array:
    """Keep the band, fade out and set the peak."""
    sound = sosfilt(_band_pass(*BAND_HZ, sample_rate_hz), sound)
    remaining_s = np.arange(len(sound))[::-1] / sample_rate_hz
    return np.asarray(PEAK * _unit_peak(sound * np.minimum(remaining_s / FADE_S, 1.0)), dtype=np.float32)
