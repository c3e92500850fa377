"""The HTTP face: REST under /api/v1, the live WebSocket, /metrics, and the dashboard. It computes nothing."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Coroutine, Iterator
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import numpy as np
from fastapi import FastAPI, HTTPException, Query, Request, Response, WebSocket, WebSocketDisconnect
from fastapi.responses import FileResponse, PlainTextResponse
from fastapi.staticfiles import StaticFiles
from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector
from pydantic import BaseModel, ConfigDict
from starlette.middleware.trustedhost import TrustedHostMiddleware

from livessl import __version__
from livessl.clock import utc_ns, utc_text
from livessl.core.types import FRAME_S
from livessl.server.api.auth import HEALTH, Access, Gate
from livessl.server.api.encode import API_VERSION, JsonObject
from livessl.server.api.png import map_png
from livessl.server.fanout import Filter, Numbered, Subscription
from livessl.server.maps import FUSED, VIEWS, bounds_of_view_m, projection
from livessl.server.parts import Parts
from livessl.server.store import Cursor, StoreError
from livessl.server.store import Query as EventQuery
from livessl.site.addresses import is_loopback
from livessl.site.build.grid import search_grid
from livessl.site.models import Site

STATIC: Final = Path(__file__).parents[1] / "static"

SEND_TIMEOUT_S: Final = 30.0
"""A client that takes no byte for so long is gone."""

MAX_REASON: Final = 120
"""A closing frame's reason holds 123 bytes (RFC 6455)."""

KINDS: Final = frozenset({"update", "event", "track", "arrays"})
_REFUSALS: Final[dict[int | str, dict[str, Any]]] = {
    401: {"description": "no token, or one that is not known"},
    403: {"description": "a token of a lesser role"},
}

_log = logging.getLogger(__name__)

_CSP: Final = "default-src 'self'; img-src 'self' data:; connect-src 'self' ws: wss:; frame-ancestors 'self'"


def create_app(parts: Parts, access: Access) -> FastAPI:
    """The application around a running server's parts, open to anyone or to those who have a token."""
    site = parts.site
    app = FastAPI(
        title="livessl",
        version=__version__,
        description="Where in the room a sound happened: events, live estimates, tracks, arrays and power maps.",
        docs_url=None,  # its page would load scripts from elsewhere
        redoc_url=None,
        openapi_url="/api/v1/openapi.json",
        responses=_REFUSALS if access.wanted else {},
    )

    app.add_middleware(Gate, access=access, refusals=parts.refusals)
    if not access.wanted and is_loopback(site.server.http.host):
        # else a page from anywhere could have its own name point here, and read as if it were ours
        app.add_middleware(
            TrustedHostMiddleware,
            allowed_hosts=["127.0.0.1", "localhost", "[::1]", site.server.http.host],
        )

    @app.middleware("http")
    async def _headers(request: Request, proceed: Callable[[Request], Any]) -> Response:
        response: Response = await proceed(request)
        response.headers["Content-Security-Policy"] = _CSP
        response.headers["X-Content-Type-Options"] = "nosniff"
        response.headers.setdefault("Cache-Control", "no-cache")
        return response

    _add_state_routes(app, parts)
    _add_switch_route(app, parts)
    _add_access_route(app, parts, access)
    _add_event_routes(app, parts)
    _add_map_route(app, parts)
    _add_live_route(app, parts)

    @app.get("/", include_in_schema=False)
    async def dashboard() -> FileResponse:
        return FileResponse(STATIC / "index.html")

    app.mount("/static", StaticFiles(directory=STATIC), name="static")
    if access.wanted:
        _tell_of_tokens(app.openapi())
    return app


def _tell_of_tokens(described: JsonObject) -> None:
    """Into the OpenAPI, which knows of no gate before the application."""
    described.setdefault("components", {})["securitySchemes"] = {"token": {"type": "http", "scheme": "bearer"}}
    described["security"] = [{"token": []}]
    described["paths"][HEALTH]["get"]["security"] = [{}, {"token": []}]


