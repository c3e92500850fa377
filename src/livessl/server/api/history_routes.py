"""HTTP routes of the history of events, of its exports, and of its heat map."""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec
from typing import Annotated, Any, Final, Literal

import numpy as np
import orjson
from fastapi import APIRouter, Depends, HTTPException, Query, Request, Response
from fastapi.responses import StreamingResponse

from livessl.clock import utc_text
from livessl.core.types import Status
from livessl.schema import answers
from livessl.schema.answers import errors
from livessl.server.api.encode import API_VERSION
from livessl.server.api.paging import UNCHANGED, cached, page_answer, paged
from livessl.server.api.png import map_png
from livessl.server.api.queries import Time, array_names, instant, require_no_nul, unprocessable
from livessl.server.history.export import FORMATS
from livessl.server.history.heat_map import Cells
from livessl.server.parts import Parts
from livessl.server.store import Query as EventQuery
from livessl.server.zones.zone_map import no_zone
from livessl.site.build.grid import search_grid

MAX_CELLS: Final = 250_000
"""Most cells of a heat map: those of a hall of 50 m x 50 m at 0.1 m."""

_BINARY: Final = {"schema": {"type": "string", "format": "binary"}}
_NAMES: Final = errors(404, 503, texts={404: "There is no zone or array of that name."})


def history_routes(parts: Parts) -> APIRouter:
    """Return the routes of events, exports and heat map."""
    router = APIRouter()
    searched = Depends(_filters(parts))
    _add_events(router, parts, searched)
    _add_exports(router, parts, searched)
    _add_heat_map(router, parts, searched)
    return router


def _filters(parts: Parts) -> Callable[..., EventQuery]:
    """Return the dependency with the query parameters that all searches share."""
    site = parts.site

    def filters(
        since: Annotated[Time | None, Query(description="only events that began then or later; RFC 3339")] = None,
        until: Annotated[Time | None, Query(description="only events that began then or earlier; RFC 3339")] = None,
        zone: Annotated[str | None, Query(description="only events inside this zone")] = None,
        status: Annotated[Status | None, Query(description="only events of this status")] = None,
        min_confidence: Annotated[
            float | None, Query(ge=0, le=1, description="only events of at least this confidence")
        ] = None,
        min_level_dbfs: Annotated[
            float | None, Query(ge=-200, le=20, description="only events of at least this level in dB full scale")
        ] = None,
        array: Annotated[
            str | None, Query(description="only events that this array detected or contributed to")
        ] = None,
        text: Annotated[
            str | None,
            Query(
                min_length=1,
                max_length=200,
                description="only events with this text in id, status, reason, method, zones or arrays, ignoring case",
            ),
        ] = None,
        excluded: Annotated[
            bool | None,
            Query(description="`true`: only events in excluded zones; `false`: only events outside of them"),
        ] = None,
    ) -> EventQuery:
        zones = parts.zone_book.current.zones
        if zone is not None and zone not in zones:
            raise HTTPException(404, no_zone(zone, zones))
        known = [*dict.fromkeys([*array_names(site), *(spec.name for spec in site.specs)])]
        if array is not None and array not in known:
            raise HTTPException(404, f"no array {array!r}; there are {', '.join(known)}")
        require_no_nul(text=text)
        return EventQuery(
            since_ns=instant("since", since),
            until_ns=instant("until", until),
            zone=zone,
            status=None if status is None else str(status),
            min_confidence=min_confidence,
            min_level_dbfs=min_level_dbfs,
            array=array,
            text=text,
            excluded=excluded,
        )

    return filters


