"""Tracks: a constant-velocity Kalman filter for each source, fed with estimates; time is passed in.

Estimates of one moment go to the tracks that make them likeliest together, so two that cross keep their names by where
they were going; who turned round in a pause is looked for where he was heard last. An estimate moves its track as far
as its covariance and its confidence let it, least along what the arrays cannot tell.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from livessl.core.types import Estimate, FloatArray, Track, TrackState

ACCELERATION_M_S2: Final = 1.0
"""Standard deviation of the acceleration that the motion model allows: a person setting off."""

START_SPEED_M_S: Final = 1.0
"""Standard deviation of a new track's velocity: a walk."""

GATE_M: Final = 1.0
"""An estimate further than this from where every track should be by now, outside its uncertainty, and as far from where
the track was heard last, starts a new one. One that is less sure than this starts none beside a track."""

GATE_SIGMAS2: Final = 11.34
"""99 % of a chi-square with three degrees of freedom."""

SILENCE_S: Final = 3.0
"""A track without estimates for so long has ended."""

_NEVER: Final = 1e9
"""Stands for what is outside every gate, where sums must stay finite."""

CONFIRM_S: Final = 1.0
"""While a source is followed, another is told of from its second estimate on, which must come within so long: a single
one beside it is a reflection more often than somebody new."""

MIN_STD_M: Final = 0.05
"""The least believed of a single estimate's uncertainty: models of the room are not better than this."""

WRONG_STD_M: Final = 0.5
"""Standard deviation of an estimate that is wrong, along each axis; how likely it is wrong its confidence tells."""


@dataclass(slots=True, eq=False)
class _Filter:
    id: int
    time_ns: int
    state: FloatArray  # position and velocity (6,)
    covariance: FloatArray  # (6, 6)
    last: _Last
    told: bool = False

    def predicted(self, time_ns: int) -> _Motion:
        """Where it is if it goes on as it went."""
        return _moved(self.state, self.covariance, time_ns - self.time_ns)

    def set_off_anew(self, time_ns: int) -> _Motion:
        """Where it is if it went anywhere from where it was heard last."""
        return _moved(*_at_rest(self.last.position_m, self.last.covariance_m2), time_ns - self.last.time_ns)

    def update(self, motion: _Motion, estimate: _Found) -> None:
        """Take in an estimate of it, having moved so."""
        before = motion.covariance
        gain = before[:, :3] @ np.linalg.inv(before[:3, :3] + estimate.noise_m2)
        self.state = motion.state + gain @ (estimate.position_m - motion.state[:3])
        keep = np.eye(6)
        keep[:, :3] -= gain
        self.covariance = keep @ before @ keep.T + gain @ estimate.noise_m2 @ gain.T  # Joseph form: stays symmetric
        self.time_ns = max(self.time_ns, estimate.time_ns)
        if estimate.tells_place or not self.last.is_place:
            self.last = _Last(self.time_ns, self.state[:3], self.covariance[:3, :3], estimate.tells_place)

    def track(self, state: TrackState) -> Track:
        return Track(
            self.id, state, self.time_ns, self.state[:3].copy(), self.state[3:].copy(), self.covariance[:3, :3].copy()
        )


@dataclass(frozen=True, slots=True)
class _Last:
    """Where a track was when an estimate last told its place; as long as none did, any estimate."""

    time_ns: int
    position_m: FloatArray
    covariance_m2: FloatArray
    is_place: bool


@dataclass(frozen=True, slots=True)
class _Motion:
    """Where a track may have got to: position and velocity (6,), and their covariance (6, 6)."""

    state: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, slots=True)
class _Found:
    """An estimate, with what is believed of its error: covariance (3, 3)."""

    time_ns: int
    position_m: FloatArray
    noise_m2: FloatArray
    tells_place: bool

    @classmethod
    def of(cls, estimate: Estimate, *, probable: bool) -> _Found:
        spread_m = float(np.sqrt(max(0.0, np.linalg.eigvalsh(estimate.covariance_m2)[-1])))
        wrong = 1.0 - estimate.confidence if probable else 0.0
        least_m2 = MIN_STD_M**2 + wrong * WRONG_STD_M**2
        noise_m2 = estimate.covariance_m2 + least_m2 * np.eye(3)
        return cls(estimate.time_ns, estimate.position_m, noise_m2, spread_m <= GATE_M)


