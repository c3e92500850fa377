"""Computes the part of a position's covariance that comes from the set-up: arrays not exactly where the site says.

The position is where the delays fit best: a displacement d_m of microphone m moves it by
dp = (sum g g^T / s^2)^-1 sum_m G_m d_m, g the slopes of the path differences with the position, and G_m the pull of
that microphone. The microphones of one frame are displaced together, by a shift and a turn of the frame. A wrong speed
of sound scales all path differences alike.
This error is the same for all sounds from one place, so it says nothing about how positions scatter. It does lower the
probability that a position is right.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Final

import numpy as np
import scipy

from livessl.core.correlate.gcc_phat import mean_square_angular_frequency
from livessl.core.geometry import microphone_pairs, pair_weight
from livessl.core.types import ArraySpec, FloatArray, IntArray

_DELAY_M: Final = 0.003
"""Error of the delays, in metres of path, with which their information is compared with that of the distance: without
it, a coordinate that no array determines would have an infinite error."""

NINETY_PERCENT: Final = 6.251
"""Squared radius, in standard deviations, of the ellipsoid that contains 90 % of a normal distribution in space."""

_DIRECTIONS: Final = 500
"""Number of directions over which a probability is averaged: its error is below 0.002 for any covariance."""

_KELVIN: Final = 293.0
"""Usual temperature, in kelvin: the speed of sound goes with its square root."""


def set_up_covariance_m2(arrays: Sequence[ArraySpec], position_m: FloatArray, axes: Sequence[int]) -> FloatArray:
    """Covariance (3, 3) of a position, in square metres, that follows from the `uncertainty` of the arrays' set-ups.

    The delays of channels within an array are taken to be exact.

    Parameters
    ----------
    arrays : sequence of ArraySpec
        The arrays that the position was computed from, at least one.
    position_m : (3,) float64
    axes : sequence of int
        Axes along which the position was searched for; along the others it has no error.
    """
    distances_m = [float(np.linalg.norm(position_m - spec.centre_m)) for spec in arrays]
    unknown_m = max(*distances_m, *(spec.aperture_m for spec in arrays))
    counts = np.array([len(spec.microphones_m) for spec in arrays])
    from_m = position_m - np.concatenate([spec.microphones_m for spec in arrays])
    distance_m = np.maximum(np.linalg.norm(from_m, axis=1), 1e-3)
    toward = from_m / distance_m[:, None]
    pairs = [microphone_pairs(count) + begin for count, begin in zip(counts, _begins(counts), strict=True)]
    first, second = np.concatenate(pairs).T
    bandwidths = np.array([mean_square_angular_frequency(spec.band_hz) for spec in arrays])
    weights = bandwidths / bandwidths.mean() / _DELAY_M**2 * [pair_weight(count) for count in counts]
    slopes = toward[second] - toward[first]
    weighted = np.repeat(weights, [len(own) for own in pairs])[:, None] * slopes
    information = np.eye(3) / unknown_m**2 + weighted.T @ slopes
    by_speed = weighted.T @ (distance_m[second] - distance_m[first])
    pulls = np.zeros_like(toward)  # sum over the pairs of a microphone, with its sign in each
    np.add.at(pulls, second, weighted)
    np.subtract.at(pulls, first, weighted)
    spread = _by_frames(arrays, pulls[:, :, None] * toward[:, None, :])
    speed_share = max(spec.uncertainty.temperature_c for spec in arrays) / (2.0 * _KELVIN)
    spread += speed_share**2 * np.outer(by_speed, by_speed)
    free = np.ix_(list(axes), list(axes))
    covariance_m2 = np.zeros((3, 3))
    inverse = np.linalg.inv(information[free])
    covariance_m2[free] = inverse @ spread[free] @ inverse
    return covariance_m2


def probability_within(radius_m: float, covariance_m2: FloatArray) -> float:
    """Return the probability that a normally distributed error is at most `radius_m` long.

    In units of its standard deviations the error has a uniform direction u, and a length that follows a chi
    distribution with three degrees of freedom, F. The probability is the mean of F(radius / |L u|), C = L L^T.

    Parameters
    ----------
    radius_m : float
    covariance_m2 : (3, 3) float64
        Square metres.
    """
    deviations_m = np.sqrt(np.maximum(np.linalg.eigvalsh(covariance_m2), 0.0))
    reach = radius_m / np.maximum(np.linalg.norm(_directions() * deviations_m, axis=1), 1e-12)
    density = np.sqrt(2.0 / np.pi) * reach * np.exp(-np.square(reach) / 2.0)
    return float(np.mean(scipy.special.erf(reach / np.sqrt(2.0)) - density))


def half_axis_m(covariance_m2: FloatArray) -> float:
    """Return the longest half axis, in metres, of the ellipsoid that contains 90 % of a normal distribution (3, 3)."""
    return float(np.sqrt(max(0.0, NINETY_PERCENT * np.linalg.eigvalsh(covariance_m2)[-1])))


@cache
def _directions() -> FloatArray:
    """Unit vectors (N, 3), evenly spread over the sphere on a spiral of golden angles."""
    number = np.arange(_DIRECTIONS)
    height = (2.0 * number + 1.0) / _DIRECTIONS - 1.0
    angle = np.pi * (3.0 - np.sqrt(5.0)) * number
    around = np.sqrt(1.0 - np.square(height))
    return np.stack([around * np.cos(angle), around * np.sin(angle), height], axis=1)


def _by_frames(arrays: Sequence[ArraySpec], pulls: FloatArray) -> FloatArray:
    """Return the spread (3, 3) by shifts and turns of the arrays' frames; `pulls` (K, 3, 3) of all microphones."""
    frames = [spec.parts or (len(spec.microphones_m),) for spec in arrays]  # microphones of each frame
    counts = np.array([count for own in frames for count in own])
    begins, microphones_m = _begins(counts), np.concatenate([spec.microphones_m for spec in arrays])
    centres_m = np.add.reduceat(microphones_m, begins) / counts[:, None]
    x, y, z = (microphones_m - np.repeat(centres_m, counts, axis=0)).T
    zero = np.zeros_like(x)
    turned = np.array([[zero, z, -y], [-z, zero, x], [y, -x, zero]]).transpose(2, 0, 1)  # (K, 3, 3), by unit turns
    shifts, turns = np.add.reduceat(pulls, begins), np.add.reduceat(pulls @ turned, begins)
    known = [spec.uncertainty for spec, own in zip(arrays, frames, strict=True) for _ in own]
    shifts *= np.array([one.position_m for one in known])[:, None, None]
    turns *= np.radians([one.orientation_deg for one in known])[:, None, None]
    both = np.concatenate([shifts, turns])
    return np.asarray(np.einsum("fab,fcb->ac", both, both))


def _begins(counts: IntArray) -> IntArray:
    """Return where each of several runs begins that follow one another, of these lengths."""
    return np.asarray(np.cumsum(counts) - counts)
