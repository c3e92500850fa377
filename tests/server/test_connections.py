"""Clients that only hold connections: how many there may be, and how long a request may take, over real sockets."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator
from contextlib import ExitStack

import httpx
import pytest
from websockets.sync.client import connect

from livessl.server import connections, http
from livessl.server.app import Server
from small_site import HANG_S, running_server, site_of, wait_until

MOST = 6
SHORT_S = 0.3
"""Time for a whole request, in the tests of it."""

GET = b"GET /api/v1/health HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"


def opened(server: Server) -> socket.socket:
    port = int(server.url.rpartition(":")[2])
    return socket.create_connection(("127.0.0.1", port), timeout=HANG_S)


def is_closed(client: socket.socket) -> bool:
    """Read to the end of what the server sends; True if it closes the connection, fail if it does not in time."""
    try:
        while client.recv(65536):
            pass
    except ConnectionResetError:
        pass
    return True


def health(server: Server) -> int:
    try:
        return httpx.get(f"{server.url}/api/v1/health", timeout=HANG_S).status_code
    except httpx.TransportError:
        return 0


@pytest.fixture
def limited(monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    monkeypatch.setattr(http, "MAX_CONNECTIONS", MOST)
    monkeypatch.setattr(connections, "REQUEST_S", 10.0 * HANG_S)
    with running_server(site_of()) as server:
        wait_until(lambda: health(server) == 200, "the server")
        wait_until(lambda: not server.uvicorn.server_state.connections, "the end of that request's connection")
        yield server


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    monkeypatch.setattr(connections, "REQUEST_S", SHORT_S)
    with running_server(site_of()) as server:
        wait_until(lambda: health(server) == 200, "the server")
        yield server


def test_the_last_connection_is_answered(limited: Server) -> None:
    with ExitStack() as stack:
        for _ in range(MOST - 1):
            stack.enter_context(opened(limited))
        wait_until(lambda: len(limited.uvicorn.server_state.connections) == MOST - 1, "the other connections")
        assert health(limited) == 200


@pytest.mark.parametrize("sent", [b"", b"GET / HTTP/1.1\r\nX-A: "])
def test_idle_connections_are_limited_and_make_room_when_they_close(
    limited: Server, sent: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    with ExitStack() as stack:
        idle = [stack.enter_context(opened(limited)) for _ in range(MOST)]
        for client in idle:
            client.sendall(sent)
        for _ in range(3):
            assert is_closed(stack.enter_context(opened(limited)))
        assert health(limited) == 0
        assert sum("further ones are closed" in record.getMessage() for record in caplog.records) == 1
        for client in idle:
            client.setblocking(False)
            with pytest.raises(BlockingIOError):
                client.recv(1)  # those that were there stay
    wait_until(lambda: health(limited) == 200, "room for a request")
    assert sum("connections were closed" in record.getMessage() for record in caplog.records) == 1


def drip(client: socket.socket) -> None:
    client.settimeout(SHORT_S / 10.0)
    try:
        for byte in b"GET / HTTP/1.1\r\nX-A: " + b"x" * 10_000:
            client.sendall(bytes([byte]))
            try:
                if not client.recv(1):
                    break
            except TimeoutError:
                continue
    except (BrokenPipeError, ConnectionResetError):
        pass
    client.settimeout(HANG_S)


def answered_then_partial(client: socket.socket) -> None:
    client.sendall(GET)
    assert client.recv(65536).startswith(b"HTTP/1.1 200")
    client.sendall(GET[:-2])


SLOW: dict[str, Callable[[socket.socket], None]] = {
    "nothing": lambda _: None,
    "half a head": lambda client: client.sendall(GET[:20]),
    "a byte now and then": drip,
    "half a second request": answered_then_partial,
    "half a body": lambda client: client.sendall(
        b"PUT /api/v1/arrays/north HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 9\r\n\r\n{"
    ),
}


@pytest.mark.parametrize("how", SLOW)
def test_a_connection_that_sends_no_whole_request_is_closed(impatient: Server, how: str) -> None:
    with opened(impatient) as client:
        SLOW[how](client)
        assert is_closed(client)
    assert health(impatient) == 200


def test_a_subscriber_is_not_closed_for_sending_nothing(impatient: Server) -> None:
    with connect(f"ws{impatient.url[4:]}/api/v1/live", open_timeout=HANG_S) as subscriber:
        for _ in range(2):
            with opened(impatient) as idle:
                assert is_closed(idle)  # so that more than the time for a request has passed
        subscriber.ping().wait(HANG_S)
        assert subscriber.close_code is None


def test_a_connection_may_send_requests_one_after_another(impatient: Server) -> None:
    with httpx.Client(timeout=HANG_S) as client:
        for _ in range(3):
            assert client.get(f"{impatient.url}/api/v1/health").status_code == 200
            with opened(impatient) as idle:
                assert is_closed(idle)


def test_small_answers_do_not_wait_for_acknowledgements() -> None:
    """Connections send at once (TCP_NODELAY): an answer of two packets would wait 40 ms for the client."""
    with http.listen("127.0.0.1", 0) as listener, socket.create_connection(listener.getsockname()):
        accepted, _ = listener.accept()
        with accepted:
            assert accepted.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY) != 0
