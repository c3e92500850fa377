"""Tracks: a constant-velocity Kalman filter for each source, fed with estimates; time is passed in."""

from __future__ import annotations

from collections.abc import Iterable
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

MIN_STD_M: Final = 0.05
"""The least believed of a single estimate's uncertainty: models of the room are not better than this."""


@dataclass(slots=True, eq=False)
class _Filter:
    id: int
    time_ns: int
    state: FloatArray  # position and velocity (6,)
    covariance: FloatArray  # (6, 6)

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
        """Take in the estimates of one moment; return the tracks that changed."""
        changed = self._end_silent(time_ns)
        for estimate in estimates:
            noise = estimate.covariance_m2 + MIN_STD_M**2 * np.eye(3)
            nearest = self._nearest(estimate, noise)
            if nearest is None:
                changed.append(self._start(estimate, noise).track(TrackState.NEW))
            else:
                nearest.predict(estimate.time_ns)
                nearest.update(estimate.position_m, noise)
                changed.append(nearest.track(TrackState.UPDATE))
        return changed

    def _nearest(self, estimate: Estimate, noise_m2: FloatArray) -> _Filter | None:
        best, best_distance = None, np.inf
        for candidate in self._filters:
            ahead = _Filter(candidate.id, candidate.time_ns, candidate.state, candidate.covariance)
            ahead.predict(estimate.time_ns)
            difference = estimate.position_m - ahead.state[:3]
            spread = ahead.covariance[:3, :3] + noise_m2
            distance = float(difference @ np.linalg.solve(spread, difference))
            near = distance <= GATE_SIGMAS2 or float(np.linalg.norm(difference)) <= GATE_M
            if near and distance < best_distance:
                best, best_distance = candidate, distance
        return best

    def _start(self, estimate: Estimate, noise_m2: FloatArray) -> _Filter:
        covariance = np.zeros((6, 6))
        covariance[:3, :3] = noise_m2
        covariance[3:, 3:] = START_SPEED_M_S**2 * np.eye(3)
        state = np.concatenate([estimate.position_m, np.zeros(3)])
        started = _Filter(self._next_id, estimate.time_ns, state, covariance)
        self._next_id += 1
        self._filters.append(started)
        return started

    def _end_silent(self, time_ns: int) -> list[Track]:
        silent = [f for f in self._filters if time_ns - f.time_ns > SILENCE_S * 1e9]
        self._filters = [f for f in self._filters if f not in silent]
        return [f.track(TrackState.END) for f in silent]
