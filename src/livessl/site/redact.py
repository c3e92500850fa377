"""Takes secrets out of a site file and of texts, so that both can be given away for help."""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Mapping
from typing import Any, Final

from livessl.site.tokens import TOKEN_PREFIX

HIDDEN: Final = "(hidden)"
"""Stands for what was taken out."""

LEAST_SECRET: Final = 4
"""Shortest text that is taken out of other texts; shorter ones are parts of ordinary words."""

_SECRET_KEY: Final = re.compile(
    r"pas+w|passphrase|pwd|secret|token|credential|auth|user|private|api_?key", re.IGNORECASE
)
_ADDRESS: Final = re.compile(r"([a-z][a-z0-9+.-]*://)([^/?#]*)(.*)", re.IGNORECASE | re.DOTALL)
_USER_IN_ADDRESS: Final = re.compile(r"(?<=://)[^/\s@'\"]+@")
_TOKEN: Final = re.compile(rf"{re.escape(TOKEN_PREFIX)}[A-Za-z0-9_-]{{16,}}|(?<=Bearer )\S+|whsec_[A-Za-z0-9+/=]+")


def redacted(data: Any) -> tuple[Any, frozenset[str]]:
    """Return the data of a site file without secrets, and the texts that were taken out.

    Values are hidden whose key sounds like a secret, addresses keep their scheme and host alone, and commands their
    program alone. Names of files stay unless their key sounds like a secret: nobody should have to know which key wants
    a file and which a password.
    """
    taken: set[str] = set()
    return _redacted(data, "", taken), frozenset(taken)


def scrubbed(text: str, secrets: Collection[str] = ()) -> str:
    """Return a text without these secrets, and without users in addresses and what looks like a token."""
    for secret in sorted(secrets, key=len, reverse=True):
        if len(secret) >= LEAST_SECRET:
            for written in (secret, json.dumps(secret)[1:-1], json.dumps(secret, ensure_ascii=False)[1:-1]):
                text = text.replace(written, HIDDEN)
    return _TOKEN.sub(HIDDEN, _USER_IN_ADDRESS.sub(f"{HIDDEN}@", text))


def _redacted(value: Any, key: str, taken: set[str]) -> Any:
    if isinstance(value, Mapping):
        return {name: _redacted(inner, str(name), taken) for name, inner in value.items()}
    if key == "command" and isinstance(value, list):
        return [value[0], *(_hide(word, taken) for word in value[1:])] if value else []
    if isinstance(value, list):
        return [_redacted(inner, key, taken) for inner in value]
    if value is not None and not isinstance(value, bool) and _SECRET_KEY.search(key):
        return _hide(value, taken)
    return _short_address(value, taken) if isinstance(value, str) else value


def _hide(value: Any, taken: set[str]) -> str:
    taken.add(str(value))
    return HIDDEN


def _short_address(text: str, taken: set[str]) -> str:
    """Return an address with scheme, host and port alone; any other text as it is."""
    found = _ADDRESS.fullmatch(text)
    if found is None:
        return text
    scheme, authority, rest = found.groups()
    user, _, host = authority.rpartition("@")
    taken.update(part for part in re.split(r"[:/?#&=]", f"{user}/{rest}") if part)
    return f"{scheme}{host}" + ("/…" if user or rest else "")