def describe_site(site: Site, mode: str) -> JsonObject:
    """Geometry and settings, for clients that draw."""
    grid = search_grid(site)
    return {
        "v": API_VERSION,
        "site": site.site,
        "version": __version__,
        "mode": mode,
        "room": {"size_m": list(site.room.size_m)},
        "grid": {"bounds_m": [list(b) for b in grid.bounds_m], "spacing_m": grid.spacing_m, "shape": list(grid.shape)},
        "speed_of_sound_m_s": site.c_m_s,
        "band_hz": list(site.band_hz),
        "method": site.fusion.method,
        "frame_s": FRAME_S,
        "activity": {"threshold": site.activity.threshold, "floor_factor": site.activity.floor_factor},
        "arrays": {
            spec.name: {
                "position_m": spec.centre_m.round(4).tolist(),
                "microphones_m": spec.microphones_m.round(4).tolist(),
                "band_hz": list(spec.band_hz),
            }
            for spec in site.processed
        },
        "joint": {name: list(members) for name, members in site.joint.items()},
        "zones": {name: {"bounds_m": [list(b) for b in zone.bounds_m]} for name, zone in site.zones.items()},
        "privacy": _privacy(site),
    }


def _privacy(site: Site) -> JsonObject:
    return {"mode": site.privacy, "retention_days": site.store.retention_days}


def _add_state_routes(app: FastAPI, parts: Parts) -> None:
    site, event_log = parts.site, parts.event_log

    @app.get("/api/v1/site", tags=["state"])
    def get_site() -> JsonObject:
        """Room, grid, arrays and settings."""
        return describe_site(site, parts.site_time.mode)

    @app.get("/api/v1/arrays", tags=["state"])
    def get_arrays() -> JsonObject:
        """State, age of the last message, levels, drift and counters of every array."""
        now_utc = utc_text(parts.site_time.now_ns())
        return {"v": API_VERSION, "now_utc": now_utc, "arrays": parts.array_states.describe()}

    @app.get("/api/v1/tracks", tags=["estimates"])
    def get_tracks() -> JsonObject:
        """The tracks that live now."""
        return {"v": API_VERSION, "tracks": parts.tracks.all()}

    @app.get("/api/v1/health", tags=["state"], responses={503: {"description": "the server has failed"}})
    def get_health(request: Request, response: Response) -> JsonObject:
        """Whether the server works (503 where it does not) and how the arrays are; without a token the status only."""
        arrays = parts.array_states.describe()
        reasons = [f"{a['name']}: {a['reason']}" for a in arrays if a["reason"] is not None]
        states = {a["state"] for a in arrays if a["enabled"]}  # what is disabled is so on purpose
        status = "ok" if states == {"healthy"} else "starting" if states <= {"starting", "healthy"} else "degraded"
        if event_log.unkept:
            reasons.append(f"server.events_db: {event_log.unkept} events were not kept; free space or release the file")
            status = "degraded" if status == "ok" else status
        if event_log.unsaved:
            reasons.append(f"server.events_db: {event_log.unsaved} events wait for it; free space or release the file")
            status = "degraded" if status == "ok" else status
        if parts.failure is not None:
            status, reasons = "failed", [f"fusion: {parts.failure!r}", *reasons]
            response.status_code = 503
        if request.scope["client_role"] is None:
            return {"v": API_VERSION, "status": status}
        return {
            "v": API_VERSION,
            "status": status,
            "version": __version__,
            "mode": parts.site_time.mode,
            "uptime_s": round(parts.site_time.uptime_s(), 3),
            "arrays": {a["name"]: a["state"] for a in arrays},
            "reasons": reasons,
            "privacy": _privacy(site),
            "secured": {
                "nodes": site.keys is not None,
                "tokens": site.server.http.tokens is not None,
                "tls": site.server.http.certificate is not None,
            },
            "refused": {door: parts.refusals.count(door) for door in ("nodes", "http")},
        }

    registry = CollectorRegistry()
    registry.register(_Metrics(parts))
    registry.register(parts.latency.histogram)

    @app.get("/metrics", tags=["state"], response_class=PlainTextResponse)
    def get_metrics() -> PlainTextResponse:
        """Metrics in the text format of Prometheus."""
        return PlainTextResponse(generate_latest(registry), media_type="text/plain; version=0.0.4; charset=utf-8")


