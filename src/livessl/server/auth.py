"""The gate before the HTTP face: tokens, roles and limits, for requests and WebSockets alike. It knows no route."""

from __future__ import annotations

from typing import Final

from starlette.datastructures import Headers
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from livessl.keys import Client, Role, Tokens
from livessl.server.refusals import Refusals

DOOR: Final = "http"

MAX_BODY_BYTES: Final = 65_536
"""Nothing that a client has to say is longer."""

PROTOCOL: Final = "livessl"
TOKEN_PROTOCOL: Final = "livessl.token."  # noqa: S105 - what stands before a token
"""A browser's WebSocket sends no headers of its own, but can name protocols: `livessl` and `livessl.token.TOKEN`."""

HEALTH: Final = "/api/v1/health"
ACCESS: Final = "/api/v1/access"

ANYONE: Final = Client("anyone", Role.ADMIN)
"""Where a site has no tokens: it then listens on this machine only."""

_READING: Final = frozenset({"GET", "HEAD", "OPTIONS"})


class Gate:
    """Lets a request through, or answers it.

    What the application may want to know of its client is in the scope, under `client_role`.

    Parameters
    ----------
    app : ASGIApp
        What it guards.
    tokens : Tokens or None
        None lets everyone do everything.
    refusals : Refusals
        Told of everyone who is turned away.
    """

    def __init__(self, app: ASGIApp, tokens: Tokens | None, refusals: Refusals) -> None:
        self._app = app
        self._tokens = tokens
        self._refusals = refusals

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one connection of the ASGI interface."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        client = self._client(scope)
        refusal = _refusal(scope, client)
        if refusal is not None:
            status, reason = refusal
            self._refusals.note(DOOR, (scope["client"] or ("a local socket",))[0], reason)
            if scope["type"] == "websocket":  # before it is open: the handshake is answered with 403
                await send({"type": "websocket.close"})
                return
            headers = {"WWW-Authenticate": 'Bearer realm="livessl"'} if status == 401 else None
            await JSONResponse({"detail": reason}, status, headers)(scope, receive, send)
            return
        scope["client_role"] = None if client is None else client.role
        await self._app(scope, receive, _choosing_protocol(scope, send))

    def _client(self, scope: Scope) -> Client | None:
        if self._tokens is None:
            return ANYONE
        token = _token(scope)
        return None if token is None else self._tokens.client(token)


def needed_role(method: str, path: str) -> Role | None:
    """What a request takes: nothing for the empty dashboard and a word on health, else by what it does.

    A route that is added later is guarded before anyone thinks of it.
    """
    if method in _READING and (path in ("/", HEALTH) or path.startswith("/static/")):
        return None
    if path == ACCESS:
        return Role.ADMIN
    return Role.VIEWER if method in _READING else Role.OPERATOR


def _refusal(scope: Scope, client: Client | None) -> tuple[int, str] | None:
    """Status and reason, in words that hold nothing of the request."""
    needed = needed_role(scope.get("method", "GET"), scope["path"])
    if needed is not None and client is None:
        return 401, "expected a valid token; send it as Authorization: Bearer TOKEN"
    if needed is not None and client is not None and client.role < needed:
        return 403, f"expected a token of the role {needed}, this one is of a {client.role}"
    headers = Headers(scope=scope)
    if "transfer-encoding" in headers:
        return 411, "expected a body whose length is told beforehand"
    if int(headers.get("content-length", "0")) > MAX_BODY_BYTES:
        return 413, f"expected a body of at most {MAX_BODY_BYTES} bytes"
    return None


def _token(scope: Scope) -> str | None:
    scheme, _, token = Headers(scope=scope).get("authorization", "").partition(" ")
    if scheme.lower() == "bearer":
        return token.strip()
    protocols: list[str] = scope.get("subprotocols", [])
    return next((name.removeprefix(TOKEN_PROTOCOL) for name in protocols if name.startswith(TOKEN_PROTOCOL)), None)


def _choosing_protocol(scope: Scope, send: Send) -> Send:
    """A browser that offers protocols hangs up unless one is chosen; it must not be the one with the token."""
    if PROTOCOL not in scope.get("subprotocols", ()):
        return send

    async def choose(message: Message) -> None:
        if message["type"] == "websocket.accept":
            message = {**message, "subprotocol": PROTOCOL}
        await send(message)

    return choose
