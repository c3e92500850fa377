"""Fits a set-up to the delays of sounds with the freedom that a careful set-up has.

No pose is measured exactly, and delays in rooms have outliers. Each array may therefore be shifted and turned, each
microphone may be elsewhere, and the speed of sound may differ, by as much as their standard deviations allow. What
remains is weighed by a distribution with heavy tails, for each sound at each array together, because an array that
receives an echo best has errors in all its delays.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from livessl.core.commission.places import Delays, Microphones, contradictions_s, slopes_s_m
from livessl.core.commission.poses import moved
from livessl.core.types import FloatArray

DELAY_STD_S: Final = 6e-6
"""Standard deviation of a delay in a room that is no outlier, seconds."""

TAILS: Final = 3.0
"""Degrees of freedom of the t distribution of delays: 3 has heavy tails."""

POSITION_STD_M: Final = 0.02
ORIENTATION_STD_DEG: Final = 1.2
MICROPHONE_STD_M: Final = 0.002
SPEED_STD_M_S: Final = 1.5
"""Standard deviations of a careful set-up, along each axis: metres, degrees, metres and m/s."""

_STEPS: Final = 5
_MOST_STEP_M: Final = 1.0
"""Longest step of a place in one iteration, metres."""

_LEAST_SLOPE: Final = 1e-6
"""Added to the normal equations of a place, in standard deviations per metre squared: some are not determined."""

_POSE: Final = 6
"""Unknowns of a pose: three of the shift, three of the turn."""


@dataclass(frozen=True, slots=True)
class Freedom:
    """Standard deviations of one array, along each axis.

    Parameters
    ----------
    position_m, orientation_deg : float
        Metres and degrees.
    microphones_m : (K,) float64
        Of each microphone, metres.
    """

    position_m: float
    orientation_deg: float
    microphones_m: FloatArray


@dataclass(frozen=True, slots=True)
class Explained:
    """The fit of a set-up to some sounds.

    Parameters
    ----------
    deviance : float
        Minus twice the logarithm of the likelihood and of the priors, up to a constant; lower is better.
    places_m : (S, 3) float64
        Where the sounds were, metres.
    shifts_m, turns_deg : mapping of array to (3,) float64
        By how much each array differs from the given set-up.
    displaced_m : mapping of array to (K, 3) float64
        By how much each microphone does besides.
    speed_off_m_s : float
        By how much the speed of sound does.
    """

    deviance: float
    places_m: FloatArray
    shifts_m: Mapping[str, FloatArray]
    turns_deg: Mapping[str, FloatArray]
    displaced_m: Mapping[str, FloatArray]
    speed_off_m_s: float


def careful(microphones: Microphones) -> dict[str, Freedom]:
    """Return the freedom of arrays that were set up with care."""
    return {
        name: Freedom(POSITION_STD_M, ORIENTATION_STD_DEG, np.full(len(at_m), MICROPHONE_STD_M))
        for name, at_m in microphones.items()
    }


def explained(
    microphones: Microphones,
    delays: Delays,
    starts_m: FloatArray,
    bounds_m: FloatArray,
    c_m_s: float,
    freedom: Mapping[str, Freedom],
    speed_std_m_s: float = SPEED_STD_M_S,
) -> Explained:
    """Fit places and the small freedom of a set-up to delays, and return how well they fit.

    Parameters
    ----------
    microphones : mapping of array to (K, 3) float64
        The set-up, metres.
    delays : mapping of array to (S, K) float64
        Seconds; NaN where there is none.
    starts_m : (S, 3) float64
        Places to begin at, metres.
    bounds_m : (3, 2) float64
        Search volume, metres.
    c_m_s, speed_std_m_s : float
        Speed of sound and its standard deviation, m/s.
    freedom : mapping of array to Freedom
    """
    problem = _Problem(microphones, delays, bounds_m, c_m_s, freedom, speed_std_m_s)
    places_m, unknowns = starts_m.copy(), np.zeros(len(problem.scale))
    best = problem.deviance(places_m, unknowns), places_m, unknowns
    for _ in range(_STEPS):
        places_m, unknowns = problem.step(places_m, unknowns)
        deviance = problem.deviance(places_m, unknowns)
        if deviance < best[0]:
            best = deviance, places_m, unknowns
    return problem.result(*best)


class _Problem:
    """The fit. Unknowns are in standard deviations: for each array shift, turn and microphones, then the speed."""

    def __init__(
        self,
        microphones: Microphones,
        delays: Delays,
        bounds_m: FloatArray,
        c_m_s: float,
        freedom: Mapping[str, Freedom],
        speed_std_m_s: float,
    ) -> None:
        self._microphones, self._delays, self._bounds_m, self._c_m_s = microphones, delays, bounds_m, c_m_s
        counts = [measured.shape[1] for measured in delays.values()]
        ends = np.cumsum(counts)
        self._rows = {name: slice(end - n, end) for name, end, n in zip(delays, ends, counts, strict=True)}
        self._columns: dict[str, slice] = {}
        parts: list[FloatArray] = []
        at = 0
        for name, count in zip(delays, counts, strict=True):
            own = freedom[name]
            parts += [np.full(3, own.position_m), np.full(3, np.radians(own.orientation_deg))]
            parts.append(np.repeat(own.microphones_m, 3))
            self._columns[name] = slice(at, at + _POSE + 3 * count)
            at += _POSE + 3 * count
        self.scale = np.concatenate([*parts, [speed_std_m_s]])
        # independent delays of each sound at each array
        self._count = {name: np.maximum(np.isfinite(one).sum(axis=1) - 1, 0) for name, one in delays.items()}

    def deviance(self, places_m: FloatArray, unknowns: FloatArray) -> float:
        """Minus twice the logarithm of the likelihood and of the priors."""
        total = float(unknowns @ unknowns)
        for name, squares in self._squares(self._off(places_m, unknowns)).items():
            total += float(((TAILS + self._count[name]) * np.log1p(squares / TAILS)).sum())
        return total

    def step(self, places_m: FloatArray, unknowns: FloatArray) -> tuple[FloatArray, FloatArray]:
        """One step of the method of Gauss and Newton, the places eliminated; reweighted for the tails."""
        microphones, c_m_s = self._set_up(unknowns)
        off = self._off(places_m, unknowns)
        weight = np.zeros_like(off)
        for name, squares in self._squares(off).items():
            weight[:, self._rows[name]] = ((TAILS + self._count[name]) / (TAILS + squares))[:, None]
        of_places = slopes_s_m(microphones, self._delays, places_m, c_m_s) / DELAY_STD_S
        of_unknowns = self._slopes(microphones, places_m, c_m_s) * (self.scale / DELAY_STD_S)
        weighted = of_places * weight[..., None]
        normal = np.einsum("sri,srj->sij", weighted, of_places) + _LEAST_SLOPE * np.eye(3)
        mixed = np.einsum("sri,srn->sin", weighted, of_unknowns)
        right = np.einsum("sri,sr->si", weighted, off)
        rows = (of_unknowns * weight[..., None]).reshape(-1, len(unknowns))
        whole = rows.T @ of_unknowns.reshape(-1, len(unknowns)) + np.eye(len(unknowns))
        gradient = rows.T @ off.ravel() + unknowns
        solved = np.linalg.solve(normal, np.concatenate([mixed, right[..., None]], axis=2))
        of_mixed, of_right = solved[..., :-1], solved[..., -1]
        reduced = whole - np.einsum("sin,sim->nm", mixed, of_mixed)
        change = -np.linalg.solve(reduced, gradient - np.einsum("sin,si->n", mixed, of_right))
        step_m = np.clip(-(of_right + of_mixed @ change), -_MOST_STEP_M, _MOST_STEP_M)
        moved_m = np.clip(places_m + step_m, self._bounds_m[:, 0], self._bounds_m[:, 1])
        return moved_m, unknowns + change

    def result(self, deviance: float, places_m: FloatArray, unknowns: FloatArray) -> Explained:
        """Return the unknowns by name."""
        off = unknowns * self.scale
        shifts_m, turns_deg, displaced_m = {}, {}, {}
        for name, columns in self._columns.items():
            own = off[columns]
            shifts_m[name], turns_deg[name] = own[:3], np.degrees(own[3:_POSE])
            displaced_m[name] = own[_POSE:].reshape(-1, 3)
        return Explained(deviance, places_m, shifts_m, turns_deg, displaced_m, float(off[-1]))

    def _set_up(self, unknowns: FloatArray) -> tuple[dict[str, FloatArray], float]:
        off = unknowns * self.scale
        microphones = {}
        for name, columns in self._columns.items():
            own = off[columns]
            microphones[name] = moved(self._microphones[name], own[:3], own[3:_POSE]) + own[_POSE:].reshape(-1, 3)
        return microphones, self._c_m_s + float(off[-1])

    def _off(self, places_m: FloatArray, unknowns: FloatArray) -> FloatArray:
        microphones, c_m_s = self._set_up(unknowns)
        return contradictions_s(microphones, self._delays, places_m, c_m_s) / DELAY_STD_S

    def _squares(self, off: FloatArray) -> dict[str, FloatArray]:
        return {name: (off[:, rows] ** 2).sum(axis=1) for name, rows in self._rows.items()}

    def _slopes(self, microphones: Microphones, places_m: FloatArray, c_m_s: float) -> FloatArray:
        """Slope (S, R, N) of the contradictions by the unknowns, seconds per metre, radian and m/s."""
        parts = [self._of_array(name, microphones[name], places_m, c_m_s) for name in self._columns]
        return np.concatenate(parts, axis=1)

    def _of_array(self, name: str, at_m: FloatArray, places_m: FloatArray, c_m_s: float) -> FloatArray:
        towards = places_m[:, None] - at_m
        away_m = np.maximum(np.linalg.norm(towards, axis=2), 1e-9)
        slope = -towards / (away_m * c_m_s)[..., None]  # of the delays by the microphones' positions
        columns, index = self._columns[name], np.arange(len(at_m))
        slopes = np.zeros((len(places_m), len(at_m), len(self.scale)))
        own = slopes[..., columns]
        own[..., :3] = slope
        own[..., 3:_POSE] = np.cross(at_m - at_m.mean(axis=0), slope)
        own[..., _POSE:].reshape(len(places_m), len(at_m), len(at_m), 3)[:, index, index] = slope
        slopes[..., -1] = -away_m / c_m_s**2
        there = np.isfinite(self._delays[name])[..., None]
        slopes = np.where(there, slopes, 0.0)
        mean = slopes.sum(axis=1, keepdims=True) / np.maximum(there.sum(axis=1, keepdims=True), 1)
        return np.asarray(np.where(there, slopes - mean, 0.0))