class Switch(BaseModel):
    """Whether an array's sound is to be used."""

    model_config = ConfigDict(extra="forbid", strict=True)

    enabled: bool


def _add_switch_route(app: FastAPI, parts: Parts) -> None:
    site = parts.site

    @app.put(
        "/api/v1/arrays/{name}/enabled",
        tags=["state"],
        responses={
            400: {"description": "the body is no text"},
            404: {"description": "no such array"},
            503: {"description": "the event database takes nothing"},
        },
    )
    def put_enabled(name: str, switch: Switch, request: Request) -> JsonObject:
        """Disable an array that does harm, or enable it again; for operators."""
        if name not in _names(site):
            raise HTTPException(404, f"no array {name!r}; there are {', '.join(_names(site))}")
        try:
            parts.array_states.enable(name, switch.enabled)
        except StoreError as error:
            raise HTTPException(503, str(error)) from error
        done = "enabled" if switch.enabled else "disabled"
        _log.info("%r has %s array %r", request.scope["client_name"], done, name)
        return {"v": API_VERSION, "name": name, "enabled": switch.enabled}


def _add_access_route(app: FastAPI, parts: Parts, access: Access) -> None:
    @app.get("/api/v1/access", tags=["state"])
    def get_access() -> JsonObject:
        """Who may ask, which nodes are enrolled, and who was refused; for admins."""
        return {
            "v": API_VERSION,
            "clients": [{"name": c.name, "role": str(c.role)} for c in access.clients],
            "nodes": list(parts.receiver.enrolled),
            "refused": [
                {"door": r.door, "who": r.who, "reason": r.reason, "count": r.count, "last_utc": utc_text(r.last_ns)}
                for r in parts.refusals.known()
            ],
        }


def _add_event_routes(app: FastAPI, parts: Parts) -> None:
    site, store = parts.site, parts.store

    @app.get("/api/v1/events", tags=["estimates"], responses={404: {"description": "no such zone"}})
    def get_events(
        since: Annotated[str | None, Query(description="RFC 3339; events that began then or later")] = None,
        until: Annotated[str | None, Query(description="RFC 3339; events that began then or earlier")] = None,
        zone: Annotated[str | None, Query(description="only events inside this zone")] = None,
        min_confidence: Annotated[float | None, Query(ge=0, le=1)] = None,
        limit: Annotated[int, Query(ge=1, le=1000)] = 50,
        cursor: Annotated[str | None, Query(description="next_cursor of the page before")] = None,
    ) -> JsonObject:
        """Finished events, newest first."""
        if zone is not None and zone not in site.zones:
            raise HTTPException(404, f"no zone {zone!r}; zones are {', '.join(site.zones) or 'none'}")
        query = EventQuery(
            _instant("since", since), _instant("until", until), zone, min_confidence, limit, _cursor(cursor)
        )
        events, following = store.find(query)
        return {"v": API_VERSION, "events": events, "next_cursor": None if following is None else str(following)}

    @app.get("/api/v1/events/{event_id}", tags=["estimates"], responses={404: {"description": "no such event"}})
    def get_event(event_id: str) -> JsonObject:
        """One event."""
        event = store.get(event_id)
        if event is None:
            raise HTTPException(404, f"no event {event_id!r}")
        return {"v": API_VERSION, **event}


