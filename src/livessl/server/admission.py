"""Decides which greetings of nodes are refused, and why. It keeps no state.

`guard` refuses peers before they can greet, because of their keys; `ingest` asks this module and replies.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

from livessl import wire
from livessl.site.models import Site

OTHER_KEY: Final = "its key belongs to another node"
OTHER_SITE: Final = "its site file differs from the server's"
IN_USE: Final = "its name or arrays are in use"
OTHER_VERSION: Final = "it runs another version of livessl"
"""Causes of refused greetings, as metrics name them."""

MOST_LISTED: Final = 10
"""Most arrays that a refusal lists: its text may have 1000 characters."""


@dataclass(frozen=True, slots=True)
class Refusal:
    """A refused greeting.

    Parameters
    ----------
    node : str
        Name of the node, as it says.
    arrays : tuple of str
        Arrays that the node would send.
    cause : str
        One of the few causes above.
    text : str
        The reason in full, with the cure.
    """

    node: str
    arrays: tuple[str, ...]
    cause: str
    text: str


def refusal_of(site: Site, hello: wire.Hello, enrolled: str | None, others: Iterable[wire.Hello]) -> Refusal | None:
    """Return why a greeting is refused; None if the node may join.

    Parameters
    ----------
    site : Site
        Contains the arrays and their nodes.
    hello : Hello
        The greeting.
    enrolled : str or None
        Node that owns the key of the connection; None if the site uses no keys.
    others : iterable of Hello
        Greetings of the other nodes that are connected.
    """
    checks = (
        (OTHER_KEY, _key_fault(site, hello, enrolled)),
        (OTHER_SITE, _array_fault(site, hello) or _rate_fault(site, hello)),
        (IN_USE, _conflict(hello, others)),
    )
    found = next(((cause, text) for cause, text in checks if text is not None), None)
    return None if found is None else Refusal(hello.node, tuple(hello.arrays), *found)


def refusal_of_version(error: wire.OtherVersionError) -> Refusal:
    """Return the refusal of a greeting of another version of the wire format."""
    which = "an older" if error.version < wire.VERSION else "a newer"
    text = (
        f"the node runs {which} livessl than the server (wire version {error.version}, the server's is "
        f"{wire.VERSION}); install the same version on both"
    )
    return Refusal(error.node, error.arrays, OTHER_VERSION, text)


def _key_fault(site: Site, hello: wire.Hello, enrolled: str | None) -> str | None:
    """Return the reason why the node may not use this key, which belongs to one node; None if it may."""
    if enrolled is None:
        return None
    if hello.node != enrolled:
        return f"node {hello.node!r} has shown the key of {enrolled!r}; give each node its own"
    foreign = next((a for a in hello.arrays if site.node_of(a) not in (None, enrolled)), None)
    if foreign is not None and not hello.replay:
        return f"array {foreign!r} belongs to node {site.node_of(foreign)!r} in the server's site file"
    return None


def _array_fault(site: Site, hello: wire.Hello) -> str | None:
    known = [spec.name for spec in site.processed]
    unknown = next((name for name in hello.arrays if name not in known), None)
    if unknown is None:
        return None
    joint = next((name for name, members in site.joint.items() if unknown in members), None)
    if joint is not None:
        return f"array {unknown!r} is joined in {joint!r} at the server; give node and server the same `joint`"
    listed = ", ".join(known[:MOST_LISTED]) + (f" and {len(known) - MOST_LISTED} more" if known[MOST_LISTED:] else "")
    return f"no array {unknown!r} in the server's site file; it has {listed}"


def _rate_fault(site: Site, hello: wire.Hello) -> str | None:
    for name, rate_hz in hello.arrays.items():
        node = site.node_of(name)
        stated_hz = site.nodes[node].device.sample_rate_hz if node else None
        if stated_hz is not None and rate_hz != stated_hz:
            where = f"nodes.{node}.device.sample_rate_hz"
            return f"array {name!r}: the server's site file says {stated_hz:g} Hz ({where}), got {rate_hz:g} Hz"
        high_hz = site.array(name).band_hz[1]
        if high_hz >= rate_hz / 2:
            needed = f"array {name!r} uses up to {high_hz:g} Hz and needs more than {2 * high_hz:g} Hz"
            return f"{needed}, got {rate_hz:g} Hz; correct the node's sample_rate_hz"
    return None


def _conflict(hello: wire.Hello, others: Iterable[wire.Hello]) -> str | None:
    """Return why the node cannot join beside the nodes that are connected; None if it can."""
    for other in others:
        if other.replay != hello.replay:
            return "live nodes are connected; stop them first" if hello.replay else "a replay is running"
        if other.node == hello.node:
            return f"a node named {hello.node!r} is connected already; names must differ"
        taken = sorted(set(other.arrays) & set(hello.arrays))
        if taken:
            return f"array {taken[0]!r} is captured by node {other.node!r} already"
    return None
