"""Measures the poses of arrays and the speed of sound, with standard deviations, by bundle adjustment.

The unknowns are the rotation and the shift of each array that may move, the speed of sound if it may differ, and the
places of the sounds. Known places and poses are priors, with their standard deviations. The arrays need no common
clock. If some arrays have a common clock, the times between them can be used as well.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from livessl.core.commission.arrivals import Arrivals
from livessl.core.commission.places import Delays, Microphones, contradictions_s, slopes_s_m
from livessl.core.types import FloatArray

DELAY_STD_S: Final = 20e-6
"""Standard deviation of a measured delay in a room, seconds."""

MICROPHONE_STD_M: Final = 0.002
"""Standard deviation of each microphone's place within its array, metres, because arrays are built with errors of some
millimetres. The error of a place is the same for all sounds, so more sounds do not reduce it."""

UNKNOWN_M: Final = 100.0
UNKNOWN_DEG: Final = 360.0
"""Standard deviations, in metres and degrees, that stand for "unknown"."""

LINE: Final = 0.01
"""Ratio of width to length up to which an array counts as a line."""

_TOLERANCE: Final = 1e-5
"""Relative change of cost and unknowns below which the adjustment ends."""

_MOST_STEPS: Final = 40
_STEP: Final = 1e-4
"""Step of the numerical derivatives, in units of the scales of the unknowns (`_SHIFT_SCALE_M` and those below)."""

_UNKNOWNS: Final = 6
"""Number of unknowns of a pose: three of the shift, three of the rotation."""

_SHIFT_SCALE_M: Final = 0.1
_TURN_SCALE_RAD: Final = 0.1
_SPEED_SCALE_M_S: Final = 3.0


@dataclass(frozen=True, slots=True)
class Freedom:
    """Standard deviations by which the set-up may differ from the site file.

    Parameters
    ----------
    arrays : mapping of array to (float, float)
        Standard deviations of the position in metres and of the orientation in degrees. Other arrays keep their poses.
    speed_std_m_s : float
        Standard deviation of the speed of sound, m/s; 0 if the speed is known.
    microphone_std_m : float
        Standard deviation of each microphone's place in its array along each axis, metres; 0 if the places are known.
    """

    arrays: Mapping[str, tuple[float, float]]
    speed_std_m_s: float = 0.0
    microphone_std_m: float = 0.0


@dataclass(frozen=True, slots=True)
class Pose:
    """Difference between the pose of an array and its pose in the site file.

    Parameters
    ----------
    shift_m : (3,) float64
        Shift of the centre of the array, metres.
    turn_deg : (3,) float64
        Rotation about the centre: a vector along the axis, whose length is the angle in degrees.
    covariance : (6, 6) float64
        Covariance of the shift (m) and the rotation (radians).
    """

    shift_m: FloatArray
    turn_deg: FloatArray
    covariance: FloatArray

    @property
    def angle_deg(self) -> float:
        """Angle of the rotation, degrees."""
        return float(np.linalg.norm(self.turn_deg))

    @property
    def distance_m(self) -> float:
        """Size of the shift, metres."""
        return float(np.linalg.norm(self.shift_m))

    def applied(self, microphones_m: FloatArray) -> FloatArray:
        """Return the positions (K, 3) of the microphones after the rotation and the shift, metres."""
        return moved(microphones_m, self.shift_m, np.radians(self.turn_deg))


@dataclass(frozen=True, slots=True)
class Adjusted:
    """The set-up that explains some sounds best.

    Parameters
    ----------
    poses : mapping of array to Pose
    c_m_s : float
        Speed of sound, m/s.
    c_std_m_s : float
        Standard deviation of the speed of sound, m/s; 0 if the speed was known.
    places_m : (S, 3) float64
        Places of the sounds, metres.
    misfits_s : (S,) float64
        Root mean square of the residuals of each sound's delays, seconds.
    microphones : mapping of array to (K, 3) float64
        Positions of the microphones, metres. If their places within the arrays are unknown, the measured offsets are
        included.
    """

    poses: Mapping[str, Pose]
    c_m_s: float
    c_std_m_s: float
    places_m: FloatArray
    misfits_s: FloatArray
    microphones: Microphones


def adjust(
    microphones: Microphones,
    delays: Delays,
    places_m: FloatArray,
    c_m_s: float,
    freedom: Freedom,
    place_std_m: float = UNKNOWN_M,
    delay_std_s: float = DELAY_STD_S,
    arrivals: Arrivals | None = None,
    begin: Adjusted | None = None,
) -> Adjusted:
    """Find the poses, the speed of sound and the places that explain delays best.

    Parameters
    ----------
    microphones : mapping of array to (K, 3) float64
        Positions in the site file, or a rough guess, metres.
    delays : mapping of array to (S, K) float64
        Seconds.
    places_m : (S, 3) float64
        Places of the sounds, or places at which to begin, metres.
    c_m_s : float
        Speed of sound in the site file, m/s.
    freedom : Freedom
    place_std_m : float
        Standard deviation of the given places along each axis, metres.
    delay_std_s : float
        Standard deviation of the delays, seconds.
    arrivals : Arrivals or None
        Times between arrays that share a clock.
    begin : Adjusted or None
        Result of another adjustment of the same set-up, at which this one begins.
    """
    problem = _Problem(microphones, delays, places_m, c_m_s, freedom, place_std_m, delay_std_s, arrivals)
    solved = least_squares(
        problem.residuals,
        problem.start if begin is None else problem.at(begin),
        problem.slopes,
        x_scale=problem.scale,
        loss="soft_l1",
        f_scale=2.5,
        ftol=_TOLERANCE,
        xtol=_TOLERANCE,
        max_nfev=_MOST_STEPS,
    )
    return problem.result(solved.x, np.asarray(solved.jac))


class _Problem:
    """The adjustment as a vector of unknowns and a vector of residuals in standard deviations."""

    def __init__(
        self,
        microphones: Microphones,
        delays: Delays,
        places_m: FloatArray,
        c_m_s: float,
        freedom: Freedom,
        place_std_m: float,
        delay_std_s: float,
        arrivals: Arrivals | None,
    ) -> None:
        self._microphones, self._delays, self._places_m = microphones, delays, places_m
        self._c_m_s, self._freedom, self._place_std_m = c_m_s, freedom, place_std_m
        self._delay_std_s, self._arrivals = delay_std_s, arrivals
        self._free = [name for name in microphones if name in freedom.arrays]
        pose_scale = [_SHIFT_SCALE_M] * 3 + [_TURN_SCALE_RAD] * 3
        offsets = sum(microphones[name].size for name in delays) if freedom.microphone_std_m > 0.0 else 0
        few = [
            *pose_scale * len(self._free),
            *([_SPEED_SCALE_M_S] if freedom.speed_std_m_s > 0.0 else []),
            *([freedom.microphone_std_m] * offsets),
        ]
        self.start = np.concatenate([np.zeros(len(few)), places_m.ravel()])
        self.scale = np.array(few + [1.0] * places_m.size)

    def at(self, adjusted: Adjusted) -> FloatArray:
        """Return the unknowns of a result; the microphones have no offsets from their places within the arrays."""
        unknowns = self.start.copy()
        for index, name in enumerate(self._free):
            pose = adjusted.poses[name]
            first = index * _UNKNOWNS
            unknowns[first : first + _UNKNOWNS] = [*pose.shift_m, *np.radians(pose.turn_deg)]
        if self._freedom.speed_std_m_s > 0.0:
            unknowns[len(self._free) * _UNKNOWNS] = adjusted.c_m_s - self._c_m_s
        unknowns[-self._places_m.size :] = adjusted.places_m.ravel()
        return unknowns

    def residuals(self, unknowns: FloatArray) -> FloatArray:
        """Return the residuals of delays and priors, in standard deviations."""
        poses, speed_m_s, places_m = self._unpack(unknowns)
        at_m = self._moved(poses, unknowns)
        parts = [contradictions_s(at_m, self._delays, places_m, speed_m_s).ravel() / self._delay_std_s]
        for name, (shift_m, turn) in poses.items():
            position_std_m, orientation_std_deg = self._freedom.arrays[name]
            parts += [shift_m / position_std_m, turn / np.radians(orientation_std_deg)]
        if self._freedom.speed_std_m_s > 0.0:
            parts.append(np.array([(speed_m_s - self._c_m_s) / self._freedom.speed_std_m_s]))
        if self._freedom.microphone_std_m > 0.0:
            parts.append(self._offsets(unknowns) / self._freedom.microphone_std_m)
        if self._arrivals is not None:
            off_s = self._arrivals.contradictions_s(at_m, places_m, speed_m_s)
            parts.append(off_s.ravel() / self._arrivals.std_s)
        parts.append(((places_m - self._places_m) / self._place_std_m).ravel())
        return np.concatenate(parts)

    def slopes(self, unknowns: FloatArray) -> FloatArray:
        """Return the slope of the residuals: by differences for poses, speed and microphones, exact for places."""
        here = self.residuals(unknowns)
        slopes = np.zeros((len(here), len(unknowns)))
        few = len(unknowns) - self._places_m.size
        for column in range(few):
            step = _STEP * self.scale[column]
            moved = unknowns.copy()
            moved[column] += step
            slopes[:, column] = (self.residuals(moved) - here) / step
        poses, speed_m_s, places_m = self._unpack(unknowns)
        sounds = np.arange(len(places_m))
        at_m = self._moved(poses, unknowns)
        of_places = slopes_s_m(at_m, self._delays, places_m, speed_m_s) / self._delay_std_s
        rows = of_places.shape[1]
        blocks = slopes[: len(sounds) * rows, few:].reshape(len(sounds), rows, len(sounds), 3)
        blocks[sounds, :, sounds] = of_places
        if self._arrivals is not None:
            of_times = self._arrivals.slopes_s_m(at_m, places_m, speed_m_s) / self._arrivals.std_s
            count = of_times.shape[0] * of_times.shape[1]
            rows_of_times = slopes[-places_m.size - count : -places_m.size, few:]
            rows_of_times.reshape(len(sounds), -1, len(sounds), 3)[sounds, :, sounds] = of_times
        slopes[-places_m.size :, few:] = np.eye(places_m.size) / self._place_std_m
        return slopes

    def result(self, unknowns: FloatArray, jacobian: FloatArray) -> Adjusted:
        """Return the result for the unknowns, with the covariance from the slope of the residuals."""
        poses, speed_m_s, places_m = self._unpack(unknowns)
        covariance = np.asarray(np.linalg.pinv(jacobian.T @ jacobian, hermitian=True), dtype=np.float64)
        at_m = self._moved(poses, unknowns)
        off = contradictions_s(at_m, self._delays, places_m, speed_m_s)
        count = sum(np.maximum(np.isfinite(one).sum(axis=1) - 1, 0) for one in self._delays.values())
        misfits_s = np.sqrt((off**2).sum(axis=1) / np.maximum(count, 1))
        found = {}
        for index, name in enumerate(self._free):
            own = slice(index * _UNKNOWNS, (index + 1) * _UNKNOWNS)
            shift_m, turn = poses[name]
            found[name] = Pose(shift_m, np.degrees(turn), covariance[own, own])
        at = len(self._free) * _UNKNOWNS
        c_std_m_s = float(np.sqrt(covariance[at, at])) if self._freedom.speed_std_m_s > 0.0 else 0.0
        return Adjusted(found, speed_m_s, c_std_m_s, places_m, misfits_s, at_m)

    def _unpack(self, unknowns: FloatArray) -> tuple[dict[str, tuple[FloatArray, FloatArray]], float, FloatArray]:
        poses, at = {}, 0
        for name in self._free:
            poses[name] = unknowns[at : at + 3], unknowns[at + 3 : at + _UNKNOWNS]
            at += _UNKNOWNS
        speed_m_s = self._c_m_s
        if self._freedom.speed_std_m_s > 0.0:
            speed_m_s = self._c_m_s + unknowns[at]
        return poses, float(speed_m_s), unknowns[-self._places_m.size :].reshape(-1, 3)

    def _offsets(self, unknowns: FloatArray) -> FloatArray:
        """Return the offsets of all microphones from their places within the arrays, metres."""
        first = len(self._free) * _UNKNOWNS + (self._freedom.speed_std_m_s > 0.0)
        return unknowns[first : -self._places_m.size]

    def _moved(self, poses: Mapping[str, tuple[FloatArray, FloatArray]], unknowns: FloatArray) -> dict[str, FloatArray]:
        """Return the places (K, 3) of the microphones of each array, metres."""
        offsets_m, found = self._offsets(unknowns).reshape(-1, 3), {}
        for name in self._delays:
            at_m = self._microphones[name]
            at_m = moved(at_m, *poses[name]) if name in poses else at_m
            if len(offsets_m):
                at_m, offsets_m = at_m + offsets_m[: len(at_m)], offsets_m[len(at_m) :]
            found[name] = at_m
        return found


def moved(microphones_m: FloatArray, shift_m: FloatArray, turn: FloatArray) -> FloatArray:
    """Return positions (K, 3), metres, after a rotation about their centre (a vector, radians) and then a shift."""
    centre_m = microphones_m.mean(axis=0)
    return np.asarray(Rotation.from_rotvec(turn).apply(microphones_m - centre_m) + centre_m + shift_m)


def line_axis(microphones_m: FloatArray) -> FloatArray | None:
    """Return the direction (3,) of the line on which microphones (K, 3) lie; None if they lie on no line.

    Two microphones always lie on a line.
    """
    _, extent_m, axes = np.linalg.svd(microphones_m - microphones_m.mean(axis=0), full_matrices=False)
    return np.asarray(axes[0]) if extent_m[1] <= LINE * extent_m[0] else None


def without_spin(covariance: FloatArray, microphones_m: FloatArray) -> FloatArray:
    """Return the covariance (..., 6, 6) of a pose, without the rotation of a line of microphones about its own axis.

    Such a rotation moves no microphone, so no sound determines it and no position depends on it. The covariance of an
    array that is not a line is returned unchanged.
    """
    axis = line_axis(microphones_m)
    if axis is None:
        return covariance
    spin = np.concatenate([np.zeros(3), axis])
    shared = covariance @ spin
    return np.asarray(covariance - shared[..., :, None] * shared[..., None, :] / (shared @ spin)[..., None, None])
