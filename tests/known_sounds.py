"""Sounds at known places of the small site, as a server hears them: for the tests of live calibration."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

from livessl import offline
from livessl.clock import SystemClock, UnpacedClock
from livessl.core.types import Event, FloatArray
from livessl.recordings.assign import AssignedRecording
from livessl.recordings.recording import MemoryRecording
from livessl.server.app import Server
from small_site import RATE_HZ, heard, scene, site_of

COUNT = 8
CLOCK = SystemClock()
LATER_NS = 5_000_000_000
"""Sounds begin so long after they are handed to the server: after any prompt that is being printed meanwhile."""


@cache
def events(order: tuple[int, ...] = (0, 1, 2, 3), count: int = COUNT) -> tuple[Event, ...]:
    """The events of a scene, with what the arrays received; the channels of 'south' are plugged in in this order."""
    samples = {"north": heard("north", count), "south": heard("south", count)[list(order)]}
    parts = [
        AssignedRecording(name, MemoryRecording(name, float(RATE_HZ), one), 0, (1, 2, 3, 4))
        for name, one in samples.items()
    ]
    outputs = offline.run(site_of(), parts, UnpacedClock())
    return tuple(output for output in outputs if isinstance(output, Event) and output.source == 1)


def places_m() -> list[FloatArray]:
    """Where the sounds were made."""
    return [source.position_m for source in scene(COUNT).sources]


def finish(server: Server, event: Event) -> int:
    """Have a server finish this event now; return the number of the sound."""
    start_ns = CLOCK.now_ns() + LATER_NS
    server.parts.set_up_watch.take(replace(event, start_ns=start_ns, end_ns=start_ns + 400_000_000))
    return server.parts.set_up_watch.heard.last


def at(count: int = COUNT) -> list[str]:
    """Options of `livessl calibrate` that give the places."""
    return [f"--at={','.join(f'{x:.3f}' for x in place_m)}" for place_m in places_m()[:count]]