def _unprocessable(name: str, what: str) -> HTTPException:
    """A query that cannot be understood, told as FastAPI tells its own."""
    return HTTPException(422, [{"type": "value_error", "loc": ["query", name], "msg": what}])


def _instant(name: str, text: str | None) -> int | None:
    if text is None:
        return None
    try:
        time_ns = utc_ns(text.replace(" ", "+"))  # an unescaped + in a query arrives as a blank
    except (ValueError, OverflowError) as error:
        raise _unprocessable(name, f"{name}: {error}") from error
    return max(-(2**63), min(2**63 - 1, time_ns))


def _cursor(text: str | None) -> Cursor | None:
    try:
        return None if text is None else Cursor.parse(text)
    except ValueError as error:
        raise _unprocessable("cursor", f"cursor: {error}") from error


def _names(site: Site) -> list[str]:
    return [spec.name for spec in site.processed]


def _mapped(site: Site) -> list[str]:
    """Names that a map may be asked of."""
    return [FUSED, *_names(site)]


def _add_map_route(app: FastAPI, parts: Parts) -> None:
    site = parts.site

    @app.get(
        "/api/v1/map",
        tags=["estimates"],
        responses={
            200: {"content": {"image/png": {}, "application/octet-stream": {}}},
            204: {"description": "no window has been localized yet"},
            404: {"description": "no such array, or it has no part in the newest map"},
        },
    )
    def get_map(
        array: Annotated[str, Query(description="'fused' or an array's name")] = FUSED,
        view: Annotated[Literal["floor", "side", "front", "volume"], Query()] = "floor",
        format: Annotated[Literal["png", "float32"], Query()] = "png",  # noqa: A002 - the API's word
    ) -> Response:
        """The newest power map: a projection (largest value along the axis left out) or the whole volume."""
        if array not in _mapped(site):
            raise HTTPException(404, f"no array {array!r}; there are {', '.join(_mapped(site))}")
        if view == "volume" and format == "png":
            raise _unprocessable("view", "view=volume has no picture; use format=float32")
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
        if format == "png":
            return Response(map_png(image), media_type="image/png", headers=headers)
        body = np.ascontiguousarray(image, dtype="<f4").tobytes()
        return Response(body, media_type="application/octet-stream", headers=headers)


def _add_live_route(app: FastAPI, parts: Parts) -> None:
    site, fanout = parts.site, parts.fanout

    @app.websocket("/api/v1/live")
    async def live(
        socket: WebSocket,
        kinds: str | None = None,
        min_confidence: str = "0",
        zone: str | None = None,
        since_seq: str | None = None,
    ) -> None:
        await socket.accept()  # a reason can only be told to a client that is connected
        try:
            _refuse_strangers(socket)
            wanted = _filter(site, kinds, min_confidence, zone)
            since = _number("since_seq", since_seq)
        except ValueError as error:
            await socket.close(1008, str(error)[:MAX_REASON])
            return
        arrays = await asyncio.to_thread(parts.array_states.describe)
        subscription = fanout.subscribe(wanted, since)
        hello = {
            "v": API_VERSION,
            "seq": fanout.last_seq,
            "kind": "hello",
            "now_utc": utc_text(parts.site_time.now_ns()),
            "site": site.site,
            "mode": parts.site_time.mode,
            "last_seq": fanout.last_seq,
            "role": str(socket.scope["client_role"]),
            "arrays": arrays,
        }
        try:
            await _while_connected(socket, _send_all(socket, subscription, Numbered(hello), parts))
        finally:
            fanout.unsubscribe(subscription)

    @app.websocket("/api/v1/map")
    async def watch_map(socket: WebSocket, array: str = FUSED, views: str = "floor") -> None:
        await socket.accept()
        try:
            _refuse_strangers(socket)
            chosen = _chosen_views(site, array, views)
        except ValueError as error:
            await socket.close(1008, str(error)[:MAX_REASON])
            return
        news, loop = asyncio.Event(), asyncio.get_running_loop()

        def drawn() -> None:
            loop.call_soon_threadsafe(news.set)

        with parts.maps.watching(array, chosen, drawn):
            await _while_connected(socket, _send_pictures(socket, parts, array, chosen, news))


