"""REST route `GET event-log`: events in the order in which they were stored, for clients that resume."""

from __future__ import annotations

from typing import Annotated

import orjson
from fastapi import APIRouter, HTTPException, Query, Response

from livessl.schema import answers
from livessl.schema.answers import errors
from livessl.server.api.encode import API_VERSION
from livessl.server.api.queries import unprocessable
from livessl.server.history.log import LogPosition
from livessl.server.parts import Parts
from livessl.server.store import Query as EventQuery
from livessl.server.zones.zone_map import no_zone


def event_log_route(parts: Parts) -> APIRouter:
    """`GET /api/v1/event-log`."""
    router = APIRouter()

    @router.get(
        "/api/v1/event-log",
        tags=["estimates"],
        response_model=answers.EventLog,
        responses=errors(404, 503, texts={404: "There is no zone of that name."}),
    )
    def get_event_log(
        after: Annotated[
            str | None,
            Query(description="`position` of an answer, unchanged: the events stored since then. None if absent"),
        ] = None,
        limit: Annotated[int, Query(ge=1, le=1000, description="most events of an answer")] = 200,
        zone: Annotated[str | None, Query(description="only events inside this zone")] = None,
        min_confidence: Annotated[
            float | None, Query(ge=0, le=1, description="only events of at least this confidence")
        ] = None,
    ) -> Response:
        """Events in the order in which they were stored: what a client missed while it was away.

        An event that was stored again, because sound of it arrived late, is there once: as it is now.
        """
        zones = parts.zone_book.current.zones
        if zone is not None and zone not in zones:
            raise HTTPException(404, no_zone(zone, zones))
        try:
            place = None if after is None else LogPosition.parse(after)
        except ValueError as error:
            raise unprocessable("after", f"after: {error}") from error
        unsaved = parts.event_log.unsaved  # before the page, which may lack what is stored in between
        page = parts.store.log(EventQuery(zone=zone, min_confidence=min_confidence, limit=limit), place)
        head = {
            "v": API_VERSION,
            "position": str(page.position),
            "more": page.has_more,
            "unsaved": unsaved,
            "complete": page.is_complete,
        }
        listed = ",".join(row.body for row in page.rows).encode()
        return Response(orjson.dumps(head)[:-1] + b',"events":[' + listed + b"]}", media_type="application/json")

    return router
