"""Makes and reads CURVE key pairs of server and nodes, and enrols or dismisses nodes. It opens no socket."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import yaml
import zmq
from zmq.utils import z85

from livessl.site.findings import read_yaml, reason
from livessl.site.models import Site
from livessl.site.secret_files import KEY, check_name, fault, read_secret, write_whole

SERVER: Final = "server"
"""Name of the server's own key pair, which no node may have."""

NODES_FILE: Final = "nodes.yaml"
"""File in the keys folder that holds the public keys of the enrolled nodes."""


@dataclass(frozen=True, slots=True)
class KeyPair:
    """A CURVE25519 key pair, 32 bytes each; its repr omits the secret half."""

    public: bytes
    secret: bytes = field(repr=False)


@dataclass(frozen=True, slots=True)
class ServerKeys:
    """Keys of the server: its own pair, and the public keys of the enrolled nodes by name."""

    own: KeyPair
    nodes: Mapping[str, bytes]


@dataclass(frozen=True, slots=True)
class NodeKeys:
    """Keys of a node: its own pair, and the server's public key."""

    own: KeyPair
    server: bytes


def make_server_keys(directory: Path) -> bytes:
    """Make the server's pair in the keys folder, and return the public half.

    Raises
    ------
    ConfigError
        If there is a pair already: a new one would lock out the nodes that know it.
    """
    return _make_pair(directory, SERVER)


def make_node_keys(directory: Path, name: str, server: bytes | None = None) -> bytes:
    """Make a node's pair in the keys folder, and return the public half.

    Parameters
    ----------
    directory : Path
        The keys folder.
    name : str
        Name of the node in the site file, or `replay` for the command that plays sessions to a server.
    server : bytes or None
        The server's public key; None if the folder holds `server.public` already.

    Raises
    ------
    ConfigError
        If the node has a pair already, or the server's public key is not known.
    """
    check_name(name)
    if name == SERVER:
        raise fault(directory, "a node cannot be named 'server': that is the server's own pair; rename it")
    if server is not None:
        write_whole(directory / f"{SERVER}.public", server.hex() + "\n", 0o644)
    _read_public(directory / f"{SERVER}.public")
    return _make_pair(directory, name)


def enrol(directory: Path, name: str, public: bytes) -> None:
    """Accept a node's public key on the server, in place of any earlier key of that node."""
    check_name(name)
    _write_nodes(directory, {**enrolled(directory), name: public})


def dismiss(directory: Path, name: str) -> None:
    """Stop accepting a node's key on the server.

    Raises
    ------
    ConfigError
        If the node is not enrolled.
    """
    held = enrolled(directory)
    if name not in held:
        raise fault(directory / NODES_FILE, f"no node {name!r} is enrolled; nodes are {', '.join(held) or 'none'}")
    _write_nodes(directory, {other: key for other, key in held.items() if other != name})


def server_keys(site: Site) -> ServerKeys | None:
    """Return the server's keys; None if the site uses no keys.

    Raises
    ------
    ConfigError
        If the server has no pair, or a file cannot be used.
    """
    if site.keys is None:
        return None
    directory = site.file(site.keys)
    return ServerKeys(_read_pair(directory, SERVER, "`livessl keys server`"), enrolled(directory))


def node_keys(site: Site, name: str, server: str | None = None) -> NodeKeys | None:
    """Return a node's keys; None if the site uses no keys.

    Parameters
    ----------
    site : Site
    name : str
        Name of the node.
    server : str or None
        File with the public key of a further server; None for the key of the node's own server.

    Raises
    ------
    ConfigError
        If the node has no pair, the server's public key is missing, or a file cannot be used.
    """
    if site.keys is None:
        return None
    directory = site.file(site.keys)
    own = _read_pair(directory, name, f"`livessl keys node {name}`")
    return NodeKeys(own, _read_public(directory / f"{SERVER}.public" if server is None else site.file(server)))


def enrolled(directory: Path) -> dict[str, bytes]:
    """Return the public keys of the nodes that the server accepts, by name.

    Raises
    ------
    ConfigError
        If their file holds something else.
    """
    path = directory / NODES_FILE
    if not path.exists():
        return {}
    try:
        data = read_yaml(path.read_text(encoding="utf-8"))
        return {str(name): as_key(str(text)) for name, text in dict(data or {}).items()}
    except (OSError, UnicodeDecodeError, yaml.YAMLError, TypeError, ValueError) as error:
        what = f"expected NAME: PUBLIC KEY a line: {error}; correct it with `livessl keys enrol`"
        raise fault(path, what) from error


def as_key(text: str) -> bytes:
    """Return the public key that a text holds.

    Raises
    ------
    ValueError
        If the text is not a key.
    """
    if not KEY.fullmatch(text):
        raise ValueError(f"expected a public key of 64 hexadecimal digits, got {len(text)} characters")
    return bytes.fromhex(text)


def _write_nodes(directory: Path, nodes: Mapping[str, bytes]) -> None:
    lines = "".join(f'{name}: "{key.hex()}"\n' for name, key in sorted(nodes.items()))
    head = "# Made by `livessl keys enrol`: the public keys of the nodes that the server accepts.\n"
    write_whole(directory / NODES_FILE, head + lines, 0o600)


def _make_pair(directory: Path, name: str) -> bytes:
    secret_path = directory / f"{name}.secret"
    if secret_path.exists():
        raise fault(secret_path, "exists already and would be lost; move it away to make a new one")
    public, secret = (z85.decode(half) for half in zmq.curve_keypair())
    write_whole(secret_path, secret.hex() + "\n", 0o600)
    write_whole(directory / f"{name}.public", public.hex() + "\n", 0o644)
    return public


def _read_pair(directory: Path, name: str, maker: str) -> KeyPair:
    path = directory / f"{name}.secret"
    text = read_secret(path, f"make it with {maker}").strip()
    if not KEY.fullmatch(text):
        raise fault(path, f"expected a secret key of 64 hexadecimal digits, got something else; make it with {maker}")
    secret = bytes.fromhex(text)
    return KeyPair(z85.decode(zmq.curve_public(z85.encode(secret))), secret)


def _read_public(path: Path) -> bytes:
    try:
        return as_key(path.read_text(encoding="utf-8").strip())
    except (OSError, UnicodeDecodeError, ValueError) as error:
        cure = "`livessl keys server` on the server prints it; pass it to `livessl keys node --server`"
        raise fault(path, f"the server's public key cannot be read: {reason(error)}; {cure}") from error