def _chosen_views(site: Site, array: str, views: str) -> tuple[str, ...]:
    if array not in _mapped(site):
        raise ValueError(f"array: none of that name; there are {', '.join(_mapped(site))}")
    chosen = tuple(dict.fromkeys(view.strip() for view in views.split(",")))
    if not set(chosen) <= VIEWS.keys():
        raise ValueError(f"views: expected some of {', '.join(VIEWS)}")
    return chosen


async def _while_connected(socket: WebSocket, work: Coroutine[Any, Any, None]) -> None:
    """Do the work until it ends or the client is gone."""
    tasks = asyncio.create_task(work), asyncio.create_task(_until_gone(socket))
    try:
        ended, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
    for task in ended:
        task.result()  # raises what was wrong, if anything


def _refuse_strangers(socket: WebSocket) -> None:
    """A page from elsewhere may not listen: browsers keep it from reading our answers, but not our WebSocket."""
    origin = socket.headers.get("origin")
    if origin is not None and origin.partition("://")[2] != socket.headers.get("host"):
        raise ValueError("origin: pages of other servers may not listen")


def _number(name: str, text: str | None) -> int | None:
    if text is not None and not (text.isascii() and text.isdigit() and len(text) < 20):
        raise ValueError(f"{name}: expected the seq of a message")
    return None if text is None else int(text)


def _filter(site: Site, kinds: str | None, min_confidence: str, zone: str | None) -> Filter:
    chosen = None if kinds is None else frozenset(kind.strip() for kind in kinds.split(","))
    if chosen is not None and not chosen <= KINDS:
        raise ValueError(f"kinds: expected some of {', '.join(sorted(KINDS))}")
    try:
        least = float(min_confidence)
    except ValueError:
        least = float("nan")
    if not 0.0 <= least <= 1.0:
        raise ValueError("min_confidence: expected a number from 0 to 1")
    if zone is not None and zone not in site.zones:
        raise ValueError(f"zone: none of that name; zones are {', '.join(site.zones) or 'none'}")
    return Filter(chosen, least, zone)


async def _send_all(socket: WebSocket, subscription: Subscription, first: Numbered, parts: Parts) -> None:
    message = first
    while await _sent(socket.send_text(message.text)):
        if message.published_ns is not None:
            parts.latency.delivered(message.message, (parts.clock.monotonic_ns() - message.published_ns) / 1e9)
        if subscription.lags:  # else all of it goes out in one turn, even to a client that has left meanwhile
            await asyncio.sleep(0)
        message = await subscription.next()


async def _send_pictures(
    socket: WebSocket, parts: Parts, array: str, views: tuple[str, ...], news: asyncio.Event
) -> None:
    """Send each window's pictures as they are drawn; what a slow client has no time for is left out."""
    shown = None
    while True:
        news.clear()
        drawn = parts.maps.drawn
        pictures = [] if drawn is None else [drawn.pictures.get((array, view)) for view in views]
        if drawn is not None and drawn.window is not shown and all(pictures):
            shown = drawn.window
            for picture in pictures:
                if picture is not None and not await _sent(socket.send_bytes(picture.packed(parts.site_time.now_ns()))):
                    return
        await news.wait()


async def _sent(sending: Coroutine[Any, Any, None]) -> bool:
    """Whether a client took what it was sent, in time."""
    try:
        async with asyncio.timeout(SEND_TIMEOUT_S):
            await sending
    except (TimeoutError, WebSocketDisconnect, RuntimeError):
        return False
    return True


async def _until_gone(socket: WebSocket) -> None:
    """Read and ignore what a client says, so that its leaving is noticed."""
    while (await socket.receive())["type"] != "websocket.disconnect":
        pass


