"""Delivers alerts as webhooks: HTTP requests, signed as Standard Webhooks specifies."""

from __future__ import annotations

import asyncio
import base64
import binascii
import hashlib
import hmac
import re
import ssl
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Final
from urllib.parse import urlsplit

import orjson

from livessl import __version__
from livessl.server.alerts.actions import ActionSetting, DeliveryError, client_tls
from livessl.server.api.encode import JsonObject
from livessl.site.secret_files import fault, read_secret

SECRET_PREFIX: Final = "whsec_"  # noqa: S105 - a prefix, not a secret
SECRET_BYTES: Final = range(24, 65)
"""Lengths of a secret, in bytes, that the specification allows: 192 to 512 bits."""

MAX_HEAD_BYTES: Final = 16_384
"""Longest head of an HTTP answer that is read, in bytes; its body is not read."""

_STATUS: Final = re.compile(rb"HTTP/1\.[01] ([1-5][0-9]{2})(?: [^\r\n]*)?\r?$")
_RETRY_AFTER: Final = re.compile(rb"^retry-after:[ \t]*([0-9]{1,9})[ \t]*\r?$", re.IGNORECASE | re.MULTILINE)


class Webhook:
    """Posts alerts to one address.

    Parameters
    ----------
    setting : ActionSetting

    Raises
    ------
    ConfigError
        If the secret or the certificates cannot be read.
    """

    def __init__(self, setting: ActionSetting) -> None:
        config = setting.config.webhook
        assert config is not None
        url = urlsplit(config.url)
        self._host = url.hostname or ""
        self._is_tls = url.scheme == "https"
        self._port = url.port or (443 if self._is_tls else 80)
        self._authority = url.netloc
        self._target = (url.path or "/") + (f"?{url.query}" if url.query else "")
        self._clock = setting.clock
        self._timeout_s = setting.config.timeout_s
        self._tls = client_tls(setting, config.ca) if self._is_tls else None
        self._key = None
        if config.secret is not None:
            path = setting.site.file(config.secret)
            text = read_secret(path, "make one as docs/alerts.md describes").strip()
            key = secret_key(text)
            if key is None:
                raise fault(
                    path, f"expected {SECRET_PREFIX} and 24 to 64 bytes in Base64; make one as docs/alerts.md says"
                )
            self._key = key

    @asynccontextmanager
    async def connected(self, ready: Callable[[], None]) -> AsyncIterator[None]:  # noqa: ARG002
        """Open no connection in advance, because alerts are rare."""
        yield

    async def deliver(self, alert: JsonObject) -> None:
        """Post an alert. Every status other than 2xx is a failure, and redirections are not followed.

        Raises
        ------
        DeliveryError
            If the address does not answer in time, or answers with another status. 410 means that the address is gone
            permanently.
        """
        try:
            async with asyncio.timeout(self._timeout_s):
                head = await self._post(self._request(alert))
        except TimeoutError as error:
            raise DeliveryError(f"no answer within {self._timeout_s:g} s") from error
        except (OSError, ssl.SSLError, asyncio.IncompleteReadError, asyncio.LimitOverrunError) as error:
            reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
            raise DeliveryError(f"cannot reach {self._authority}: {reason}") from error
        _check(head)

    def _request(self, alert: JsonObject) -> bytes:
        """Return the whole request, with the present time and the signature."""
        payload = orjson.dumps(
            {"type": "livessl.alert", "timestamp": alert["time_utc"] or alert["raised_utc"], "data": alert}
        )
        seconds = self._clock.now_ns() // 1_000_000_000
        lines = [
            f"POST {self._target} HTTP/1.1",
            f"Host: {self._authority}",
            f"User-Agent: livessl/{__version__}",
            "Content-Type: application/json",
            f"Content-Length: {len(payload)}",
            "Connection: close",
            f"webhook-id: {alert['key']}",
            f"webhook-timestamp: {seconds}",
        ]
        if self._key is not None:
            lines.append(f"webhook-signature: {signature(self._key, alert['key'], seconds, payload)}")
        return "\r\n".join((*lines, "", "")).encode("ascii") + payload

    async def _post(self, request: bytes) -> bytes:
        """Send a request on a new connection; return the head of the final answer."""
        reader, writer = await asyncio.open_connection(
            self._host, self._port, ssl=self._tls, limit=MAX_HEAD_BYTES, happy_eyeballs_delay=0.25
        )
        try:
            writer.write(request)
            await writer.drain()
            while (head := await reader.readuntil(b"\r\n\r\n")).startswith((b"HTTP/1.1 1", b"HTTP/1.0 1")):
                pass  # an interim answer
            return head
        finally:
            writer.close()


def secret_key(text: str) -> bytes | None:
    """Return the key that the text of a secret encodes; None if it is not a valid secret."""
    try:
        key = base64.b64decode(text.removeprefix(SECRET_PREFIX), validate=True)
    except (binascii.Error, ValueError):
        return None
    return key if text.startswith(SECRET_PREFIX) and len(key) in SECRET_BYTES else None


def signature(key: bytes, message_id: str, seconds: int, payload: bytes) -> str:
    """Return the value of `webhook-signature`: HMAC-SHA256 of id, time and body, joined by full stops."""
    signed = f"{message_id}.{seconds}.".encode() + payload
    return "v1," + base64.b64encode(hmac.new(key, signed, hashlib.sha256).digest()).decode()


def _check(head: bytes) -> None:
    """Raise DeliveryError unless the head of an answer says that the request was accepted."""
    found = _STATUS.match(head.split(b"\n", 1)[0])
    if found is None:
        raise DeliveryError(f"expected an HTTP answer, got {head[:40]!r}")
    status = int(found[1])
    if 200 <= status < 300:
        return
    asked = _RETRY_AFTER.search(head)
    wait_s = None if asked is None else float(asked[1])
    raise DeliveryError(f"answered {status}, expected 2xx", retry_after_s=wait_s, hopeless=status == 410)
