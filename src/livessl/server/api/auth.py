"""The gate before the HTTP face: tokens, roles and limits, for requests and WebSockets alike. It knows no route."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Final

from starlette.datastructures import Headers
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from livessl.server.refusals import Refusals
from livessl.site.tokens import Client, Role, Tokens

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

SAY_S: Final = 1.0
"""How long a client whose token is revoked has to take the reason."""

_READING: Final = frozenset({"GET", "HEAD", "OPTIONS"})


class Access:
    """The tokens in force, and the WebSockets that were opened with them. All calls on the event loop's thread.

    Parameters
    ----------
    tokens : Tokens or None
        None lets everyone do everything.
    """

    def __init__(self, tokens: Tokens | None) -> None:
        self._tokens = tokens
        self._open: dict[asyncio.Event, tuple[str, Client]] = {}

    @property
    def wanted(self) -> bool:
        """Whether a token is needed."""
        return self._tokens is not None

    @property
    def clients(self) -> tuple[Client, ...]:
        """Everyone who has a token."""
        return () if self._tokens is None else self._tokens.clients

    def client(self, token: str | None) -> Client | None:
        """Whom a request comes from."""
        if self._tokens is None:
            return ANYONE
        return None if token is None else self._tokens.client(token)

    def replace(self, tokens: Tokens) -> None:
        """Other tokens are in force from now on; WebSockets of those that are not any more end."""
        self._tokens = tokens
        for revoked, (token, client) in self._open.items():
            if tokens.client(token) != client:
                revoked.set()

    @contextmanager
    def held(self, token: str, client: Client) -> Iterator[asyncio.Event]:
        """While a WebSocket is open: what is set when its token is revoked, or has another role."""
        revoked = asyncio.Event()
        self._open[revoked] = token, client
        try:
            yield revoked
        finally:
            del self._open[revoked]


class Gate:
    """Lets a request through, or answers it.

    What the application may want to know of its client is in the scope, under `client_role` and `client_name`.

    Parameters
    ----------
    app : ASGIApp
        What it guards.
    access : Access
        Who may.
    refusals : Refusals
        Told of everyone who is turned away.
    """

    def __init__(self, app: ASGIApp, access: Access, refusals: Refusals) -> None:
        self._app = app
        self._access = access
        self._refusals = refusals

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one connection of the ASGI interface."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        token = _token(scope)
        client = self._access.client(token)
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
        scope["client_name"] = None if client is None else client.name
        if scope["type"] == "websocket" and client is not None and token is not None:
            with self._access.held(token, client) as revoked:
                await self._app(scope, _until(revoked, receive), _choosing_protocol(scope, send))
                if revoked.is_set():
                    await _say_why(send)
        else:
            await self._app(scope, receive, _choosing_protocol(scope, send))


async def _say_why(send: Send) -> None:
    """To a client that reads; one that does not is cut all the same."""
    with suppress(TimeoutError):
        async with asyncio.timeout(SAY_S):
            await send({"type": "websocket.close", "code": 1008, "reason": "the token is not valid any more"})


def _until(revoked: asyncio.Event, receive: Receive) -> Receive:
    """As what the client says; but once its token is revoked, it has left."""

    async def receive_or_leave() -> Message:
        said, ended = asyncio.ensure_future(receive()), asyncio.ensure_future(revoked.wait())
        try:
            await asyncio.wait((said, ended), return_when=asyncio.FIRST_COMPLETED)
            return {"type": "websocket.disconnect", "code": 1008} if ended.done() else said.result()
        finally:
            said.cancel()
            ended.cancel()

    return receive_or_leave


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
