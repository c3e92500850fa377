"""Reads the places of an event: its position or candidates, and how certain they are."""

from __future__ import annotations

import math
from typing import Any, Final, NamedTuple

import numpy as np

from livessl.core.types import FloatArray, Status
from livessl.server.history.query import JsonObject

DISTANCE_STD: Final = 0.5
"""Standard deviation of the distance from the nearest array, as a share of it, if an event has a direction only."""


RANGE_UNKNOWN: Final = 0.25
"""Ratio of the position's standard deviation to its distance from the nearest array beyond which the distance is not
known; that of `livessl.core.stream.verdict`, which a hub does not load."""


class Whereabouts(NamedTuple):
    """The places of an event.

    Parameters
    ----------
    status : Status
        Refused if there is no place.
    places_m : ndarray (n, 3)
        The position, or the candidates for it, in metres; none if refused.
    covariance_m2 : ndarray (3, 3)
        Covariance of each of them. If the distance is not known, it is known to `DISTANCE_STD` here.
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
    candidates = [each["position_m"] for each in event.get("candidates") or ()]
    if not (candidates and _has_distance(event, spread_m2)):
        spread_m2 = spread_m2 + _along_the_sight_m2(event)
    return Whereabouts(Status.DIRECTION_ONLY, np.array(candidates or [position_m], dtype=float), spread_m2)


def _without_negative_variances(covariance_m2: Any) -> FloatArray:
    """Return a covariance without the negative variances that rounding may cause."""
    given = np.asarray(covariance_m2, dtype=float)
    variances_m2, axes = np.linalg.eigh((given + given.T) / 2.0)
    return np.asarray((axes * np.maximum(variances_m2, 0.0)) @ axes.T)


def _has_distance(event: JsonObject, covariance_m2: FloatArray) -> bool:
    """Return whether an event is a direction for its candidates alone, because its distance is certain enough."""
    distances_m = [each["distance_m"] for each in event.get("contributions") or ()]
    spread_m = math.sqrt(max(0.0, float(np.linalg.eigvalsh(covariance_m2)[-1])))
    return len(distances_m) > 1 and spread_m <= RANGE_UNKNOWN * min(distances_m)


def _along_the_sight_m2(event: JsonObject) -> FloatArray:
    """Return the covariance of a distance that is not known, along the line from the nearest array that contributed."""
    seen = min(event.get("contributions") or (), key=lambda each: each["distance_m"], default=None)
    if seen is None:
        return np.zeros((3, 3))
    azimuth, elevation = math.radians(seen["azimuth_deg"]), math.radians(seen["elevation_deg"])
    level = math.cos(elevation)
    sight = np.array([level * math.cos(azimuth), level * math.sin(azimuth), math.sin(elevation)])
    return np.asarray(np.outer(sight, sight) * (DISTANCE_STD * seen["distance_m"]) ** 2)
