"""Server address, token and certificates of a client, single HTTP requests, and which errors may pass by themselves."""

from __future__ import annotations

import http.client
import json
import ssl
import urllib.error
import urllib.request
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final
from urllib.parse import urlencode, urlsplit

from livessl.errors import RunError, UseError

ANSWER_S: Final = 30.0
"""Longest wait, in seconds, for an answer."""

SHOWN_BYTES: Final = 300
"""Longest part of an answer, in bytes, that an error repeats."""

READ_BYTES: Final = 1 << 20
"""Longest part of a refusal's answer, in bytes, in which its reason is sought."""

TEMPORARY: Final = frozenset({408, 425, 429})
"""Statuses below 500 that may be gone at the next attempt."""


class UnreachableError(RunError):
    """No answer from the server: it does not run, restarts, or cannot be reached."""


class UnavailableError(UnreachableError):
    """The server runs, and cannot answer this request now."""


class RefusedError(RunError):
    """The server refuses the request: the token, a parameter or the address is wrong."""


@dataclass(frozen=True, slots=True)
class Address:
    """A server, and how to reach it.

    Parameters
    ----------
    url : str
        Without a slash at its end.
    token : str or None
    context : ssl.SSLContext or None
        Certificates to trust; None without TLS.
    """

    url: str
    token: str | None
    context: ssl.SSLContext | None

    @classmethod
    def of(cls, url: str, token: str | None, ca_file: str | Path | None) -> Address:
        """Return the address that a user gives.

        Raises
        ------
        UseError
            If the URL is none of HTTP, or the file with certificates cannot be used.
        """
        check_url(url)
        if token is not None and not (token.isascii() and token.isprintable()):
            raise UseError("token: expected the text that `livessl keys token` printed, got other characters")
        secure = url.startswith("https://")
        if ca_file is not None and not secure:
            raise UseError(f"ca_file: expected an address that begins with https:// beside it, got {url!r}")
        try:
            context = ssl.create_default_context(cafile=ca_file) if secure else None
        except OSError as error:
            raise UseError(f"ca_file: cannot read certificates from {ca_file}: {error}; name a PEM file") from error
        return cls(url.rstrip("/"), token, context)

    @property
    def headers(self) -> dict[str, str]:
        """Headers of every request."""
        return {} if self.token is None else {"Authorization": f"Bearer {self.token}"}

    def live(self, query: Mapping[str, str]) -> str:
        """Return the address of the live WebSocket."""
        return f"ws{self.url.removeprefix('http')}/api/v1/live?{urlencode(query)}"

    def get(self, path: str, query: Mapping[str, str] | None = None) -> bytes:
        """Return the answer to `GET /api/v1/PATH`.

        Raises
        ------
        UnreachableError
            If no answer comes; `UnavailableError` if the server answers that it cannot serve the request now.
        RefusedError
            If the request is wrong.
        """
        address = f"{self.url}/api/v1/{path}" + (f"?{urlencode(query)}" if query else "")
        request = urllib.request.Request(address, headers=self.headers)  # noqa: S310 - `of` has checked the scheme
        try:
            with open_url(request, ANSWER_S, self.context) as response:
                return bytes(response.read())
        except urllib.error.HTTPError as error:
            said = redirection(error) or f": {reason_of(error, SHOWN_BYTES)}"
            what = f"{address}: the server answered {error.code}{said}"
            if may_pass(error.code):
                raise UnavailableError(what) from error
            raise RefusedError(what + self.cure(error.code)) from error
        except (OSError, http.client.HTTPException) as error:
            raise self.lost(error) from error

    def cure(self, status: int) -> str:
        """Return what to do about a refusal with this status."""
        if status not in (401, 403):
            return ""
        return "; give a token" if self.token is None else "; give a token that is valid and has the role"

    def lost(self, error: Exception) -> RunError:
        """Return the error to raise for an error of the connection: `RefusedError` if further attempts would fail."""
        reason = error.reason if isinstance(error, urllib.error.URLError) else error
        if isinstance(reason, ssl.SSLError) and reason.reason in _NO_TLS:
            return RefusedError(f"{self.url}: what answers does not speak TLS ({reason.reason}); try http://")
        if isinstance(reason, ssl.SSLCertVerificationError):
            cure = "name the certificate of its authority as ca_file"
            return RefusedError(f"{self.url}: its certificate is not trusted: {reason.verify_message}; {cure}")
        return UnreachableError(f"{self.url}: no answer from a server ({reason}); check that it runs and its address")


_NO_TLS: Final = frozenset({"WRONG_VERSION_NUMBER", "HTTP_REQUEST", "PACKET_LENGTH_TOO_LONG", "RECORD_LAYER_FAILURE"})
"""Reasons of OpenSSL where the other end answers in plain text."""


class _Unredirected(urllib.request.HTTPRedirectHandler):
    """Makes an error of every redirect: urllib would send the token to whatever host the redirect names."""

    def redirect_request(self, *_: Any) -> None:
        """Follow nothing."""


def open_url(request: urllib.request.Request, wait_s: float, context: ssl.SSLContext | None = None) -> Any:
    """Return the answer to a request as a context manager; a redirect is not followed, but raises `HTTPError`."""
    handlers: list[Any] = [_Unredirected()]
    if context is not None:
        handlers.append(urllib.request.HTTPSHandler(context=context))
    return urllib.request.build_opener(*handlers).open(request, timeout=wait_s)


def redirection(error: urllib.error.HTTPError) -> str:
    """Return where a redirect leads, and what to do, as the rest of a sentence; empty if the answer is no redirect."""
    target = error.headers.get("Location") if 300 <= error.code < 400 else None
    return "" if target is None else f", a redirect to {target}; give that server's address if you trust it"


def reason_of(error: urllib.error.HTTPError, shown_bytes: int = 0) -> str:
    """Return the reason that a server gives for a refusal.

    Whatever answers, livessl or another program, and however the answer ends, there is no further error.

    Parameters
    ----------
    error : HTTPError
        The refusal; its answer is read and closed.
    shown_bytes : int
        Longest beginning of an answer, in bytes, to return where it gives no reason.
    """
    body = b""
    try:
        with error:
            body = error.read(READ_BYTES)
        detail = json.loads(body)["detail"]
        return detail if isinstance(detail, str) else "; ".join(str(fault["msg"]) for fault in detail)
    except (OSError, ValueError, KeyError, TypeError, RecursionError, http.client.HTTPException):
        return body[:shown_bytes].decode(errors="replace")


def may_pass(status: int) -> bool:
    """Return whether a request that was answered with this status may succeed later."""
    return status >= 500 or status in TEMPORARY


def check_url(url: str) -> None:
    """Raise `UseError` unless `url` names a server."""
    example = "url: expected an address such as http://127.0.0.1:8000"
    try:
        parts = urlsplit(url)
        port, host = parts.port, parts.hostname
        (host or "").encode("idna")
    except ValueError as error:  # of a port, of brackets, or of a name with an empty part
        raise UseError(f"{example}, got {url!r}: {error}") from error
    if parts.scheme not in ("http", "https") or not host or port == 0 or not url.isprintable() or " " in url:
        raise UseError(f"{example}, got {url!r}")
    if parts.username is not None or parts.query or parts.fragment:
        raise UseError(f"{example}, without a user, a query or a fragment, got one; give the token by itself")
