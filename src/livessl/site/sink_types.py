"""The registry of sinks by their `type` in the site file. Checking a site file imports this module, but no sink."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

SINKS: Final[dict[str, str | Callable[..., object]]] = {"jsonl": "livessl.server.sinks:JsonLines"}
"""Maps the `type` in a site file to a factory, which gets a `SinkConfig` and returns a `livessl.server.sinks.Sink`.

A factory is a callable, or the text "module:attribute" of one that is imported when a server opens the sink."""


def check_sink_type(name: str) -> str:
    """Return the name of a type of sink.

    Raises
    ------
    ValueError
        If there is no such type.
    """
    if name not in SINKS:
        raise ValueError(f"expected {' or '.join(map(repr, SINKS))}, got {name!r}")
    return name
