"""REST routes of the site, arrays, tracks, health and maps; decides the `status` of health and its reasons."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import asdict
from typing import Annotated, Final, Literal

import numpy as np
import orjson
from fastapi import APIRouter, HTTPException, Query, Request, Response
from pydantic import WithJsonSchema

from livessl import __version__
from livessl.clock import utc_text
from livessl.core.commission.blind_spot import CURE, BlindSpot
from livessl.core.commission.finding import LEAST_SOUNDS
from livessl.core.types import FRAME_S
from livessl.schema import answers
from livessl.schema.answers import errors
from livessl.schema.findings import Findings
from livessl.server.api.auth import ACCESS, HEALTH, Access
from livessl.server.api.encode import API_VERSION, JsonObject
from livessl.server.api.png import map_png
from livessl.server.api.queries import array_names, map_names, unprocessable
from livessl.server.maps import FUSED, bounds_of_view_m, projection
from livessl.server.parts import Parts
from livessl.server.store import StoreError
from livessl.site.build.grid import search_grid
from livessl.site.models import Site

_log = logging.getLogger(__name__)

NONE_ENABLED: Final = "all arrays are disabled, so nothing is located; enable one"
"""Reason of `degraded` where an operator has disabled every array."""

_DATE_TIME: Final = {"type": "string", "format": "date-time"}
_BINARY: Final = {"schema": {"type": "string", "format": "binary"}}
MAP_HEADERS: Final = {
    name: {"description": description, "schema": schema, "example": example}
    for name, schema, example, description in (
        ("X-Map-Shape", {"type": "string"}, "200,160", "Lengths of the axes: rows and columns, or x, y and z."),
        ("X-Map-Bounds-M", {"type": "string"}, "0,10,0,8", "Lowest and highest coordinate of each axis, in metres."),
        ("X-Map-Time-Utc", _DATE_TIME, "2026-01-31T12:00:00.050000Z", "Middle of the window, in UTC."),
        ("X-Map-Age-S", {"type": "number"}, 0.25, "Age of the window in seconds."),
        ("X-Map-Min", {"type": "number"}, 0.0123, "Smallest power."),
        ("X-Map-Max", {"type": "number"}, 0.873, "Largest power."),
    )
}

Time = Annotated[str, WithJsonSchema(_DATE_TIME)]


def as_json(found: JsonObject, status: int = 200) -> Response:
    """An answer as JSON. The models in `schema/` describe it in OpenAPI; it is not validated against them here."""
    return Response(orjson.dumps(found), status, media_type="application/json")


def describe_site(parts: Parts) -> JsonObject:
    """Geometry and settings, for clients that draw."""
    site, picture = parts.site, parts.floor_plan
    grid = search_grid(site)
    return {
        "v": API_VERSION,
        "site": site.site,
        "version": __version__,
        "mode": parts.site_time.mode,
        "room": {"size_m": list(site.room.size_m)},
        "grid": {"bounds_m": [list(b) for b in grid.bounds_m], "spacing_m": grid.spacing_m, "shape": list(grid.shape)},
        "speed_of_sound_m_s": parts.set_up.site.c_m_s,
        "band_hz": list(site.band_hz),
        "method": site.fusion.method,
        "frame_s": FRAME_S,
        "activity": {"threshold": site.activity.threshold, "floor_factor": site.activity.floor_factor},
        "arrays": parts.set_up.describe_arrays(),
        "joint": {name: list(members) for name, members in site.joint.items()},
        "zones": parts.zone_book.describe(),
        "can_draw": site.zones_file is not None,
        "floor_plan": None if picture is None else {"bounds_m": [list(b) for b in picture.bounds_m]},
        "privacy": _privacy(site),
    }


def _privacy(site: Site) -> JsonObject:
    return {"mode": site.privacy, "retention_days": site.store.retention_days}


def _blind_spot(spot: BlindSpot) -> JsonObject:
    is_turn = spot.fault != "moved"
    return {
        "kind": "blind_spot",
        "fault": spot.fault,
        "arrays": list(spot.arrays),
        "least_m": None if is_turn else spot.least,
        "least_deg": spot.least if is_turn else None,
        "along": list(spot.along),
        "message": spot.message,
        "cure": CURE,
    }


def _secured(site: Site) -> JsonObject:
    return {
        "nodes": site.keys is not None,
        "tokens": site.server.http.tokens is not None,
        "tls": site.server.http.certificate is not None,
    }


def state_routes(parts: Parts) -> APIRouter:
    """Site, arrays, tracks and health."""
    router = APIRouter()
    _add_state(router, parts)
    _add_health(router, parts)
    return router


def _add_state(router: APIRouter, parts: Parts) -> None:
    @router.get("/api/v1/site", tags=["state"], response_model=answers.Site)
    def get_site() -> Response:
        """Room, grid, arrays and settings."""
        return as_json(describe_site(parts))

    @router.get("/api/v1/arrays", tags=["state"], response_model=answers.Arrays)
    def get_arrays() -> Response:
        """State, age of the last message, levels, drift and counters of every array, and where it is."""
        now_utc, places = utc_text(parts.site_time.now_ns()), parts.set_up.describe_arrays()
        arrays = [
            {**array, **{key: places[array["name"]][key] for key in ("position_m", "microphones_m")}}
            for array in parts.array_states.describe()
        ]
        return as_json({"v": API_VERSION, "now_utc": now_utc, "arrays": arrays})

    @router.get("/api/v1/findings", tags=["state"], response_model=Findings)
    def get_findings() -> Response:
        """Faults of the set-up that the last sounds show, errors first, and faults that they could not show."""
        state = parts.set_up_watch.state
        findings = [{"kind": "finding", **asdict(finding)} for finding in state.findings]
        blind_spots = [_blind_spot(spot) for spot in state.blind_spots]
        sounds = {"sounds": state.sounds, "least_sounds": LEAST_SOUNDS}
        return as_json({"v": API_VERSION, **sounds, "findings": findings, "blind_spots": blind_spots})

    @router.get("/api/v1/tracks", tags=["estimates"], response_model=answers.Tracks)
    def get_tracks() -> Response:
        """The tracks that live now."""
        return as_json({"v": API_VERSION, "tracks": parts.tracks.all()})


def _add_health(router: APIRouter, parts: Parts) -> None:
    site = parts.site

    @router.get(
        HEALTH,
        tags=["state"],
        response_model=answers.Health | answers.HealthStatus,
        responses={503: {"model": answers.Health | answers.HealthStatus, "description": "The server has failed."}},
    )
    def get_health(request: Request) -> Response:
        """Condition of the server and of its arrays; without a token the status alone. The code is 503 on failure."""
        arrays = parts.array_states.describe()
        status, reasons = condition(parts, arrays)
        code = 503 if status == "failed" else 200
        if request.scope["client_role"] is None:
            return as_json({"v": API_VERSION, "status": status}, code)
        found = {
            "v": API_VERSION,
            "status": status,
            "version": __version__,
            "mode": parts.site_time.mode,
            "uptime_s": round(parts.site_time.uptime_s(), 3),
            "arrays": {a["name"]: a["state"] for a in arrays},
            "reasons": reasons,
            "load": parts.overload.describe(),
            "privacy": _privacy(site),
            "secured": _secured(site),
            "refused": {door: parts.refusals.count(door) for door in ("nodes", "http")},
        }
        return as_json(found, code)


def condition(parts: Parts, arrays: Sequence[JsonObject]) -> tuple[str, list[str]]:
    """Return the status of the server, and the reasons for it."""
    reasons = [f"{a['name']}: {a['reason']}" for a in arrays if a["reason"] is not None]
    states = {a["state"] for a in arrays if a["enabled"]}  # an operator disables an array on purpose
    status = "ok" if states == {"healthy"} else "degraded" if not states <= {"starting", "healthy"} else "starting"
    if not states:
        status = "degraded"
        reasons.append(NONE_ENABLED)
    discarded = parts.event_log.discarded
    # as long as writing succeeds, events that wait are about to be written, which is no fault
    unsaved = parts.event_log.unsaved if parts.store.backlog.is_failing else 0
    if discarded:
        reasons.append(f"server.events_db: {discarded} events were not stored; {parts.store.cure}")
    if others := parts.event_log.discarded_others:
        what = "entries of the journal or messages for the hub"
        reasons.append(f"server.events_db: {others} {what} were not stored; {parts.store.cure}")
    if unsaved:
        reasons.append(f"server.events_db: {unsaved} events wait to be stored; {parts.store.cure}")
    if parts.store.problem is not None:
        reasons.append(parts.store.problem)
    if (discarded or others or unsaved or parts.store.problem) and status == "ok":
        status = "degraded"
    problems = parts.alerts.problems + ([] if parts.clips is None else parts.clips.problems)
    if parts.hub_link is not None and parts.hub_link.problem is not None:
        problems.append(parts.hub_link.problem)
    if problems and status == "ok":
        status = "degraded"
    reasons += problems
    overload = parts.overload.message
    if overload is not None:
        status, reasons = "overloaded", [overload, *reasons]
    if parts.failure is not None:
        return "failed", [f"fusion: {parts.failure!r}", *reasons]
    return status, reasons


def switch_route(parts: Parts) -> APIRouter:
    """Disable and enable an array."""
    site, router = parts.site, APIRouter()

    @router.put(
        "/api/v1/arrays/{name}/enabled",
        tags=["state"],
        response_model=answers.Switched,
        responses=errors(400, 404, 411, 413, 503, texts={404: "There is no array of that name."}),
    )
    def put_enabled(name: str, switch: answers.Switch, request: Request) -> Response:
        """Disable an array that does harm, or enable it again; for operators."""
        if name not in array_names(site):
            raise HTTPException(404, f"no array {name!r}; there are {', '.join(array_names(site))}")
        try:
            parts.array_states.enable(name, switch.enabled)
        except StoreError as error:
            raise HTTPException(503, str(error)) from error
        done = "enabled" if switch.enabled else "disabled"
        who = request.scope["client_name"]
        _log.info("%r has %s array %r", who, done, name)
        parts.journal.configuration(f"array {name}", who, f"{who!r} has {done} array {name!r}", switch.model_dump())
        return as_json({"v": API_VERSION, "name": name, "enabled": switch.enabled})

    return router


def access_route(parts: Parts, access: Access) -> APIRouter:
    """Clients, nodes and refusals."""
    router = APIRouter()

    @router.get(ACCESS, tags=["state"], response_model=answers.AccessList)
    def get_access() -> Response:
        """Clients that have a token, nodes that are enrolled, and callers that were refused; for admins."""
        found = {
            "v": API_VERSION,
            "clients": [{"name": c.name, "role": str(c.role)} for c in access.clients],
            "nodes": list(parts.receiver.enrolled),
            "refused": [
                {"door": r.door, "who": r.who, "reason": r.reason, "count": r.count, "last_utc": utc_text(r.last_ns)}
                for r in parts.refusals.known()
            ],
        }
        return as_json(found)

    return router


def map_route(parts: Parts) -> APIRouter:
    """Power maps."""
    site, router = parts.site, APIRouter()

    @router.get(
        "/api/v1/map",
        tags=["estimates"],
        response_class=Response,
        responses={
            200: {
                "description": "The map: a picture, or little-endian float32 numbers, row by row.",
                "content": {"image/png": _BINARY, "application/octet-stream": _BINARY},
                "headers": MAP_HEADERS,
            },
            204: {"description": "No window has been localized yet."},
            **errors(404, texts={404: "There is no array of that name, or it has no part in the newest map."}),
        },
    )
    def get_map(
        array: Annotated[str, Query(description="`fused`, or an array's name")] = FUSED,
        view: Annotated[
            Literal["floor", "side", "front", "volume"],
            Query(description="projection (largest value along the axis left out), or `volume` with format=float32"),
        ] = "floor",
        format: Annotated[  # noqa: A002 - the API's word
            Literal["png", "float32"], Query(description="picture, or numbers")
        ] = "png",
    ) -> Response:
        """The newest power map: a projection (largest value along the axis left out) or the whole volume."""
        if array not in map_names(site):
            raise HTTPException(404, f"no array {array!r}; there are {', '.join(map_names(site))}")
        if view == "volume" and format == "png":
            raise unprocessable("view", "view=volume has no picture; use format=float32")
        return newest_map(parts, array, view, format)

    return router


def newest_map(parts: Parts, array: str, view: str, form: str) -> Response:
    """The newest window's map as a picture or as numbers; 204 before the first window.

    Raises
    ------
    HTTPException
        404 if the array has no part in that window.
    """
    drawn = parts.maps.newest(array)
    if drawn is None:
        return Response(status_code=204)
    power = drawn.power(array)
    if power is None:
        raise HTTPException(404, f"array {array!r} has no part in the newest map")
    grid, time_ns = drawn.maps.grid, drawn.window.time_ns
    if view == "volume":
        image, bounds_m = power.reshape(grid.shape), [edge for bounds in grid.bounds_m for edge in bounds]
    else:
        image, bounds_m = projection(power, grid.shape, view), list(bounds_of_view_m(drawn.maps, view))
    headers = {
        "X-Map-Shape": ",".join(str(n) for n in image.shape),
        "X-Map-Bounds-M": ",".join(f"{edge:g}" for edge in bounds_m),
        "X-Map-Time-Utc": utc_text(time_ns),
        "X-Map-Age-S": f"{(parts.site_time.now_ns() - time_ns) / 1e9:.3f}",
        "X-Map-Min": f"{image.min():.6g}",
        "X-Map-Max": f"{image.max():.6g}",
    }
    if form == "png":
        return Response(map_png(image), media_type="image/png", headers=headers)
    body = np.ascontiguousarray(image, dtype="<f4").tobytes()
    return Response(body, media_type="application/octet-stream", headers=headers)
