"""HTTP below the routes: the listening socket, TLS, and the limits that protect the server from its clients."""

from __future__ import annotations

import socket
import ssl
from pathlib import Path
from typing import Final

import uvicorn
from fastapi import FastAPI
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.exceptions import InvalidState

from livessl.errors import ConfigError, Fault
from livessl.server.receiver import BindError, address_cure
from livessl.site.models import Site
from livessl.site.server_models import HttpConfig

SHUTDOWN_S: Final = 2
"""Time, in seconds, that open connections get to end."""

MAX_CONNECTIONS: Final = 1000
"""Most connections at once: more than any site has clients, and fewer than the 1024 files that most systems allow a
process to open."""

MAX_INCOMING_BYTES: Final = 4096
"""Longest WebSocket message that a client may send; the server ignores them all."""

MAX_HEAD_BYTES: Final = 16_384
"""Longest head of a request: its first line and all of its headers."""

MAX_UNREAD_BYTES: Final = 131_072
"""Send buffer of a connection, for a client that does not read; the system's own choice would be megabytes for each."""

CIPHERS: Final = "ECDHE+AESGCM:ECDHE+CHACHA20"
"""Ciphers for TLS 1.2: forward secret and authenticated, as all of TLS 1.3 are."""


class _WebSocket(WebSocketsSansIOProtocol):
    """A WebSocket that can be shut down while its client is closing it; uvicorn's own would stop the whole shutdown."""

    def shutdown(self) -> None:
        try:
            super().shutdown()
        except InvalidState:
            self.transport.close()


def listen(host: str, port: int) -> socket.socket:
    """Return a socket that listens for HTTP.

    Raises
    ------
    BindError
        If the address is taken, or not one of this machine.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, MAX_UNREAD_BYTES)  # inherited by the accepted sockets
    try:
        listener.bind((host, port))
        listener.listen(128)
    except OSError as error:
        listener.close()
        cure = address_cure(error.errno)
        raise BindError(f"server.http: cannot listen on {host}:{port}: {error.strerror}; {cure}") from error
    return listener


def url_of(listener: socket.socket, *, tls: bool) -> str:
    """Return the URL of a listening socket."""
    host, port = listener.getsockname()[:2]
    return f"{'https' if tls else 'http'}://{f'[{host}]' if ':' in host else host}:{port}"


def certificate_of(site: Site) -> Path | None:
    """Return the site's certificate file, None if it serves without TLS.

    The certificate is loaded here because uvicorn would find a fault only when it is too late.

    Raises
    ------
    ConfigError
        If certificate and private key cannot be read or do not match.
    """
    http: HttpConfig = site.server.http
    if http.certificate is None or http.private_key is None:
        return None
    certificate, key = site.file(http.certificate), site.file(http.private_key)
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(certificate, key, password="")
    except (OSError, ssl.SSLError) as error:
        reason = getattr(error, "reason", None) or error.strerror
        what = f"cannot use {certificate} with {key}: {reason}; name a PEM certificate and its key without a passphrase"
        raise ConfigError([Fault("server.http.certificate", what)]) from error
    return certificate


def uvicorn_server(app: FastAPI, site: Site, certificate: Path | None) -> uvicorn.Server:
    """Return the server of an application, with limits on what clients may take of it."""
    key = site.server.http.private_key
    return uvicorn.Server(
        uvicorn.Config(
            app,
            ws=_WebSocket,  # sends many small messages faster than uvicorn's other implementations
            log_level="warning",
            http="h11",  # the implementation that limits the head of a request
            h11_max_incomplete_event_size=MAX_HEAD_BYTES,
            ssl_certfile=certificate,
            ssl_ciphers=CIPHERS,
            ssl_keyfile=None if key is None else site.file(key),
            limit_concurrency=MAX_CONNECTIONS,
            ws_max_size=MAX_INCOMING_BYTES,
            ws_per_message_deflate=False,  # small messages hardly shrink, and each would cost time and memory
            timeout_graceful_shutdown=SHUTDOWN_S,
        )
    )
