"""A hub as one process with its API, page and intake; several hubs may share one PostgreSQL database."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final

from fastapi import Depends, FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import FileResponse, JSONResponse
from fastapi.staticfiles import StaticFiles

from livessl import __version__
from livessl.clock import Clock
from livessl.federation.archive import Archive
from livessl.federation.config import Hub
from livessl.federation.halls import Halls
from livessl.federation.intake import Intake
from livessl.federation.metrics import metrics_route
from livessl.federation.routes import hub_routes
from livessl.garbage import collect_as_usual
from livessl.schema.answers import errors
from livessl.server.api.app import STATIC
from livessl.server.api.auth import Access, Gate
from livessl.server.api.hosts import HostCheck, ServerNames
from livessl.server.api.proxy import BehindProxy
from livessl.server.api.queries import refuse_request, refuse_unknown_parameters
from livessl.server.event_retention import delete_old_events
from livessl.server.forwarding.stream import ended
from livessl.server.history.database import StoreError
from livessl.server.http import certificate_of, listen, url_of, uvicorn_server
from livessl.server.refusals import Refusals
from livessl.service_manager import ServiceManager

PAGE: Final = Path(__file__).parent / "page"
"""Files of the page."""

SIGN_S: Final = 0.2
"""Interval, in seconds, at which the event loop gives a sign of life."""

_CSP: Final = "default-src 'self'; img-src 'self' data:; frame-ancestors 'self'"

_DESCRIPTION: Final = """\
Results of many sites: where each is, how it is, and the events, tracks and alerts of all of them. Objects are those of
a site's own API, with the name of the site.
"""


def create_hub_app(hub: Hub, archive: Archive, intake: Intake, access: Access, refusals: Refusals) -> FastAPI:
    """The application of a hub, open to everyone or to clients that have a token."""
    http = hub.settings.http
    app = FastAPI(
        title="livessl hub",
        version=__version__,
        description=_DESCRIPTION,
        docs_url=None,
        redoc_url=None,
        openapi_url="/api/v1/openapi.json",
        responses=errors(401, 403) if access.wanted else {},
    )
    app.add_middleware(Gate, access=access, refusals=refusals)
    app.add_middleware(HostCheck, names=ServerNames(http), refusals=refusals)
    app.middleware("http")(_with_safe_headers)
    app.add_middleware(BehindProxy, http=http)
    strict = [Depends(refuse_unknown_parameters)]
    app.include_router(hub_routes(hub.settings.hub, archive, intake), dependencies=strict, responses=errors(422))
    app.include_router(metrics_route(archive, intake))
    app.add_exception_handler(StoreError, _without_database)
    app.add_exception_handler(RequestValidationError, refuse_request)

    @app.get("/", include_in_schema=False)
    async def page() -> FileResponse:
        return FileResponse(PAGE / "index.html")

    app.mount("/static/site", StaticFiles(directory=STATIC), name="site")
    app.mount("/static", StaticFiles(directory=PAGE), name="static")
    return app


async def _without_database(_request: Request, error: Exception) -> Response:
    return JSONResponse({"detail": str(error)}, 503)


async def _with_safe_headers(request: Request, proceed: Callable[[Request], Any]) -> Response:
    response: Response = await proceed(request)
    response.headers["Content-Security-Policy"] = _CSP
    response.headers["X-Content-Type-Options"] = "nosniff"
    response.headers.setdefault("Cache-Control", "no-cache")
    return response


class HubServer:
    """A hub bound to its address, not yet running.

    Parameters
    ----------
    hub : Hub
    clock : Clock
    service : ServiceManager or None
        Gets reports; None without a service manager.

    Raises
    ------
    BindError
        If the address is taken.
    ConfigError
        If tokens, certificates, or files of `nats` cannot be used, or nats-py is not installed.
    StoreError
        If an SQLite file cannot be used; PostgreSQL may come later.
    """

    def __init__(self, hub: Hub, clock: Clock, service: ServiceManager | None = None) -> None:
        http = hub.settings.http
        access = Access(None if http.tokens is None else hub.file(http.tokens))
        certificate = certificate_of(http, hub.file, "http")
        self._access, self._clock, self._hub = access, clock, hub
        self._service = ServiceManager(clock) if service is None else service
        with ExitStack() as undo:  # closes what is open if a later step fails
            self._listener = listen(http.host, http.port)
            undo.callback(self._listener.close)
            self.archive = Archive(hub.database, clock, Halls(hub.settings.halls))
            """The database, which other hubs may share."""
            undo.callback(self.archive.close)
            self.intake = Intake(hub, self.archive, clock)
            """The part that takes messages in."""
            undo.pop_all()
        app = create_hub_app(hub, self.archive, self.intake, access, Refusals(clock))
        self.uvicorn = uvicorn_server(app, certificate)
        """The HTTP server."""
        self.url = url_of(self._listener, tls=certificate is not None)
        """The address of API and page."""

    def run(self) -> None:
        """Serve until SIGINT, SIGTERM or `stop`; raise the error that has ended the intake, if one has."""
        collect_as_usual()  # or each answer about many sites has it look through all that was loaded
        try:
            asyncio.run(self._serve())
        finally:
            self.archive.close()
            self._listener.close()

    def stop(self) -> None:
        """End `run`; from any thread."""
        self.uvicorn.should_exit = True

    async def _serve(self) -> None:
        receiving = asyncio.create_task(self.intake.run())
        receiving.add_done_callback(lambda _: self.stop())
        retention = delete_old_events(self.archive, self._clock, self._hub.settings.retention_days)
        others = retention, self._access.reload_tokens(), self._give_signs_of_life()
        tasks = [receiving, *(asyncio.create_task(work) for work in others)]
        try:
            await self.uvicorn.serve(sockets=[self._listener])
        finally:
            self._service.stopping()
            failure = receiving.exception() if receiving.done() and not receiving.cancelled() else None
            await ended(*tasks)
        if failure is not None:
            raise failure

    async def _give_signs_of_life(self) -> None:
        """Report to the service manager, while the event loop turns."""
        while True:
            if self.uvicorn.started:
                self._service.turn(self._in_words)
            await asyncio.sleep(SIGN_S)

    def _in_words(self) -> str:
        if self.intake.problem is not None:
            return f"{self.intake.problem}; serving on {self.url}"
        work = "takes the messages of the sites in" if self.intake.has_turn else "another hub takes messages in"
        return f"{work}; serving on {self.url}"
