"""The part of a position's error that comes from the set-up: arrays that stand or point elsewhere than the site says.

Each array's delays tell a place relative to the array. An array that is shifted and turned tells another place, off by
d_a; of the places that the arrays tell, the position is the mean, weighted with what each array knows of it:
dp = (sum I_a)^-1 sum I_a d_a, I_a the information of its delays. A wrong speed of sound scales all delays alike.
This error is the same for all sounds from one place, so it says nothing about how positions scatter.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from livessl.core.correlate.gcc_phat import mean_square_angular_frequency
from livessl.core.geometry import microphone_pairs, pair_weight
from livessl.core.types import ArraySpec, FloatArray

_DELAY_M: Final = 0.003
"""Error of the delays, in metres of path, with which their information is compared with that of the distance: without
it, a coordinate that no array determines would have an infinite error."""

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
    to_m = [position_m - spec.centre_m for spec in arrays]
    farthest_m = max(float(np.linalg.norm(each)) for each in to_m)
    information, spread, by_speed = np.eye(3) / max(farthest_m, 1e-3) ** 2, np.zeros((3, 3)), np.zeros(3)
    bandwidths = np.array([mean_square_angular_frequency(spec.band_hz) for spec in arrays])
    for spec, offset_m, share in zip(arrays, to_m, bandwidths / bandwidths.mean(), strict=True):
        own, late_m = _slopes(spec, position_m)
        weight = pair_weight(len(spec.microphones_m)) * share / _DELAY_M**2
        of_array = weight * own.T @ own
        across = offset_m @ offset_m * np.eye(3) - np.outer(offset_m, offset_m)
        known = spec.uncertainty
        moved_m2 = known.position_m**2 * np.eye(3) + np.radians(known.orientation_deg) ** 2 * across
        information += of_array
        spread += of_array @ moved_m2 @ of_array
        by_speed += weight * own.T @ late_m
    speed_share = max(spec.uncertainty.temperature_c for spec in arrays) / (2.0 * _KELVIN)
    spread += speed_share**2 * np.outer(by_speed, by_speed)
    free = np.ix_(list(axes), list(axes))
    covariance_m2 = np.zeros((3, 3))
    inverse = np.linalg.inv(information[free])
    covariance_m2[free] = inverse @ spread[free] @ inverse
    return covariance_m2


def _slopes(spec: ArraySpec, position_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return how the path differences of an array's pairs change with the position (P, 3), and the differences (P,)."""
    from_m = position_m - spec.microphones_m
    distance_m = np.maximum(np.linalg.norm(from_m, axis=1), 1e-3)
    first, second = microphone_pairs(len(spec.microphones_m)).T
    toward = from_m / distance_m[:, None]
    return toward[second] - toward[first], distance_m[second] - distance_m[first]
