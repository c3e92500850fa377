"""The file of access tokens (names, roles, hashes): makes, finds and revokes tokens, and never stores one."""

from __future__ import annotations

import hashlib
import hmac
import secrets
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Annotated, Final, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from livessl.errors import ConfigError, Fault
from livessl.site.findings import dotted, read_yaml
from livessl.site.secret_files import KEY, NAME, check_name, fault, read_secret, write_whole

TOKEN_PREFIX: Final = "livessl_"  # noqa: S105 - a prefix, not a secret
"""Prefix of every token, by which scanners for leaked secrets recognize one."""

TOKEN_BYTES: Final = 32
"""Random bytes of a token. 256 bits cannot be guessed, so a plain hash suffices: no salt, no slow function."""


class Role(IntEnum):
    """Permissions of a client; each role includes those of the roles before it."""

    VIEWER = 1
    """May read."""
    OPERATOR = 2
    """May change settings."""
    ADMIN = 3
    """May see all clients and every refused attempt."""

    def __str__(self) -> str:
        return self.name.lower()


RoleName = Literal["viewer", "operator", "admin"]


@dataclass(frozen=True, slots=True)
class Client:
    """The owner of a token."""

    name: str
    role: Role


class _Entry(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", hide_input_in_errors=True)

    name: Annotated[str, Field(pattern=f"^{NAME.pattern}$")]
    role: RoleName
    sha256: Annotated[str, Field(pattern=f"^{KEY.pattern}$")]


class _TokensFile(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", hide_input_in_errors=True)

    tokens: Annotated[tuple[_Entry, ...], Field(min_length=1)]


class Tokens:
    """The clients that have access, by the hashes of their tokens.

    Parameters
    ----------
    clients : mapping of bytes to Client
        The key is the SHA-256 of the token.
    """

    def __init__(self, clients: Mapping[bytes, Client]) -> None:
        self._clients = dict(clients)

    @property
    def clients(self) -> tuple[Client, ...]:
        """All clients that have a token."""
        return tuple(self._clients.values())

    def client(self, token: str) -> Client | None:
        """Return the owner of a token, or None; the time that it takes does not depend on the token."""
        presented = _hash(token)
        found = None
        for known, client in self._clients.items():
            if hmac.compare_digest(known, presented):
                found = client
        return found


def file_stamp(path: Path) -> tuple[int, int] | None:
    """Return a value that changes when a file is rewritten; None if there is no file."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_mtime_ns, found.st_ino


def read_tokens(path: Path, *, missing_ok: bool = False) -> Tokens:
    """Read a tokens file.

    Parameters
    ----------
    path : Path
    missing_ok : bool
        Return no tokens if there is no file, as after the last token was revoked.

    Raises
    ------
    ConfigError
        If the file cannot be read, can be used by others, or is not a tokens file.
    """
    if missing_ok and not path.exists():
        return Tokens({})
    text = read_secret(path, "make a token with `livessl keys token`")
    return Tokens({bytes.fromhex(entry.sha256): _client(entry) for entry in _entries(path, text)})


def add_token(path: Path, name: str, role: RoleName) -> str:
    """Make a token, add its hash to a file, and return the token, which is stored nowhere.

    Raises
    ------
    ConfigError
        If the name is taken, or the file cannot be used.
    """
    check_name(name)
    held = _entries(path, read_secret(path, "")) if path.exists() else ()
    if any(entry.name == name for entry in held):
        raise fault(path, f"a token named {name!r} exists already; choose another --name, or revoke it first")
    token = TOKEN_PREFIX + secrets.token_urlsafe(TOKEN_BYTES)
    _write_tokens(path, (*held, _Entry(name=name, role=role, sha256=_hash(token).hex())))
    return token


def revoke_token(path: Path, name: str) -> None:
    """Remove a token from a file.

    Raises
    ------
    ConfigError
        If the file has no token of that name.
    """
    held = _entries(path, read_secret(path, "there is no token to revoke"))
    left = tuple(entry for entry in held if entry.name != name)
    if len(left) == len(held):
        known = ", ".join(entry.name for entry in held) or "none"
        raise fault(path, f"no token named {name!r}; tokens are {known}")
    _write_tokens(path, left)


def _client(entry: _Entry) -> Client:
    return Client(entry.name, Role[entry.role.upper()])


def _hash(token: str) -> bytes:
    return hashlib.sha256(token.encode("utf-8", "surrogateescape")).digest()


def _entries(path: Path, text: str) -> tuple[_Entry, ...]:
    try:
        entries = _TokensFile.model_validate(read_yaml(text)).tokens
    except yaml.YAMLError:
        raise fault(path, "not valid YAML; make it with `livessl keys token`") from None
    except ValidationError as error:  # the message names the place, but never the value there
        faults = [Fault(f"{path}: {dotted(item['loc'])}", item["msg"]) for item in error.errors()]
        raise ConfigError(faults) from None
    names = [entry.name for entry in entries]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise fault(path, f"expected each name once, got {twice!r} twice; remove one")
    return entries


def _write_tokens(path: Path, entries: tuple[_Entry, ...]) -> None:
    if not entries:
        path.unlink()
        return
    data = {"tokens": [entry.model_dump() for entry in entries]}
    head = "# Made by `livessl keys token`: hashes of the clients' tokens. The tokens themselves are stored nowhere.\n"
    write_whole(path, head + yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=200), 0o600)
