"""Tracks: a constant-velocity Kalman filter for each source, fed with estimates; time is passed in.

Estimates of one moment go to the tracks that make them likeliest together, so two that cross keep their names by where
they were going. An estimate moves its track as far as its covariance lets it, least along what the arrays cannot tell.
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
"""An estimate further than this from every track's prediction, and outside its uncertainty, starts a new one."""

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


@dataclass(slots=True, eq=False)
class _Filter:
    id: int
    time_ns: int
    state: FloatArray  # position and velocity (6,)
    covariance: FloatArray  # (6, 6)
    told: bool = False

    def predict(self, time_ns: int) -> None:
        dt = max(0.0, (time_ns - self.time_ns) / 1e9)
        motion = np.eye(6)
        motion[:3, 3:] = dt * np.eye(3)
        noise = np.kron(np.array([[dt**4 / 4, dt**3 / 2], [dt**3 / 2, dt**2]]), np.eye(3)) * ACCELERATION_M_S2**2
        self.state = motion @ self.state
        self.covariance = motion @ self.covariance @ motion.T + noise
        self.time_ns = max(self.time_ns, time_ns)

    def update(self, position_m: FloatArray, noise_m2: FloatArray) -> None:
        gain = self.covariance[:, :3] @ np.linalg.inv(self.covariance[:3, :3] + noise_m2)
        self.state = self.state + gain @ (position_m - self.state[:3])
        keep = np.eye(6)
        keep[:, :3] -= gain
        self.covariance = keep @ self.covariance @ keep.T + gain @ noise_m2 @ gain.T  # Joseph form: stays symmetric

    def track(self, state: TrackState) -> Track:
        return Track(
            self.id, state, self.time_ns, self.state[:3].copy(), self.state[3:].copy(), self.covariance[:3, :3].copy()
        )


class Tracker:
    """Follows sources: associate, update, start, end."""

    def __init__(self) -> None:
        self._filters: list[_Filter] = []
        self._next_id = 1

    def step(self, time_ns: int, estimates: Iterable[Estimate] = ()) -> list[Track]:
        """Take in the estimates of one moment, no two of one source; return the tracks that changed."""
        changed = self._end_silent(time_ns)
        followed = any(track.told and time_ns - track.time_ns <= CONFIRM_S * 1e9 for track in self._filters)
        found = [(each, each.covariance_m2 + MIN_STD_M**2 * np.eye(3)) for each in estimates]
        for (estimate, noise), known in zip(found, self._assigned(found), strict=True):
            if known is None:
                track = self._start(estimate, noise)
            else:
                track = known
                track.predict(estimate.time_ns)
                track.update(estimate.position_m, noise)
            if track.told:
                changed.append(track.track(TrackState.UPDATE))
            elif known is not None or not followed:
                track.id, track.told = self._next_id, True
                self._next_id += 1
                changed.append(track.track(TrackState.NEW))
        return changed

    def _assigned(self, found: Sequence[tuple[Estimate, FloatArray]]) -> list[_Filter | None]:
        """The track of each estimate, no track twice: as many as can be, and of these the likeliest together."""
        tracks: list[_Filter | None] = [*self._filters]
        if not tracks or not found:
            return [None] * len(found)
        cost = np.array([[_surprise(track, *each) for track in self._filters] for each in found])
        if len(found) == 1:
            best = int(cost[0].argmin())
            return [tracks[best] if np.isfinite(cost[0, best]) else None]
        from scipy.optimize import linear_sum_assignment  # most sites never get here, and it takes long to load

        finite = np.where(np.isfinite(cost), cost, _NEVER)
        rows, columns = linear_sum_assignment(finite)
        chosen: list[_Filter | None] = [None] * len(found)
        for row, column in zip(rows, columns, strict=True):
            chosen[row] = tracks[column] if np.isfinite(cost[row, column]) else None
        return chosen

    def _start(self, estimate: Estimate, noise_m2: FloatArray) -> _Filter:
        covariance = np.zeros((6, 6))
        covariance[:3, :3] = noise_m2
        covariance[3:, 3:] = START_SPEED_M_S**2 * np.eye(3)
        state = np.concatenate([estimate.position_m, np.zeros(3)])
        started = _Filter(0, estimate.time_ns, state, covariance)
        self._filters.append(started)
        return started

    def _end_silent(self, time_ns: int) -> list[Track]:
        def is_silent(track: _Filter) -> bool:
            return time_ns - track.time_ns > (SILENCE_S if track.told else CONFIRM_S) * 1e9

        ended = [track.track(TrackState.END) for track in self._filters if track.told and is_silent(track)]
        self._filters = [track for track in self._filters if not is_silent(track)]
        return ended


def _surprise(track: _Filter, estimate: Estimate, noise_m2: FloatArray) -> float:
    """How little an estimate was to be expected of a track, d^2 + ln det S; infinite outside its gate."""
    ahead = _Filter(track.id, track.time_ns, track.state, track.covariance)
    ahead.predict(estimate.time_ns)
    difference = estimate.position_m - ahead.state[:3]
    spread = ahead.covariance[:3, :3] + noise_m2
    distance2 = float(difference @ np.linalg.solve(spread, difference))
    if distance2 > GATE_SIGMAS2 and float(np.linalg.norm(difference)) > GATE_M:
        return np.inf
    return distance2 + float(np.linalg.slogdet(spread)[1])
