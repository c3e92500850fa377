"""Fits delays by a set-up that may be off by as little as people measure, and says how well that explains them.

Arrays are placed to within a centimetre or two and a degree at best. A set-up as filed that is compared with
alternatives without that freedom always contradicts the sounds a little, and a small turn or shift of a wrong array
explains it. So the set-up as filed and each alternative get the same freedom: arrays may be shifted and turned, each
microphone may be elsewhere, and the speed of sound may differ, by as much as their standard deviations allow. What
remains is weighed by a distribution with heavy tails, for each sound at each array together, because an array that
receives an echo best has errors in all its delays.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from livessl.core.commission.set_up import SetUp, Stacked, away, centred_rows, centred_where, inverse
from livessl.core.types import FloatArray, IntArray

TAILS: Final = 3.0
"""Degrees of freedom of the t distribution of delays: 3 has heavy tails."""

FREE_LATE_S: Final = 1e-3
"""Standard deviation of the delay of a channel that may have any, seconds."""

FIRST_STDS_S: Final = (48e-6, 24e-6, 12e-6)
"""Least standard deviations of the delays in the first steps, seconds, so that a set-up that is far from the sounds is
drawn to them although they are all in the tails."""

MOST_STEPS: Final = 8
"""Steps of a fit beyond the first ones."""

_ENOUGH: Final = 0.02
"""Change of every deviance below which a fit ends."""

_MOST_STEP_M: Final = 1.0
"""Longest step of a place in one iteration, metres."""

_LEAST_SLOPE: Final = 1e-6
"""Added to the normal equations of a place, in standard deviations per metre squared: some are not determined."""

_POSE: Final = 6
"""Unknowns of a pose: three of the shift, three of the turn."""


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
    late_s : float
        Delay of the channel that may have one, seconds.
    """

    deviance: float
    places_m: FloatArray
    shifts_m: Mapping[str, FloatArray]
    turns_deg: Mapping[str, FloatArray]
    displaced_m: Mapping[str, FloatArray]
    speed_off_m_s: float
    late_s: float


def explained(set_ups: Sequence[SetUp], starts_m: FloatArray, bounds_m: FloatArray) -> list[Explained]:
    """Fit places and the small freedom of set-ups to delays, and return how well they fit.

    Parameters
    ----------
    set_ups : sequence of SetUp
        H set-ups of the same arrays with as many sounds.
    starts_m : (H, S, 3) float64
        Places to begin at, metres.
    bounds_m : (3, 2) float64
        Search volume, metres.
    """
    fit = Fit(set_ups, starts_m, bounds_m)
    fit.run()
    return fit.results()


def unknowns_of(set_up: SetUp) -> int:
    """Return the number of unknowns of a fit: those of each array, the speed of sound and the delay of a channel."""
    return sum(_POSE + 3 * len(set_up.microphones[name]) for name in set_up.delays) + 2


