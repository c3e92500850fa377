"""HTTP below the routes: listening socket, TLS certificate and ciphers, most connections of clients, longest head."""

from __future__ import annotations

import asyncio
import logging
import socket
import ssl
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final, NamedTuple

import uvicorn
from fastapi import FastAPI
from starlette.types import Receive, Scope, Send
from uvicorn._types import ASGISendEvent
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.exceptions import InvalidState

from livessl.errors import ConfigError, Fault
from livessl.server.connections import LimitedListener, TimedRequests
from livessl.server.receiver import BindError, address_cure
from livessl.site.addresses import in_url
from livessl.site.server_models import HttpConfig

SHUTDOWN_S: Final = 2
"""Time, in seconds, that open connections get to end."""

MAX_CONNECTIONS: Final = 900
"""Most connections at once: more than any site has clients, and fewer than the 1024 files that most systems allow a
process to open, of which the nodes' connections and the database need some."""

MAX_INCOMING_BYTES: Final = 4096
"""Longest WebSocket message that a client may send; the server ignores them all."""

MAX_HEAD_BYTES: Final = 16_384
"""Longest head of a request: its first line and all of its headers."""

MAX_UNREAD_BYTES: Final = 131_072
"""Send buffer of a connection, for a client that does not read; the system's own choice would be megabytes for each."""

CIPHERS: Final = "ECDHE+AESGCM:ECDHE+CHACHA20"
"""Ciphers for TLS 1.2: forward secret and authenticated, as all of TLS 1.3 are."""

_log = logging.getLogger(__name__)


class _WebSocket(WebSocketsSansIOProtocol):
    """uvicorn's WebSocket without two of its faults.

    It can be shut down while its client is closing it, and it does not log an error when a handshake is refused with
    an answer of ours.
    """

    async def send(self, message: ASGISendEvent) -> None:
        await super().send(message)
        if self.initial_response is not None and self.close_sent:
            self.handshake_complete = True

    def shutdown(self) -> None:
        try:
            super().shutdown()
        except InvalidState:
            self.transport.close()


class _Ended:
    """An application whose open connections end without an error when the server stops before their clients do."""

    def __init__(self, app: FastAPI) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await self._app(scope, receive, send)
        except asyncio.CancelledError:  # `SHUTDOWN_S` is over; uvicorn would log a traceback
            if scope["type"] == "lifespan":
                raise
            _log.info("a connection of %s was still open at the end", scope.get("client"))


def listen(host: str, port: int) -> socket.socket:
    """Return a socket that listens for HTTP.

    Raises
    ------
    BindError
        If the address is taken, or not one of this machine.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with ExitStack() as undo:
        try:
            listener = undo.enter_context(LimitedListener(family, MAX_CONNECTIONS))
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, MAX_UNREAD_BYTES)  # accepted sockets inherit it
            # they inherit this, too; asyncio sets it only if the protocol was named. Without it, an answer of two
            # packets waits 40 ms for the client's delayed acknowledgement
            listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            address: tuple[Any, ...] = (host, port)
            if family == socket.AF_INET6:
                listener.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 0)  # :: is every IPv4 address as well
                address = socket.getaddrinfo(host, port, family)[0][4]  # has the number of a link-local interface
            listener.bind(address)
            listener.listen(128)
        except OSError as error:
            cure = address_cure(error.errno)
            where = f"{in_url(host)}:{port}"
            raise BindError(f"server.http: cannot listen on {where}: {error.strerror}; {cure}") from error
        undo.pop_all()
    return listener


def url_of(listener: socket.socket, *, tls: bool) -> str:
    """Return the URL of a listening socket."""
    name = listener.getsockname()
    host, port = socket.getnameinfo(name, socket.NI_NUMERICHOST | socket.NI_NUMERICSERV)  # with its interface
    return f"{'https' if tls else 'http'}://{in_url(host)}:{port}"


class Certificate(NamedTuple):
    """Files of a certificate and of its private key."""

    certificate: Path
    private_key: Path


def certificate_of(http: HttpConfig, file: Callable[[str], Path], where: str = "server.http") -> Certificate | None:
    """Return the certificate of an HTTP server, None if it serves without TLS.

    The certificate is loaded here because uvicorn would find a fault only when it is too late.

    Parameters
    ----------
    http : HttpConfig
    file : callable
        Returns the path of a file that the configuration names.
    where : str
        Place of the configuration, for errors.

    Raises
    ------
    ConfigError
        If certificate and private key cannot be read or do not match.
    """
    if http.certificate is None or http.private_key is None:
        return None
    certificate, key = file(http.certificate), file(http.private_key)
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(certificate, key, password="")
    except (OSError, ssl.SSLError) as error:
        reason = getattr(error, "reason", None) or error.strerror
        what = f"cannot use {certificate} with {key}: {reason}; name a PEM certificate and its key without a passphrase"
        raise ConfigError([Fault(f"{where}.certificate", what)]) from error
    return Certificate(certificate, key)


def uvicorn_server(app: FastAPI, certificate: Certificate | None) -> uvicorn.Server:
    """Return the server of an application, with limits on what clients may take of it."""
    return uvicorn.Server(
        uvicorn.Config(
            _Ended(app),
            ws=_WebSocket,  # sends many small messages faster than uvicorn's other implementations
            log_level="warning",
            log_config=None,  # its messages go where those of all others go, in the same form
            http=TimedRequests,  # h11 is the implementation that limits the head of a request
            loop="asyncio",  # another loop would not accept connections by `LimitedListener.accept`
            h11_max_incomplete_event_size=MAX_HEAD_BYTES,
            ssl_certfile=None if certificate is None else certificate.certificate,
            ssl_ciphers=CIPHERS,
            ssl_keyfile=None if certificate is None else certificate.private_key,
            limit_concurrency=MAX_CONNECTIONS + 1,  # it counts the asking connection, which the listener has admitted
            ws_max_size=MAX_INCOMING_BYTES,
            proxy_headers=False,  # the application reads them, by the site's rules
            ws_per_message_deflate=False,  # small messages hardly shrink, and each would cost time and memory
            timeout_graceful_shutdown=SHUTDOWN_S,
        )
    )
