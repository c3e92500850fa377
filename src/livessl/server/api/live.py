"""The WebSockets of messages, power maps and live sound; disconnects a client that accepts nothing.

`server/fanout.py` decides what a slow client misses, and `queries` reads the parameters.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Coroutine, Sequence
from contextlib import ExitStack
from typing import Any, Final

from fastapi import APIRouter, WebSocket, WebSocketDisconnect

from livessl.clock import utc_text
from livessl.server.api import queries
from livessl.server.api.auth import DOOR, caller
from livessl.server.api.encode import API_VERSION, JsonObject
from livessl.server.api.hosts import OTHER_PAGE, ServerNames, other_page
from livessl.server.clips.listeners import Listener
from livessl.server.fanout import Numbered, Subscription
from livessl.server.maps import FUSED
from livessl.server.parts import Parts
from livessl.server.refusals import Refusals

LIVE: Final = "/api/v1/live"
MAP: Final = "/api/v1/map"
LISTEN: Final = "/api/v1/listen"

SEND_TIMEOUT_S: Final = 30.0
"""A client that accepts no byte for this long, in seconds, is disconnected."""

MAX_REASON: Final = 123
"""Longest reason of a closing frame, in bytes, that RFC 6455 allows."""

POLICY_VIOLATION: Final = 1008
"""Close code of RFC 6455 for a request that the server refuses."""


_log = logging.getLogger(__name__)


def live_routes(parts: Parts, names: ServerNames) -> APIRouter:
    """The WebSockets of messages, of power maps, and of sound."""
    router = APIRouter()
    _add_messages(router, parts, names)
    _add_maps(router, parts, names)
    _add_sound(router, parts, names)
    return router


def _add_messages(router: APIRouter, parts: Parts, names: ServerNames) -> None:
    fanout, book = parts.fanout, parts.zone_book

    @router.websocket(LIVE)
    async def live(
        socket: WebSocket,
        kinds: str | None = None,
        min_confidence: str = "0",
        zone: str | None = None,
        track: str | None = None,
        max_rate_hz: str | None = None,
        since_seq: str | None = None,
    ) -> None:
        await socket.accept()  # only a connected client can receive a reason
        try:
            _refuse_other_pages(socket, names, parts.refusals)
            queries.check_parameters(socket.query_params, queries.LiveParameters)
            wanted = queries.live_filter(book.current.zones, kinds, min_confidence, zone, track, max_rate_hz)
            since = queries.whole_number("since_seq", since_seq)
        except ValueError as error:
            await _refuse(socket, error)
            return
        arrays = await asyncio.to_thread(parts.array_states.describe)
        subscription = fanout.subscribe(wanted, since)
        hello = Numbered(greeting(parts, str(socket.scope["client_role"]), arrays))
        try:
            await _while_connected(socket, _send_all(socket, subscription, hello, parts))
        finally:
            fanout.unsubscribe(subscription)


def _add_maps(router: APIRouter, parts: Parts, names: ServerNames) -> None:
    @router.websocket(MAP)
    async def watch_map(socket: WebSocket, array: str = FUSED, views: str = "floor") -> None:
        await socket.accept()
        try:
            _refuse_other_pages(socket, names, parts.refusals)
            queries.check_parameters(socket.query_params, queries.MapParameters)
            chosen = queries.chosen_views(parts.site, array, views)
        except ValueError as error:
            await _refuse(socket, error)
            return
        news, loop = asyncio.Event(), asyncio.get_running_loop()

        def drawn() -> None:
            loop.call_soon_threadsafe(news.set)

        with parts.maps.watching(array, chosen, drawn):
            await _while_connected(socket, _send_pictures(socket, parts, array, chosen, news))


def _add_sound(router: APIRouter, parts: Parts, names: ServerNames) -> None:
    @router.websocket(LISTEN)
    async def listen(socket: WebSocket, array: str = "", channel: str = "1") -> None:
        await socket.accept()
        with ExitStack() as stack:
            try:
                _refuse_other_pages(socket, names, parts.refusals)
                queries.check_parameters(socket.query_params, queries.ListenParameters)
                number = queries.chosen_microphone(parts.site, array, channel)
                listener = stack.enter_context(parts.listeners.listening(array, number))
            except ValueError as error:
                await _refuse(socket, error)
                return
            who = socket.scope["client_name"]
            _log.info("%r listens to microphone %d of array %r", who, number, array)
            await _while_connected(socket, _send_sound(socket, listener))
            _log.info("%r listens no longer", who)


def greeting(parts: Parts, role: str, arrays: Sequence[JsonObject]) -> JsonObject:
    """Encode the first message of a connection."""
    return {
        "v": API_VERSION,
        "seq": parts.fanout.last_seq,
        "kind": "hello",
        "now_utc": utc_text(parts.site_time.now_ns()),
        "site": parts.site.site,
        "mode": parts.site_time.mode,
        "last_seq": parts.fanout.last_seq,
        "role": role,
        "arrays": arrays,
        "overload": parts.overload.message,
    }


def _refuse_other_pages(socket: WebSocket, names: ServerNames, refusals: Refusals) -> None:
    """Raise ValueError if a page of another server opened the WebSocket: browsers do not prevent that themselves."""
    if not names.may_open(socket.headers):
        refusals.note(DOOR, caller(socket.scope), OTHER_PAGE)
        raise ValueError(other_page(socket.headers))


async def _refuse(socket: WebSocket, error: ValueError) -> None:
    reason = str(error).encode()[:MAX_REASON].decode(errors="ignore")
    await socket.close(POLICY_VIOLATION, reason)


async def _while_connected(socket: WebSocket, work: Coroutine[Any, Any, None]) -> None:
    """Do the work until it ends or the client disconnects."""
    tasks = asyncio.create_task(work), asyncio.create_task(_until_gone(socket))
    try:
        ended, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
    for task in ended:
        task.result()  # raises the exception that ended the task, if there was one


async def _send_all(socket: WebSocket, subscription: Subscription, first: Numbered, parts: Parts) -> None:
    """Send the first message, and then those of the subscription, until the client is gone."""
    message = first
    while await _sent(socket.send_text(message.text)):
        if message.published_ns is not None:
            parts.latency.delivered(message.message, (parts.clock.monotonic_ns() - message.published_ns) / 1e9)
        if subscription.lags:  # otherwise the whole queue is sent in one turn, even to a client that has disconnected
            await asyncio.sleep(0)
        message = await subscription.next()


async def _send_pictures(
    socket: WebSocket, parts: Parts, array: str, views: tuple[str, ...], news: asyncio.Event
) -> None:
    """Send each window's pictures as they are drawn; a slow client skips windows."""
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


async def _send_sound(socket: WebSocket, listener: Listener) -> None:
    """Send a microphone's sound as it comes, until the client is gone."""
    while await _sent(socket.send_bytes(await listener.next())):
        await asyncio.sleep(0)


async def _sent(sending: Coroutine[Any, Any, None]) -> bool:
    """Await a sending; return whether the client accepted it within `SEND_TIMEOUT_S`."""
    try:
        async with asyncio.timeout(SEND_TIMEOUT_S):
            await sending
    except (TimeoutError, WebSocketDisconnect, RuntimeError):
        return False
    return True


async def _until_gone(socket: WebSocket) -> None:
    """Read and discard the client's messages, so that its disconnection is noticed."""
    while (await socket.receive())["type"] != "websocket.disconnect":
        pass
