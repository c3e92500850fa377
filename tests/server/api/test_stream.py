"""Server-sent events: what the WebSocket sends, resumption by the browser's header, filters, and limits of clients."""

from __future__ import annotations

import json
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest

from livessl.server import connections
from livessl.server.api import stream
from livessl.server.app import Server
from livessl.server.fanout import BACKLOG
from livessl.site.tokens import add_token, revoke_token
from messages import event_message, update_message
from scene_server import live
from small_site import HANG_S, running_server, site_of, wait_until


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    with running_server(site_of()) as server:
        yield server


class Events:
    """Events of a stream, as a browser's `EventSource` would read them."""

    def __init__(self, response: httpx.Response) -> None:
        self._lines = response.iter_lines()
        self.last_id: str | None = None
        self.comments = 0

    def __iter__(self) -> Iterator[dict[str, Any]]:
        data: list[str] = []
        for line in self._lines:
            name, _, value = line.partition(":")
            value = value.removeprefix(" ")
            if name == "" and line:
                self.comments += 1
            elif name == "id":
                self.last_id = value
            elif name == "data":
                data.append(value)
            elif not line and data:
                yield json.loads("\n".join(data))
                data = []

    def next(self) -> dict[str, Any]:
        return next(iter(self))


@contextmanager
def streaming(server: Server, query: str = "", **headers: str) -> Iterator[Events]:
    """Open the stream; the greeting has been sent then."""
    url = f"{server.url}/api/v1/stream{query}"
    with httpx.stream("GET", url, headers=headers, timeout=HANG_S) as response:
        assert response.status_code == 200
        assert response.headers["Content-Type"].partition(";")[0] == "text/event-stream"
        yield Events(response)


def publish(server: Server, *messages: dict[str, Any]) -> None:
    assert server.loop is not None
    for message in messages:
        server.loop.call_soon_threadsafe(server.parts.fanout.publish, message)


def test_stream_carries_what_the_websocket_carries(server: Server) -> None:
    with streaming(server, "?kinds=event") as events, live(server, "?kinds=event") as socket:
        greeting, other = events.next(), json.loads(socket.recv(timeout=HANG_S))
        assert greeting["kind"] == other["kind"] == "hello"
        publish(server, event_message(id="a"), update_message(), event_message(id="b"))
        for _ in range(2):
            assert events.next() == json.loads(socket.recv(timeout=HANG_S))
        assert events.last_id == str(server.parts.fanout.last_seq)


def test_browser_that_returns_gets_what_it_missed(server: Server) -> None:
    with streaming(server, "?kinds=event") as events:
        assert events.next()["kind"] == "hello"
        begin = events.last_id
        publish(server, event_message(id="a"))
        assert events.next()["id"] == "a"
        seen = events.last_id
    publish(server, event_message(id="b"))
    assert begin is not None
    assert seen is not None
    with streaming(server, "?kinds=event&since_seq=5", **{"Last-Event-ID": seen}) as events:
        assert events.next()["kind"] == "hello"
        assert events.last_id is None  # older messages follow: it must not count as the last one
        assert events.next()["id"] == "b"
    with streaming(server, f"?kinds=event&since_seq={begin}") as events:
        assert [events.next().get("id") for _ in range(3)] == [None, "a", "b"]
    with streaming(server, **{"Last-Event-ID": "5"}) as events:
        assert [events.next()["kind"] for _ in range(2)] == ["hello", "gap"]


def test_silence_is_broken_by_heartbeats_that_carry_the_number(server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stream, "HEARTBEAT_S", 0.02)
    with streaming(server, "?kinds=alert") as events:
        begin = events.next()["last_seq"]
        for k in range(3):
            publish(server, update_message(event_id=str(k)))
        lines = iter(events._lines)
        wait_until(lambda: (next(lines), server.parts.fanout.last_seq >= begin + 3)[1], "the updates")
        number = 0
        while number < begin + 3:
            name, _, value = next(lines).partition(": ")
            assert name in ("id", ":", "")  # never an empty message
            number = int(value) if name == "id" else number


@pytest.mark.parametrize(
    ("query", "where", "reason"),
    [
        ("kinds=events", "kinds", "kinds: expected some of"),
        ("zone=hall", "zone", "zone: no zone 'hall'; zones are door"),
        ("min_confidence=2", "min_confidence", "min_confidence: expected a number from 0 to 1, got '2'"),
        ("track=first", "track", "track: expected the number of a track, got 'first'"),
        ("max_rate_hz=0", "max_rate_hz", "max_rate_hz: expected a number above 0, at most 1000, got '0'"),
        ("max_rate_hz=nan", "max_rate_hz", "max_rate_hz: expected"),
        ("since_seq=x", "since_seq", "since_seq: expected the seq of a message, got 'x'"),
        ("kind=event", "kind", "unknown parameter 'kind'; did you mean 'kinds'?"),
    ],
)
def test_wrong_filter_is_refused_with_a_reason(server: Server, query: str, where: str, reason: str) -> None:
    response = httpx.get(f"{server.url}/api/v1/stream?{query}")
    assert response.status_code == 422
    [fault] = response.json()["detail"]
    assert fault["loc"] == ["query", where]
    assert fault["msg"].startswith(reason)


def test_wrong_number_to_resume_after_is_refused_as_the_header_that_it_came_in(server: Server) -> None:
    response = httpx.get(f"{server.url}/api/v1/stream", headers={"Last-Event-ID": "x"})
    [fault] = response.json()["detail"]
    assert fault["loc"] == ["header", "last-event-id"]


def test_client_that_does_not_read_costs_a_bounded_queue_and_is_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connections, "STALLED_S", 0.1)
    with running_server(site_of()) as server:
        host, port = server.url.removeprefix("http://").split(":")
        with socket.create_connection((host, int(port))) as client:
            client.sendall(f"GET /api/v1/stream HTTP/1.1\r\nHost: {host}\r\n\r\n".encode())
            wait_until(lambda: server.parts.fanout.clients == 1, "its place")
            [subscription] = server.parts.fanout._subscriptions
            text = "x" * 50_000
            sent = 0

            def is_cut() -> bool:
                nonlocal sent
                publish(server, event_message(id=f"{sent}{text}"))
                sent += 1
                assert len(subscription._waiting) <= BACKLOG
                return server.parts.fanout.clients == 0

            wait_until(is_cut, "the end of its place")


def test_stream_ends_at_once_when_its_token_is_revoked(tmp_path: Path) -> None:
    path = tmp_path / "tokens.yaml"
    token = add_token(path, "wall", "viewer")
    add_token(path, "other", "viewer")
    with running_server(site_of({"server.http.tokens": "tokens.yaml"}, tmp_path)) as server:
        assert httpx.get(f"{server.url}/api/v1/stream").status_code == 401
        with streaming(server, "?kinds=event", Authorization=f"Bearer {token}") as events:
            assert events.next()["role"] == "viewer"
            revoke_token(path, "wall")
            assert list(events) == []
        assert httpx.get(f"{server.url}/api/v1/stream", headers={"Authorization": f"Bearer {token}"}).status_code == 401


def test_stream_ends_when_the_server_stops() -> None:
    with running_server(site_of()) as server, streaming(server, "?kinds=event") as events:
        assert events.next()["kind"] == "hello"
        server.stop()
        assert list(events) == []  # and no error: the answer is complete


def test_head_of_the_stream_has_no_body(server: Server) -> None:
    response = httpx.head(f"{server.url}/api/v1/stream")
    assert (response.status_code, response.content) == (200, b"")
