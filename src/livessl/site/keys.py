"""Secrets on disk: the key pairs of server and nodes, and the tokens of clients. It opens no socket."""

from __future__ import annotations

import hashlib
import hmac
import os
import re
import secrets
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from pathlib import Path
from typing import Annotated, Final, Literal

import yaml
import zmq
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from zmq.utils import z85

from livessl.site.load import read_yaml
from livessl.site.models import ConfigError, Fault, Site

TOKEN_PREFIX: Final = "livessl_"  # noqa: S105 - what every token begins with, so that scanners for leaks find them
TOKEN_BYTES: Final = 32
"""Of randomness: nobody guesses 256 bits, so a plain hash at rest is enough and needs no salt nor slowness."""

SERVER: Final = "server"
NODES_FILE: Final = "nodes.yaml"

_NAME: Final = re.compile(r"[A-Za-z0-9._-]{1,64}")
_KEY: Final = re.compile(r"[0-9a-f]{64}")


class Role(IntEnum):
    """What a client may do; each role may all that the one before it may."""

    VIEWER = 1
    """Read."""
    OPERATOR = 2
    """Change."""
    ADMIN = 3
    """See who may do what, and who was refused."""

    def __str__(self) -> str:
        return self.name.lower()


RoleName = Literal["viewer", "operator", "admin"]


@dataclass(frozen=True, slots=True)
class Client:
    """Whom a token stands for."""

    name: str
    role: Role


@dataclass(frozen=True, slots=True)
class KeyPair:
    """A CURVE25519 key pair, 32 bytes each; the secret half is in no repr."""

    public: bytes
    secret: bytes = field(repr=False)


@dataclass(frozen=True, slots=True)
class ServerKeys:
    """What the server needs: its own pair, and the public keys of the nodes by name."""

    own: KeyPair
    nodes: Mapping[str, bytes]


@dataclass(frozen=True, slots=True)
class NodeKeys:
    """What a node needs: its own pair, and the server's public key."""

    own: KeyPair
    server: bytes