class Tracker:
    """Follows sources: associate, update, start, end."""

    def __init__(self) -> None:
        self._filters: list[_Filter] = []
        self._next_id = 1

    def step(self, time_ns: int, estimates: Iterable[Estimate] = (), *, probable: bool = True) -> list[Track]:
        """Take in the estimates of one moment, no two of one source; return the tracks that changed.

        Parameters
        ----------
        time_ns : int
        estimates : iterable of Estimate
        probable : bool
            Whether their confidence is the probability that they are right.
        """
        changed = self._end_silent(time_ns)
        followed = any(track.told and time_ns - track.time_ns <= CONFIRM_S * 1e9 for track in self._filters)
        found = [_Found.of(each, probable=probable) for each in estimates]
        for estimate, known in zip(found, self._assigned(found), strict=True):
            if known is not None:
                track, motion = known
                track.update(motion, estimate)
            elif estimate.tells_place or not followed:
                track = self._start(estimate)
            else:
                continue
            if track.told:
                changed.append(track.track(TrackState.UPDATE))
            elif known is not None or not followed:
                track.id, track.told = self._next_id, True
                self._next_id += 1
                changed.append(track.track(TrackState.NEW))
        return changed

    def _assigned(self, found: Sequence[_Found]) -> list[tuple[_Filter, _Motion] | None]:
        """The track of each estimate, no track twice: as many as can be, and of these the likeliest together."""
        tracks = [*self._filters]
        if not tracks or not found:
            return [None] * len(found)
        expected = [[_expected(track, each) for track in tracks] for each in found]
        cost = np.array([[surprise for surprise, _ in row] for row in expected])
        chosen: list[tuple[_Filter, _Motion] | None] = [None] * len(found)
        if len(found) == 1:
            pairs = [(0, int(cost[0].argmin()))]
        else:
            from scipy.optimize import linear_sum_assignment  # most sites never get here, and it takes long to load

            pairs = list(zip(*linear_sum_assignment(np.where(np.isfinite(cost), cost, _NEVER)), strict=True))
        for row, column in pairs:
            if np.isfinite(cost[row, column]):
                chosen[row] = tracks[column], expected[row][column][1]
        return chosen

    def _start(self, estimate: _Found) -> _Filter:
        last = _Last(estimate.time_ns, estimate.position_m, estimate.noise_m2, estimate.tells_place)
        started = _Filter(0, estimate.time_ns, *_at_rest(estimate.position_m, estimate.noise_m2), last)
        self._filters.append(started)
        return started

    def _end_silent(self, time_ns: int) -> list[Track]:
        def is_silent(track: _Filter) -> bool:
            return time_ns - track.time_ns > (SILENCE_S if track.told else CONFIRM_S) * 1e9

        ended = [track.track(TrackState.END) for track in self._filters if track.told and is_silent(track)]
        self._filters = [track for track in self._filters if not is_silent(track)]
        return ended


def _at_rest(position_m: FloatArray, covariance_m2: FloatArray) -> tuple[FloatArray, FloatArray]:
    """State and covariance of what may set off at once, in any direction."""
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


def _expected(track: _Filter, estimate: _Found) -> tuple[float, _Motion]:
    """How little an estimate was to be expected of a track, d^2 + ln det S, and how it moved; infinite out of its gate.

    What only tells a direction makes no source of a single estimate that nobody was told of.
    """
    motion = track.predicted(estimate.time_ns)
    if not (track.told or estimate.tells_place):
        return np.inf, motion
    off_m, distance2, surprise = _off(motion, estimate)
    if distance2 <= GATE_SIGMAS2 or off_m <= GATE_M:
        return surprise, motion
    motion = track.set_off_anew(estimate.time_ns)
    off_m, _, surprise = _off(motion, estimate)
    return (surprise if off_m <= GATE_M else np.inf), motion


def _off(motion: _Motion, estimate: _Found) -> tuple[float, float, float]:
    """How far an estimate is from where a track should be: metres, d^2, and d^2 + ln det S."""
    difference = estimate.position_m - motion.state[:3]
    spread = motion.covariance[:3, :3] + estimate.noise_m2
    distance2 = float(difference @ np.linalg.solve(spread, difference))
    return float(np.linalg.norm(difference)), distance2, distance2 + float(np.linalg.slogdet(spread)[1])
