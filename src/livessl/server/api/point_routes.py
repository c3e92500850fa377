"""REST route `GET point`: pan and tilt by which a camera faces a position or event."""

from __future__ import annotations

import math
from typing import Annotated, Final

from fastapi import APIRouter, HTTPException, Query, Response
from pydantic import BaseModel, Field

from livessl.core.geometry import pan_tilt_deg
from livessl.core.types import Status
from livessl.schema.answers import errors
from livessl.schema.values import PositionM, Version
from livessl.server.api.encode import API_VERSION
from livessl.server.api.queries import unprocessable
from livessl.server.api.routes import as_json
from livessl.server.parts import Parts

MAX_M: Final = 1e6
"""Largest coordinate of a position, in metres; the site file has the same limit."""

LEAST_M: Final = 1e-3
"""Least distance, in metres, of a position from the camera; a nearer one has no direction."""

_NOT_FOUND: Final = "There is no camera of that name, or no event of that id."
_NO_PLACE: Final = "The event was not located."


class Pointing(BaseModel):
    """The direction in which a camera faces a position."""

    v: Version
    camera: str = Field(description="Name of the camera in the site file.", examples=["door"])
    event_id: str | None = Field(description="Id of the event; null for a given position.", examples=["lab-1"])
    position_m: PositionM
    pan_deg: float = Field(ge=-180, le=180, description="Degrees to the right of the camera's direction at rest.")
    tilt_deg: float = Field(ge=-90, le=90, description="Degrees upwards.")
    distance_m: float = Field(gt=0, description="Distance between the position and the camera, in metres.")


def point_route(parts: Parts) -> APIRouter:
    """Return the router with `GET point`."""
    cameras, router = parts.site.cameras, APIRouter()

    @router.get(
        "/api/v1/point",
        tags=["estimates"],
        response_model=Pointing,
        responses=errors(404, 409, 503, texts={404: _NOT_FOUND, 409: _NO_PLACE}),
    )
    def get_point(
        camera: Annotated[str, Query(description="name of the camera in the site file")],
        event: Annotated[str | None, Query(description="id of the event to point at")] = None,
        position_m: Annotated[
            str | None,
            Query(description="position to point at instead of an event: x,y,z in metres", examples=["2.1,3.4,1.2"]),
        ] = None,
    ) -> Response:
        """Pan and tilt by which a camera faces an event or a position."""
        if camera not in cameras:
            raise HTTPException(404, f"no camera {camera!r}; cameras are {', '.join(cameras) or 'none: add cameras'}")
        if (event is None) == (position_m is None):
            got = "neither" if event is None else "both"
            raise unprocessable("event", f"event: expected either event or position_m, got {got}")
        place_m = _place(position_m) if position_m is not None else _place_of(parts, str(event))
        mount = cameras[camera]
        pan_deg, tilt_deg, distance_m = pan_tilt_deg(place_m, mount.position_m, **mount.orientation_deg.named_deg)
        if distance_m < LEAST_M:
            raise unprocessable("position_m", "position_m: expected a place that is not the camera's own")
        found = {"v": API_VERSION, "camera": camera, "event_id": event, "position_m": place_m}
        angles = {"pan_deg": round(pan_deg, 3), "tilt_deg": round(tilt_deg, 3), "distance_m": round(distance_m, 3)}
        return as_json({**found, **angles})

    return router


def _place(text: str) -> list[float]:
    try:
        place_m = [float(part) for part in text.split(",")]
    except ValueError:
        place_m = []
    if len(place_m) != 3 or not all(math.isfinite(value) and abs(value) <= MAX_M for value in place_m):
        raise unprocessable("position_m", f"position_m: expected x,y,z in metres, got {text!r}")
    return place_m


def _place_of(parts: Parts, event_id: str) -> list[float]:
    event = parts.store.get(event_id)
    if event is None:
        raise HTTPException(404, f"no event {event_id!r}")
    if event["status"] != Status.LOCATED:
        raise HTTPException(409, f"event {event_id!r} is {event['status']}: no camera can be pointed at it")
    place_m: list[float] = event["position_m"]
    return place_m
