"""Complete messages for tests that publish or store their own: the fields that a server would send."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from livessl.core.types import Estimate, Event, Status, Update
from livessl.server.api.encode import JsonObject, Messages
from small_site import site_of

START_NS = 1_767_225_600_000_000_000
ESTIMATE = Estimate(START_NS, np.array([2.0, 2.0, 1.0]), np.eye(3) * 0.01, 0.5, ("north", "south"))


def event_message(**changes: Any) -> JsonObject:
    """A located event outside every zone, changed."""
    return {**_event(), **changes}


def update_message(**changes: Any) -> JsonObject:
    """A located update outside every zone, changed."""
    return {**_update(), **changes}


@cache
def _event() -> JsonObject:
    end_ns = START_NS + 400_000_000
    event = Event("small-1", START_NS, end_ns, Status.LOCATED, None, ESTIMATE, power=0.01, method="onset")
    return Messages(site_of(), START_NS, utc=True).event(event)


@cache
def _update() -> JsonObject:
    update = Update("small-1", Status.LOCATED, ESTIMATE, power=0.01)
    return Messages(site_of(), START_NS, utc=True).update(update)


def small_event(number: int, **changes: object) -> JsonObject:
    """The event of the small site with a number as its id."""
    return event_message(id=f"small-{number}", **changes)
