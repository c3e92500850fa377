"""Pages of events (limit, cursors) of a server and of a hub, and answers of any kind with an ETag."""

from __future__ import annotations

from dataclasses import replace
from hashlib import sha256
from typing import Annotated, Any, Final

import orjson
from fastapi import Depends, Query, Request, Response

from livessl.server.api.encode import API_VERSION
from livessl.server.api.queries import page_cursor, unprocessable
from livessl.server.history.query import Page
from livessl.server.history.query import Query as EventQuery

UNCHANGED: Final[dict[int | str, dict[str, Any]]] = {
    304: {"description": "Nothing has changed since the answer with the ETag in `If-None-Match`."}
}
"""OpenAPI description of status 304, which `cached` returns if the client's copy is current."""


def paged(searched: Any) -> Any:
    """Return the dependency of a route that lists events.

    Parameters
    ----------
    searched : Any
        Dependency (`fastapi.Depends`) that reads the filters of the events; `limit`, `cursor` and `after` are added.
    """

    def page(
        query: EventQuery = searched,
        limit: Annotated[int, Query(ge=1, le=1000, description="most events on a page")] = 50,
        cursor: Annotated[
            str | None, Query(description="`next_cursor` of a page, unchanged; continues the list: older events")
        ] = None,
        after: Annotated[
            str | None,
            Query(description="`previous_cursor` of a page, unchanged; goes back: newer events than those of the page"),
        ] = None,
    ) -> EventQuery:
        if cursor is not None and after is not None:
            raise unprocessable("after", "after: expected either cursor or after, got both; leave one out")
        return replace(query, limit=limit, before=page_cursor(cursor), after=page_cursor(after, "after"))

    return Depends(page)


def page_answer(request: Request, page: Page) -> Response:
    """Answer with a page of events."""
    head = {
        "v": API_VERSION,
        "next_cursor": None if page.older is None else str(page.older),
        "previous_cursor": None if page.newer is None else str(page.newer),
    }
    listed = ",".join(row.body for row in page.rows).encode()
    return cached(request, orjson.dumps(head)[:-1] + b',"events":[' + listed + b"]}")


def cached(request: Request, body: bytes, media_type: str = "application/json") -> Response:
    """Answer with an ETag, or with 304 if the client has this answer already."""
    tag = f'"{sha256(body).hexdigest()[:32]}"'
    known = [each.strip().removeprefix("W/") for each in request.headers.get("if-none-match", "").split(",")]
    if tag in known or "*" in known:
        return Response(status_code=304, headers={"ETag": tag})
    return Response(body, media_type=media_type, headers={"ETag": tag})
