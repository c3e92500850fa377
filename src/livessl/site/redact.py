"""Takes secrets out of a site file and of texts (support bundle)."""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from livessl.site.tokens import TOKEN_PREFIX

HIDDEN: Final = "(hidden)"
"""Stands for what was taken out."""

LEAST_SECRET: Final = 4
"""Shortest text that is taken out of other texts; shorter ones are parts of ordinary words."""

_SECRET_KEY: Final = re.compile(r"pas+w|passphrase|pwd|secret|token|credential|auth|private|api_?key", re.IGNORECASE)
_NAME_KEY: Final = re.compile("user", re.IGNORECASE)
_ORDINARY: Final = frozenset(
    (
        *("admin", "alarm", "alert", "alerts", "audio", "events", "guest", "guests", "home"),
        *("hook", "hooks", "info", "livessl", "mqtt", "nats", "notify", "operator", "postgres"),
        *("postgresql", "public", "root", "server", "service", "services", "sound", "topic", "user"),
        *("users", "viewer", "webhook", "webhooks"),
    )
)
"""Names of users and parts of paths that are words of every log."""

_ADDRESS: Final = re.compile(r"([a-z][a-z0-9+.-]*://)([^/?#]*)(.*)", re.IGNORECASE | re.DOTALL)
_USER_IN_ADDRESS: Final = re.compile(r"(?<=://)[^/\s@'\"]+@")
_TOKEN: Final = re.compile(rf"{re.escape(TOKEN_PREFIX)}[A-Za-z0-9_-]{{16,}}|(?<=Bearer )\S+|whsec_[A-Za-z0-9+/=]+")


@dataclass
class _Taken:
    """Texts that were taken out: secrets, and names and paths, which may be ordinary words."""

    secrets: set[str] = field(default_factory=set)
    names: set[str] = field(default_factory=set)


def redacted(data: Any) -> tuple[Any, frozenset[str]]:
    """Return the data of a site file without secrets, and the texts that were taken out.

    Values are hidden whose key sounds like a secret, or a key above it; addresses keep their scheme and host alone, and
    commands their program alone. Names of files stay unless their key sounds like a secret, so that one need not know
    which key wants a file and which a password.

    Names of users and parts of paths and commands that are ordinary words, or stand elsewhere in what is shown, are not
    among the texts: without them, other texts would have holes and be no safer.
    """
    taken = _Taken()
    shown = _redacted(data, "", taken)
    known = _ORDINARY | set(_words(shown))
    return shown, frozenset(taken.secrets | {name for name in taken.names if name.lower() not in known})


def scrubbed(text: str, secrets: Collection[str] = ()) -> str:
    """Return a text without these secrets, and without users in addresses and what looks like a token."""
    for secret in sorted(secrets, key=len, reverse=True):
        if len(secret) >= LEAST_SECRET:
            for written in (secret, json.dumps(secret)[1:-1], json.dumps(secret, ensure_ascii=False)[1:-1]):
                text = text.replace(written, HIDDEN)
    return _TOKEN.sub(HIDDEN, _USER_IN_ADDRESS.sub(f"{HIDDEN}@", text))


def _redacted(value: Any, key: str, taken: _Taken) -> Any:
    if isinstance(value, Mapping):
        # a key inside of a secret is as secret as the key around it
        around = key if _is_secret(key) else ""
        return {name: _redacted(inner, around or str(name), taken) for name, inner in value.items()}
    if key == "command" and isinstance(value, list | str):
        return _short_command(value, taken)
    if isinstance(value, list):
        return [_redacted(inner, key, taken) for inner in value]
    if value is not None and not isinstance(value, bool) and _is_secret(key):
        if not isinstance(value, float):  # whose digits would be taken out of other numbers
            (taken.secrets if _SECRET_KEY.search(key) else taken.names).add(str(value))
        return HIDDEN
    return _short_address(value, taken) if isinstance(value, str) else value


def _is_secret(key: str) -> bool:
    return _SECRET_KEY.search(key) is not None or _NAME_KEY.search(key) is not None


def _short_command(command: list[Any] | str, taken: _Taken) -> list[Any] | str:
    """Return a command with its program alone."""
    words = command.split() if isinstance(command, str) else command
    taken.names.update(str(word) for word in words[1:])
    if isinstance(command, str):
        return " ".join([*words[:1], *([HIDDEN] if len(words) > 1 else [])])
    return [*words[:1], *(HIDDEN for _ in words[1:])]


def _short_address(text: str, taken: _Taken) -> str:
    """Return an address with scheme, host and port alone; any other text as it is."""
    found = _ADDRESS.fullmatch(text)
    if found is None:
        return text
    scheme, authority, rest = found.groups()
    user, _, host = authority.rpartition("@")
    name, _, password = user.partition(":")
    taken.secrets.update({password} - {""})
    taken.names.update(part for part in re.split(r"[:/?#&=]", f"{name}/{rest}") if part)
    return f"{scheme}{host}" + ("/…" if user or rest else "")


def _words(shown: Any) -> Iterator[str]:
    """Yield the words of keys and texts, in lower case, whole and in their parts."""
    if isinstance(shown, Mapping):
        for key, value in shown.items():
            yield from _words(str(key))
            yield from _words(value)
    elif isinstance(shown, list):
        for value in shown:
            yield from _words(value)
    elif isinstance(shown, str):
        yield shown.lower()
        yield from re.findall(r"\w+", shown.lower())
