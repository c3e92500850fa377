"""A TCP proxy that misbehaves on purpose: delay, stalls as of lost packets, partitions, torn connections."""

from __future__ import annotations

import asyncio
import random
import threading
from collections.abc import Coroutine
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Self

from small_site import HANG_S


@dataclass
class Weather:
    """How the network is, now.

    Parameters
    ----------
    jitter_s : float
        Greatest extra delay of a piece of data, seconds; order is kept, as TCP keeps it.
    loss : float
        Share of pieces of which a packet is lost: they, and what follows, wait for it to be sent again.
    retransmit_s : float
        How long that takes, seconds: TCP's least time-out is 0.2 s.
    cut : bool
        Nothing passes, and nobody is told.
    """

    jitter_s: float = 0.0
    loss: float = 0.0
    retransmit_s: float = 0.2
    cut: bool = False


class Proxy:
    """Listens on a port of its own and hands on to another.

    Parameters
    ----------
    target : (str, int)
        Host and port.
    seed : int
        Of delays and losses.
    """

    def __init__(self, target: tuple[str, int], seed: int = 0) -> None:
        self.weather = Weather()
        self._target = target
        self._rng = random.Random(seed)
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="proxy", daemon=True)
        self._writers: set[asyncio.StreamWriter] = set()
        self._tasks: set[asyncio.Task[None]] = set()
        self.connections = 0
        self.port = 0

    def __enter__(self) -> Self:
        self._thread.start()
        self._server = self._call(asyncio.start_server(self._serve, "127.0.0.1", 0))
        self.port = self._server.sockets[0].getsockname()[1]
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._call(self._close())
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(timeout=HANG_S)
        self._loop.close()

    @property
    def endpoint(self) -> str:
        """ZeroMQ's name of it."""
        return f"tcp://127.0.0.1:{self.port}"

    def tear(self) -> None:
        """Reset every connection, in the middle of whatever was on its way."""
        self._call(self._tear())

    def _call(self, work: Coroutine[Any, Any, Any]) -> Any:
        return asyncio.run_coroutine_threadsafe(work, self._loop).result(timeout=HANG_S)

    async def _close(self) -> None:
        self._server.close()
        await self._tear()
        for task in list(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    async def _tear(self) -> None:
        for writer in list(self._writers):
            writer.transport.abort()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._tasks.add(task)
        try:
            while self.weather.cut:  # the handshake does not get through either
                await asyncio.sleep(0.02)
            there_reader, there_writer = await asyncio.open_connection(*self._target)
        except (OSError, asyncio.CancelledError):  # nobody listens, or the proxy closes
            writer.transport.abort()
            self._tasks.discard(task)
            return
        self.connections += 1
        self._writers |= {writer, there_writer}
        try:
            await asyncio.gather(self._pump(reader, there_writer), self._pump(there_reader, writer))
        except (OSError, asyncio.CancelledError):  # asyncio prints a handler that was cancelled as an error
            pass
        finally:
            for end in (writer, there_writer):
                end.transport.abort()
                self._writers.discard(end)
            self._tasks.discard(task)

    async def _pump(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Read and hand on apart, so that a delay is one and not a lower rate."""
        queue: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue(1000)
        feeding = asyncio.create_task(self._feed(reader, queue))
        try:
            while True:
                due_s, data = await queue.get()
                await asyncio.sleep(due_s - self._loop.time())
                while self.weather.cut:
                    await asyncio.sleep(0.02)
                if not data:
                    raise ConnectionResetError
                writer.write(data)
                await writer.drain()
        finally:
            feeding.cancel()
            await asyncio.gather(feeding, return_exceptions=True)

    async def _feed(self, reader: asyncio.StreamReader, queue: asyncio.Queue[tuple[float, bytes]]) -> None:
        last_s = 0.0
        data = b"begun"
        while data:
            try:
                data = await reader.read(16_384)
            except OSError:
                data = b""
            weather = self.weather
            delay_s = self._rng.uniform(0.0, weather.jitter_s)
            while self._rng.random() < weather.loss:
                delay_s += weather.retransmit_s
            last_s = max(last_s, self._loop.time() + delay_s)
            await queue.put((last_s, data))
