"""Impulse responses of a box whose walls differ in what they absorb, and of a source that faces a direction.

It is the image method of `livessl.simulation.room` with a reflection factor for each wall and frequency band. Needs
numba.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import ArrayLike
from scipy.fft import irfft, next_fast_len, rfft

from livessl.core.kernels.jit import jit
from livessl.core.types import Float32Array, FloatArray
from livessl.simulation.room import GUARD, OVERSAMPLING, absorption, checked_positions, decimation_gain

CROSSOVERS_HZ: Final = (500.0, 2000.0)
"""Frequencies, in hertz, between the low, the middle and the high band; each crossover is an octave wide."""

TALKER: Final = (0.1, 0.3, 0.45)
"""Share a of the dipole in the pattern (1 - a) + a cos(angle) of a talker, in each band. Behind him the sound is weaker
by 2, 8 and 20 dB, about as measured by Chu and Warnock (Detailed directivity of sound fields around human talkers,
IRC-RR-104, National Research Council Canada, 2002)."""

MOST_ABSORPTION: Final = 0.98
"""Largest absorption coefficient of a wall."""


def wall_absorption(
    rt60_s: float, room_size_m: ArrayLike, shares: ArrayLike, bands: ArrayLike = (1.0,), c_m_s: float = 343.0
) -> FloatArray:
    """Return the absorption of each wall in each band for a nominal reverberation time.

    Parameters
    ----------
    rt60_s : float
        Reverberation time in seconds, by Sabine, where the bands' factor is 1.
    room_size_m : (3,)
        Metres.
    shares : (3, 2)
        How much each wall absorbs relative to the others: at 0 and at the far end of x, y and z.
    bands : (B,)
        Factor on the absorption in each band, low to high: one, or three.
    c_m_s : float
        Speed of sound, m/s.

    Returns
    -------
    (3, 2, B) float64
        The mean over the surface is that of `absorption`, times the band's factor, unless a wall would exceed
        `MOST_ABSORPTION`.
    """
    mean = absorption(rt60_s, room_size_m, c_m_s)
    x, y, z = np.asarray(room_size_m, dtype=np.float64)
    areas = np.repeat([y * z, x * z, x * y], 2).reshape(3, 2)
    relative = np.asarray(shares, dtype=np.float64)
    relative = relative * areas.sum() / (relative * areas).sum()
    return np.asarray(np.minimum(mean * relative[..., None] * np.asarray(bands, dtype=np.float64), MOST_ABSORPTION))


def wall_responses(
    room_size_m: ArrayLike,
    source_m: ArrayLike,
    microphones_m: ArrayLike,
    absorptions: FloatArray,
    *,
    duration_s: float,
    sample_rate_hz: float,
    c_m_s: float = 343.0,
    facing: FloatArray | None = None,
) -> Float32Array:
    """Compute the responses from a source to omnidirectional microphones by the image method.

    An image at distance d has the amplitude g prod beta^n / (4 pi d). The product is over the walls, with n reflections
    at each, and g is the source's pattern in the direction in which the sound leaves it.

    Parameters
    ----------
    room_size_m : (3,)
        Metres, one corner at the origin.
    source_m : (3,)
        Metres, strictly inside.
    microphones_m : (K, 3)
        Metres, strictly inside, none at the source.
    absorptions : (3, 2, B) float64
        Absorption coefficients, as `wall_absorption` returns them; B is 1, or 3 for the bands between `CROSSOVERS_HZ`.
    duration_s : float
        Length in seconds; it contains every image that arrives within it.
    sample_rate_hz : float
    c_m_s : float
        Speed of sound, m/s.
    facing : (3,) float64 or None
        Direction that a `TALKER` faces; None for a source that radiates equally in all directions.

    Returns
    -------
    (K, n) float32
        Sample 0 is the moment of emission; 1 is the amplitude at 1/(4 pi) metres.

    Raises
    ------
    ValueError
        If a position lies outside the room, or the number of bands is neither 1 nor 3.
    """
    room_m, source, microphones = checked_positions(room_size_m, source_m, microphones_m)
    given = absorptions.shape[2]
    if given not in (1, 1 + len(CROSSOVERS_HZ)):
        raise ValueError(f"walls: expected absorption in 1 or {1 + len(CROSSOVERS_HZ)} bands, got {given}")
    directed = facing is not None
    bands = max(given, 1 + len(CROSSOVERS_HZ)) if directed else given
    beta = np.sqrt(1.0 - np.broadcast_to(absorptions, (3, 2, bands)))
    dipole = np.array(TALKER) if directed else np.zeros(bands)
    ahead = np.zeros(3) if facing is None else np.asarray(facing) / np.linalg.norm(facing)
    count = int(np.ceil(duration_s * sample_rate_hz))
    fft_size = next_fast_len(count + GUARD, real=True)
    shares = decimation_gain(fft_size) * _band_gains(fft_size, sample_rate_hz, bands)
    bins_per_m, reach_m = sample_rate_hz * OVERSAMPLING / c_m_s, duration_s * c_m_s
    responses = np.empty((len(microphones), count), dtype=np.float32)
    for k, microphone in enumerate(microphones):
        axes = [
            _axis(room_m[axis], source[axis], microphone[axis], reach_m, beta[axis], ahead[axis]) for axis in range(3)
        ]
        fine = np.zeros((count * OVERSAMPLING + 2, bands), dtype=np.float32)
        _walk(*axes[0], *axes[1], *axes[2], reach_m**2, bins_per_m, dipole, fine)
        spectra = np.asarray(rfft(fine[: count * OVERSAMPLING].T, fft_size * OVERSAMPLING, axis=1))
        spectrum = (spectra[:, : fft_size // 2 + 1] * shares).sum(axis=0)
        responses[k] = irfft(spectrum, fft_size)[:count]
    return responses


def _band_gains(fft_size: int, sample_rate_hz: float, bands: int) -> FloatArray:
    """Return the share of each band in each bin, (B, fft_size/2 + 1); the shares sum to 1."""
    frequencies_hz = np.arange(fft_size // 2 + 1) * sample_rate_hz / fft_size
    if bands == 1:
        return np.ones((1, len(frequencies_hz)))
    octaves = np.log2(np.maximum(frequencies_hz, 1.0) / np.array(CROSSOVERS_HZ)[:, None])
    above = 0.5 - 0.5 * np.cos(np.pi * np.clip(octaves + 0.5, 0.0, 1.0))
    edges = np.vstack([np.ones(len(frequencies_hz)), above, np.zeros(len(frequencies_hz))])
    return np.asarray(edges[:-1] - edges[1:])


def _axis(
    length_m: float, source_m: float, microphone_m: float, reach_m: float, beta: FloatArray, ahead: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return squared distances, parts of the pattern's scalar product, and gains (n, B) of images along one axis.

    They are in the order of distance. Of i reflections, the wall that the sound meets last gets the odd one: the far
    wall for images beyond it. Every reflection turns the direction that the source faces.
    """
    ends = int(reach_m / length_m) + 2
    index = np.arange(-ends, ends + 1, dtype=np.int64)
    even = index % 2 == 0
    off_m = microphone_m - (index * length_m + np.where(even, source_m, length_m - source_m))
    number = np.abs(index)
    more, fewer = (number + 1) // 2, number // 2
    at_zero, at_end = np.where(index < 0, more, fewer), np.where(index < 0, fewer, more)
    gains = beta[0] ** at_zero[:, None] * beta[1] ** at_end[:, None]  # 0^0 = 1: the direct path
    nearest = np.argsort(np.square(off_m))
    nearest = nearest[np.abs(off_m[nearest]) < reach_m]
    parts = off_m * np.where(even, ahead, -ahead)
    return np.square(off_m[nearest]), parts[nearest], np.ascontiguousarray(gains[nearest])


