"""Finds where sounds were from the delays within each array, and the misfit: how far the delays contradict each other.

The contradiction, the misfit, is what remains of the delays at the best places. It is some 20 us in a set-up that is as
filed, in a room, and 100 us and more where an array is turned or its channels are in another order.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from livessl.core.types import Float32Array, FloatArray

Microphones = Mapping[str, FloatArray]
"""Positions (K, 3) of the microphones of each array, metres."""

Delays = Mapping[str, FloatArray]
"""Delays (S, K) of S sounds at the channels of each array, seconds; NaN where there is none."""

MOST_POINTS: Final = 5_000
"""Most grid points at which places begin; their spacing grows with the search volume."""

KEPT: Final = 0.8
"""Share of the sounds that count, those that fit best: now and then an array receives an echo or another sound best."""

_STEPS: Final = 25
"""Steps of the refinement, which ends after a handful."""

LEAST_DAMPING: Final = 1e-9
LEAST_SLOPE: Final = 1e-16
"""Least damping, and what is added to the normal equations of a place in square seconds per square metre, so that they
can be solved for a sound that two channels received, or one. Slopes are some 1e-3 s/m."""

_FIRST_DAMPING: Final = 1e-3
_LEAST_M: Final = 1e-6
"""Step, in metres, below which the refinement ends."""


@dataclass(frozen=True, slots=True)
class Places:
    """Positions of some sounds, and how well they explain the delays.

    Parameters
    ----------
    positions_m : (S, 3) float64
        Metres.
    misfits_s : (S,) float64
        Root mean square of what remains of each sound's delays, per degree of freedom, seconds.
    """

    positions_m: FloatArray
    misfits_s: FloatArray

    @property
    def misfit_s(self) -> float:
        """Root mean square misfit of the `KEPT` share of the sounds that fit best, seconds."""
        best = np.sort(self.misfits_s)[: max(1, round(KEPT * len(self.misfits_s)))]
        return float(np.sqrt(np.mean(best**2)))


def centred(delays_s: FloatArray) -> FloatArray:
    """Delays (..., K) against the mean of the channels that have one; 0 where there is none."""
    there = np.isfinite(delays_s)
    count = np.maximum(there.sum(axis=-1, keepdims=True), 1)
    mean = np.where(there, delays_s, 0.0).sum(axis=-1, keepdims=True) / count
    return np.asarray(np.where(there, delays_s - mean, 0.0))


def degrees_of_freedom(delays: Delays) -> FloatArray:
    """Number of independent delays of each sound beyond the three of its place, at least 1, (S,)."""
    counts = [np.maximum(np.isfinite(one).sum(axis=1) - 1, 0) for one in delays.values()]
    return np.asarray(np.maximum(np.sum(counts, axis=0) - 3, 1), dtype=np.float64)


class PlaceSearch:
    """Finds the places of sounds in a search volume.

    Parameters
    ----------
    bounds_m : (3, 2) float64
        Search volume, metres.
    c_m_s : float
        Speed of sound, m/s.
    points_m : (G, 3) float64 or None
        Points at which places begin, metres; None for a grid in the volume.
    """

    def __init__(self, bounds_m: FloatArray, c_m_s: float, points_m: FloatArray | None = None) -> None:
        self.bounds_m = np.asarray(bounds_m, dtype=np.float64)
        self.c_m_s = c_m_s
        self._points_m = _points(self.bounds_m) if points_m is None else np.asarray(points_m, dtype=np.float64)

    @property
    def points_m(self) -> FloatArray:
        """Grid points (G, 3) at which places begin, metres."""
        return self._points_m

    def table_s(self, microphones_m: FloatArray) -> FloatArray:
        """Delays (K, G) that a sound at each grid point has at an array's microphones, seconds."""
        squares = ((self._points_m[None] - microphones_m[:, None]) ** 2).sum(axis=2)
        return np.asarray(np.sqrt(squares) / self.c_m_s)

    def tables_s(self, microphones_m: FloatArray) -> Float32Array:
        """Delays (T, K, G) as `table_s` has them of T arrays (T, K, 3), in single precision: exact to 0.1 us."""
        points_m, at_m = self.points_m.astype(np.float32), microphones_m.astype(np.float32)
        squares = at_m @ (np.float32(-2.0) * points_m.T)
        squares += (at_m**2).sum(axis=-1)[..., None]
        squares += (points_m**2).sum(axis=-1)
        np.maximum(squares, 0.0, out=squares)
        np.sqrt(squares, out=squares)
        squares /= np.float32(self.c_m_s)
        return squares

    def costs(self, table_s: FloatArray, delays_s: FloatArray) -> FloatArray:
        """Squared contradiction of delays (S, K) at one array with each grid point, (S, G)."""
        costs = np.zeros((len(delays_s), table_s.shape[1]))
        there = np.isfinite(delays_s)
        for pattern in np.unique(there, axis=0):
            if pattern.sum() < 2:
                continue
            rows = (there == pattern).all(axis=1)
            table = table_s[pattern] - table_s[pattern].mean(axis=0)
            measured = centred(delays_s[np.ix_(rows, pattern)])
            squares = (measured**2).sum(axis=1)[:, None] + (table**2).sum(axis=0)
            costs[rows] = squares - 2.0 * (measured @ table)
        return np.maximum(costs, 0.0)

    def at_lowest(self, costs: FloatArray) -> FloatArray:
        """Grid points (S, 3) of the lowest of costs (S, G), metres."""
        return np.asarray(self._points_m[np.argmin(costs, axis=1)])

    def fit(self, microphones: Microphones, delays: Delays, c_m_s: float | None = None) -> Places:
        """Find the places of sounds from their delays at some arrays."""
        costs = sum(self.costs(self.table_s(microphones[name]), measured) for name, measured in delays.items())
        return self.refine(microphones, delays, self.at_lowest(np.asarray(costs)), c_m_s)

    def refine(
        self, microphones: Microphones, delays: Delays, starts_m: FloatArray, c_m_s: float | None = None
    ) -> Places:
        """Refine places (S, 3) by the method of Levenberg and Marquardt, all sounds at once, within the volume."""
        c = self.c_m_s if c_m_s is None else c_m_s
        positions_m, damping = starts_m.copy(), np.full(len(starts_m), _FIRST_DAMPING)
        off = contradictions_s(microphones, delays, positions_m, c)
        slope = slopes_s_m(microphones, delays, positions_m, c)
        cost = (off**2).sum(axis=1)
        for _ in range(_STEPS):
            normal = np.einsum("sri,srj->sij", slope, slope)
            right = np.einsum("sri,sr->si", slope, off)
            scale = np.einsum("sii->s", normal) / 3.0
            normal = normal + (damping * scale + LEAST_SLOPE)[:, None, None] * np.eye(3)
            moved_m = np.clip(
                positions_m - np.linalg.solve(normal, right[..., None])[..., 0],
                self.bounds_m[:, 0],
                self.bounds_m[:, 1],
            )
            tried = contradictions_s(microphones, delays, moved_m, c)
            tried_slope = slopes_s_m(microphones, delays, moved_m, c)
            tried_cost = (tried**2).sum(axis=1)
            better = tried_cost < cost
            done = np.linalg.norm(moved_m - positions_m, axis=1).max() < _LEAST_M
            positions_m[better], off[better], slope[better] = moved_m[better], tried[better], tried_slope[better]
            cost = np.where(better, tried_cost, cost)
            damping = np.where(better, np.maximum(damping / 5.0, LEAST_DAMPING), damping * 8.0)
            if done:
                break
        return Places(positions_m, np.sqrt(cost / degrees_of_freedom(delays)))


