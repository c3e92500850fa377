"""Publishes what simulated sites send, and asks the stream how far a hub is with it."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Coroutine, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from itertools import chain, islice
from typing import TYPE_CHECKING, Final

from hub_sites import MESSAGES_PER_HOUR, MIN_PACE, SimulatedSite
from livessl.federation.storing import Delivery
from livessl.server.forwarding.link import REPORT_S, WINDOW
from livessl.server.forwarding.stream import CONSUMER, HEALTH, MESSAGE_ID, STREAM, message_id, subject

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from nats.aio.client import Client
    from nats.js import JetStreamContext

CONNECTIONS: Final = 4
"""Connections that all simulated sites share; real ones have one each."""

LOOK_S: Final = 0.2
"""Interval, in seconds, at which the stream is asked how far the hub is."""


@dataclass
class Progress:
    """What the sites have published, and how far the hub is."""

    stream: JetStreamContext
    sent: dict[int, float] = field(default_factory=dict)
    """When each message was handed to NATS, by its number in the stream."""
    events: int = 0
    lags_s: list[float] = field(default_factory=list)
    """Ages of the oldest message that the hub has not taken in, at each look."""
    most_waiting: int = 0
    taken: int = 0
    """Number of the last message in the stream before which the hub has taken in all."""

    async def look(self) -> int:
        """Ask the stream how many messages wait for the hub; return that."""
        info = await self.stream.consumer_info(STREAM, CONSUMER)
        waiting = int(info.num_pending or 0) + int(info.num_ack_pending or 0)
        self.taken = int(info.ack_floor.stream_seq) if info.ack_floor else 0
        oldest = self.sent.get(self.taken + 1) if waiting else None
        self.lags_s.append(0.0 if oldest is None else time.perf_counter() - oldest)
        self.most_waiting = max(self.most_waiting, waiting)
        return waiting

    async def watch(self, end: asyncio.Event) -> None:
        """Look until the end."""
        while not end.is_set():
            await self.look()
            await asyncio.sleep(LOOK_S)

    async def drain(self, patience_s: float) -> bool:
        """Return whether the hub has taken everything in within some seconds."""
        until = time.perf_counter() + patience_s
        while await self.look():
            if time.perf_counter() > until:
                return False
            await asyncio.sleep(LOOK_S)
        return True


async def publish(progress: Progress, stream: JetStreamContext, window: Sequence[Delivery]) -> None:
    """Publish some messages as a site's server does, and wait until the stream has acknowledged all."""
    waiting, times = [], []
    for site, kind, place, body in window:
        times.append(time.perf_counter())
        headers = {MESSAGE_ID: message_id(place), "Nats-Expected-Stream": STREAM}
        waiting.append(await stream.publish_async(subject(site, kind), body, headers=headers))
        progress.events += kind == "event"
    for each, sent in zip(await asyncio.gather(*waiting), times, strict=True):
        progress.sent[each.seq] = sent


async def publish_at_once(
    progress: Progress, stream: JetStreamContext, sites: Sequence[SimulatedSite], minutes: int
) -> None:
    """Publish the first minutes of some sites in windows, as fast as the stream acknowledges them."""
    following = (message for _ in range(minutes) for site in sites for message in site.minute())
    messages = chain((message for site in sites for message in site.begin()), following)
    while window := list(islice(messages, WINDOW)):
        await publish(progress, stream, window)


async def publish_paced(
    progress: Progress, sites: Sequence[SimulatedSite], seconds: float, times_real: float = 1.0
) -> float:
    """Publish at the pace of real time or a multiple of it, site by site; return the messages of a second."""
    rate = max(MIN_PACE, times_real * len(sites) * MESSAGES_PER_HOUR / 3600)
    begun, count = time.perf_counter(), 0
    messages = (message for number in range(10**9) for message in sites[number % len(sites)].minute())
    while (passed := time.perf_counter() - begun) < seconds:
        due = round(passed * rate) - count
        if due > 0:
            due = min(due, WINDOW)
            await publish(progress, progress.stream, list(islice(messages, due)))
            count += due
        await asyncio.sleep(0.01)
    return rate


async def report(client: Client, sites: Sequence[SimulatedSite], end: asyncio.Event) -> None:
    """Publish the reports of all sites on themselves, evenly spread, until the end."""
    begun, count = time.perf_counter(), 0
    while not end.is_set():
        due = int((time.perf_counter() - begun) / REPORT_S * len(sites))
        for number in range(count, due):
            site = sites[number % len(sites)]
            await client.publish(subject(site.name, HEALTH), site.report())
        count = due
        await asyncio.sleep(0.02)


@asynccontextmanager
async def meanwhile(work: Callable[[asyncio.Event], Coroutine[None, None, None]]) -> AsyncIterator[None]:
    """Do something while the context lasts; what fails in it fails here.

    The event tells it to end: Python 3.11 may lose a cancellation of what waits for an answer of NATS.
    """
    end = asyncio.Event()
    task = asyncio.create_task(work(end))
    try:
        yield
    finally:
        end.set()
        await task
