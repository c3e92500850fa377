"""Adds the headers that protect pages, and lets pages of other origins read the REST API (CORS) or frame pages.

`hosts.py` checks `Host` and `Origin`: which requests are addressed to this server, and which pages may open WebSockets.
"""

from __future__ import annotations

import re
from base64 import b64encode
from hashlib import sha256
from pathlib import Path
from typing import Final

from starlette.datastructures import MutableHeaders
from starlette.middleware.cors import CORSMiddleware
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from livessl.site.server_models import HttpConfig

READING: Final = ("GET", "HEAD")
"""Methods that pages of other origins may use: they may read, whatever the role of their token."""

_SENT: Final = ("Authorization", "If-None-Match", "Last-Event-ID", "Range")
_SHOWN: Final = ("Content-Range", "ETag", "Retry-After")
_PREFLIGHT_S: Final = 600


class SafeHeaders:
    """ASGI middleware that adds the headers of every answer.

    Parameters
    ----------
    app : ASGIApp
        The application behind it.
    http : HttpConfig
        The site file's `server.http`; `frame_ancestors` may frame the pages.
    page : Path
        The dashboard's page, whose own script is admitted.
    """

    def __init__(self, app: ASGIApp, http: HttpConfig, page: Path) -> None:
        self._app = app
        self._policy = _content_security_policy(page.read_text(encoding="utf-8"), http.frame_ancestors)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one connection of the ASGI interface."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return

        async def send_safely(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                headers["Content-Security-Policy"] = self._policy
                headers["X-Content-Type-Options"] = "nosniff"
                headers.setdefault("Cache-Control", "no-cache")
            await send(message)

        await self._app(scope, receive, send_safely)


def other_origins(app: ASGIApp, http: HttpConfig, shown: tuple[str, ...]) -> ASGIApp:
    """ASGI middleware that lets pages of `allowed_origins` read the REST API with their own token (CORS).

    Parameters
    ----------
    app : ASGIApp
        The application behind it.
    http : HttpConfig
    shown : tuple of str
        Further headers of answers that these pages may read.
    """
    return CORSMiddleware(
        app,
        allow_origins=http.allowed_origins,
        allow_methods=READING,
        allow_headers=_SENT,
        expose_headers=(*_SHOWN, *shown),
        max_age=_PREFLIGHT_S,
    )


def _content_security_policy(page: str, ancestors: tuple[str, ...]) -> str:
    """Return the content security policy of all pages; the only inline script it admits is the dashboard's."""
    scripts = re.findall(r"<script>(.*?)</script>", page, re.DOTALL)
    digests = (b64encode(sha256(script.encode()).digest()).decode() for script in scripts)
    admitted = " ".join(["'self'", *(f"'sha256-{digest}'" for digest in digests)])
    framing = " ".join(["'self'", *ancestors])
    return (
        f"default-src 'self'; script-src {admitted}; img-src 'self' data:; "
        f"media-src 'self' blob:; connect-src 'self' ws: wss:; frame-ancestors {framing}"
    )
