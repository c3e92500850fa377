"""Stacks several set-ups, so that all are fitted in one computation; has the accuracy of a careful set-up."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from livessl.core.commission.places import LEAST_DAMPING, LEAST_SLOPE, Delays, Microphones
from livessl.core.types import BoolArray, FloatArray, IntArray

POSITION_STD_M: Final = 0.02
ORIENTATION_STD_DEG: Final = 1.2
MICROPHONE_STD_M: Final = 0.002
SPEED_STD_M_S: Final = 1.5
"""Standard deviations of a careful set-up, along each axis: metres, degrees, metres and m/s."""

DELAY_STD_S: Final = 6e-6
"""Standard deviation, in seconds, of a delay in a room that is no outlier, if no other value is known."""

_STEPS: Final = 25
"""Largest number of steps of the refinement of places; usually it ends after a few."""

_FIRST_DAMPING: Final = 1e-3
_ENOUGH_M: Final = 1e-3
"""Step, in metres, below which the refinement of places ends."""


@dataclass(frozen=True, slots=True)
class Freedom:
    """Standard deviations of one array, along each axis.

    Parameters
    ----------
    position_m : float
        Metres.
    orientation_deg : (3,) float64
        Standard deviations about x, y and z, degrees.
    microphones_m : (K,) float64
        Standard deviation of each microphone, metres.
    """

    position_m: float
    orientation_deg: FloatArray
    microphones_m: FloatArray


@dataclass(frozen=True, slots=True)
class SetUp:
    """A set-up, the delays of some sounds in it, and its standard deviations.

    Parameters
    ----------
    microphones : mapping of array to (K, 3) float64
        Metres.
    delays : mapping of array to (S, K) float64
        Delays in seconds; NaN if a channel has no delay.
    c_m_s, speed_std_m_s : float
        Speed of sound and its standard deviation, m/s.
    freedom : mapping of array to Freedom
    late : (str, int) or None
        Array and index of a channel that may have any delay.
    stds_s : mapping of array to (S,) float64
        Standard deviations of the delays of each sound, seconds; `DELAY_STD_S` for arrays that it leaves out.
    """

    microphones: Microphones
    delays: Delays
    c_m_s: float
    freedom: Mapping[str, Freedom]
    speed_std_m_s: float = SPEED_STD_M_S
    late: tuple[str, int] | None = None
    stds_s: Mapping[str, FloatArray] = field(default_factory=dict)


def careful(
    microphones: Microphones, position_std_m: float = POSITION_STD_M, orientation_std_deg: float = ORIENTATION_STD_DEG
) -> dict[str, Freedom]:
    """Return the freedom of arrays that were set up with care, or with the given standard deviations."""
    return {
        name: Freedom(position_std_m, np.full(3, orientation_std_deg), np.full(len(at_m), MICROPHONE_STD_M))
        for name, at_m in microphones.items()
    }


@dataclass(frozen=True, slots=True)
class Known:
    """The accuracy with which a set-up, and the delays of some sounds in it, are known.

    Parameters
    ----------
    freedom : mapping of array to Freedom
    stds_s : mapping of array to (S,) float64
        Standard deviations of the delays of each sound, seconds; `DELAY_STD_S` for arrays that it leaves out.
    """

    freedom: Mapping[str, Freedom]
    stds_s: Mapping[str, FloatArray] = field(default_factory=dict)

    def of_sounds(self, rows: IntArray) -> Known:
        """Return the accuracy for some of the sounds."""
        return Known(self.freedom, {name: one[rows] for name, one in self.stds_s.items()})


class Stacked:
    """H set-ups of the same arrays, with S sounds each.

    Parameters
    ----------
    set_ups : sequence of SetUp
        Set-ups with the same arrays, the same numbers of microphones, and the same number of sounds.
    bounds_m : (3, 2) float64
        Search volume, metres.

    Attributes
    ----------
    microphones : dict of array to (H, K, 3) float64
        Metres.
    there : dict of array to (H, S, K) bool
        Whether a channel has a delay for a sound.
    measured_s : dict of array to (H, S, K) float64
        Delays minus the mean over the array's channels, seconds.
    std_s : dict of array to (H, S) float64
        Standard deviations of the delays, seconds.
    c_m_s : (H,) float64
        Metres per second.
    """

    def __init__(self, set_ups: Sequence[SetUp], bounds_m: FloatArray) -> None:
        self.set_ups, self.bounds_m = tuple(set_ups), bounds_m
        self.names = tuple(set_ups[0].delays)
        self.microphones = {name: np.stack([one.microphones[name] for one in set_ups]) for name in self.names}
        self.c_m_s = np.array([one.c_m_s for one in set_ups])
        self.there: dict[str, BoolArray] = {}
        self.measured_s: dict[str, FloatArray] = {}
        self.std_s: dict[str, FloatArray] = {}
        for name in self.names:
            delays_s = np.stack([one.delays[name] for one in set_ups])
            self.there[name] = np.isfinite(delays_s)
            self.measured_s[name] = centred_where(delays_s, self.there[name])
            unknown_s = np.full(delays_s.shape[1], DELAY_STD_S)
            self.std_s[name] = np.stack([one.stds_s.get(name, unknown_s) for one in set_ups])

    def placed(self, starts_m: FloatArray, but: Sequence[tuple[str, int] | None] = ()) -> FloatArray:
        """Find the places (H, S, 3), metres, that explain the delays best in the set-ups as given.

        All places are refined together by the method of Levenberg and Marquardt, within the search volume.

        Parameters
        ----------
        starts_m : (H, S, 3) float64
            Places at which the search begins, metres.
        but : sequence of (str, int) or None
            For each set-up, the array and index of a channel that is not used; None to use all.
        """
        there = {name: one.copy() for name, one in self.there.items()}
        for row, left_out in enumerate(but):
            if left_out is not None:
                there[left_out[0]][row, :, left_out[1]] = False
        measured = {name: centred_where(self.measured_s[name], there[name]) for name in self.names}
        places_m, damping = starts_m.copy(), np.full(starts_m.shape[:2], _FIRST_DAMPING)
        off, slope = self._off_and_slope(places_m, there, measured)
        cost = (off**2).sum(axis=-1)
        for _ in range(_STEPS):
            turned = slope.swapaxes(-1, -2)
            normal = turned @ slope
            scale = np.trace(normal, axis1=-2, axis2=-1) / 3.0
            normal = normal + (damping * scale + LEAST_SLOPE)[..., None, None] * np.eye(3)
            step_m = (inverse(normal) @ (turned @ off[..., None]))[..., 0]
            tried_m = np.clip(places_m - step_m, self.bounds_m[:, 0], self.bounds_m[:, 1])
            done = np.linalg.norm(tried_m - places_m, axis=-1).max() < _ENOUGH_M
            tried, tried_slope = self._off_and_slope(tried_m, there, measured)
            tried_cost = (tried**2).sum(axis=-1)
            better = tried_cost < cost
            places_m[better], off[better], slope[better] = tried_m[better], tried[better], tried_slope[better]
            cost = np.where(better, tried_cost, cost)
            damping = np.where(better, np.maximum(damping / 5.0, LEAST_DAMPING), damping * 8.0)
            if done:
                break
        return places_m

    def _off_and_slope(
        self, places_m: FloatArray, there: dict[str, BoolArray], measured_s: dict[str, FloatArray]
    ) -> tuple[FloatArray, FloatArray]:
        """Return the residuals (H, S, R) of the delays, seconds, and their slopes (H, S, R, 3) by the places."""
        offs, slopes = [], []
        for name in self.names:
            away_m, unit = away(places_m, self.microphones[name])
            c_m_s = self.c_m_s[:, None, None]
            offs.append(centred_where(away_m / c_m_s, there[name]) - measured_s[name])
            slopes.append(centred_rows(unit / c_m_s[..., None], there[name]))
        return np.concatenate(offs, axis=2), np.concatenate(slopes, axis=2)


def away(places_m: FloatArray, microphones_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return distances (H, S, K), metres, and unit vectors (H, S, K, 3) to places (H, S, 3) from microphones."""
    towards = places_m[:, :, None] - microphones_m[:, None]
    away_m = np.maximum(np.sqrt(np.einsum("hski,hski->hsk", towards, towards)), 1e-9)
    return away_m, towards / away_m[..., None]


def centred_where(values: FloatArray, there: BoolArray) -> FloatArray:
    """Return existing values (..., K) minus their mean, and 0 for missing ones."""
    return centred_rows(values[..., None], there)[..., 0]


def centred_rows(values: FloatArray, there: BoolArray) -> FloatArray:
    """Return existing rows (..., K, n) minus their mean over K, and 0 for missing ones."""
    count = np.maximum(there.sum(axis=-1), 1)[..., None, None]
    known = np.where(there[..., None], values, 0.0)
    return np.asarray(np.where(there[..., None], known - known.sum(axis=-2, keepdims=True) / count, 0.0))


def inverse(matrices: FloatArray) -> FloatArray:
    """Return the inverses of matrices (..., 3, 3), by cofactors: LAPACK is slow with many small ones."""
    a, b, c = (matrices[..., row, :] for row in range(3))
    cofactors = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=-1)
    determinant = (a * cofactors[..., 0]).sum(axis=-1)
    return np.asarray(cofactors / determinant[..., None, None])
