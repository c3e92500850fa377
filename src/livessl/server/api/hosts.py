"""Checks Host and Origin: which requests are addressed to this server, and which pages may open WebSockets.

`headers.py` lets pages of other origins read the REST API (CORS).
"""

from __future__ import annotations

import re
from typing import Final

from starlette.datastructures import Headers
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Receive, Scope, Send

from livessl.server.api.auth import DOOR, caller
from livessl.server.refusals import Refusals
from livessl.site.addresses import in_url, is_loopback
from livessl.site.server_models import HttpConfig

FORWARDED_HOST: Final = "x-forwarded-host"
"""Header in which a reverse proxy repeats the host that the browser asked for."""

OTHER_HOST: Final = "a host name that is not the server's own"
OTHER_PAGE: Final = "a page of another server"
"""Reasons of refusals, as metrics and the log name them."""

MAX_SHOWN: Final = 32
"""Longest part of a refused name that an answer repeats, in characters. The text of `other_page`, which names both
cures, is then as long as the closing reason of a WebSocket may be: 123 bytes."""

_OWN: Final = ("127.0.0.1", "localhost", "[::1]")
_PORTS: Final = {"http": ":80", "https": ":443"}
_HOST: Final = re.compile(r"(\[[0-9a-f:.]+\]|[^:\[\]]+)(?::[0-9]*)?")


class ServerNames:
    """Names of the server: 127.0.0.1, localhost, [::1], and the `host` and `trusted_hosts` of the site file."""

    def __init__(self, http: HttpConfig) -> None:
        self._names = frozenset({*_OWN, in_url(http.host).lower(), *http.trusted_hosts})
        self._trusted = frozenset(http.trusted_hosts)
        self._origins = frozenset(http.allowed_origins)
        self.limited = bool(http.trusted_hosts) or (http.tokens is None and is_loopback(http.host))
        """True if requests under other names are refused. Without tokens they must be: any web page could otherwise
        point its own host name at this server and read the answers as its own (DNS rebinding)."""

    def foreign(self, headers: Headers) -> str | None:
        """Return the name that a request is addressed to if it is not the server's own, otherwise None.

        Behind a proxy that replaces the host, a request has two host names: the name by which the proxy calls the
        server (`Host`), and the name by which the client calls the proxy (`X-Forwarded-Host`). Both are checked.
        """
        hosts = headers.get("host", ""), public_host(headers)
        return next((host for host in hosts if not _matches(host, self._names)), None)

    def may_open(self, headers: Headers) -> bool:
        """Return True if a client may open a WebSocket.

        A page may open one if its host and port are those that the request is addressed to, if its host is in
        `trusted_hosts` (any port), or if its origin is in `allowed_origins`. Browsers leave this check to the server,
        and send the page's `Origin`; a request without `Origin` comes from another program and is accepted.
        Behind a proxy that replaces the host, only `X-Forwarded-Host` or `trusted_hosts` reveal the name that the
        browser uses.
        """
        scheme, _, page = headers.get("origin", "").lower().partition("://")
        if "origin" not in headers or headers["origin"].lower() in self._origins:
            return True
        port = _PORTS.get(scheme, "")
        hosts = {headers.get("host", "").lower(), public_host(headers).lower()}
        return (page != "" and page in {host.removesuffix(port) for host in hosts}) or _matches(page, self._trusted)


def public_host(headers: Headers) -> str:
    """Return the host that the client asked for, with its port: as the proxy says, or else as the request does."""
    return headers.get(FORWARDED_HOST, headers.get("host", "")).partition(",")[0].strip()


class HostCheck:
    """ASGI middleware that refuses requests under names that are not the server's.

    Parameters
    ----------
    app : ASGIApp
        The application behind it.
    names : ServerNames
        The server's names.
    refusals : Refusals
        Counts and logs refused requests.
    """

    def __init__(self, app: ASGIApp, names: ServerNames, refusals: Refusals) -> None:
        self._app = app
        self._names = names
        self._refusals = refusals

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one connection of the ASGI interface."""
        limited = scope["type"] != "lifespan" and self._names.limited
        host = self._names.foreign(Headers(scope=scope)) if limited else None
        if host is None:
            await self._app(scope, receive, send)
            return
        self._refusals.note(DOOR, caller(scope), OTHER_HOST)
        what = f"host: expected a name of this server, got {host[:MAX_SHOWN]!r}; add it to server.http.trusted_hosts"
        await PlainTextResponse(what, 400)(scope, receive, send)


def other_page(headers: Headers) -> str:
    """Return the reason that closes the WebSocket of another server's page; the dashboard shows it.

    It names both cures, because the server cannot know whether the page is its own, loaded through a proxy.
    """
    page = headers.get("origin", "").partition("://")[2] or headers.get("origin", "")
    cure = "add it to server.http.trusted_hosts (proxy) or allowed_origins"
    return f"origin: {page[:MAX_SHOWN]} is not this server; {cure}"


def _matches(host: str, patterns: frozenset[str]) -> bool:
    """Return True if a host, whatever its port, is one of the names, or a subdomain of `x` if `*.x` is listed."""
    found = _HOST.fullmatch(host.lower())
    if found is None:
        return False
    name = found[1]
    return name in patterns or any(p.startswith("*.") and name.endswith(p[1:]) for p in patterns)
