"""Decides which events of a server in a hall are its own concern: those of its tile, and those near it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from livessl.core.types import FloatArray, Status
from livessl.server.forwarding.whereabouts import whereabouts
from livessl.server.history.query import JsonObject
from livessl.site import polygon
from livessl.site.hall import hall_of, neighbourhood
from livessl.site.models import Site

MARGIN_M: Final = 1.0
"""Least distance, in metres, from the tile up to which an event is sent: twice the error of 0.5 m that its confidence
is about, for positions whose covariance is too small."""

MARGIN_STD: Final = 3.0
"""The same distance in standard deviations of the position, in the direction in which it is least certain."""


class Tile:
    """The tile of a server.

    Every server of a hall receives arrays of its neighbours, and so locates sounds deep in their tiles, with the few
    arrays that it has there. It neither sends these to the hub nor alerts about them, unless a rule names zones. A
    refused event has no position, and concerns the tile if one of its arrays detected it.

    Parameters
    ----------
    hall : str
        Name of the hall.
    corners_m : sequence of (float, float)
        Corners of the tile, in metres.
    own : frozenset of str
        Names of the arrays in the tile.
    """

    def __init__(self, hall: str, corners_m: Sequence[polygon.Point], own: frozenset[str]) -> None:
        self.hall = hall
        self._corners_m = corners_m
        self._own = own

    @classmethod
    def of(cls, site: Site) -> Tile | None:
        """Return the tile of a site; None for a site that has its room to itself."""
        hall = hall_of(site)
        return None if hall is None else cls(hall.name, hall.tile_m, frozenset(neighbourhood(site, hall).own))

    def concerns(self, event: JsonObject) -> bool:
        """Return whether an event is in the tile or near it; else it is its neighbours' alone.

        Parameters
        ----------
        event : JsonObject
            As the API has it.
        """
        found = whereabouts(event)
        if found.status == Status.REFUSED:
            heard_by = event.get("heard_by") or ()
            return not heard_by or not self._own.isdisjoint(heard_by)
        margin_m = max(MARGIN_M, MARGIN_STD * _horizontal_std_m(found.covariance_m2))
        return any(self._outside_m(place_m) <= margin_m for place_m in found.places_m)

    def sent(self, event: JsonObject) -> JsonObject | None:
        """Return a final event as the hub gets it, with its hall; None if it does not concern the tile."""
        if not self.concerns(event):
            return None
        in_tile = event["position_m"] is not None and self._outside_m(event["position_m"]) == 0.0
        return {**event, "hall": {"name": self.hall, "in_tile": in_tile}}

    def _outside_m(self, place_m: Sequence[float] | FloatArray) -> float:
        return polygon.distance_m(self._corners_m, float(place_m[0]), float(place_m[1]))


def _horizontal_std_m(covariance_m2: FloatArray) -> float:
    """Return the largest standard deviation of a position on the floor plan, in metres."""
    return math.sqrt(max(0.0, float(np.linalg.eigvalsh(covariance_m2[:2, :2])[-1])))
