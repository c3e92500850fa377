"""Events of the servers of a hall, as a hub gets them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import orjson

from alert_desk import encoded, sound
from livessl.core.types import Status
from livessl.federation.storing import Delivery
from livessl.server.api.encode import JsonObject
from livessl.server.forwarding.stream import Place


def hall_event(
    name: str,
    position_m: Sequence[float] | None = (2.0, 2.0, 1.0),
    *,
    hall: str = "works",
    in_tile: bool = True,
    heard_by: Sequence[str] = ("north", "south"),
    **changes: Any,
) -> JsonObject:
    """An event of 0.5 s with its hall."""
    status = Status.REFUSED if position_m is None else Status.LOCATED
    made = encoded(sound(position_m=position_m, event_id=name, **{"status": status, **changes}))
    return {**made, "heard_by": list(heard_by), "hall": {"name": hall, "in_tile": in_tile}}


def delivered(site: str, number: int, event: JsonObject) -> Delivery:
    """An event on its way to the hub."""
    return Delivery(site, "event", Place("a", number), orjson.dumps(event))