class KnownPlaces(PlaceSearch):
    """The places of sounds that were made at measured places, which are not searched for.

    Parameters
    ----------
    places_m : (S, 3) float64
        Metres.
    c_m_s : float
        Speed of sound, m/s.
    """

    def __init__(self, places_m: FloatArray, c_m_s: float) -> None:
        super().__init__(np.column_stack([places_m.min(axis=0), places_m.max(axis=0)]), c_m_s, places_m)

    def costs(self, table_s: FloatArray, delays_s: FloatArray) -> FloatArray:
        """Squared contradiction of delays (S, K) at one array with the place of each sound, (S, 1)."""
        off_s = centred(np.where(np.isfinite(delays_s), table_s.T, np.nan)) - centred(delays_s)
        return np.asarray((off_s**2).sum(axis=1, keepdims=True))

    def at_lowest(self, costs: FloatArray) -> FloatArray:  # noqa: ARG002 - places are known
        """The places (S, 3), metres."""
        return self._points_m.copy()

    def refine(
        self,
        microphones: Microphones,
        delays: Delays,
        starts_m: FloatArray,  # noqa: ARG002 - places are known
        c_m_s: float | None = None,
    ) -> Places:
        """The places, and how far the delays are from them."""
        off = contradictions_s(microphones, delays, self._points_m, self.c_m_s if c_m_s is None else c_m_s)
        count = np.sum([np.maximum(np.isfinite(one).sum(axis=1) - 1, 0) for one in delays.values()], axis=0)
        return Places(self._points_m, np.sqrt((off**2).sum(axis=1) / np.maximum(count, 1)))


