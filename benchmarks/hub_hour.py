"""An hour of many sites at a multiple of its pace: how far behind a hub is, and what it takes, in the course of it."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Sequence
from contextlib import asynccontextmanager
from dataclasses import asdict, dataclass
from functools import partial
from typing import TYPE_CHECKING, Final

import nats

from history import Times
from hub_processes import World, measure_answers
from hub_publishing import CONNECTIONS, Progress, meanwhile, publish_at_once, publish_paced, report
from hub_sites import SimulatedSite
from livessl.server.api.encode import JsonObject
from livessl.server.forwarding.stream import STREAM
from processor_time import memory_mb

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from nats.js import JetStreamContext

PARTS: Final = 6
"""Parts of the hour that are measured each by itself."""


@dataclass(frozen=True)
class Hour:
    """Sites, minutes that they send, how many times as fast as in real time, and seconds to wait for the hub."""

    sites: int
    minutes: int
    times_real: float
    patience_s: float

    @property
    def part_s(self) -> float:
        """Length of a part, in seconds of this benchmark."""
        return 60.0 * self.minutes / self.times_real / PARTS


@asynccontextmanager
async def _connections(url: str) -> AsyncIterator[tuple[nats.NATS, Sequence[JetStreamContext]]]:
    """Connect as the sites do; yield a client, and a stream for each connection."""
    clients = [await nats.connect(url) for _ in range(CONNECTIONS)]
    try:
        yield clients[0], [client.jetstream(timeout=60.0) for client in clients]
    finally:
        for client in clients:
            await client.close()


async def measure_hour(world: World, hour: Hour) -> JsonObject:
    """Let sites start, and then send their messages at a multiple of the pace of real time.

    Their reports on themselves come at the pace of real time, as only the newest of each counts.
    """
    sites = [SimulatedSite(number) for number in range(hour.sites)]
    async with _connections(world.server.url) as (client, streams):
        progress = Progress(streams[0])
        async with meanwhile(partial(report, client, sites)), meanwhile(progress.watch):
            starts = (
                publish_at_once(progress, stream, sites[number::CONNECTIONS], 0)
                for number, stream in enumerate(streams)
                if sites[number::CONNECTIONS]
            )
            await asyncio.gather(*starts)
            assert await progress.drain(hour.patience_s), "the hub does not take in what sites send when they start"
            begun, sent, empty = time.perf_counter(), len(progress.sent), world.stored_bytes()
            parts = [await _measure_part(world, progress, sites, hour) for _ in range(PARTS)]
            is_drained = await progress.drain(hour.patience_s)
        took_s, published = time.perf_counter() - begun, len(progress.sent) - sent
        state = (await streams[0].stream_info(STREAM)).state
    return {
        "hour": hour.sites,
        "minutes": hour.minutes,
        "times_real": hour.times_real,
        "messages": published,
        "events": progress.events,
        "is_drained": is_drained,
        "took_s": took_s,
        "stream_bytes": state.bytes,
        "database_bytes": world.stored_bytes() - empty,
        "parts": [{"until_minute": hour.minutes * number / PARTS, **part} for number, part in enumerate(parts, 1)],
    }


async def _measure_part(world: World, progress: Progress, sites: Sequence[SimulatedSite], hour: Hour) -> JsonObject:
    progress.lags_s.clear()
    progress.most_waiting = 0
    before, begun, sent = world.processor_s(), time.perf_counter(), len(progress.sent)
    asking = asyncio.create_task(asyncio.to_thread(measure_answers, world, hour.sites, hour.part_s))
    await publish_paced(progress, sites, hour.part_s, hour.times_real)
    after, passed_s = world.processor_s(), time.perf_counter() - begun
    published = len(progress.sent) - sent
    return {
        "messages": published,
        "messages_per_s": published / passed_s,
        "lag": asdict(Times.of(progress.lags_s)),
        "most_waiting": progress.most_waiting,
        "processor_share": {name: (after[name] - before[name]) / passed_s for name in after},
        "hub_memory_mb": memory_mb(world.hub.process.pid),
        "answers": await asking,
    }
