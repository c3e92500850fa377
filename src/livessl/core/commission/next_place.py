"""Proposes the place of the next clap of a calibration, and decides how well poses must be known (`AIM_M`)."""

from __future__ import annotations

from typing import Final

import numpy as np

from livessl.core.commission.places import Microphones
from livessl.core.commission.poses import MICROPHONE_STD_M, without_spin
from livessl.core.commission.resection import CLAP_STD_S
from livessl.core.types import FloatArray

AIM_M: Final = 0.03
AIM_DEG: Final = 1.0
"""Standard deviations of a pose, in metres and degrees, at which a calibration is good enough. The remaining errors
then move positions by no more than positions scatter anyway."""

STEP_M: Final = 0.5
"""Spacing of the proposed places, metres; places at multiples of it are easy to find with a tape."""

HEIGHTS_M: Final = (0.5, 1.0, 1.5, 2.0)
"""Heights of the proposed places, metres; all can be reached by hand. A search volume that holds none of them has
the height of its middle."""

MARGIN_M: Final = 0.5
"""Least distance of a proposed place from the sides of the search volume, metres."""

NEAREST_M: Final = 1.0
"""Least distance of a proposed place from an array, metres; nearer places would have to be measured more exactly."""

APART_M: Final = 0.75
"""Least distance of a proposed place from the places of earlier claps, metres."""

_ROUGH_M: Final = 1.0
_ROUGH_DEG: Final = 60.0
"""Standard deviations of a pose before any clap."""


def proposed_place(
    microphones: Microphones, places_m: FloatArray, bounds_m: FloatArray, c_m_s: float, place_std_m: float
) -> FloatArray | None:
    """Find the place at which the next clap improves the worst-known pose most.

    Parameters
    ----------
    microphones : mapping of array to (K, 3) float64
        Known or assumed positions of the microphones, metres.
    places_m : (S, 3) float64
        Places of the claps so far, metres; S may be 0.
    bounds_m : (3, 2) float64
        Search volume, metres.
    c_m_s : float
        Speed of sound, m/s.
    place_std_m : float
        Standard deviation of places along each axis, metres.

    Returns
    -------
    (3,) float64 or None
        Metres; None if no place is free.
    """
    candidates_m = _candidates(microphones, places_m, bounds_m)
    if len(candidates_m) == 0:
        return None
    known = {name: _information(at_m, places_m, c_m_s, place_std_m).sum(axis=0) for name, at_m in microphones.items()}
    off = np.zeros(len(candidates_m))
    for name, at_m in microphones.items():
        added = _information(at_m, candidates_m, c_m_s, place_std_m)
        position_m, orientation_deg = _stds(known[name] + _rough() + added, at_m)
        off = np.maximum(off, np.maximum(position_m / AIM_M, orientation_deg / AIM_DEG))
    return np.asarray(candidates_m[np.argmin(off)])


def expected_stds(
    microphones_m: FloatArray, places_m: FloatArray, c_m_s: float, place_std_m: float
) -> tuple[float, float]:
    """Predict the largest standard deviations, in metres and degrees, of a pose measured by claps at places (S, 3)."""
    information = _information(microphones_m, places_m, c_m_s, place_std_m).sum(axis=0)
    position_m, orientation_deg = _stds((information + _rough())[None], microphones_m)
    return float(position_m[0]), float(orientation_deg[0])


def _rough() -> FloatArray:
    """Return the information (6, 6) on a pose before any clap."""
    return np.diag([_ROUGH_M**-2.0] * 3 + [np.radians(_ROUGH_DEG) ** -2.0] * 3)


def _candidates(microphones: Microphones, places_m: FloatArray, bounds_m: FloatArray) -> FloatArray:
    """Return the places (G, 3) on a grid, away from walls, arrays and the claps so far, metres."""
    axes = [
        np.arange(np.ceil((low + MARGIN_M) / STEP_M) * STEP_M, high - MARGIN_M + 1e-9, STEP_M) for low, high in bounds_m
    ]
    low, high = bounds_m[2]
    axes[2] = np.array([height for height in HEIGHTS_M if low <= height <= high] or [0.5 * (low + high)])
    grid_m = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    free = np.ones(len(grid_m), dtype=bool)
    for at_m in microphones.values():
        free &= np.linalg.norm(grid_m - at_m.mean(axis=0), axis=1) >= NEAREST_M
    for place_m in places_m:
        free &= np.linalg.norm(grid_m - place_m, axis=1) >= APART_M
    return np.asarray(grid_m[free])


def _information(microphones_m: FloatArray, places_m: FloatArray, c_m_s: float, place_std_m: float) -> FloatArray:
    """Return the Fisher information (S, 6, 6) that a clap at each place gives on an array's shift (m) and turn (rad).

    The place of a clap is not known exactly; its standard deviation adds to the covariance of the delays.
    """
    towards = places_m[:, None] - microphones_m
    unit = towards / np.maximum(np.linalg.norm(towards, axis=2, keepdims=True), 1e-9)
    arms_m = microphones_m - microphones_m.mean(axis=0)
    slopes = np.concatenate([-unit, -np.cross(arms_m[None], unit)], axis=2) / c_m_s
    slopes -= slopes.mean(axis=1, keepdims=True)
    of_place = unit / c_m_s
    of_place = of_place - of_place.mean(axis=1, keepdims=True)
    covariance = (CLAP_STD_S**2 + (MICROPHONE_STD_M / c_m_s) ** 2) * np.eye(
        len(microphones_m)
    ) + place_std_m**2 * of_place @ of_place.swapaxes(1, 2)
    return np.asarray(slopes.swapaxes(1, 2) @ np.linalg.solve(covariance, slopes))


def _stds(information: FloatArray, microphones_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Largest standard deviations (G,) of positions in metres and of orientations in degrees."""
    covariance = without_spin(np.asarray(np.linalg.inv(information), dtype=np.float64), microphones_m)
    variance = np.maximum(np.diagonal(covariance, axis1=1, axis2=2), 0.0)
    return np.sqrt(variance[:, :3].max(axis=1)), np.degrees(np.sqrt(variance[:, 3:].max(axis=1)))
