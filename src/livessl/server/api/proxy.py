"""Restores what a reverse proxy hides (X-Forwarded-For, scheme, sub-path), from trusted proxies only."""

from __future__ import annotations

from ipaddress import ip_address, ip_network
from typing import Final

from starlette.datastructures import Headers
from starlette.responses import RedirectResponse
from starlette.types import ASGIApp, Receive, Scope, Send

from livessl.server.api.hosts import FORWARDED_HOST
from livessl.site.addresses import plain_address
from livessl.site.server_models import HttpConfig

_SECURE: Final = {"http": False, "ws": False, "https": True, "wss": True}


class BehindProxy:
    """ASGI middleware, the outermost: the application behind it sees what the client sent to the proxy.

    `X-Forwarded-For`, `-Proto` and `-Host` count only if a proxy at one of `forwarded_allow_ips` sent them. The path
    begins with `root_path` afterwards, whether or not the proxy has removed it.

    Parameters
    ----------
    app : ASGIApp
        The application behind it.
    http : HttpConfig
        The site file's `server.http`.
    """

    def __init__(self, app: ASGIApp, http: HttpConfig) -> None:
        self._app = app
        self._root = http.root_path
        self._proxies = [ip_network(text) for text in http.forwarded_allow_ips]

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one connection of the ASGI interface."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        if self._root and scope["path"] == self._root and scope["type"] == "http":  # relative addresses need the slash
            await RedirectResponse(f"{self._root}/", 308)(scope, receive, send)
            return
        self._restore_client(scope)
        if self._root:
            self._put_under_root(scope)
        await self._app(scope, receive, send)

    def _restore_client(self, scope: Scope) -> None:
        """Replace the proxy's address and scheme by the client's; drop a host that no proxy has forwarded."""
        address, port = scope["client"] or ("", 0)
        address = plain_address(address)
        if self._is_proxy(address):
            headers = Headers(scope=scope)
            if (client := self._client(headers.getlist("x-forwarded-for"))) is not None:
                address, port = client, 0
            secure = _SECURE.get(headers.get("x-forwarded-proto", "").strip().lower())
            if secure is not None:
                plain = "ws" if scope["type"] == "websocket" else "http"
                scope["scheme"] = f"{plain}s" if secure else plain
        else:
            scope["headers"] = [header for header in scope["headers"] if header[0] != FORWARDED_HOST.encode()]
        if scope["client"] is not None:
            scope["client"] = address, port

    def _put_under_root(self, scope: Scope) -> None:
        """Put `root_path` before the path, where ASGI expects it, unless the proxy has left it there."""
        before = "" if scope["path"].startswith(f"{self._root}/") else self._root
        scope["root_path"] = self._root
        scope["path"] = before + scope["path"]
        scope["raw_path"] = before.encode() + scope["raw_path"]

    def _client(self, lists: list[str]) -> str | None:
        """Return the last address that is not a proxy's: each proxy appends the address that it was called from."""
        client = None
        for text in reversed(",".join(lists).split(",")):
            address = _address(text.strip())
            if address is None:
                break
            client = address
            if not self._is_proxy(address):
                break
        return client

    def _is_proxy(self, address: str) -> bool:
        try:
            parsed = ip_address(address.partition("%")[0])
        except ValueError:
            return False
        return any(parsed in network for network in self._proxies)


def _address(text: str) -> str | None:
    """Return the address in an entry of `X-Forwarded-For`, with or without a port; None if there is none."""
    if text.startswith("["):
        text = text[1:].partition("]")[0]
    elif text.count(":") == 1:
        text = text.partition(":")[0]
    try:
        return plain_address(str(ip_address(text)))
    except ValueError:
        return None