class _Entry(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", hide_input_in_errors=True)

    name: Annotated[str, Field(pattern=f"^{_NAME.pattern}$")]
    role: RoleName
    sha256: Annotated[str, Field(pattern=f"^{_KEY.pattern}$")]


class _TokensFile(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", hide_input_in_errors=True)

    tokens: Annotated[tuple[_Entry, ...], Field(min_length=1)]


class Tokens:
    """The clients that may ask, by the hashes of their tokens.

    Parameters
    ----------
    clients : mapping of bytes to Client
        By the SHA-256 of the token.
    """

    def __init__(self, clients: Mapping[bytes, Client]) -> None:
        self._clients = dict(clients)

    @property
    def clients(self) -> tuple[Client, ...]:
        """Everyone who has a token."""
        return tuple(self._clients.values())

    def client(self, token: str) -> Client | None:
        """Whose token it is, found in a time that tells nothing of how near a guess came."""
        presented = _hash(token)
        found = None
        for known, client in self._clients.items():
            if hmac.compare_digest(known, presented):
                found = client
        return found


def file_stamp(path: Path) -> tuple[int, int] | None:
    """What changes when a file is written anew; None where there is none."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_mtime_ns, found.st_ino


def read_tokens(path: Path, *, missing_ok: bool = False) -> Tokens:
    """The tokens of a file; with `missing_ok`, none where there is no file, for the last one was revoked.

    Raises
    ------
    ConfigError
        Where it cannot be read, is open to others, or holds something else.
    """
    if missing_ok and not path.exists():
        return Tokens({})
    text = _read_secret(path, "make a token with `livessl keys token`")
    return Tokens({bytes.fromhex(entry.sha256): _client(entry) for entry in _entries(path, text)})


def add_token(path: Path, name: str, role: RoleName) -> str:
    """Make a token, write its hash into a file, and return it: nobody will see it again.

    Raises
    ------
    ConfigError
        Where the name is taken, or the file cannot be used.
    """
    _check_name(name)
    held = _entries(path, _read_secret(path, "")) if path.exists() else ()
    if any(entry.name == name for entry in held):
        raise _fault(path, f"a token named {name!r} is there already; choose another --name, or revoke it first")
    token = TOKEN_PREFIX + secrets.token_urlsafe(TOKEN_BYTES)
    _write_tokens(path, (*held, _Entry(name=name, role=role, sha256=_hash(token).hex())))
    return token


def revoke_token(path: Path, name: str) -> None:
    """Take a token away.

    Raises
    ------
    ConfigError
        Where there is none of that name.
    """
    held = _entries(path, _read_secret(path, "there is no token to revoke"))
    left = tuple(entry for entry in held if entry.name != name)
    if len(left) == len(held):
        raise _fault(path, f"no token named {name!r}; there are {', '.join(entry.name for entry in held) or 'none'}")
    _write_tokens(path, left)


def make_server_keys(directory: Path) -> bytes:
    """Make the server's pair in the keys folder, and return the public half.

    Raises
    ------
    ConfigError
        Where there is one already: nodes know it, and would be locked out.
    """
    return _make_pair(directory, SERVER)


def make_node_keys(directory: Path, name: str, server: bytes | None = None) -> bytes:
    """Make a node's pair in the keys folder, and return the public half.

    Parameters
    ----------
    directory : Path
        The keys folder.
    name : str
        The node's, in the site file; `replay` for who plays sessions to a server.
    server : bytes or None
        The server's public key; None where `server.public` lies in the folder already.

    Raises
    ------
    ConfigError
        Where the node has a pair already, or the server's public key is not known.
    """
    _check_name(name)
    if name == SERVER:
        raise _fault(directory, "a node cannot be named 'server': that is the server's own pair; rename it")
    if server is not None:
        _write(directory / f"{SERVER}.public", server.hex() + "\n", 0o644)
    _read_public(directory / f"{SERVER}.public")
    return _make_pair(directory, name)


def enrol(directory: Path, name: str, public: bytes) -> None:
    """Let a node in, on the server; a key that it had before is let in no longer."""
    _check_name(name)
    _write_nodes(directory, {**enrolled(directory), name: public})


def dismiss(directory: Path, name: str) -> None:
    """Let a node in no longer.

    Raises
    ------
    ConfigError
        Where it was not enrolled.
    """
    held = enrolled(directory)
    if name not in held:
        raise _fault(directory / NODES_FILE, f"no node {name!r} is enrolled; there are {', '.join(held) or 'none'}")
    _write_nodes(directory, {other: key for other, key in held.items() if other != name})


def server_keys(site: Site) -> ServerKeys | None:
    """What the server needs; None where the site uses no keys.

    Raises
    ------
    ConfigError
        Where the server has no pair, or a file cannot be used.
    """
    if site.keys is None:
        return None
    directory = site.file(site.keys)
    return ServerKeys(_read_pair(directory, SERVER, "`livessl keys server`"), enrolled(directory))


def node_keys(site: Site, name: str) -> NodeKeys | None:
    """What a node needs; None where the site uses no keys.

    Raises
    ------
    ConfigError
        Where the node has no pair, the server's public key is missing, or a file cannot be used.
    """
    if site.keys is None:
        return None
    directory = site.file(site.keys)
    own = _read_pair(directory, name, f"`livessl keys node {name}`")
    return NodeKeys(own, _read_public(directory / f"{SERVER}.public"))


def enrolled(directory: Path) -> dict[str, bytes]:
    """Public keys of the nodes that are let in, by name.

    Raises
    ------
    ConfigError
        Where their file holds something else.
    """
    path = directory / NODES_FILE
    if not path.exists():
        return {}
    try:
        data = read_yaml(path.read_text(encoding="utf-8"))
        return {str(name): as_key(str(text)) for name, text in dict(data or {}).items()}
    except (OSError, UnicodeDecodeError, yaml.YAMLError, TypeError, ValueError) as error:
        what = f"expected NAME: PUBLIC KEY a line: {error}; correct it with `livessl keys enrol`"
        raise _fault(path, what) from error


def as_key(text: str) -> bytes:
    """The public key of a text.

    Raises
    ------
    ValueError
        Where it is none.
    """
    if not _KEY.fullmatch(text):
        raise ValueError(f"expected a public key of 64 hexadecimal digits, got {len(text)} characters")
    return bytes.fromhex(text)


def _client(entry: _Entry) -> Client:
    return Client(entry.name, Role[entry.role.upper()])


def _hash(token: str) -> bytes:
    return hashlib.sha256(token.encode("utf-8", "surrogateescape")).digest()


def _entries(path: Path, text: str) -> tuple[_Entry, ...]:
    try:
        entries = _TokensFile.model_validate(read_yaml(text)).tokens
    except yaml.YAMLError:
        raise _fault(path, "not valid YAML; make it with `livessl keys token`") from None
    except ValidationError as error:  # which place, but never what stands there
        faults = [Fault(f"{path}: {'.'.join(map(str, item['loc']))}", item["msg"]) for item in error.errors()]
        raise ConfigError(faults) from None
    names = [entry.name for entry in entries]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise _fault(path, f"expected each name once, got {twice!r} twice; take one away")
    return entries


def _write_tokens(path: Path, entries: tuple[_Entry, ...]) -> None:
    if not entries:
        path.unlink()
        return
    data = {"tokens": [entry.model_dump() for entry in entries]}
    head = "# Made by `livessl keys token`: hashes of the clients' tokens, which are kept nowhere.\n"
    _write(path, head + yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=200), 0o600)


def _write_nodes(directory: Path, nodes: Mapping[str, bytes]) -> None:
    lines = "".join(f'{name}: "{key.hex()}"\n' for name, key in sorted(nodes.items()))
    head = "# Made by `livessl keys enrol`: the public keys of the nodes that the server lets in.\n"
    _write(directory / NODES_FILE, head + lines, 0o600)


def _make_pair(directory: Path, name: str) -> bytes:
    secret_path = directory / f"{name}.secret"
    if secret_path.exists():
        raise _fault(secret_path, "is there already and would be lost; move it away to make a new one")
    public, secret = (z85.decode(half) for half in zmq.curve_keypair())
    _write(secret_path, secret.hex() + "\n", 0o600)
    _write(directory / f"{name}.public", public.hex() + "\n", 0o644)
    return public


def _read_pair(directory: Path, name: str, maker: str) -> KeyPair:
    path = directory / f"{name}.secret"
    text = _read_secret(path, f"make it with {maker}").strip()
    if not _KEY.fullmatch(text):
        raise _fault(path, f"expected a secret key of 64 hexadecimal digits, got something else; make it with {maker}")
    secret = bytes.fromhex(text)
    return KeyPair(z85.decode(zmq.curve_public(z85.encode(secret))), secret)


def _read_public(path: Path) -> bytes:
    try:
        return as_key(path.read_text(encoding="utf-8").strip())
    except (OSError, UnicodeDecodeError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        cure = "`livessl keys server` on the server tells it; give it to `livessl keys node --server`"
        raise _fault(path, f"the server's public key cannot be read: {reason}; {cure}") from error


def _read_secret(path: Path, cure: str) -> str:
    try:
        mode = path.stat().st_mode & 0o777
        if mode & 0o077:
            raise _fault(path, f"can be used by others (mode {mode:o}); chmod 600 it")
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "not a text file"
        raise _fault(path, f"cannot be read: {reason}; {cure}") from error


def _write(path: Path, text: str, mode: int) -> None:
    """Write a whole file or nothing; it is never, for no moment, open to others."""
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    part = path.with_name(path.name + ".part")
    part.unlink(missing_ok=True)
    with os.fdopen(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "w", encoding="utf-8") as file:
        file.write(text)
    part.replace(path)


def _check_name(name: str) -> None:
    if not _NAME.fullmatch(name):
        raise ConfigError([Fault(repr(name), "expected a name of 1 to 64 letters, digits, '.', '_' or '-'")])


def _fault(path: Path, what: str) -> ConfigError:
    return ConfigError([Fault(str(path), what)])
