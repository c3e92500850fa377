"""The live messages as server-sent events (`GET stream`), with heartbeat and resumption by Last-Event-ID."""

from __future__ import annotations

import asyncio
from typing import Annotated, Any, Final

from fastapi import APIRouter, Header, Query, Request, Response
from pydantic import WithJsonSchema
from starlette.types import Receive, Scope, Send

from livessl.server.api import queries
from livessl.server.api.live import greeting
from livessl.server.fanout import Numbered, Subscription
from livessl.server.parts import Parts

STREAM: Final = "/api/v1/stream"

LAST_EVENT_ID: Final = "last-event-id"
"""Header in which a browser names the last message that it received."""

HEARTBEAT_S: Final = 10.0
"""Longest silence in seconds. A heartbeat lets proxies and clients distinguish a quiet site from a dead connection.
It also gives the latest number to a client whose filter admits little."""

RETRY_MS: Final = 1000
"""Wait, in milliseconds, after which a browser connects again."""

_HEADERS: Final = {"Content-Type": "text/event-stream", "X-Accel-Buffering": "no"}
"""The second one has nginx pass messages on at once."""

_FORM: Final = """\
Messages of the live WebSocket, one a `data:` line. `id:` is the number to resume after: a browser sends it as
`Last-Event-ID`. The first message is `hello`; after at most 10 s without a message there is a comment.
"""


def _schema(name: str) -> WithJsonSchema:
    """Schema of a query parameter that is read as text, so that both transports give the same reasons."""
    described = queries.LiveParameters.model_json_schema()["properties"][name]
    return WithJsonSchema({key: value for key, value in described.items() if key not in ("default", "title")})


def _query(name: str) -> Any:
    return Query(description=queries.LiveParameters.model_fields[name].description)


def stream_route(parts: Parts) -> APIRouter:
    """`GET /api/v1/stream`."""
    router = APIRouter()

    @router.get(
        STREAM,
        tags=["estimates"],
        response_class=Response,
        responses={200: {"description": _FORM, "content": {"text/event-stream": {"schema": {"type": "string"}}}}},
    )
    async def get_stream(
        request: Request,
        kinds: Annotated[str | None, _schema("kinds"), _query("kinds")] = None,
        min_confidence: Annotated[str, _schema("min_confidence"), _query("min_confidence")] = "0",
        zone: Annotated[str | None, _schema("zone"), _query("zone")] = None,
        track: Annotated[str | None, _schema("track"), _query("track")] = None,
        max_rate_hz: Annotated[str | None, _schema("max_rate_hz"), _query("max_rate_hz")] = None,
        since_seq: Annotated[str | None, _schema("since_seq"), _query("since_seq")] = None,
        last_event_id: Annotated[
            str | None, _schema("since_seq"), Header(description="Like `since_seq`, and stronger.")
        ] = None,
    ) -> Response:
        """Live messages as server-sent events, for as long as the client stays."""
        try:
            zones = parts.zone_book.current.zones
            wanted = queries.live_filter(zones, kinds, min_confidence, zone, track, max_rate_hz)
            since = queries.whole_number("since_seq", since_seq)
            since = since if not last_event_id else queries.whole_number(LAST_EVENT_ID, last_event_id)
        except ValueError as error:
            name = str(error).partition(":")[0]
            raise queries.unprocessable(name, str(error), "header" if name == LAST_EVENT_ID else "query") from error
        if "head_only" in request.scope:
            return Response(headers=_HEADERS)
        arrays = await asyncio.to_thread(parts.array_states.describe)
        subscription = parts.fanout.subscribe(wanted, since)
        hello = greeting(parts, str(request.scope["client_role"]), arrays)
        return _Stream(parts, subscription, Numbered(hello), resumes=since is not None)

    return router


class _Stream(Response):
    """An answer that ends when the client leaves or the server stops.

    Parameters
    ----------
    parts : Parts
    subscription : Subscription
        The stream ends it.
    hello : Numbered
        The first message.
    resumes : bool
        Whether older messages follow the first one, so that it must not count as the last one received.
    """

    def __init__(self, parts: Parts, subscription: Subscription, hello: Numbered, *, resumes: bool) -> None:
        super().__init__(headers=_HEADERS)
        del self.headers["content-length"]
        self._parts = parts
        self._subscription = subscription
        self._hello = hello
        self._resumes = resumes

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:  # noqa: ARG002 - ASGI's arguments
        """Send messages until the client is gone."""
        fanout = self._parts.fanout
        try:
            await send({"type": "http.response.start", "status": 200, "headers": self.raw_headers})
            tasks = [
                asyncio.create_task(self._send_all(send)),
                asyncio.create_task(_until_gone(receive)),
                asyncio.create_task(fanout.ended.wait()),
            ]
            try:
                ended, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            finally:
                for task in tasks:
                    task.cancel()
                await asyncio.gather(*tasks, return_exceptions=True)
            for task in ended:
                task.result()  # raises the exception that ended the task, if there was one
            await send({"type": "http.response.body", "body": b""})
        finally:
            fanout.unsubscribe(self._subscription)

    async def _send_all(self, send: Send) -> None:
        parts, subscription = self._parts, self._subscription
        number = None if self._resumes else parts.fanout.last_seq
        await _send(send, f"retry: {RETRY_MS}\n{_block(self._hello.text, number)}")
        while True:
            try:
                async with asyncio.timeout(HEARTBEAT_S):
                    message = await subscription.next()
            except TimeoutError:  # nothing waits, so that everything published so far has been sent
                await _send(send, f":\nid: {parts.fanout.last_seq}\n\n")
                continue
            await _send(send, _block(message.text, message.message.get("seq")))
            if message.published_ns is not None:
                parts.latency.delivered(message.message, (parts.clock.monotonic_ns() - message.published_ns) / 1e9)
            if subscription.lags:  # otherwise the whole queue is sent in one turn, even to a client that has left
                await asyncio.sleep(0)


def _block(text: str, number: int | None) -> str:
    """Return an event of the stream; JSON has no line breaks."""
    return f"data: {text}\n\n" if number is None else f"id: {number}\ndata: {text}\n\n"


async def _send(send: Send, text: str) -> None:
    """Send a part of the answer; wait while the client does not read. See `TimedRequests`, which ends that."""
    await send({"type": "http.response.body", "body": text.encode(), "more_body": True})


async def _until_gone(receive: Receive) -> None:
    while (await receive())["type"] != "http.disconnect":
        pass
