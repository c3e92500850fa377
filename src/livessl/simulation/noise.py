"""Makes the noise that rooms have: pink, a fan, hum, music, bursts, from everywhere or from one side.

It knows no room and no level.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import scipy.fft
from numpy.typing import NDArray

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

MAINS_HZ: Final = (50.0, 60.0)
"""Frequencies of the mains, in hertz; a transformer hums at the even harmonics."""

HUM_ORDERS: Final = 24
"""Number of harmonics of a hum; the power of one falls with the square of its order."""

HUM_HISS: Final = 0.01
"""Share of a hum's power that is pink noise."""

CHORD_S: Final = 0.4
"""Time, in seconds, between two chords of the music."""

NOTES_HZ: Final = tuple(110.0 * 2.0 ** (step / 12.0) for step in (0, 2, 3, 5, 7, 8, 10, 12, 14, 15, 17, 19, 20, 22, 24))
"""Notes of the music, in hertz: two octaves of a minor scale."""

ON_S: Final = (0.3, 1.0)
OFF_S: Final = (0.4, 1.6)
"""Ranges, in seconds, of the time for which an intermittent noise is on, and off."""

SIDE_WAVES: Final = 12
"""Number of plane waves of the noise from one side."""

SIDE_DEG: Final = 40.0
"""Largest angle, in degrees, between one of these waves and the middle of the side."""

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


def hum(rng: np.random.Generator, count: int, sample_rate_hz: float) -> Float32Array:
    """Return the hum of a transformer or a supply, (count,), with a mean power of 1: harmonics of twice the mains."""
    first_hz = 2.0 * float(rng.choice(MAINS_HZ))
    orders = np.arange(1, HUM_ORDERS + 1)
    orders = orders[orders * first_hz < 0.45 * sample_rate_hz]
    times_s = np.arange(count) / sample_rate_hz
    tones = np.zeros(count)
    for order in orders:
        level = rng.uniform(0.5, 1.5) / order
        tones += level * np.sin(2.0 * np.pi * order * first_hz * times_s + rng.uniform(0.0, 2.0 * np.pi))
    tones *= np.sqrt((1.0 - HUM_HISS) / np.square(tones).mean())
    return np.asarray(tones + np.sqrt(HUM_HISS) * pink(rng, count, sample_rate_hz)[0], dtype=np.float32)


def music(rng: np.random.Generator, count: int, sample_rate_hz: float) -> Float32Array:
    """Return music, (count,), with a mean power of 1: plucked chords, a bass, and a drum on every other beat."""
    beat = round(CHORD_S * sample_rate_hz)
    times_s = np.arange(4 * beat) / sample_rate_hz
    sound = np.zeros(count + len(times_s))
    for number, start in enumerate(range(-int(rng.integers(beat)), count, beat)):
        here = np.zeros(len(times_s))
        for note_hz in (NOTES_HZ[int(rng.integers(7))], *rng.choice(NOTES_HZ, 3, replace=False)):
            for order in range(1, 9):
                if order * note_hz < 0.45 * sample_rate_hz:
                    decay = np.exp(-times_s * order / 0.6)
                    here += decay * np.sin(2.0 * np.pi * order * note_hz * times_s + rng.uniform(0.0, 6.28)) / order
        if number % 2:
            here += 2.0 * rng.standard_normal(len(times_s)) * np.exp(-times_s / 0.05)
        used = here[max(0, -start) :]
        sound[max(0, start) : max(0, start) + len(used)] += used
    sound = sound[:count]
    return np.asarray(sound / np.sqrt(np.square(sound).mean()), dtype=np.float32)


def intermittent(rng: np.random.Generator, count: int, sample_rate_hz: float) -> Float32Array:
    """Return pink noise that goes on and off, (count,), with a mean power of 1 over all: a tool, a printer, a tap."""
    hiss = pink(rng, count, sample_rate_hz)[0]
    on, start = np.zeros(count, dtype=np.float32), 0
    while start < count:
        start += round(rng.uniform(*OFF_S) * sample_rate_hz) if start else round(rng.uniform(0.0, 1.0) * sample_rate_hz)
        stop = start + round(rng.uniform(*ON_S) * sample_rate_hz)
        on[start:stop] = 1.0
        start = stop
    if not on.any():
        on[:] = 1.0  # shorter than the first pause
    sound = hiss * on
    return np.asarray(sound / np.sqrt(np.square(sound).mean()), dtype=np.float32)


def from_one_side(
    rng: np.random.Generator, microphones_m: FloatArray, count: int, sample_rate_hz: float, c_m_s: float
) -> Float32Array:
    """Return pink noise from one side, traffic or rain on a roof, at microphones: (K, count), a mean power of 1 each.

    It is the sum of independent plane waves from directions within `SIDE_DEG` of one of the four walls or the ceiling.
    Parameters are those of `diffuse`.
    """
    sides = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1]], dtype=np.float64)
    side = sides[int(rng.integers(len(sides)))]
    angles = np.radians(SIDE_DEG) * np.sqrt(rng.uniform(0.0, 1.0, SIDE_WAVES))
    turns = rng.uniform(0.0, 2.0 * np.pi, SIDE_WAVES)
    first, second = (np.roll(np.abs(side), shift) for shift in (1, 2))
    across = np.cos(turns)[:, None] * first + np.sin(turns)[:, None] * second
    towards = np.cos(angles)[:, None] * side + np.sin(angles)[:, None] * across
    frequencies_hz = scipy.fft.rfftfreq(count, 1.0 / sample_rate_hz)
    spectra = _pink_spectra(rng, count, sample_rate_hz, SIDE_WAVES)
    early_s = towards @ (microphones_m - microphones_m.mean(axis=0)).T / c_m_s
    summed = np.zeros((len(microphones_m), len(frequencies_hz)), dtype=np.complex128)
    for spectrum, each_s in zip(spectra, early_s, strict=True):
        summed += spectrum * np.exp(2j * np.pi * frequencies_hz * each_s[:, None])
    return _in_time(summed, count)


def _pink_spectra(rng: np.random.Generator, count: int, sample_rate_hz: float, channels: int) -> FloatArray:
    """Draw the spectra (channels, F) of independent pink noise; their expected power is equal."""
    frequencies_hz = scipy.fft.rfftfreq(count, 1.0 / sample_rate_hz)
    drawn = rng.standard_normal((2, channels, len(frequencies_hz)))
    inside = frequencies_hz >= LOWEST_HZ
    shape = np.where(inside, 1.0 / np.sqrt(np.maximum(frequencies_hz, LOWEST_HZ)), 0.0)
    return np.asarray((drawn[0] + 1j * drawn[1]) * shape)


def _in_time(spectra: FloatArray | NDArray[np.complex128], count: int) -> Float32Array:
    """Transform to the time domain and give every channel a mean power of 1."""
    noise = scipy.fft.irfft(spectra, count, axis=1)
    return np.asarray(noise / np.sqrt(np.square(noise).mean(axis=1, keepdims=True)), dtype=np.float32)
