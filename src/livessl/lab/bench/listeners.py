"""Many clients of a server in one process, and the age of the messages that they receive."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from typing import Any, Final

import orjson
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed

from livessl.clock import SystemClock, utc_ns

STAGES: Final = ("sent", "received", "located")
"""Stages of latency that an update reports."""

GRACE_S: Final = 2.0
"""Time, in seconds, for messages still on their way after the end of the measured time."""


@dataclass(slots=True)
class Received:
    """What the clients of a process received: updates of windows that ended in the measured time, and all else.

    Parameters
    ----------
    latencies_s : list of float
        Time from the window's end to the client, for each update and client.
    stages_s : dict of str to list of float
        Stages that the first client's updates report; `delivered` is the rest of the latency.
    updates, events, gaps, pictures : int
        Sums over all clients: updates, events, missed messages, maps.
    """

    latencies_s: list[float] = field(default_factory=list)
    stages_s: dict[str, list[float]] = field(default_factory=lambda: {name: [] for name in (*STAGES, "delivered")})
    updates: int = 0
    events: int = 0
    gaps: int = 0
    pictures: int = 0


def listen(url: str, clients: int, watchers: int, parent: Connection) -> None:
    """Run many clients, in a process of its own.

    It sends `None` when it is ready, receives the beginning and the end of the measured time (site times), and sends
    what it `Received`.
    """
    parent.send(None)
    from_ns, until_ns = parent.recv()
    parent.send(asyncio.run(_listen(url, clients, watchers, from_ns, until_ns)))


async def _listen(url: str, clients: int, watchers: int, from_ns: int, until_ns: int) -> Received:
    received = Received()
    address = f"ws{url.removeprefix('http')}/api/v1"
    async with AsyncExitStack() as open_, asyncio.TaskGroup() as tasks:
        for number in range(clients):
            socket = await open_.enter_async_context(connect(f"{address}/live?kinds=update,event", compression=None))
            tasks.create_task(_follow(socket, received, from_ns, until_ns, first=number == 0))
        for _ in range(watchers):
            socket = await open_.enter_async_context(connect(f"{address}/map", compression=None))
            tasks.create_task(_watch(socket, received, until_ns))
    return received


async def _follow(socket: Any, received: Received, from_ns: int, until_ns: int, *, first: bool) -> None:
    clock = SystemClock()
    async for data in _messages(socket, until_ns):
        now_ns = clock.now_ns()
        message = orjson.loads(data)
        if message["kind"] == "event":
            received.events += 1
        elif message["kind"] == "gap":
            received.gaps += message["missed"]
        elif message["kind"] == "update":
            end_ns = utc_ns(message["end_utc"])
            if not from_ns < end_ns <= until_ns:
                continue
            received.updates += 1
            latency_s = (now_ns - end_ns) / 1e9
            received.latencies_s.append(latency_s)
            stages = message["latency_stages_s"]
            if first and stages is not None:
                for name in STAGES:
                    received.stages_s[name].append(stages[name])
                received.stages_s["delivered"].append(latency_s - message["latency_s"])


async def _watch(socket: Any, received: Received, until_ns: int) -> None:
    async for _ in _messages(socket, until_ns):
        received.pictures += 1


async def _messages(socket: Any, until_ns: int) -> AsyncIterator[bytes | str]:
    """Yield messages until a grace time after the end."""
    clock = SystemClock()
    while (left_s := (until_ns - clock.now_ns()) / 1e9 + GRACE_S) > 0:
        try:
            data = await asyncio.wait_for(socket.recv(), left_s)
        except (TimeoutError, ConnectionClosed):
            return
        yield data