@jit()
def _walk(  # type: ignore[no-untyped-def]
    x2, x_part, x_gain, y2, y_part, y_gain, z2, z_part, z_gain, reach2, bins_per_m, dipole, fine
):
    """Add every image within reach to the fine time axis (bins, B), each to the two bins it lies between."""
    bands, last = fine.shape[1], len(fine) - 2
    column = np.empty(bands, np.float64)
    for z in range(len(z2)):
        if z2[z] >= reach2:
            break
        for y in range(len(y2)):
            if z2[z] + y2[y] >= reach2:
                break
            for band in range(bands):
                column[band] = z_gain[z, band] * y_gain[y, band] / (4.0 * np.pi)
            for x in range(len(x2)):
                square = z2[z] + y2[y] + x2[x]
                if square >= reach2:
                    break
                distance_m = np.sqrt(square)
                cosine = (z_part[z] + y_part[y] + x_part[x]) / distance_m
                place = distance_m * bins_per_m
                lower = int(place)
                if lower > last:
                    break
                upper = place - lower
                for band in range(bands):
                    pattern = 1.0 - dipole[band] + dipole[band] * cosine
                    amplitude = column[band] * x_gain[x, band] * pattern / distance_m
                    fine[lower, band] += np.float32((1.0 - upper) * amplitude)
                    fine[lower + 1, band] += np.float32(upper * amplitude)