class _Metrics(Collector):
    """Everything countable, read when it is asked for."""

    def __init__(self, parts: Parts) -> None:
        self._parts = parts

    def collect(self) -> Iterator[Metric]:
        parts = self._parts
        yield GaugeMetricFamily("livessl_uptime_seconds", "Time since start.", parts.site_time.uptime_s())
        yield GaugeMetricFamily("livessl_websocket_clients", "Subscribers.", parts.fanout.clients)
        yield GaugeMetricFamily("livessl_map_watchers", "Subscribers to maps.", parts.maps.watchers)
        yield CounterMetricFamily("livessl_maps_drawn", "Drawings of maps.", parts.maps.drawings)
        yield CounterMetricFamily(
            "livessl_messages_superseded", "Messages that slow subscribers never got.", parts.fanout.superseded
        )
        yield GaugeMetricFamily(
            "livessl_updates_left_out",
            "Windows since the server began this live run that gave way to newer ones.",
            parts.engine.updates_left_out,
        )
        events = parts.event_log
        yield CounterMetricFamily("livessl_events", "Events since start.", events.published)
        yield CounterMetricFamily("livessl_events_unkept", "Events that the store did not take.", events.unkept)
        yield GaugeMetricFamily("livessl_events_unsaved", "Events that wait for the store.", events.unsaved)
        yield GaugeMetricFamily("livessl_events_stored", "Events in the store.", parts.store.count())
        yield CounterMetricFamily("livessl_sink_failures", "Events that a sink did not take.", parts.sinks.failures)
        yield CounterMetricFamily("livessl_messages_refused", "Malformed messages.", parts.receiver.ingest.malformed)
        refused = CounterMetricFamily("livessl_refused", "Peers and requests turned away.", labels=["door", "reason"])
        for (door, reason), count in parts.refusals.counts().items():
            refused.add_metric([door, reason], count)
        yield refused
        up = GaugeMetricFamily("livessl_array_up", "1 where the array is healthy.", labels=["array"])
        age = GaugeMetricFamily("livessl_array_age_seconds", "Since the last message.", labels=["array"])
        enabled = GaugeMetricFamily("livessl_array_enabled", "1 unless an operator has disabled it.", labels=["array"])
        level = GaugeMetricFamily("livessl_array_level_dbfs", "In-band level.", labels=["array"])
        agreement = GaugeMetricFamily(
            "livessl_array_sounds",
            "Of the last ten sounds that three arrays or more heard, in how many it agreed with the others, or not.",
            labels=["array", "verdict"],
        )
        off = GaugeMetricFamily(
            "livessl_array_clock_offset_seconds",
            "How far ahead of the reference its clock is, by the sounds heard.",
            labels=["array", "reference"],
        )
        unsure = GaugeMetricFamily(
            "livessl_array_clock_offset_std_seconds", "Standard deviation of that.", labels=["array", "reference"]
        )
        counts = CounterMetricFamily("livessl_array", "Counts of an array.", labels=["array", "what"])
        for array in parts.array_states.describe():
            up.add_metric([array["name"]], float(array["state"] == "healthy"))
            enabled.add_metric([array["name"]], float(array["enabled"]))
            if array["age_s"] is not None:
                age.add_metric([array["name"]], array["age_s"])
            if array["level_dbfs"] is not None:
                level.add_metric([array["name"]], array["level_dbfs"])
            for verdict, count in array["agreement"].items():
                agreement.add_metric([array["name"], verdict], count)
            if (clock := array["clock_offset"]) is not None:
                off.add_metric([array["name"], clock["reference"]], clock["offset_s"])
                unsure.add_metric([array["name"], clock["reference"]], clock["std_s"])
            for what, count in array["counters"].items():
                counts.add_metric([array["name"], what], count)
        yield from (up, enabled, age, level, agreement, off, unsure, counts)
