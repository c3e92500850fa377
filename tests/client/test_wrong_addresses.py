"""Addresses that cannot work, or that send a client elsewhere: they are errors at once, and nobody gets the token."""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
from websockets.exceptions import InvalidMessage

from livessl.cli.server_answers import ask
from livessl.client import RefusedError, UnreachableError, aconnect, connect
from livessl.client.address import Address
from livessl.client.retry import LONGEST_WAIT_S, Patience
from livessl.errors import RunError, UseError
from publishing_lives import free_port

TOKEN = "secret"


class Answers(BaseHTTPRequestHandler):
    """Answers every request with the status and the headers of its server."""

    protocol_version = "HTTP/1.1"
    server: Any

    def do_GET(self) -> None:
        self.server.seen.append(dict(self.headers))
        self.send_response(self.server.status)
        for name, value in ({"Content-Length": str(len(self.server.body))} | self.server.headers).items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(self.server.body)
        self.close_connection = True

    def log_message(self, *_: Any) -> None:
        pass


@contextmanager
def answering(status: int, body: bytes = b"", **headers: str) -> Iterator[Any]:
    server: Any = ThreadingHTTPServer(("127.0.0.1", 0), Answers)
    server.status, server.body, server.seen = status, body, []
    server.headers = {name.replace("_", "-"): value for name, value in headers.items()}
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    try:
        yield server
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def url_of(server: Any, scheme: str = "http") -> str:
    return f"{scheme}://127.0.0.1:{server.server_port}"


async def _first(url: str) -> None:
    async with aconnect(url, TOKEN, give_up_s=0.0) as live:
        async for _ in live:
            return


def test_no_redirect_is_followed_with_the_token(tmp_path: Path) -> None:
    (tmp_path / "token").write_text(TOKEN)
    with answering(200) as other, answering(307, Location=f"{url_of(other)}/elsewhere") as server:
        url, said = url_of(server), f"answered 307.*a redirect to {url_of(other)}/elsewhere"
        with connect(url, TOKEN, give_up_s=0.0) as live:
            with pytest.raises(RefusedError, match=said):
                live.site()
            with pytest.raises(RefusedError, match=said):
                next(iter(live))
        with pytest.raises(RefusedError, match=said):
            asyncio.run(_first(url))
        with pytest.raises(RunError, match=said):
            ask(url, "site", tmp_path / "token")
        assert len(server.seen) == 4
        assert other.seen == []


@pytest.mark.parametrize("status", [408, 425, 429, 500, 503])
def test_busy_server_is_tried_again(status: int) -> None:
    with answering(status) as server, connect(url_of(server), give_up_s=0.0) as live:
        with pytest.raises(UnreachableError):
            next(iter(live))
        with pytest.raises(UnreachableError):
            live.site()


def test_plain_server_at_an_https_address_is_named() -> None:
    with answering(200) as server, connect(url_of(server, "https"), give_up_s=0.0) as live:
        for ask_it in (live.site, lambda: next(iter(live))):
            with pytest.raises(RefusedError, match=r"does not speak TLS .*; try http://"):
                ask_it()


@pytest.mark.parametrize(
    "url",
    ["http://", "http://:8000", "http://host:80x", "http://host:0", "http://host:99999", "http://a..b", "http://a b",
     "http://[::1", "ftp://host", "http://user:word@host", "http://host/?a=b", "http://host/#a"],
)  # fmt: skip
def test_address_that_cannot_work_is_refused_at_once(url: str) -> None:
    with pytest.raises(UseError, match=r"^url: expected an address such as"):
        connect(url)


@pytest.mark.parametrize(
    "url", ["http://host", "https://host:8443/livessl/", "http://[::1]:8000", "http://größe.example"]
)
def test_usual_addresses_are_taken(url: str) -> None:
    assert Address.of(url, None, None).url == url.rstrip("/")


def test_first_loss_is_logged_with_its_reason_and_no_further_one(caplog: pytest.LogCaptureFixture) -> None:
    patience = Patience(Address("http://host", None, None), None)
    for _ in range(3):
        patience.next_wait_s(OSError("no route to host"))
    patience.proven()
    patience.next_wait_s(OSError("cable cut"))
    assert [record.getMessage() for record in caplog.records] == [
        "http://host: no connection (no route to host); trying again",
        "http://host: no connection (cable cut); trying again",
    ]


