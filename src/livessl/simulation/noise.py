"""Noise that rooms have: pink noise, a fan, and noise that arrives from everywhere. It knows no room and no level."""

from __future__ import annotations

from typing import Final

import numpy as np
import scipy.fft

from livessl.core.types import Float32Array, FloatArray

LOWEST_HZ: Final = 100.0
"""Lowest frequency, in hertz, of all noise: that of the arrays' band. Below it pink noise has most of its power, and a
level would say little about the band."""

BLADES_HZ: Final = (90.0, 180.0)
"""Range of a fan's blade-passing frequency, in hertz."""

HARMONICS: Final = 8
"""Number of a fan's harmonics; each has half the power of the one before."""

TONAL_SHARE: Final = 0.5
"""Share of a fan's power that is in its harmonics."""

WANDER: Final = 0.003
"""Standard deviation of a fan's speed, relative to its mean: a belt or a mains motor under a changing load."""

WANDER_S: Final = 0.5
"""Time, in seconds, over which a fan's speed changes."""

_RIDGE: Final = 1e-6
"""Share of independent noise that keeps the coherence matrix positive definite where microphones are close."""

_BLOCK: Final = 2048
"""Number of frequency bins whose matrices are decomposed at once, so that memory does not grow with the length."""


def pink(rng: np.random.Generator, count: int, sample_rate_hz: float, channels: int = 1) -> Float32Array:
    """Return independent pink noise from `LOWEST_HZ` up: (channels, count), with a mean power of 1.

    The noise is periodic: its end continues with its beginning.
    """
    return _in_time(_pink_spectra(rng, count, sample_rate_hz, channels), count)


def fan(rng: np.random.Generator, count: int, sample_rate_hz: float) -> Float32Array:
    """Return the sound of a fan, (count,), with a mean power of 1: pink noise and the harmonics of its blades.

    Every draw is another fan, whose speed wanders slowly.
    """
    blades_hz = rng.uniform(*BLADES_HZ)
    knots = max(2, round(count / sample_rate_hz / WANDER_S) + 2)
    times_s = np.arange(count) / sample_rate_hz
    speed = np.interp(times_s, WANDER_S * np.arange(knots), 1.0 + WANDER * rng.standard_normal(knots))
    phase = 2.0 * np.pi * blades_hz * np.cumsum(speed) / sample_rate_hz
    orders = [n for n in range(1, HARMONICS + 1) if n * blades_hz > LOWEST_HZ]
    tones = sum(2.0 ** (-n / 2.0) * np.sin(n * phase + rng.uniform(0.0, 2.0 * np.pi)) for n in orders)
    tones = tones / np.sqrt(np.square(tones).mean())
    hiss = pink(rng, count, sample_rate_hz)[0]
    mixed = np.sqrt(TONAL_SHARE) * tones + np.sqrt(1.0 - TONAL_SHARE) * hiss
    return np.asarray(mixed / np.sqrt(np.square(mixed).mean()), dtype=np.float32)


def diffuse(
    rng: np.random.Generator, microphones_m: FloatArray, count: int, sample_rate_hz: float, c_m_s: float
) -> Float32Array:
    """Return pink noise of a spherically isotropic field at microphones: (K, count), each with a mean power of 1.

    The coherence of two microphones at a distance d is sin(k d) / (k d), k = 2 pi f / c. Independent noise gets it by
    the Cholesky factor of the microphones' coherence matrix in each bin (Habets, Cohen and Gannot, Generating
    nonstationary multisensor signals under a spatial coherence constraint, JASA 124(5), 2008).

    Parameters
    ----------
    rng : numpy.random.Generator
    microphones_m : (K, 3) float64
        Metres.
    count : int
        Number of samples; the noise is periodic, as that of `pink`.
    sample_rate_hz : float
    c_m_s : float
        Speed of sound, m/s.
    """
    distances_m = np.linalg.norm(microphones_m[:, None] - microphones_m[None], axis=2)
    spectra = _pink_spectra(rng, count, sample_rate_hz, len(microphones_m))
    frequencies_hz = scipy.fft.rfftfreq(count, 1.0 / sample_rate_hz)
    ridge = _RIDGE * np.eye(len(microphones_m))
    for first in range(0, len(frequencies_hz), _BLOCK):
        block = slice(first, first + _BLOCK)
        coherence = np.sinc(2.0 * frequencies_hz[block, None, None] * distances_m / c_m_s)
        factors = np.linalg.cholesky((coherence + ridge) / (1.0 + _RIDGE))
        spectra[:, block] = np.einsum("fik,kf->if", factors, spectra[:, block])
    return _in_time(spectra, count)


def _pink_spectra(rng: np.random.Generator, count: int, sample_rate_hz: float, channels: int) -> FloatArray:
    """Draw the spectra (channels, F) of independent pink noise; their expected power is equal."""
    frequencies_hz = scipy.fft.rfftfreq(count, 1.0 / sample_rate_hz)
    drawn = rng.standard_normal((2, channels, len(frequencies_hz)))
    inside = frequencies_hz >= LOWEST_HZ
    shape = np.where(inside, 1.0 / np.sqrt(np.maximum(frequencies_hz, LOWEST_HZ)), 0.0)
    return np.asarray((drawn[0] + 1j * drawn[1]) * shape)


def _in_time(spectra: FloatArray, count: int) -> Float32Array:
    """Transform to the time domain and give every channel a mean power of 1."""
    noise = scipy.fft.irfft(spectra, count, axis=1)
    return np.asarray(noise / np.sqrt(np.square(noise).mean(axis=1, keepdims=True)), dtype=np.float32)
