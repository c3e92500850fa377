"""Reads the places of an event: its position or candidates, and how certain they are."""

from __future__ import annotations

import math
from typing import Any, Final, NamedTuple

import numpy as np

from livessl.core.types import FloatArray, Status
from livessl.server.history.query import JsonObject

DISTANCE_STD: Final = 0.5
"""Standard deviation of the distance from the nearest array, as a share of it, if an event has a direction only."""


class Whereabouts(NamedTuple):
    """The places of an event.

    Parameters
    ----------
    status : Status
        Refused if there is no place.
    places_m : ndarray (n, 3)
        The position, or the candidates for it, in metres; none if refused.
    covariance_m2 : ndarray (3, 3)
        Covariance of each of them; for a direction, the distance counts as known to a factor only.
    """

    status: Status
    places_m: FloatArray
    covariance_m2: FloatArray


def whereabouts(event: JsonObject) -> Whereabouts:
    """Return where the sound of an event may have been.

    Parameters
    ----------
    event : JsonObject
        A final event, as the API has it.
    """
    position_m, covariance_m2 = event.get("position_m"), event.get("covariance_m2")
    status = event["status"]
    if position_m is None or covariance_m2 is None or status not in (Status.LOCATED, Status.DIRECTION_ONLY):
        return Whereabouts(Status.REFUSED, np.empty((0, 3)), np.eye(3))
    spread_m2 = _without_negative_variances(covariance_m2)
    if status == Status.LOCATED:
        return Whereabouts(Status.LOCATED, np.array([position_m], dtype=float), spread_m2)
    candidates = [each["position_m"] for each in event.get("candidates") or ()] or [position_m]
    places_m = np.array(candidates, dtype=float)
    return Whereabouts(Status.DIRECTION_ONLY, places_m, spread_m2 + _along_the_sight_m2(event))


def _without_negative_variances(covariance_m2: Any) -> FloatArray:
    """Return a covariance without the negative variances that rounding may cause."""
    given = np.asarray(covariance_m2, dtype=float)
    variances_m2, axes = np.linalg.eigh((given + given.T) / 2.0)
    return np.asarray((axes * np.maximum(variances_m2, 0.0)) @ axes.T)


def _along_the_sight_m2(event: JsonObject) -> FloatArray:
    """Return the covariance of a distance that is not known, along the line from the nearest array that contributed."""
    seen = min(event.get("contributions") or (), key=lambda each: each["distance_m"], default=None)
    if seen is None:
        return np.zeros((3, 3))
    azimuth, elevation = math.radians(seen["azimuth_deg"]), math.radians(seen["elevation_deg"])
    level = math.cos(elevation)
    sight = np.array([level * math.cos(azimuth), level * math.sin(azimuth), math.sin(elevation)])
    return np.asarray(np.outer(sight, sight) * (DISTANCE_STD * seen["distance_m"]) ** 2)
