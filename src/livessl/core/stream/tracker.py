"""Decides which track an estimate joins, and starts, confirms and ends tracks: a Kalman filter for each source, gates.

The estimates of one time are assigned to the tracks for which all assignments together are most likely, so that two
sources that cross keep their tracks by their velocities. A source that turned round in a pause is also searched for at
its last position. The covariance and the confidence of an estimate decide how far it moves its track: least along the
line of sight, where arrays are least exact.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from livessl.core.types import Estimate, FloatArray, Track, TrackState

ACCELERATION_M_S2: Final = 1.0
"""Standard deviation of the acceleration in the motion model, in m/s^2: that of a person who starts to walk."""

START_SPEED_M_S: Final = 1.0
"""Standard deviation of a new track's velocity, in m/s: that of a walking person."""

GATE_M: Final = 1.0
"""Distance, in metres, from the predicted and the last position of a track beyond which an estimate, if it is also
outside the uncertainty, starts a new track. An estimate with a greater standard deviation starts no track beside
another."""

GATE_SIGMAS2: Final = 11.34
"""Squared Mahalanobis distance of the gate: 99 % of a chi-square with three degrees of freedom."""

SILENCE_S: Final = 3.0
"""Time without estimates, in seconds, after which a track ends."""

_OUTSIDE: Final = 1e9
"""Cost of an assignment outside every gate; finite, because the costs are summed."""

CONFIRM_S: Final = 1.0
"""Time, in seconds, within which a second estimate must confirm a new track while another source is followed. A single
estimate beside another source is more often a reflection than a new source."""

MIN_STD_M: Final = 0.05
"""Least standard deviation of an estimate, in metres; models of the room are not more exact."""

WRONG_STD_M: Final = 0.5
"""Standard deviation, in metres along each axis, of a wrong estimate; the confidence is the probability that an
estimate is not wrong."""


@dataclass(slots=True, eq=False)
class _Filter:
    id: int
    time_ns: int
    state: FloatArray  # position and velocity (6,)
    covariance: FloatArray  # (6, 6)
    last: _Last
    confirmed: bool = False

    def predicted(self, time_ns: int) -> _Motion:
        """Return the motion of the source if it continues at its velocity."""
        return _moved(self.state, self.covariance, time_ns - self.time_ns)

    def set_off_anew(self, time_ns: int) -> _Motion:
        """Return the motion of the source if it starts in any direction from its last position."""
        return _moved(*_at_rest(self.last.position_m, self.last.covariance_m2), time_ns - self.last.time_ns)

    def update(self, motion: _Motion, estimate: _Measurement) -> None:
        """Update the track with an estimate, after a motion."""
        before = motion.covariance
        gain = before[:, :3] @ np.linalg.inv(before[:3, :3] + estimate.noise_m2)
        self.state = motion.state + gain @ (estimate.position_m - motion.state[:3])
        keep = np.eye(6)
        keep[:, :3] -= gain
        self.covariance = keep @ before @ keep.T + gain @ estimate.noise_m2 @ gain.T  # Joseph form: stays symmetric
        self.time_ns = max(self.time_ns, estimate.time_ns)
        if estimate.is_place or not self.last.is_place:
            self.last = _Last(self.time_ns, self.state[:3], self.covariance[:3, :3], estimate.is_place)

    def track(self, state: TrackState) -> Track:
        return Track(
            self.id, state, self.time_ns, self.state[:3].copy(), self.state[3:].copy(), self.covariance[:3, :3].copy()
        )


@dataclass(frozen=True, slots=True)
class _Last:
    """Position of a track at its last estimate with a position; if there was none, at its last estimate."""

    time_ns: int
    position_m: FloatArray
    covariance_m2: FloatArray
    is_place: bool


@dataclass(frozen=True, slots=True)
class _Motion:
    """Predicted position and velocity (6,) of a track, and their covariance (6, 6)."""

    state: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, slots=True)
class _Measurement:
    """An estimate with the covariance (3, 3) of its error, confidence included, without the error of the set-up."""

    time_ns: int
    position_m: FloatArray
    noise_m2: FloatArray
    is_place: bool

    @classmethod
    def of(cls, estimate: Estimate, *, probable: bool) -> _Measurement:
        covariance_m2 = estimate.sound_covariance_m2
        spread_m = float(np.sqrt(max(0.0, np.linalg.eigvalsh(covariance_m2)[-1])))
        wrong = 1.0 - estimate.sound_confidence if probable else 0.0
        least_m2 = MIN_STD_M**2 + wrong * WRONG_STD_M**2
        noise_m2 = covariance_m2 + least_m2 * np.eye(3)
        return cls(estimate.time_ns, estimate.position_m, noise_m2, spread_m <= GATE_M)