def contradictions_s(microphones: Microphones, delays: Delays, positions_m: FloatArray, c_m_s: float) -> FloatArray:
    """Residuals of the delays of sounds at places (S, 3): (S, R) seconds; R counts all channels of all arrays."""
    parts = []
    for name, measured in delays.items():
        away_m = np.linalg.norm(positions_m[:, None] - microphones[name], axis=2)
        predicted = np.where(np.isfinite(measured), away_m / c_m_s, np.nan)
        parts.append(centred(predicted) - centred(measured))
    return np.concatenate(parts, axis=1)


def slopes_s_m(microphones: Microphones, delays: Delays, positions_m: FloatArray, c_m_s: float) -> FloatArray:
    """Slope (S, R, 3) of `contradictions_s` by the places, seconds per metre."""
    parts = []
    for name, measured in delays.items():
        towards = positions_m[:, None] - microphones[name]
        away_m = np.maximum(np.linalg.norm(towards, axis=2, keepdims=True), 1e-9)
        there = np.isfinite(measured)[..., None]
        slopes = np.where(there, towards / (away_m * c_m_s), 0.0)
        mean = slopes.sum(axis=1, keepdims=True) / np.maximum(there.sum(axis=1, keepdims=True), 1)
        parts.append(np.where(there, slopes - mean, 0.0))
    return np.concatenate(parts, axis=1)


def _points(bounds_m: FloatArray) -> FloatArray:
    """Grid points (G, 3) of a volume, at most about `MOST_POINTS`."""
    sides_m = bounds_m[:, 1] - bounds_m[:, 0]
    thick = sides_m > 0.0
    spacing_m = (np.prod(sides_m[thick]) / MOST_POINTS) ** (1.0 / max(int(thick.sum()), 1))
    axes = [
        np.linspace(low, high, max(2, round((high - low) / spacing_m))) if high > low else np.array([low])
        for low, high in bounds_m
    ]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def stacked(sounds: Sequence[Mapping[str, FloatArray]], microphones: Microphones) -> dict[str, FloatArray]:
    """Delays of each array over all sounds, (S, K); NaN where an array did not receive a sound."""
    return {
        name: np.array([sound.get(name, np.full(len(places_m), np.nan)) for sound in sounds])
        for name, places_m in microphones.items()
    }