def _add_events(router: APIRouter, parts: Parts, searched: Any) -> None:
    store, listed = parts.store, paged(searched)

    @router.get(
        "/api/v1/events", tags=["estimates"], response_model=answers.EventPage, responses={**_NAMES, **UNCHANGED}
    )
    def get_events(request: Request, query: EventQuery = listed) -> Response:
        """Events, newest first, early ones included; the final result of an event replaces the early one."""
        return page_answer(request, store.page(query))

    @router.get(
        "/api/v1/events/{event_id}",
        tags=["estimates"],
        response_model=answers.OneEvent,
        responses={**errors(404, 503, texts={404: "There is no event of that id."}), **UNCHANGED},
    )
    def get_event(event_id: str, request: Request) -> Response:
        """One event."""
        event = store.get(event_id)
        if event is None:
            raise HTTPException(404, f"no event {event_id!r}")
        return cached(request, orjson.dumps({"v": API_VERSION, **event}))


def _add_exports(router: APIRouter, parts: Parts, searched: Any) -> None:
    def add(form: str) -> None:
        media_type, encode = FORMATS[form]

        def export(request: Request, query: EventQuery = searched) -> Response:
            if form == "parquet" and find_spec("pyarrow") is None:
                raise HTTPException(501, "Parquet needs the package pyarrow; pip install 'livessl[export]'")
            name = f"{parts.site.site}-events.{form}".encode("ascii", "replace").decode().replace('"', "_")
            headers = {"Content-Disposition": f'attachment; filename="{name}"'}
            if "head_only" in request.scope:  # a HEAD request gets no body, so the stream is not begun
                return Response(media_type=media_type, headers=headers)
            return StreamingResponse(encode(parts.store.scan(query)), media_type=media_type, headers=headers)

        router.get(
            f"/api/v1/events.{form}",
            tags=["estimates"],
            name=f"export_{form}",
            description="All events that match the filters, newest first, as a stream.",
            response_class=Response,
            responses={
                200: {"description": "The events.", "content": {media_type: _BINARY}},
                **_NAMES,
                **(errors(501, texts={501: "pyarrow is not installed."}) if form == "parquet" else {}),
            },
        )(export)

    for form in FORMATS:
        add(form)


def _add_heat_map(router: APIRouter, parts: Parts, searched: Any) -> None:
    (x0, x1), (y0, y1), _ = search_grid(parts.site).bounds_m
    low_mm, high_mm = (round(1000 * x0), round(1000 * y0)), (round(1000 * x1), round(1000 * y1))

    @router.get(
        "/api/v1/history/heat-map",
        tags=["estimates"],
        response_model=answers.HeatMap,
        responses={200: {"content": {"image/png": _BINARY}}, **_NAMES, **UNCHANGED},
    )
    def get_heat_map(
        request: Request,
        query: EventQuery = searched,
        spacing_m: Annotated[float, Query(ge=0.01, le=100, description="edge of a cell in metres")] = 0.25,
        format: Annotated[Literal["json", "png"], Query(description="`json`: numbers; `png`: a picture")] = "json",  # noqa: A002
    ) -> Response:
        """Number of events in each cell of the floor plan; with format=png a picture, y upwards."""
        cells = Cells(low_mm, high_mm, round(1000 * spacing_m))
        if cells.shape[0] * cells.shape[1] > MAX_CELLS:
            count = f"{cells.shape[0]} x {cells.shape[1]} = {cells.shape[0] * cells.shape[1]}"
            what = f"spacing_m: expected at most {MAX_CELLS} cells, got {count}; raise spacing_m"
            raise unprocessable("spacing_m", what)
        found = parts.store.heat_map(query, cells)
        if format == "png":
            return cached(request, map_png(found.counts.T.astype(np.float32)), "image/png")
        answer = {
            "v": API_VERSION,
            "since_utc": None if query.since_ns is None else utc_text(query.since_ns),
            "until_utc": None if query.until_ns is None else utc_text(query.until_ns),
            "bounds_m": [[low / 1000, high / 1000] for low, high in zip(low_mm, high_mm, strict=True)],
            "spacing_m": cells.spacing_mm / 1000,
            "shape": cells.shape,
            "counts": found.counts,
            "events": int(found.counts.sum()),
            "elsewhere": found.elsewhere,
        }
        return cached(request, orjson.dumps(answer, option=orjson.OPT_SERIALIZE_NUMPY))