class Tracker:
    """Follows sources: associates estimates with tracks, updates tracks, starts and ends them."""

    def __init__(self) -> None:
        self._filters: list[_Filter] = []
        self._next_id = 1

    def step(self, time_ns: int, estimates: Iterable[Estimate] = (), *, probable: bool = True) -> list[Track]:
        """Take in the estimates of one time, at most one for each source; return the tracks that changed.

        Parameters
        ----------
        time_ns : int
        estimates : iterable of Estimate
        probable : bool
            Whether the confidence of the estimates is the probability that they are right.
        """
        changed = self._end_silent(time_ns)
        followed = any(track.confirmed and time_ns - track.time_ns <= CONFIRM_S * 1e9 for track in self._filters)
        found = [_Measurement.of(each, probable=probable) for each in estimates]
        for estimate, known in zip(found, self._assigned(found), strict=True):
            if known is not None:
                track, motion = known
                track.update(motion, estimate)
            elif estimate.is_place or not followed:
                track = self._start(estimate)
            else:
                continue
            if track.confirmed:
                changed.append(track.track(TrackState.UPDATE))
            elif known is not None or not followed:
                track.id, track.confirmed = self._next_id, True
                self._next_id += 1
                changed.append(track.track(TrackState.NEW))
        return changed

    def _assigned(self, found: Sequence[_Measurement]) -> list[tuple[_Filter, _Motion] | None]:
        """Assign a track or None to each estimate, no track twice: as many as possible, at the least total cost."""
        tracks = [*self._filters]
        if not tracks or not found:
            return [None] * len(found)
        expected = [[_expected(track, each) for track in tracks] for each in found]
        cost = np.array([[surprise for surprise, _ in row] for row in expected])
        chosen: list[tuple[_Filter, _Motion] | None] = [None] * len(found)
        if len(found) == 1:
            pairs = [(0, int(cost[0].argmin()))]
        else:
            from scipy.optimize import linear_sum_assignment  # loaded late: most sites never need it, and it takes long

            pairs = list(zip(*linear_sum_assignment(np.where(np.isfinite(cost), cost, _OUTSIDE)), strict=True))
        for row, column in pairs:
            if np.isfinite(cost[row, column]):
                chosen[row] = tracks[column], expected[row][column][1]
        return chosen

    def _start(self, estimate: _Measurement) -> _Filter:
        last = _Last(estimate.time_ns, estimate.position_m, estimate.noise_m2, estimate.is_place)
        started = _Filter(0, estimate.time_ns, *_at_rest(estimate.position_m, estimate.noise_m2), last)
        self._filters.append(started)
        return started

    def _end_silent(self, time_ns: int) -> list[Track]:
        def is_silent(track: _Filter) -> bool:
            return time_ns - track.time_ns > (SILENCE_S if track.confirmed else CONFIRM_S) * 1e9

        ended = [track.track(TrackState.END) for track in self._filters if track.confirmed and is_silent(track)]
        self._filters = [track for track in self._filters if not is_silent(track)]
        return ended


def _at_rest(position_m: FloatArray, covariance_m2: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the state and covariance of a source at rest that may start at once in any direction."""
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = covariance_m2
    covariance[3:, 3:] = START_SPEED_M_S**2 * np.eye(3)
    return np.concatenate([position_m, np.zeros(3)]), covariance


def _moved(state: FloatArray, covariance: FloatArray, duration_ns: int) -> _Motion:
    dt = max(0.0, duration_ns / 1e9)
    motion = np.eye(6)
    motion[:3, 3:] = dt * np.eye(3)
    noise = np.kron(np.array([[dt**4 / 4, dt**3 / 2], [dt**3 / 2, dt**2]]), np.eye(3)) * ACCELERATION_M_S2**2
    return _Motion(motion @ state, motion @ covariance @ motion.T + noise)


def _expected(track: _Filter, estimate: _Measurement) -> tuple[float, _Motion]:
    """Return the cost d^2 + ln det S of assigning an estimate to a track, and the track's motion.

    The cost is infinite outside the gate, and for an estimate that is only a direction if the track is not confirmed.
    """
    motion = track.predicted(estimate.time_ns)
    if not (track.confirmed or estimate.is_place):
        return np.inf, motion
    off_m, distance2, surprise = _off(motion, estimate)
    if distance2 <= GATE_SIGMAS2 or off_m <= GATE_M:
        return surprise, motion
    motion = track.set_off_anew(estimate.time_ns)
    off_m, _, surprise = _off(motion, estimate)
    return (surprise if off_m <= GATE_M else np.inf), motion


def _off(motion: _Motion, estimate: _Measurement) -> tuple[float, float, float]:
    """Return the distance of an estimate from a predicted position in metres, d^2, and d^2 + ln det S."""
    difference = estimate.position_m - motion.state[:3]
    spread = motion.covariance[:3, :3] + estimate.noise_m2
    distance2 = float(difference @ np.linalg.solve(spread, difference))
    return float(np.linalg.norm(difference)), distance2, distance2 + float(np.linalg.slogdet(spread)[1])