def test_connection_that_is_closed_at_once_is_no_success(monkeypatch: pytest.MonkeyPatch) -> None:
    now_ns = [0]
    monkeypatch.setattr("livessl.clock.SystemClock.monotonic_ns", lambda _: now_ns[0])
    patience = Patience(Address("http://host", None, None), 60.0)
    waits = []
    while now_ns[0] < 59e9:  # a wait may end beyond
        patience.opened()
        waits.append(patience.next_wait_s(OSError("cable")))
        now_ns[0] += round(1e9 * waits[-1])
    now_ns[0] = max(now_ns[0], round(60e9))
    patience.opened()
    with pytest.raises(UnreachableError, match="cable"):
        patience.next_wait_s(OSError("cable"))
    patience.proven()
    assert len(waits) < 40
    assert max(waits) > 0.5 * LONGEST_WAIT_S
    patience.opened()
    now_ns[0] += round(1e9 * LONGEST_WAIT_S)  # it has lived
    assert patience.next_wait_s(OSError("cable")) < 0.5


def test_token_is_not_logged(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.DEBUG), answering(403) as server:
        with connect(url_of(server), TOKEN, give_up_s=0.0) as live, pytest.raises(RefusedError):
            next(iter(live))
        with pytest.raises(RefusedError):
            asyncio.run(_first(url_of(server)))
    assert len(server.seen) == 2
    assert all(seen["Authorization"] == f"Bearer {TOKEN}" for seen in server.seen)
    assert TOKEN not in caplog.text


def test_nobody_at_the_address_is_no_refusal() -> None:
    with connect(f"http://127.0.0.1:{free_port()}", give_up_s=0.0) as live, pytest.raises(UnreachableError):
        next(iter(live))


@pytest.mark.parametrize(
    ("error", "is_hinted"),
    [
        (TimeoutError("timed out while waiting for handshake response"), True),
        (InvalidMessage("did not receive a valid HTTP response"), True),
        (TimeoutError(110, "Connection timed out"), False),
        (ConnectionRefusedError(111, "Connection refused"), False),
    ],
)
def test_what_speaks_no_http_may_be_the_port_of_the_nodes(
    error: Exception, is_hinted: bool, caplog: pytest.LogCaptureFixture
) -> None:
    Patience(Address("http://host", None, None), None).next_wait_s(error)
    assert ("not that of the nodes" in caplog.text) is is_hinted


@pytest.mark.parametrize("status", [404, 405, 501])
def test_another_program_at_the_address_is_no_livessl_server(status: int) -> None:
    with answering(status) as other, pytest.raises(RunError, match="is no livessl server, so check the address"):
        ask(f"http://127.0.0.1:{other.server_address[1]}", "findings", None)


@pytest.mark.parametrize(
    ("body", "headers", "said"),
    [
        (b'{"detail": "no such event"}', {}, ": no such event"),
        (b'{"detail": [{"msg": "too small"}, {"msg": "too large"}]}', {}, ": too small; too large"),
        (b'{"detail": "' + 900 * b"x" + b'"}', {}, ": " + 900 * "x"),
        *((body, {}, "") for body in (
            b"<html>", b"\xff\xfe", b"[]", b'"detail"', 200_000 * b"[", 9000 * b"9",
            b'{"detail": 3}', b'{"detail": ["x"]}', b'{"detail": {"msg": "x"}}', b'{"detail": [{"text": "x"}]}',
        )),
        (b"cut", {"Content_Length": "1000"}, ""),
        (b"5\r\ncut", {"Transfer_Encoding": "chunked"}, ""),
    ],
)  # fmt: skip
def test_whatever_a_foreign_server_answers_is_one_error(body: bytes, headers: dict[str, str], said: str) -> None:
    with answering(404, body, **headers) as other:
        with pytest.raises(RunError, match=f"the server answered 404 Not Found{said or '; what answers there is no'}"):
            ask(url_of(other), "site", None)
        with pytest.raises(RefusedError, match=f"the server answered 404{said}") as refused:
            Address.of(url_of(other), None, None).get("site")
    assert len(str(refused.value)) < 1200
