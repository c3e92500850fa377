"""Signs and checks links that open one picture, recording or map without a token, until they expire.

A link is the address with two parameters: `expires`, in seconds since the epoch, and `signature`, the HMAC-SHA256 of
path and expiry. Nothing is stored of a link, so it ends by its expiry, with what it opens, or with the secret.
"""

from __future__ import annotations

import hmac
import logging
import re
import secrets
import threading
from base64 import urlsafe_b64encode
from enum import Enum, auto
from pathlib import Path
from typing import Final

from livessl.clock import Clock
from livessl.errors import ConfigError
from livessl.site.secret_files import KEY, fault, read_secret, write_whole
from livessl.site.tokens import file_stamp

PARAMETERS: Final = ("expires", "signature")
"""Names of the parameters that sign an address."""

SECRET_BYTES: Final = 32

LIVE_PATH: Final = "/api/v1/map"
"""The one path that a link may open whose content changes: it shows what happens now."""

_ID: Final = "[A-Za-z0-9._-]+"
LINKABLE: Final = rf"/api/v1/(alerts/{_ID}/picture\.png|events/{_ID}/clips/{_ID}|map)"
"""Pattern of the paths that a link may open. Whatever else was signed by mistake stays closed."""

_LINKABLE: Final = re.compile(LINKABLE)

_CONTEXT: Final = b"livessl link 1\n"
"""First line of what is signed, so that no signature of another kind is valid here."""

_SECONDS: Final = re.compile(r"[0-9]{1,12}")
_CURE: Final = "delete it, and the server makes a new one: all links end then"
_log = logging.getLogger(__name__)


class Verdict(Enum):
    """The outcome of checking a link."""

    VALID = auto()
    EXPIRED = auto()
    INVALID = auto()


class SignedLinks:
    """Signs and checks links by a secret. Every thread may call it.

    Parameters
    ----------
    clock : Clock
    secret : Path or None
        File of the secret. It is made for the first link if there is none, and read again when it changes. None keeps
        the secret in memory: links end with the process then.

    Raises
    ------
    ConfigError
        If the file cannot be read, can be used by others, or is no secret.
    """

    def __init__(self, clock: Clock, secret: Path | None) -> None:
        self._clock = clock
        self._file = secret
        self._lock = threading.Lock()
        self._stamp: tuple[int, int] | None = None
        self._key = secrets.token_bytes(SECRET_BYTES)
        if secret is not None and secret.exists():
            self._read(secret)

    def sign(self, path: str, lifetime_s: float) -> tuple[str, int]:
        """Return a path of the API as a link, and when it expires, in nanoseconds since the epoch.

        Parameters
        ----------
        path : str
            Path without the site's `root_path`.
        lifetime_s : float

        Raises
        ------
        ValueError
            If no link may open that path.
        """
        if not is_linkable(path):
            raise ValueError(f"expected the path of a picture, a recording or a map, got {path!r}")
        expires_s = self._clock.now_ns() // 1_000_000_000 + max(1, round(lifetime_s))
        signature = _signature(self._current_key(makes=True), path, str(expires_s))
        return f"{path}?expires={expires_s}&signature={signature}", expires_s * 1_000_000_000

    def check(self, path: str, expires: str, signature: str) -> Verdict:
        """Check a link. The time that this takes does not depend on how much of a wrong signature is right.

        Parameters
        ----------
        path : str
            Path of the request without the site's `root_path`, decoded.
        expires, signature : str
            Parameters of the request.
        """
        if not is_linkable(path) or not _SECONDS.fullmatch(expires) or not signature.isascii():
            return Verdict.INVALID
        if not hmac.compare_digest(_signature(self._current_key(), path, expires), signature):
            return Verdict.INVALID
        return Verdict.VALID if self._clock.now_ns() < int(expires) * 1_000_000_000 else Verdict.EXPIRED

    def _current_key(self, *, makes: bool = False) -> bytes:
        """Return the key; with `makes` its file is made if there is none. An unusable file changes nothing."""
        with self._lock:
            path = self._file
            stamp = None if path is None else file_stamp(path)
            if path is not None and stamp is None and self._stamp is not None:
                self._stamp, self._key = None, secrets.token_bytes(SECRET_BYTES)  # the file was deleted
            if path is not None and (stamp != self._stamp or (makes and stamp is None)):
                try:
                    self._read(path)
                except ConfigError as error:
                    self._stamp = stamp
                    _log.error("%s; the former secret stays in force until then", error)
            return self._key

    def _read(self, path: Path) -> None:
        if not path.exists():
            try:
                write_whole(path, secrets.token_hex(SECRET_BYTES) + "\n", 0o600)
            except OSError as error:
                raise fault(path, f"cannot be written: {error.strerror or error}; correct its permissions") from error
        text = read_secret(path, _CURE).strip()
        if not KEY.fullmatch(text):
            raise fault(path, f"expected {2 * SECRET_BYTES} hexadecimal digits; {_CURE}")
        self._key, self._stamp = bytes.fromhex(text), file_stamp(path)


def is_linkable(path: str) -> bool:
    """Return whether a link may open a path of the API."""
    return _LINKABLE.fullmatch(path) is not None


def _signature(key: bytes, path: str, expires: str) -> str:
    signed = _CONTEXT + f"{expires}\n{path}".encode("ascii")
    return urlsafe_b64encode(hmac.digest(key, signed, "sha256")).decode().rstrip("=")
