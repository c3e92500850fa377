"""Puts the HTTP side together: REST under /api/v1, WebSockets, /metrics, dashboard, and the order of middleware."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from fastapi import Depends, FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import FileResponse, JSONResponse
from fastapi.staticfiles import StaticFiles
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from livessl import __version__
from livessl.schema.answers import errors
from livessl.server.api import documentation, routes
from livessl.server.api.alert_routes import alert_routes, dead_letter_routes
from livessl.server.api.asyncapi import asyncapi_route
from livessl.server.api.auth import HEALTH, Access, Gate
from livessl.server.api.clip_routes import clip_routes
from livessl.server.api.encode import JsonObject
from livessl.server.api.event_log_route import event_log_route
from livessl.server.api.headers import SafeHeaders, other_origins
from livessl.server.api.history_routes import history_routes
from livessl.server.api.hosts import HostCheck, ServerNames
from livessl.server.api.journal_routes import journal_routes
from livessl.server.api.link_routes import link_routes
from livessl.server.api.live import live_routes
from livessl.server.api.log_route import log_route
from livessl.server.api.metrics import metrics_route
from livessl.server.api.point_routes import point_route
from livessl.server.api.proposal_routes import proposal_routes
from livessl.server.api.proxy import BehindProxy
from livessl.server.api.queries import refuse_request, refuse_unknown_parameters
from livessl.server.api.reload_routes import reload_route
from livessl.server.api.relocate_routes import relocate_route
from livessl.server.api.set_up_routes import set_up_routes
from livessl.server.api.stream import stream_route
from livessl.server.api.zone_routes import zone_routes
from livessl.server.parts import Parts
from livessl.server.store import StoreError

STATIC: Final = Path(__file__).parents[1] / "static"
"""The dashboard's files."""


_DESCRIPTION: Final = """\
Where in the room a sound happened: events, live estimates, tracks, arrays and power maps.

`HEAD` works wherever `GET` does. The WebSockets `/api/v1/live` and `/api/v1/map` are described in
`/api/v1/asyncapi.json`. Two answers are plain text and can come from any path: 400 for a request to a host name that is
not the server's own, where it uses no tokens or has a list of names, and 503 when too many connections are open.
"""


def create_app(parts: Parts, access: Access) -> FastAPI:
    """The application around a running server's parts, open to everyone or to clients that have a token."""
    site, names = parts.site, ServerNames(parts.site.server.http)
    app = FastAPI(
        title="livessl",
        version=__version__,
        description=_DESCRIPTION,
        docs_url=None,  # FastAPI's page would load scripts from other servers
        redoc_url=None,
        openapi_url="/api/v1/openapi.json",
        responses=errors(401, 403) if access.wanted else {},
    )
    _add_middleware(app, parts, access, names)
    strict = [Depends(refuse_unknown_parameters)]
    for router in (
        routes.state_routes(parts),
        routes.switch_route(parts),
        routes.access_route(parts, access),
        history_routes(parts),
        event_log_route(parts),
        stream_route(parts),
        journal_routes(parts),
        routes.map_route(parts),
        alert_routes(parts),
        dead_letter_routes(parts),
        zone_routes(parts),
        set_up_routes(parts),
        proposal_routes(parts),
        clip_routes(parts),
        relocate_route(parts),
        link_routes(access),
        point_route(parts),
        reload_route(parts),
        log_route(parts),
    ):
        app.include_router(router, dependencies=strict, responses=errors(422))
    app.include_router(metrics_route(parts))
    app.include_router(live_routes(parts, names))
    app.include_router(asyncapi_route(site, access), dependencies=strict)
    documentation.add_documentation(app)

    app.add_exception_handler(StoreError, _without_database)
    app.add_exception_handler(RequestValidationError, refuse_request)
    _add_pages(app)
    if access.wanted:
        _describe_tokens(app.openapi())
    return app


def _add_middleware(app: FastAPI, parts: Parts, access: Access, names: ServerNames) -> None:
    """Add what every request passes before it gets to a route; what is added last comes first."""
    http = parts.site.server.http
    app.add_middleware(_HeadAsGet)
    app.add_middleware(Gate, access=access, refusals=parts.refusals)
    if http.allowed_origins:
        app.add_middleware(other_origins, http=http, shown=tuple(routes.MAP_HEADERS))
    app.add_middleware(HostCheck, names=names, refusals=parts.refusals)
    app.add_middleware(SafeHeaders, http=http, page=STATIC / "index.html")
    app.add_middleware(BehindProxy, http=http)


def _add_pages(app: FastAPI) -> None:
    """Add the pages of the dashboard and their files."""

    @app.get("/", include_in_schema=False)
    async def dashboard() -> FileResponse:
        return FileResponse(STATIC / "index.html")

    @app.get("/history", include_in_schema=False)
    async def history_page() -> FileResponse:
        return FileResponse(STATIC / "history.html")

    @app.get("/embed", include_in_schema=False)
    async def embedded_map() -> FileResponse:
        return FileResponse(STATIC / "embed.html")

    app.mount("/static", StaticFiles(directory=STATIC), name="static")


async def _without_database(_request: Request, error: Exception) -> Response:
    return JSONResponse({"detail": str(error)}, 503)


def _describe_tokens(described: JsonObject) -> None:
    """Add the security scheme to the OpenAPI description: the gate stands before the application that writes it."""
    described.setdefault("components", {})["securitySchemes"] = {"token": {"type": "http", "scheme": "bearer"}}
    described["security"] = [{"token": []}]
    described["paths"][HEALTH]["get"]["security"] = [{}, {"token": []}]


class _HeadAsGet:
    """Answers HEAD as GET: the same status and headers, without the body."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one connection of the ASGI interface."""
        if scope["type"] != "http" or scope["method"] != "HEAD":
            await self._app(scope, receive, send)
            return

        async def send_head(message: Message) -> None:
            if message["type"] == "http.response.body":
                message = {**message, "body": b""}
            await send(message)

        await self._app({**scope, "method": "GET", "head_only": True}, receive, send_head)
