"""REST route of the journal: alerts, ended tracks, changes of arrays and of the configuration."""

from __future__ import annotations

from typing import Annotated

import orjson
from fastapi import APIRouter, Query, Request, Response

from livessl.clock import utc_text
from livessl.schema.answers import errors
from livessl.server.api.encode import API_VERSION
from livessl.server.api.journal_schema import JournalAnswer
from livessl.server.api.paging import UNCHANGED, cached
from livessl.server.api.queries import Time, instant, page_cursor, require_no_nul
from livessl.server.history.journal import EntryKind, JournalQuery
from livessl.server.parts import Parts


def journal_routes(parts: Parts) -> APIRouter:
    """The journal."""
    router = APIRouter()

    @router.get(
        "/api/v1/history/journal",
        tags=["estimates"],
        response_model=JournalAnswer,
        responses={**UNCHANGED, **errors(503)},
    )
    def get_journal(
        request: Request,
        kind: Annotated[EntryKind | None, Query(description="only entries of this kind")] = None,
        name: Annotated[
            str | None, Query(max_length=200, description="only entries about this rule, track, array or setting")
        ] = None,
        since: Annotated[Time | None, Query(description="only entries of then or later; RFC 3339")] = None,
        until: Annotated[Time | None, Query(description="only entries of then or earlier; RFC 3339")] = None,
        text: Annotated[
            str | None,
            Query(min_length=1, max_length=200, description="only entries with this text, in any case"),
        ] = None,
        limit: Annotated[int, Query(ge=1, le=1000, description="most entries on a page")] = 50,
        cursor: Annotated[str | None, Query(description="`next_cursor` of the previous page, unchanged")] = None,
    ) -> Response:
        """Alerts, tracks, and changes of arrays and of the configuration, newest first."""
        require_no_nul(name=name, text=text)
        page = parts.store.journal(
            JournalQuery(kind, name, instant("since", since), instant("until", until), text, limit, page_cursor(cursor))
        )
        answer = {
            "v": API_VERSION,
            "entries": [
                {
                    "kind": str(entry.kind),
                    "name": entry.name,
                    "time_utc": utc_text(entry.time_ns),
                    "text": entry.text,
                    "detail": entry.detail,
                }
                for entry in page.entries
            ],
            "next_cursor": None if page.older is None else str(page.older),
        }
        return cached(request, orjson.dumps(answer))

    return router
