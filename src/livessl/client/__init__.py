"""A client of a running server: typed messages that survive a lost connection and a restarted server.

    from livessl import client

    with client.connect("http://127.0.0.1:8000", kinds=["event"]) as live:
        for event in live:
            if isinstance(event, client.Event):  # a Gap comes whichever kinds are asked for
                print(event.time_utc, event.status, event.position_m)

`aconnect` does the same with `async with` and `async for`. This package needs Pydantic and `websockets`, and nothing of
the server. Each name below is loaded when it is first used, so that the import takes no time.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from livessl.client.address import RefusedError, UnreachableError
    from livessl.client.aio import AsyncClient, aconnect
    from livessl.client.options import Options
    from livessl.client.reading import ForeignAnswerError, NewerServerError
    from livessl.client.resumption import Received
    from livessl.client.sync import Client, connect
    from livessl.schema.alerts import Alert
    from livessl.schema.answers import Arrays, Health, HealthStatus, Site, Tracks
    from livessl.schema.messages import (
        ArraysMessage,
        EventMessage,
        Gap,
        Hello,
        PosesMessage,
        TrackMessage,
        UpdateMessage,
        ZoneMessage,
        ZonesMessage,
    )
    from livessl.schema.values import Event

__all__ = [
    "Alert",
    "Arrays",
    "ArraysMessage",
    "AsyncClient",
    "Client",
    "Event",
    "EventMessage",
    "ForeignAnswerError",
    "Gap",
    "Health",
    "HealthStatus",
    "Hello",
    "NewerServerError",
    "Options",
    "PosesMessage",
    "Received",
    "RefusedError",
    "Site",
    "TrackMessage",
    "Tracks",
    "UnreachableError",
    "UpdateMessage",
    "ZoneMessage",
    "ZonesMessage",
    "aconnect",
    "connect",
]

_HOMES: Final = {
    "client.address": ("RefusedError", "UnreachableError"),
    "client.aio": ("AsyncClient", "aconnect"),
    "client.options": ("Options",),
    "client.reading": ("ForeignAnswerError", "NewerServerError"),
    "client.resumption": ("Received",),
    "client.sync": ("Client", "connect"),
    "schema.alerts": ("Alert",),
    "schema.answers": ("Arrays", "Health", "HealthStatus", "Site", "Tracks"),
    "schema.messages": (
        "ArraysMessage",
        "EventMessage",
        "Gap",
        "Hello",
        "PosesMessage",
        "TrackMessage",
        "UpdateMessage",
        "ZoneMessage",
        "ZonesMessage",
    ),
    "schema.values": ("Event",),
}
"""The names of each module, below `livessl`."""


def __getattr__(name: str) -> Any:
    home = next((home for home, names in _HOMES.items() if name in names), None)
    if home is None:
        raise AttributeError(f"module 'livessl.client' has no attribute {name!r}")
    value = getattr(import_module(f"livessl.{home}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
