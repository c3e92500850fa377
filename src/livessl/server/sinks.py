"""Sinks: destinations of events other than the store and the API, such as a file of JSON lines.

To add a sink, write a class with the methods of `Sink` here, and add it by name to the registry
`livessl.site.sink_types.SINKS`. The name is the `type` in the site file (`server.sinks`). The constructor gets the
`SinkConfig` of the site file; settings other than `path` are added to that model in `livessl.site.server_models`.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from pathlib import Path
from pkgutil import resolve_name
from typing import Protocol, cast

from livessl.errors import RunError
from livessl.server.api.encode import JsonObject
from livessl.site.server_models import SinkConfig
from livessl.site.sink_types import SINKS

_log = logging.getLogger(__name__)


class SinkError(RunError):
    """A sink that cannot be opened."""


class Sink(Protocol):
    """Receives events, one at a time, on the fusion thread."""

    def take(self, event: JsonObject) -> None:
        """Deliver one event."""
        ...

    def close(self) -> None:
        """Deliver buffered events, and close files and connections."""
        ...


class JsonLines:
    """Appends each event as a line of JSON to a file that `tail -f` and every log shipper can follow."""

    def __init__(self, config: SinkConfig) -> None:
        try:
            self._file = Path(config.path).open("a", encoding="utf-8")  # noqa: SIM115 - closed by close()
        except OSError as error:
            raise SinkError(f"server.sinks: cannot append to {config.path}: {error.strerror}") from error

    def take(self, event: JsonObject) -> None:
        """Append a line and hand it to the operating system."""
        self._file.write(json.dumps(event, separators=(",", ":")) + "\n")
        self._file.flush()

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class Sinks:
    """All sinks of a site. A failure of one sink is logged and counted, and does not affect the others."""

    def __init__(self, configs: Sequence[SinkConfig]) -> None:
        self._sinks = [(config.type, _opened(config)) for config in configs]
        self.failures = 0
        """Number of times that a sink failed to take an event."""

    def take(self, event: JsonObject) -> None:
        """Deliver an event to every sink."""
        for name, sink in self._sinks:
            try:
                sink.take(event)
            except OSError as error:
                self.failures += 1
                _log.error("sink %r did not take event %s: %s", name, event["id"], error)

    def close(self) -> None:
        """Close every sink."""
        for name, sink in self._sinks:
            try:
                sink.close()
            except OSError as error:
                _log.error("sink %r was not closed cleanly: %s", name, error)


def _opened(config: SinkConfig) -> Sink:
    factory = SINKS[config.type]
    make = resolve_name(factory) if isinstance(factory, str) else factory
    return cast(Sink, make(config))
