"""Checks access tokens: which role a request needs, what is refused (401, 403), and the longest body."""

from __future__ import annotations

import asyncio
import logging
import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final

from starlette.datastructures import Headers, QueryParams
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from livessl.errors import ConfigError
from livessl.server.refusals import Refusals
from livessl.server.signed_links import PARAMETERS, SignedLinks, Verdict, is_linkable
from livessl.site.tokens import Client, Role, Tokens, file_stamp, read_tokens

DOOR: Final = "http"

MAX_BODY_BYTES: Final = 65_536
"""Longest body of a request, in bytes; the longest that a route reads has about 20."""

PROTOCOL: Final = "livessl"
TOKEN_PROTOCOL: Final = "livessl.token."  # noqa: S105 - a prefix, not a token
"""A page cannot set headers of a WebSocket, but it can offer protocols: `livessl` and `livessl.token.TOKEN`."""

HEALTH: Final = "/api/v1/health"
ACCESS: Final = "/api/v1/access"
LOG: Final = "/api/v1/log"

ANYONE: Final = Client("anyone", Role.ADMIN)
"""Every client of a site without tokens, whose server listens on the local machine only."""

BEARER: Final = Client("a signed link", Role.OPERATOR)
"""The client that opens a signed link; it may read only the path for which the link is valid."""

RELOAD_S: Final = 1.0
"""Interval, in seconds, at which the tokens file is checked for changes: they take effect without a restart."""

CLOSE_S: Final = 1.0
"""Longest wait, in seconds, for a client to accept the reason why its connection is closed."""

_SOUND: Final = re.compile(r"/api/v1/(events/[^/]*/clips/.+|listen)", re.DOTALL)
"""Addresses of recordings and of live sound. Only operators may listen; viewers see positions, but get no sound."""

_OPEN: Final = frozenset({"/", "/docs", "/embed", "/history", HEALTH})
"""Addresses that everyone may read: pages without data, and the status."""

_READING: Final = frozenset({"GET", "HEAD", "OPTIONS"})

_log = logging.getLogger(__name__)


class Access:
    """The valid tokens, and the requests and WebSockets that use them now. For the event loop's thread only.

    Parameters
    ----------
    tokens_file : Path or None
        None gives every client the role of an admin.
    links : SignedLinks or None
        Checks links that open something without a token; None admits none.

    Raises
    ------
    ConfigError
        If the file cannot be used.
    """

    def __init__(self, tokens_file: Path | None, links: SignedLinks | None = None) -> None:
        self.links = links
        """Checks links that open something without a token; None admits none."""
        self._file = tokens_file
        self._stamp = None if tokens_file is None else file_stamp(tokens_file)
        self._tokens = None if tokens_file is None else read_tokens(tokens_file)
        self._open: dict[asyncio.Event, tuple[str, Client]] = {}

    @property
    def wanted(self) -> bool:
        """True if clients need a token."""
        return self._tokens is not None

    @property
    def clients(self) -> tuple[Client, ...]:
        """Every client that has a token."""
        return () if self._tokens is None else self._tokens.clients

    def client(self, token: str | None) -> Client | None:
        """Return the client that a token was issued to; None if there is no such token."""
        if self._tokens is None:
            return ANYONE
        return None if token is None else self._tokens.client(token)

    async def reload_tokens(self) -> None:
        """Read the tokens file again whenever it changes, until cancelled; return at once if there is none.

        If the file cannot be used, the former tokens stay valid.
        """
        while (path := self._file) is not None:
            await asyncio.sleep(RELOAD_S)
            stamp = await asyncio.to_thread(file_stamp, path)
            if stamp == self._stamp:
                continue
            self._stamp = stamp
            try:
                self._replace(await asyncio.to_thread(read_tokens, path, missing_ok=True))
                _log.info("%s has changed: %d tokens are in force", path, len(self.clients))
            except ConfigError as error:
                _log.error("%s; the former tokens stay in force", error)

    def _replace(self, tokens: Tokens) -> None:
        """Replace the valid tokens, and end the open connections whose token was revoked or has another role now."""
        self._tokens = tokens
        for revoked, (token, client) in self._open.items():
            if tokens.client(token) != client:
                revoked.set()

    @contextmanager
    def held(self, token: str, client: Client) -> Iterator[asyncio.Event]:
        """Register a WebSocket or a request; the event is set when its token is revoked or gets another role."""
        revoked = asyncio.Event()
        self._open[revoked] = token, client
        try:
            yield revoked
        finally:
            del self._open[revoked]


