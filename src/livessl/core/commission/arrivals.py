"""Arrival times of the same sounds at arrays that share a clock; unlike directions, they determine distances."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from livessl.core.commission.places import Microphones, centred
from livessl.core.types import FloatArray, IntArray

ARRIVAL_STD_S: Final = 60e-6
"""Standard deviation of a measured time between two arrays in a room, seconds: 2 cm."""


@dataclass(frozen=True, slots=True)
class Arrivals:
    """Times at which some arrays received some sounds.

    Parameters
    ----------
    arrays : tuple of str
        Arrays on one clock.
    times_s : (S, A) float64
        Mean time over the microphones of each array, seconds, up to a constant for each sound; NaN if an array did not
        receive the sound.
    std_s : float
        Standard deviation of a difference of two times, seconds.
    """

    arrays: tuple[str, ...]
    times_s: FloatArray
    std_s: float = ARRIVAL_STD_S

    def of_sounds(self, used: IntArray) -> Arrivals:
        """Return the times of some of the sounds."""
        return Arrivals(self.arrays, self.times_s[used], self.std_s)

    def contradictions_s(self, microphones: Microphones, positions_m: FloatArray, c_m_s: float) -> FloatArray:
        """Return the differences (S, A) between predicted and measured times of sounds at places (S, 3), seconds."""
        predicted = mean_times_s([microphones[name] for name in self.arrays], positions_m, c_m_s)
        there = np.isfinite(self.times_s)
        return centred(np.where(there, predicted, np.nan)) - centred(self.times_s)

    def slopes_s_m(self, microphones: Microphones, positions_m: FloatArray, c_m_s: float) -> FloatArray:
        """Return the slope (S, A, 3) of `contradictions_s` by the places, seconds per metre."""
        slopes = []
        for name in self.arrays:
            towards = positions_m[:, None] - microphones[name]
            unit = towards / np.maximum(np.linalg.norm(towards, axis=2, keepdims=True), 1e-9)
            slopes.append(unit.mean(axis=1) / c_m_s)
        there = np.isfinite(self.times_s)[..., None]
        stacked = np.where(there, np.stack(slopes, axis=1), 0.0)
        mean = stacked.sum(axis=1, keepdims=True) / np.maximum(there.sum(axis=1, keepdims=True), 1)
        return np.asarray(np.where(there, stacked - mean, 0.0))


def mean_times_s(arrays_m: list[FloatArray], positions_m: FloatArray, c_m_s: float) -> FloatArray:
    """Return the mean travel times (S, A) from places (S, 3) to the microphones of each array, seconds."""
    return (
        np.stack([np.linalg.norm(positions_m[:, None] - at_m, axis=2).mean(axis=1) for at_m in arrays_m], axis=1)
        / c_m_s
    )
