"""Measures an array's pose from claps at known places, even if the filed pose is far off."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from livessl.core.commission.places import Delays, KnownPlaces, Microphones, centred
from livessl.core.commission.poses import (
    MICROPHONE_STD_M,
    UNKNOWN_DEG,
    UNKNOWN_M,
    Adjusted,
    Freedom,
    Pose,
    adjust,
    line_axis,
    moved,
    without_spin,
)
from livessl.core.types import BoolArray, FloatArray

LEAST_PLACES: Final = 4
"""Fewest places from which a pose is measured; with three, the pose could not be checked."""

REACH_M: Final = 6.0
"""Largest distance, in metres, from the places at which an array is searched for."""

STEPS_M: Final = (1.0, 0.25)
"""Step sizes of the search for an array, metres."""

POINTS_TOGETHER: Final = 4096
"""Number of points that are tried at one time, so that a search in a hall takes little memory."""

NEAREST_M: Final = 0.1
"""Least distance of an array from a sound, metres."""

CLAP_STD_S: Final = 12e-6
"""Standard deviation of the delays of a clap, seconds. Claps are short and loud, so their delays are more exact."""

LEAST_CLAP_STD_S: Final = 2e-6
"""Least standard deviation of the delays of claps that is assumed, seconds, even if they fit better."""

SPEED_STD_M_S: Final = 3.0
"""Standard deviation of the filed speed of sound, m/s: five degrees of temperature."""

MOST_STD_M: Final = 0.10
MOST_STD_DEG: Final = 3.0
"""Standard deviations beyond which the places do not determine the pose."""


@dataclass(frozen=True, slots=True)
class MeasuredPose:
    """The pose of one array, measured by sounds at known places.

    Parameters
    ----------
    microphones_m : (K, 3) float64
        Measured places of the microphones, metres.
    shift_m : (3,) float64
        Shift from the filed centre to the measured one, metres.
    turn : Rotation
        Rotation from the filed orientation to the measured one, about the centre.
    position_std_m, orientation_std_deg : float
        Largest standard deviations along any axis.
    misfit_before_s, misfit_s : float
        Misfit of the sounds with the filed pose and with the measured one, seconds.
    covariance : (6, 6) float64
        Covariance of the position (m) and the rotation (radians). A line of microphones has no rotation about itself.
    """

    microphones_m: FloatArray
    shift_m: FloatArray
    turn: Rotation
    position_std_m: float
    orientation_std_deg: float
    misfit_before_s: float
    misfit_s: float
    covariance: FloatArray

    @property
    def is_determined(self) -> bool:
        """True if the places determine the pose."""
        return self.position_std_m <= MOST_STD_M and self.orientation_std_deg <= MOST_STD_DEG


def measure_pose(
    microphones_m: FloatArray, delays_s: FloatArray, places_m: FloatArray, c_m_s: float, place_std_m: float
) -> MeasuredPose:
    """Measure the pose of an array whose geometry is known.

    One adjustment begins at the filed pose, another at a rough pose from the directions of the sounds. The better
    result is returned.

    Parameters
    ----------
    microphones_m : (K, 3) float64
        As filed, metres.
    delays_s : (S, K) float64
        Delays of the sounds, seconds.
    places_m : (S, 3) float64
        Places at which the sounds were made, metres.
    c_m_s : float
        Speed of sound, m/s.
    place_std_m : float
        Standard deviation of the places along each axis, metres.

    Raises
    ------
    ValueError
        If there are fewer than `LEAST_PLACES`.
    """
    heard = received(delays_s)
    if heard.sum() < LEAST_PLACES:
        raise ValueError(f"expected {LEAST_PLACES} sounds or more at known places, got {heard.sum()}")
    delays_s, places_m = delays_s[heard], places_m[heard]
    starts = [(np.zeros(3), np.zeros(3))]
    directions = from_known_places(microphones_m, delays_s, places_m)
    if directions is not None:
        starts.append(directions)
    best: tuple[float, Pose, FloatArray] | None = None
    for shift_m, rotvec in starts:
        rough_m = moved(microphones_m, shift_m, rotvec)
        freedom = Freedom({"array": (UNKNOWN_M, UNKNOWN_DEG)})
        adjusted = adjust({"array": rough_m}, {"array": delays_s}, places_m, c_m_s, freedom, place_std_m, CLAP_STD_S)
        misfit_s = _misfit_s(adjusted)
        if best is None or misfit_s < best[0]:
            best = misfit_s, adjusted.poses["array"], adjusted.poses["array"].applied(rough_m)
    assert best is not None
    _, pose, measured_m = best
    return _against_filed(microphones_m, measured_m, pose, delays_s, KnownPlaces(places_m, c_m_s))


@dataclass(frozen=True, slots=True)
class MeasuredSetUp:
    """The poses of several arrays and the speed of sound, measured by the same sounds.

    Parameters
    ----------
    poses : mapping of array to MeasuredPose
    c_m_s, c_std_m_s : float
        Speed of sound and its standard deviation, m/s.
    places_m : (S, 3) float64
        Places of the sounds, metres; NaN for sounds that were not used.
    misfit_s : float
        Misfit of all used sounds with the measured set-up, seconds.
    """

    poses: Mapping[str, MeasuredPose]
    c_m_s: float
    c_std_m_s: float
    places_m: FloatArray
    misfit_s: float

    @property
    def sounds(self) -> int:
        """Number of sounds that were used."""
        return int(np.isfinite(self.places_m).all(axis=1).sum())


def measure_poses(
    microphones: Microphones, delays: Delays, places_m: FloatArray, c_m_s: float, place_std_m: float
) -> MeasuredSetUp:
    """Measure the poses of all arrays that received enough of the sounds, and the speed of sound.

    Each array is first measured alone. Then all arrays are adjusted together, because they share the errors of the
    places and the speed of sound. The places of the microphones within their arrays are measured as well, because their
    errors would change the directions of all sounds.

    Parameters
    ----------
    microphones : mapping of array to (K, 3) float64
        As filed, metres.
    delays : mapping of array to (S, K) float64
        Seconds.
    places_m, c_m_s, place_std_m
        As in `measure_pose`.

    Raises
    ------
    ValueError
        If no array received `LEAST_PLACES` of them.
    """
    enough = {name: measured for name, measured in delays.items() if received(measured).sum() >= LEAST_PLACES}
    if not enough:
        most = max((int(received(measured).sum()) for measured in delays.values()), default=0)
        raise ValueError(f"expected {LEAST_PLACES} sounds or more at known places, got {most}")
    rough = {
        name: measure_pose(microphones[name], measured, places_m, c_m_s, place_std_m).microphones_m
        for name, measured in enough.items()
    }
    freedom = Freedom(dict.fromkeys(rough, (UNKNOWN_M, UNKNOWN_DEG)), SPEED_STD_M_S, MICROPHONE_STD_M)
    adjusted = adjust(rough, enough, places_m, c_m_s, freedom, place_std_m, CLAP_STD_S)
    # how exact the delays are decides how far the microphones may be from where they were built
    std_s = min(max(_delay_std_s(adjusted, enough), LEAST_CLAP_STD_S), CLAP_STD_S)
    adjusted = adjust(rough, enough, places_m, c_m_s, freedom, place_std_m, std_s)
    known = KnownPlaces(places_m, adjusted.c_m_s)
    poses = {
        name: _against_filed(microphones[name], adjusted.microphones[name], adjusted.poses[name], measured, known)
        for name, measured in enough.items()
    }
    return MeasuredSetUp(poses, adjusted.c_m_s, adjusted.c_std_m_s, adjusted.places_m, _misfit_s(adjusted))


def _delay_std_s(adjusted: Adjusted, delays: Delays) -> float:
    """Estimate the standard deviation of delays, seconds, from their residuals.

    The misfits are root mean squares per delay. Each pose uses six degrees of freedom, the speed of sound one.
    """
    counts = np.sum([np.maximum(np.isfinite(one).sum(axis=1) - 1, 0) for one in delays.values()], axis=0)
    rows = int(counts.sum())
    squares = float((adjusted.misfits_s**2 * counts).sum())
    return float(np.sqrt(squares / max(rows - 6 * len(delays) - 1, 1)))


def received(delays_s: FloatArray) -> BoolArray:
    """Return the sounds (S,) that an array received with two channels or more, from delays (S, K)."""
    return np.asarray(np.isfinite(delays_s).sum(axis=1) > 1)


def described_pose(
    filed_m: FloatArray, measured_m: FloatArray, pose: Pose, misfit_before_s: float, misfit_s: float
) -> MeasuredPose:
    """Describe the difference of measured microphones (K, 3) from filed ones, metres; misfits are in seconds."""
    turn = turn_between(filed_m, measured_m)
    covariance = without_spin(pose.covariance, turn.apply(filed_m - filed_m.mean(axis=0)))
    variance = np.maximum(np.diag(covariance), 0.0)
    return MeasuredPose(
        measured_m,
        measured_m.mean(axis=0) - filed_m.mean(axis=0),
        turn,
        float(np.sqrt(variance[:3].max())),
        float(np.degrees(np.sqrt(variance[3:].max()))),
        misfit_before_s,
        misfit_s,
        covariance,
    )


def turn_between(filed_m: FloatArray, measured_m: FloatArray) -> Rotation:
    """Return the rotation about its centre between two poses of an array (K, 3), metres."""
    arms_m, filed_arms_m = measured_m - measured_m.mean(axis=0), filed_m - filed_m.mean(axis=0)
    if line_axis(filed_m) is not None:  # its longest arm says all; more of them leave the turn about it open
        longest = [int(np.linalg.norm(filed_arms_m, axis=1).argmax())]
        arms_m, filed_arms_m = arms_m[longest], filed_arms_m[longest]
    turn, _ = Rotation.align_vectors(arms_m, filed_arms_m)
    return turn


def _against_filed(
    filed_m: FloatArray, measured_m: FloatArray, pose: Pose, delays_s: FloatArray, known: KnownPlaces
) -> MeasuredPose:
    """Describe a measured pose with the misfits of sounds at known places."""
    before_s, after_s = (known.fit({"array": at_m}, {"array": delays_s}).misfit_s for at_m in (filed_m, measured_m))
    return described_pose(filed_m, measured_m, pose, before_s, after_s)


def _misfit_s(adjusted: Adjusted) -> float:
    return float(np.sqrt(np.mean(adjusted.misfits_s**2)))


def from_known_places(
    microphones_m: FloatArray, delays_s: FloatArray, places_m: FloatArray
) -> tuple[FloatArray, FloatArray] | None:
    """Find a rough pose of one array from sounds at known places, at which an adjustment can begin.

    The delays of each sound give its direction in the coordinates of the array. At each point of a grid around the
    places, the rotation from these directions to the directions towards the places is computed (Wahba's problem).

    Parameters
    ----------
    microphones_m : (K, 3) float64
        Metres.
    delays_s : (S, K) float64
        Seconds.
    places_m : (S, 3) float64
        Metres.

    Returns
    -------
    (3,) float64 and (3,) float64, or None
        Shift of the array's centre in metres, and rotation about the centre as a vector in radians. None if fewer than
        two sounds have a direction, or if the array is a line or a plane, whose delays give no direction.
    """
    centre_m = microphones_m.mean(axis=0)
    arms_m = microphones_m - centre_m
    there = np.isfinite(delays_s).all(axis=1)
    if there.sum() < 2 or np.linalg.matrix_rank(arms_m, tol=0.01) < 3:
        return None
    slowness, *_ = np.linalg.lstsq(arms_m, -centred(delays_s[there]).T, rcond=None)
    directions = (slowness / np.maximum(np.linalg.norm(slowness, axis=0), 1e-12)).T
    low, high = places_m.min(axis=0) - REACH_M, places_m.max(axis=0) + REACH_M
    for step_m in STEPS_M:
        axes = [np.arange(a, b + step_m / 2.0, step_m) for a, b in zip(low, high, strict=True)]
        points_m = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        chunks = (points_m[at : at + POINTS_TOGETHER] for at in range(0, len(points_m), POINTS_TOGETHER))
        found = [_contradictions(chunk, places_m[there], directions) for chunk in chunks]
        best_m = points_m[np.argmin(np.concatenate(found))]
        low, high = best_m - step_m, best_m + step_m
    towards = places_m[there] - best_m
    turn, _ = Rotation.align_vectors(towards / np.linalg.norm(towards, axis=1, keepdims=True), directions)
    return best_m - centre_m, turn.as_rotvec()


def _contradictions(points_m: FloatArray, places_m: FloatArray, directions: FloatArray) -> FloatArray:
    """Return the remaining error (G,) of the best rotation of directions (S, 3) to those from each point to the places.

    The rotation itself is not needed: the least sum of squares follows from the singular values of the sum of outer
    products (Wahba's problem; Markley 1988).
    """
    towards = places_m[None] - points_m[:, None]
    away_m = np.linalg.norm(towards, axis=2)
    towards /= np.maximum(away_m, NEAREST_M)[..., None]
    u, values, v = np.linalg.svd(np.einsum("gsi,sj->gij", towards, directions))
    sign = np.sign(np.linalg.det(u) * np.linalg.det(v))
    agreement = values[:, 0] + values[:, 1] + sign * values[:, 2]
    return np.where((away_m < NEAREST_M).any(axis=1), np.inf, len(places_m) - agreement)
