"""Measures the pose of an array from sounds at known places, wherever the site file has it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from livessl.core.commission.places import KnownPlaces, centred
from livessl.core.commission.poses import UNKNOWN_DEG, UNKNOWN_M, Freedom, Pose, adjust, moved
from livessl.core.types import FloatArray

LEAST_PLACES: Final = 4
"""Fewest places from which a pose is measured: three leave nothing to check it with."""

REACH_M: Final = 6.0
"""Distance beyond the places, in metres, within which an array is searched for."""

STEPS_M: Final = (1.0, 0.25)
"""Steps of that search, metres."""

NEAREST_M: Final = 0.1
"""Least distance of an array from a sound, metres."""

MOST_STD_M: Final = 0.10
MOST_STD_DEG: Final = 3.0
"""Standard deviations beyond which the places do not determine the pose."""


@dataclass(frozen=True, slots=True)
class MeasuredPose:
    """The pose of one array as sounds at known places say.

    Parameters
    ----------
    microphones_m : (K, 3) float64
        Measured places of the microphones, metres.
    shift_m : (3,) float64
        From the filed centre to the measured one, metres.
    turn : Rotation
        From the filed orientation to the measured one, about the centre.
    position_std_m, orientation_std_deg : float
        Largest standard deviations along any axis.
    misfit_before_s, misfit_s : float
        Misfit of the sounds with the filed pose and with the measured one, seconds.
    """

    microphones_m: FloatArray
    shift_m: FloatArray
    turn: Rotation
    position_std_m: float
    orientation_std_deg: float
    misfit_before_s: float
    misfit_s: float

    @property
    def is_determined(self) -> bool:
        """True if the places determine the pose."""
        return self.position_std_m <= MOST_STD_M and self.orientation_std_deg <= MOST_STD_DEG


def measure_pose(
    microphones_m: FloatArray, delays_s: FloatArray, places_m: FloatArray, c_m_s: float, place_std_m: float
) -> MeasuredPose:
    """Measure the pose of an array whose geometry is known.

    The adjustment begins at the filed pose and at the one that the directions of the sounds say; the better of the two
    results is returned.

    Parameters
    ----------
    microphones_m : (K, 3) float64
        As filed, metres.
    delays_s : (S, K) float64
        Delays of the sounds, seconds.
    places_m : (S, 3) float64
        Where the sounds were made, metres.
    c_m_s : float
        Speed of sound, m/s.
    place_std_m : float
        How exactly the places are known along each axis, metres.

    Raises
    ------
    ValueError
        If there are fewer than `LEAST_PLACES`.
    """
    heard = np.isfinite(delays_s).sum(axis=1) > 1
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
        adjusted = adjust({"array": rough_m}, {"array": delays_s}, places_m, c_m_s, freedom, place_std_m)
        misfit_s = float(np.sqrt(np.mean(adjusted.misfits_s**2)))
        if best is None or misfit_s < best[0]:
            best = misfit_s, adjusted.poses["array"], adjusted.poses["array"].applied(rough_m)
    assert best is not None
    _, pose, measured_m = best
    variance = np.diag(pose.covariance)
    known = KnownPlaces(places_m, c_m_s)
    turn, _ = Rotation.align_vectors(measured_m - measured_m.mean(axis=0), microphones_m - microphones_m.mean(axis=0))
    return MeasuredPose(
        measured_m,
        measured_m.mean(axis=0) - microphones_m.mean(axis=0),
        turn,
        float(np.sqrt(variance[:3].max())),
        float(np.degrees(np.sqrt(variance[3:].max()))),
        known.fit({"array": microphones_m}, {"array": delays_s}).misfit_s,
        known.fit({"array": measured_m}, {"array": delays_s}).misfit_s,
    )


def from_known_places(
    microphones_m: FloatArray, delays_s: FloatArray, places_m: FloatArray
) -> tuple[FloatArray, FloatArray] | None:
    """Find a rough pose of one array from sounds at known places: where to begin an adjustment.

    Each sound's delays give its direction in the array's own frame. A position is tried at each point of a grid around
    the places; the turn that takes the directions to those towards the places is Wahba's problem.

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
        Shift of the array's centre in metres, and turn about it as a vector in radians. None if fewer than two sounds
        have a direction, or the array is a line or a plane, whose delays have none.
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
        best_m = points_m[np.argmin(_contradictions(points_m, places_m[there], directions))]
        low, high = best_m - step_m, best_m + step_m
    towards = places_m[there] - best_m
    turn, _ = Rotation.align_vectors(towards / np.linalg.norm(towards, axis=1, keepdims=True), directions)
    return best_m - centre_m, turn.as_rotvec()


def _contradictions(points_m: FloatArray, places_m: FloatArray, directions: FloatArray) -> FloatArray:
    """How badly the best turn takes directions (S, 3) to those from each point towards the places, (G,).

    The turn itself is not needed: the least sum of squares follows from the singular values of the sum of outer
    products (Wahba's problem; Markley 1988).
    """
    towards = places_m[None] - points_m[:, None]
    away_m = np.linalg.norm(towards, axis=2)
    towards /= np.maximum(away_m, NEAREST_M)[..., None]
    u, values, v = np.linalg.svd(np.einsum("gsi,sj->gij", towards, directions))
    sign = np.sign(np.linalg.det(u) * np.linalg.det(v))
    agreement = values[:, 0] + values[:, 1] + sign * values[:, 2]
    return np.where((away_m < NEAREST_M).any(axis=1), np.inf, len(places_m) - agreement)
