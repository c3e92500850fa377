"""The rate of messages that one server's fan-out and sockets deliver to many clients, and the cost of each.

    python benchmarks/fanout.py --clients 50 --seconds 5 --arrays 2

The real application (routes, fan-out, uvicorn's settings) publishes updates as fast as its event loop can. The clients
are a process of their own and only count. The figures are for a server on one core, so pin it to one (taskset).
"""

from __future__ import annotations

import argparse
import asyncio
import multiprocessing
import resource
from multiprocessing.connection import Connection
from threading import Thread
from typing import Any

import numpy as np
from websockets.asyncio.client import connect

from livessl.clock import SystemClock
from livessl.core.types import Contribution, Estimate, Status, Update
from livessl.lab.bench import load
from livessl.server.api.encode import JsonObject, Messages, Stages
from livessl.server.app import Server
from livessl.server.fanout import LAGGING
from livessl.site.load import parse_site

CLOCK = SystemClock()


def update_of(arrays: int) -> JsonObject:
    """Return an update as it is published when a number of arrays contribute."""
    site = parse_site(load.site_text(arrays, 0.5, "tcp://127.0.0.1:5570", 8000))
    names = tuple(site.arrays)
    estimate = Estimate(10**18, np.array([1.234, 5.678, 1.5]), 0.0123 * np.eye(3), 0.61, names)
    contributions = tuple(Contribution(name, 0.2, 1e-3, 12.3, 4.5, 2.345) for name in names)
    update = Update("lab-1", Status.LOCATED, estimate, 1e-3, contributions, 10**18)
    return Messages(site, 0, utc=True).update(update, Stages(0.0, 0.001, 0.001, 0.001))


def count(url: str, clients: int, seconds: float, parent: Connection) -> None:
    """Count messages and bytes of many clients, in a process of its own; send the sums to the parent."""
    parent.send(asyncio.run(_count(url, clients, seconds, parent)))


async def _count(url: str, clients: int, seconds: float, parent: Connection) -> tuple[int, int]:
    address = f"ws{url.removeprefix('http')}/api/v1/live?kinds=update"
    sockets = await asyncio.gather(*(connect(address, compression=None) for _ in range(clients)))
    parent.send(None)
    counts = await asyncio.gather(*(_one(socket, seconds) for socket in sockets))
    await asyncio.gather(*(socket.close() for socket in sockets))
    return sum(messages for messages, _ in counts), sum(size for _, size in counts)


async def _one(socket: Any, seconds: float) -> tuple[int, int]:
    messages = size = 0
    end_ns = CLOCK.monotonic_ns() + round(seconds * 1e9)
    while (left_s := (end_ns - CLOCK.monotonic_ns()) / 1e9) > 0:
        try:
            size += len(await asyncio.wait_for(socket.recv(), left_s))
        except TimeoutError:
            break
        messages += 1
    return messages, size


async def publish(server: Server, message: JsonObject, until_ns: int) -> int:
    """Publish bursts of updates as fast as they are sent to the clients; return their number."""
    fanout, published = server.parts.fanout, 0
    while CLOCK.monotonic_ns() < until_ns:
        for _ in range(LAGGING // 2):
            fanout.publish(message, CLOCK.monotonic_ns())
            published += 1
        while fanout.lags:
            await asyncio.sleep(0)
    return published


def processor_s() -> float:
    """Return the processor time of this process so far, in seconds."""
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


def main() -> None:
    """Measure and print a line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--clients", type=int, default=50)
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument(
        "--arrays", type=int, default=2, help="arrays that contribute to an update, which decide its size"
    )
    arguments = parser.parse_args()
    site = parse_site(load.site_text(arguments.arrays, 0.5, "tcp://127.0.0.1:*", 0))
    message = update_of(arguments.arrays)
    server = Server(site, CLOCK)
    running = Thread(target=server.run)
    running.start()
    ours, theirs = multiprocessing.get_context("spawn").Pipe()
    counting = multiprocessing.get_context("spawn").Process(
        target=count, args=(server.url, arguments.clients, arguments.seconds, theirs)
    )
    counting.start()
    try:
        ours.recv()
        assert server.loop is not None
        began_s, until_ns = processor_s(), CLOCK.monotonic_ns() + round(arguments.seconds * 1e9)
        published = asyncio.run_coroutine_threadsafe(publish(server, message, until_ns), server.loop).result()
        used_s = processor_s() - began_s
        got, size = ours.recv()
        counting.join()
    finally:
        server.stop()
        running.join()
    sent = published * arguments.clients
    print(
        f"{arguments.clients} clients, {size / max(1, got):.0f} bytes: {got / arguments.seconds:,.0f} messages/s; "
        f"{1e6 * used_s / max(1, sent):.1f} us of the server's processor time each"
    )


if __name__ == "__main__":
    main()