class Gate:
    """ASGI middleware that passes a request on, or refuses it.

    It puts the client into the scope, as `client_role` and `client_name`; both are None without a token.

    Parameters
    ----------
    app : ASGIApp
        The application behind the gate.
    access : Access
        The valid tokens.
    refusals : Refusals
        Counts and logs refused requests.
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
        scope, link = _without_link(scope)
        refusal = _refusal(scope, client)
        if refusal is not None and link is not None and refusal[0] in (401, 403):
            refusal = _refusal_of_link(self._access.links, *link) or _refusal(scope, BEARER)
            client, token = BEARER, None
        if refusal is not None:
            status, reason = refusal
            self._refusals.note(DOOR, caller(scope), reason)
            if scope["type"] == "websocket":  # before it is accepted: the handshake is answered with 403
                await send({"type": "websocket.close"})
                return
            headers = {"WWW-Authenticate": 'Bearer realm="livessl"'} if status == 401 else None
            await JSONResponse({"detail": reason}, status, headers)(scope, receive, send)
            return
        scope["client_role"] = None if client is None else client.role
        scope["client_name"] = None if client is None else client.name
        if client is not None and token is not None:
            with self._access.held(token, client) as revoked:
                await self._app(scope, _until(revoked, receive, scope["type"]), _choosing_protocol(scope, send))
                if revoked.is_set() and scope["type"] == "websocket":
                    await _close_revoked(send)
        else:
            await self._app(scope, receive, _choosing_protocol(scope, send))


def caller(scope: Scope) -> str:
    """Return the address of the client, for the list of refusals."""
    return str((scope["client"] or ("a local socket",))[0])


async def _close_revoked(send: Send) -> None:
    """Close a WebSocket with the reason; a client that does not read is disconnected without it."""
    with suppress(TimeoutError):
        async with asyncio.timeout(CLOSE_S):
            await send({"type": "websocket.close", "code": 1008, "reason": "the token is no longer valid"})


def _until(revoked: asyncio.Event, receive: Receive, kind: str) -> Receive:
    """Return a `receive` that reports a disconnection once the token is revoked; `kind` is the scope's type."""

    async def receive_or_leave() -> Message:
        received, ended = asyncio.ensure_future(receive()), asyncio.ensure_future(revoked.wait())
        try:
            await asyncio.wait((received, ended), return_when=asyncio.FIRST_COMPLETED)
            return {"type": f"{kind}.disconnect", "code": 1008} if ended.done() else received.result()
        finally:
            received.cancel()
            ended.cancel()

    return receive_or_leave


def needed_role(method: str, path: str) -> Role | None:
    """Lowest role that a request needs; None for the pages without data and for health, which anyone may read.

    Every path is covered: a route that is added later is guarded from the start. A last newline is ignored, as the
    pattern of a route ignores it.
    """
    path = path.removesuffix("\n")
    if method in _READING and (path in _OPEN or path.startswith(("/static/", "/docs/"))):
        return None
    if path in (ACCESS, LOG):
        return Role.ADMIN
    if _SOUND.fullmatch(path):
        return Role.OPERATOR
    return Role.VIEWER if method in _READING else Role.OPERATOR


def _refusal(scope: Scope, client: Client | None) -> tuple[int, str] | None:
    """Status and reason of a refusal, or None. The text repeats nothing of the request: it is a label of a metric."""
    needed = needed_role(scope.get("method", "GET"), _path(scope))
    if needed is not None and client is None:
        return 401, "expected a valid token; send it as Authorization: Bearer TOKEN"
    if needed is not None and client is not None and client.role < needed:
        return 403, f"expected a token of the role {needed}, got one of the role {client.role}"
    headers = Headers(scope=scope)
    if "transfer-encoding" in headers:
        return 411, "expected a body with Content-Length, got one of unknown length"
    if int(headers.get("content-length", "0")) > MAX_BODY_BYTES:
        return 413, f"expected a body of at most {MAX_BODY_BYTES} bytes"
    return None


def _without_link(scope: Scope) -> tuple[Scope, tuple[str, str, str] | None]:
    """Split a request with a signed address into the request without the signature, and the parts of the link.

    These are its path, expiry and signature; None if the address is not signed, or is one that no link opens.
    """
    path = _path(scope)
    if scope["type"] != "http" or scope["method"] not in ("GET", "HEAD") or not is_linkable(path):
        return scope, None
    query: bytes = scope["query_string"]
    given = QueryParams(query)
    if PARAMETERS[1] not in given:
        return scope, None
    names = tuple(f"{name}=".encode() for name in PARAMETERS)
    left = b"&".join(part for part in query.split(b"&") if not part.startswith(names))
    expires, signature = (given.get(name, "") for name in PARAMETERS)
    return {**scope, "query_string": left}, (path, expires, signature)


def _refusal_of_link(links: SignedLinks | None, path: str, expires: str, signature: str) -> tuple[int, str] | None:
    """Status and reason of the refusal of a link; None if it is valid."""
    verdict = Verdict.INVALID if links is None else links.check(path, expires, signature)
    if verdict is Verdict.EXPIRED:
        return 401, "expected a link that is still valid, got one that has expired; sign in instead"
    if verdict is Verdict.INVALID:
        return 401, "expected a link as the server signed it; it was changed, or links were ended; sign in instead"
    return None


def _path(scope: Scope) -> str:
    """Return the path of a request, without the site's `root_path`."""
    path: str = scope["path"]
    return path.removeprefix(scope.get("root_path", ""))


def _token(scope: Scope) -> str | None:
    scheme, _, token = Headers(scope=scope).get("authorization", "").partition(" ")
    if scheme.lower() == "bearer":
        return token.strip()
    protocols: list[str] = scope.get("subprotocols", [])
    return next((name.removeprefix(TOKEN_PROTOCOL) for name in protocols if name.startswith(TOKEN_PROTOCOL)), None)


def _choosing_protocol(scope: Scope, send: Send) -> Send:
    """Return a `send` that accepts the protocol `livessl`: a browser needs one of its offers accepted."""
    if PROTOCOL not in scope.get("subprotocols", ()):
        return send

    async def choose(message: Message) -> None:
        if message["type"] == "websocket.accept":
            message = {**message, "subprotocol": PROTOCOL}
        await send(message)

    return choose
