"""A receiver of webhooks that records what it gets, and answers as a test says."""

from __future__ import annotations

import base64
import hashlib
import hmac
import json
import ssl
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Event, Lock, Thread
from typing import Any


@dataclass(frozen=True)
class Request:
    """One request as it came."""

    path: str
    headers: dict[str, str]
    body: bytes

    @property
    def alert(self) -> dict[str, Any]:
        """The alert in it."""
        found: dict[str, Any] = json.loads(self.body)["data"]
        return found

    @property
    def key(self) -> str:
        """The key of its alert."""
        return self.headers["webhook-id"]

    def is_signed_by(self, secret: str) -> bool:
        """Check the signature by the words of the Standard Webhooks specification."""
        key = base64.b64decode(secret.removeprefix("whsec_"))
        content = b".".join((self.key.encode(), self.headers["webhook-timestamp"].encode(), self.body))
        expected = base64.b64encode(hmac.digest(key, content, hashlib.sha256)).decode()
        return f"v1,{expected}" in self.headers["webhook-signature"].split(" ")


Answer = tuple[int, dict[str, str]]


@dataclass
class Receiver:
    """Requests that came, and the answer to the next one: a status and further headers."""

    url: str
    answer: Callable[[], Answer] = lambda: (204, {})
    requests: list[Request] = field(default_factory=list)
    accepted: list[Request] = field(default_factory=list)
    lock: Lock = field(default_factory=Lock)

    def take(self, request: Request) -> Answer:
        """Record a request, and return what to answer."""
        answer = self.answer()
        with self.lock:
            self.requests.append(request)
            if 200 <= answer[0] < 300:
                self.accepted.append(request)
        return answer

    @property
    def keys(self) -> list[str]:
        """Keys of the accepted alerts, in order."""
        with self.lock:
            return [request.key for request in self.accepted]


@contextmanager
def running_receiver(port: int = 0, tls: ssl.SSLContext | None = None) -> Iterator[Receiver]:
    """Run a receiver on a port, a free one by default."""
    gone = Event()

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"]))
            headers = {name.lower(): value for name, value in self.headers.items()}
            status, more = receiver.take(Request(self.path, headers, body))
            if gone.is_set():
                return
            self.send_response(status)
            for name, value in more.items():
                self.send_header(name, value)
            self.send_header("Content-Length", "0")
            self.end_headers()

        def log_message(self, format: str, *args: Any) -> None:  # noqa: A002 - the library's word
            pass

    with ThreadingHTTPServer(("127.0.0.1", port), Handler) as server:
        server.daemon_threads = True
        if tls is not None:
            server.socket = tls.wrap_socket(server.socket, server_side=True, do_handshake_on_connect=False)
        receiver = Receiver(f"{'http' if tls is None else 'https'}://127.0.0.1:{server.server_address[1]}/hook")
        thread = Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
        thread.start()
        try:
            yield receiver
        finally:
            gone.set()
            server.shutdown()
            thread.join()
