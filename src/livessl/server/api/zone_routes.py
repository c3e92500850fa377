"""REST routes of zones, of what tracks do in them, and of the floor plan's picture."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated, Final

from fastapi import APIRouter, HTTPException, Query, Request, Response

from livessl.schema import zones as zone_schema
from livessl.schema.answers import errors
from livessl.server.api.encode import API_VERSION
from livessl.server.api.queries import unprocessable
from livessl.server.api.routes import as_json
from livessl.server.parts import Parts
from livessl.server.zones.book import ZoneRefusedError, ZonesFileError
from livessl.server.zones.zone_map import no_zone
from livessl.site.floor_plan import PNG, SVG
from livessl.site.zone_models import Zone

_TEXTS: Final = {
    404: "There is no zone of that name.",
    409: "The site file owns the zone or names no file for drawn ones, or a rule needs the zone.",
    503: "The file of the drawn zones cannot be written.",
}
_PICTURES: Final = (PNG, SVG, "application/octet-stream")
"""Media types of the picture; the last one is for generators of clients that know no pictures."""

_BINARY: Final = {"schema": {"type": "string", "format": "binary"}}
_log = logging.getLogger(__name__)


def zone_routes(parts: Parts) -> APIRouter:
    """Zones, changes of tracks in them, and the floor plan."""
    router = APIRouter(tags=["zones"])
    _add_zones(router, parts)
    _add_zone_changes(router, parts)
    _add_floor_plan(router, parts)
    return router


def _add_zones(router: APIRouter, parts: Parts) -> None:
    book = parts.zone_book

    @router.get("/api/v1/zones", response_model=zone_schema.ZoneList)
    def get_zones() -> Response:
        """The zones in force, those of the site file and those that operators have drawn."""
        return as_json({"v": API_VERSION, "zones": book.describe(), "can_draw": parts.site.zones_file is not None})

    @router.put(
        "/api/v1/zones/{name}",
        response_model=zone_schema.OneZone,
        responses=errors(400, 409, 411, 413, 503, texts=_TEXTS),
    )
    def put_zone(name: str, zone: Zone, request: Request) -> Response:
        """Draw a zone, or change a drawn one; it is in force at once; for operators."""
        with _refusals():
            book.put(name, zone)
        who, drawn = request.scope["client_name"], zone.model_dump(mode="json")
        _log.info("%r has drawn zone %r", who, name)
        parts.journal.configuration(f"zone {name}", who, f"{who!r} has drawn zone {name!r}", {"zone": drawn})
        return as_json({"v": API_VERSION, "name": name, "zone": book.describe()[name]})

    @router.delete(
        "/api/v1/zones/{name}",
        response_model=zone_schema.Deleted,
        responses=errors(404, 409, 411, 413, 503, texts=_TEXTS),
    )
    def delete_zone(name: str, request: Request) -> Response:
        """Delete a drawn zone; for operators."""
        with _refusals():
            book.delete(name)
        who = request.scope["client_name"]
        _log.info("%r has deleted zone %r", who, name)
        parts.journal.configuration(f"zone {name}", who, f"{who!r} has deleted zone {name!r}", {"zone": None})
        return as_json({"v": API_VERSION, "name": name})


def _add_zone_changes(router: APIRouter, parts: Parts) -> None:
    @router.get("/api/v1/zone-changes", response_model=zone_schema.Changes, responses=errors(404, texts=_TEXTS))
    def get_changes(
        zone: Annotated[str | None, Query(description="only changes in this zone")] = None,
        limit: Annotated[int, Query(ge=1, le=1000, description="most changes")] = 50,
    ) -> Response:
        """Tracks that entered, left or loitered in a zone, newest first; a restart forgets them."""
        changes = [change for change in reversed(tuple(parts.presence.changes)) if zone in (None, change["zone"])]
        zones = parts.zone_book.current.zones
        if zone is not None and zone not in zones and not changes:  # a zone that was deleted keeps its changes
            raise HTTPException(404, no_zone(zone, zones))
        return as_json({"v": API_VERSION, "changes": changes[:limit]})


def _add_floor_plan(router: APIRouter, parts: Parts) -> None:
    @router.get(
        "/api/v1/floor-plan",
        response_class=Response,
        responses={
            200: {"description": "The picture under maps and zones.", "content": dict.fromkeys(_PICTURES, _BINARY)},
            **errors(404, texts={404: "The site file names no picture."}),
        },
    )
    def get_floor_plan() -> Response:
        """The picture of the floor plan; `GET site` has its place in the room."""
        picture = parts.floor_plan
        if picture is None:
            raise HTTPException(404, "the site file names no picture; add floor_plan")
        return Response(picture.data, media_type=picture.media_type)


@contextmanager
def _refusals() -> Iterator[None]:
    """Answer with the status of what keeps a zone from being changed."""
    try:
        yield
    except ValueError as error:
        raise unprocessable(None, str(error), "body") from error
    except LookupError as error:
        raise HTTPException(404, str(error)) from error
    except ZoneRefusedError as error:
        raise HTTPException(409, str(error)) from error
    except ZonesFileError as error:
        raise HTTPException(503, str(error)) from error