class Fit:
    """Fits of several set-ups, all of them together; see `explained`.

    The unknowns of each are in standard deviations: for each array shift, turn and microphones, then the speed of sound
    and the delay of one channel.
    """

    def __init__(self, set_ups: Sequence[SetUp], starts_m: FloatArray, bounds_m: FloatArray) -> None:
        self._stacked = Stacked(set_ups, bounds_m)
        self._columns: dict[str, slice] = {}
        at = 0
        for name, at_m in set_ups[0].microphones.items():
            if name in self._stacked.names:
                self._columns[name] = slice(at, at + _POSE + 3 * len(at_m))
                at += _POSE + 3 * len(at_m)
        self._scale = np.array([self._scales(one) for one in set_ups])
        # independent delays of each sound at each array
        self._count = {name: np.maximum(one.sum(axis=-1) - 1, 0) for name, one in self._stacked.there.items()}
        self._of_late = {name: np.zeros_like(one) for name, one in self._stacked.measured_s.items()}
        for row, one in enumerate(set_ups):
            if one.late is not None:
                name, index = one.late
                there = self._stacked.there[name][row]
                self._of_late[name][row] = centred_where(np.eye(there.shape[1])[index][None] * there, there)
        self._places_m, self._unknowns = starts_m.copy(), np.zeros_like(self._scale)
        self._off = self._residuals()
        self.deviances = self._deviances()
        """Deviance of each set-up so far, (H,)."""
        self._best = self._places_m, self._unknowns

    def run(self) -> None:
        """Fit until no deviance changes any more."""
        for step in range(len(FIRST_STDS_S) + MOST_STEPS):
            before = self.deviances
            self._step(FIRST_STDS_S[step] if step < len(FIRST_STDS_S) else 0.0)
            self._off = self._residuals()
            deviances = self._deviances()
            better = deviances < before
            self.deviances = np.where(better, deviances, before)
            places_m, unknowns = self._best
            self._best = (
                np.where(better[:, None, None], self._places_m, places_m),
                np.where(better[:, None], self._unknowns, unknowns),
            )
            if step >= len(FIRST_STDS_S) and (before - self.deviances).max() < _ENOUGH:
                break

    def results(self) -> list[Explained]:
        """Return the best fit of each set-up, its unknowns by name."""
        places_m, unknowns = self._best
        return list(self._results(places_m, unknowns * self._scale))

    def _results(self, places_m: FloatArray, off: FloatArray) -> Iterator[Explained]:
        for row, deviance in enumerate(self.deviances):
            own = {name: off[row, columns] for name, columns in self._columns.items()}
            yield Explained(
                float(deviance),
                places_m[row],
                {name: one[:3] for name, one in own.items()},
                {name: np.degrees(one[3:_POSE]) for name, one in own.items()},
                {name: one[_POSE:].reshape(-1, 3) for name, one in own.items()},
                float(off[row, -2]),
                float(off[row, -1]),
            )

    def _scales(self, one: SetUp) -> FloatArray:
        parts = []
        for name in self._columns:
            own = one.freedom[name]
            parts += [np.full(3, own.position_m), np.radians(own.orientation_deg)]
            parts.append(np.repeat(own.microphones_m, 3))
        return np.concatenate([*parts, [one.speed_std_m_s, FREE_LATE_S if one.late is not None else 0.0]])

    def _set_ups(self) -> tuple[dict[str, FloatArray], FloatArray]:
        """Places (H, K, 3) of the microphones of each array, metres, and speeds of sound (H,), with the unknowns."""
        off = self._unknowns * self._scale
        microphones = {}
        for name, columns in self._columns.items():
            at_m, own = self._stacked.microphones[name], off[:, columns]
            centre_m = at_m.mean(axis=1, keepdims=True)
            turn = Rotation.from_rotvec(own[:, 3:_POSE]).as_matrix()
            turned_m = (at_m - centre_m) @ turn.swapaxes(1, 2)
            microphones[name] = turned_m + centre_m + own[:, None, :3] + own[:, _POSE:].reshape(at_m.shape)
        return microphones, self._stacked.c_m_s + off[:, -2]

    def _residuals(self) -> dict[str, FloatArray]:
        """Residuals (H, S, K) of the delays at each array, in standard deviations; keeps what the slopes need."""
        self._microphones, self._c_m_s = self._set_ups()
        late_s = (self._unknowns[:, -1] * self._scale[:, -1])[:, None, None]
        self._away, residuals = {}, {}
        for name in self._columns:
            self._away[name] = away(self._places_m, self._microphones[name])
            predicted_s = self._away[name][0] / self._c_m_s[:, None, None]
            off_s = centred_where(predicted_s, self._stacked.there[name]) - self._stacked.measured_s[name]
            residuals[name] = (off_s + late_s * self._of_late[name]) / self._stacked.std_s[name][..., None]
        return residuals

    def _deviances(self) -> FloatArray:
        total = (self._unknowns**2).sum(axis=1)
        for name, off in self._off.items():
            squares = (off**2).sum(axis=-1)
            total = total + ((TAILS + self._count[name]) * np.log1p(squares / TAILS)).sum(axis=1)
        return np.asarray(total)

    def pose_of(self, name: str) -> IntArray:
        """Return the indices of an array's shift and turn among the unknowns, (6,)."""
        begin = self._columns[name].start
        return np.arange(begin, begin + _POSE)

    def pose_stds(self, name: str) -> FloatArray:
        """Return the standard deviations of an array's shift (metres) and turn (radians) in the first set-up, (6,)."""
        return np.asarray(self._scale[0, self.pose_of(name)])

    def seen(self) -> FloatArray:
        """Return how much of each unknown the delays show beyond what every set-up may be off by, (H, U, U).

        A fault d (U,), in standard deviations, changes the deviance by d' M d on average, M being the matrix of a
        set-up. It is the identity where the delays show everything, and 0 where they show nothing.
        """
        self._places_m, self._unknowns = self._best
        self._off = self._residuals()
        normal, mixed, _, whole, _ = self._normal_equations(0.0)
        reduced = _reduced(inverse(normal) @ mixed, mixed, whole)
        return np.asarray(np.eye(whole.shape[-1]) - np.linalg.inv(reduced))

    def _step(self, least_std_s: float) -> None:
        """Make one step of the method of Gauss and Newton, the places eliminated; reweighted for the tails.

        No delay is taken to be more exact than `least_std_s`.
        """
        normal, mixed, right, whole, gradient = self._normal_equations(least_std_s)
        inverted = inverse(normal)
        of_mixed, of_right = inverted @ mixed, (inverted @ right[..., None])[..., 0]
        rows, count = gradient.shape
        eliminated = mixed.reshape(rows, -1, count).swapaxes(1, 2)
        rest = gradient - (eliminated @ of_right.reshape(rows, -1, 1))[..., 0]
        change = -np.linalg.solve(_reduced(of_mixed, mixed, whole), rest[..., None])[..., 0]
        step_m = -(of_right + (of_mixed @ change[:, None, :, None])[..., 0])
        moved_m = self._places_m + np.clip(step_m, -_MOST_STEP_M, _MOST_STEP_M)
        self._places_m = np.clip(moved_m, *self._stacked.bounds_m.T)
        self._unknowns = self._unknowns + change

    def _normal_equations(
        self, least_std_s: float
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return the normal equations in blocks, with no delay more exact than a standard deviation, seconds.

        They are those of the places (H, S, 3, 3), of places and unknowns (H, S, 3, U), the gradient by the places
        (H, S, 3), the equations of the unknowns (H, U, U) and the gradient by these (H, U).
        """
        rows, count = self._scale.shape
        sounds = self._places_m.shape[1]
        normal = np.tile(_LEAST_SLOPE * np.eye(3), (rows, sounds, 1, 1))
        mixed, right = np.zeros((rows, sounds, 3, count)), np.zeros((rows, sounds, 3))
        whole, gradient = np.tile(np.eye(count), (rows, 1, 1)), self._unknowns.copy()
        for name, columns in self._columns.items():
            of_places, of_unknowns = self._slopes(name)
            off = self._off[name]
            wider = np.maximum(least_std_s / self._stacked.std_s[name], 1.0)
            squares = (off**2).sum(axis=-1) / wider**2
            weight = (TAILS + self._count[name]) / (TAILS + squares) / wider**2
            used = np.r_[columns, count - 2, count - 1]
            weighted = of_places.swapaxes(-1, -2) * weight[..., None, None]
            normal += weighted @ of_places
            mixed[..., used] += weighted @ of_unknowns
            right += (weighted @ off[..., None])[..., 0]
            root = np.sqrt(weight)[..., None]
            flat = (of_unknowns * root[..., None]).reshape(rows, -1, len(used)).swapaxes(1, 2)
            whole[:, used[:, None], used] += flat @ flat.swapaxes(1, 2)
            gradient[:, used] += (flat @ (off * root).reshape(rows, -1, 1))[..., 0]
        return normal, mixed, right, whole, gradient

    def _slopes(self, name: str) -> tuple[FloatArray, FloatArray]:
        """Slopes of an array's residuals by the places, (H, S, K, 3), and by its unknowns and the last two."""
        away_m, unit = self._away[name]
        at_m, c_m_s = self._microphones[name], self._c_m_s[:, None, None]
        there, scale = self._stacked.there[name], self._scale[:, None, None]
        std_s = self._stacked.std_s[name][..., None]
        of_places = unit / (c_m_s * std_s)[..., None]
        slope = -of_places  # by the microphones' positions
        turns = np.cross((at_m - at_m.mean(axis=1, keepdims=True))[:, None], slope)
        rows, sounds, channels, _ = slope.shape
        own = np.zeros((rows, sounds, channels, channels, 3))
        index = np.arange(channels)
        own[:, :, index, index] = slope
        speed = -away_m / (c_m_s**2 * std_s)
        parts = [slope, turns, own.reshape(rows, sounds, channels, -1), speed[..., None]]
        centred = centred_rows(np.concatenate(parts, axis=-1), there)
        of_late = (self._of_late[name] / std_s)[..., None]
        of_unknowns = np.concatenate([centred, of_late], axis=-1)
        columns = self._columns[name]
        scales = np.concatenate([scale[..., columns], scale[..., -2:]], axis=-1)
        return centred_rows(of_places, there), of_unknowns * scales


def _reduced(of_mixed: FloatArray, mixed: FloatArray, whole: FloatArray) -> FloatArray:
    """Normal equations (H, U, U) of the unknowns alone, the places eliminated."""
    rows, count = whole.shape[:2]
    eliminated = mixed.reshape(rows, -1, count).swapaxes(1, 2)
    return np.asarray(whole - eliminated @ of_mixed.reshape(rows, -1, count))
