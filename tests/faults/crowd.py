"""Clients of a soak's server over real sockets: readers, one that stalls, one that comes and goes, and others."""

from __future__ import annotations

import asyncio
import json
import socket
import threading
import urllib.request
from collections import Counter
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from types import TracebackType
from typing import Self

from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed

from clients import Listener, Log, open_client
from small_site import HANG_S

READERS = 3
"""Clients that read everything."""


class _Reader(Listener):
    """Counts events."""

    def __init__(self, heard: Counter[str]) -> None:
        super().__init__(Log())
        self._heard = heard

    def note(self, data: bytes, body: int, length: int, now_ns: int) -> None:
        self._heard["messages"] += 1
        self._heard["events"] += data.startswith(b'"kind":"event"', data.find(b'"kind"', body))


class Crowd:
    """Clients in a thread of their own: some that read, one that stalls, one that comes and goes, one that asks.

    Parameters
    ----------
    url : str
        The server's.
    """

    def __init__(self, url: str) -> None:
        host, port = url.removeprefix("http://").split(":")
        self._address = host, int(port)
        self._url = url
        self._live = f"ws{url.removeprefix('http')}/api/v1"
        self.heard: Counter[str] = Counter()
        self._connections: set[ClientConnection] = set()
        self._ended = threading.Event()
        self._failures: list[Exception] = []
        works = (self._listen, self._poll)
        self._threads = [threading.Thread(target=self._watched, args=[work], daemon=True) for work in works]

    def __enter__(self) -> Self:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ended.set()
        for thread in self._threads:
            thread.join(timeout=HANG_S)
        if self._failures and kind is None:
            raise ExceptionGroup("clients failed", self._failures)

    def _watched(self, work: Callable[[], None]) -> None:
        try:
            work()
        except Exception as failure:  # noqa: BLE001 - whatever it is, the run shall fail by it
            self._failures.append(failure)

    def _listen(self) -> None:
        asyncio.run(self._listen_all())

    async def _listen_all(self) -> None:
        loop = asyncio.get_running_loop()
        readers = [open_client(*self._address, None, "update,event,track,arrays") for _ in range(READERS)]
        listeners = [(await loop.create_connection(lambda: _Reader(self.heard), sock=each))[1] for each in readers]
        tasks = [asyncio.create_task(work) for work in (self._watch_map(), self._come_and_go(), self._stall())]
        while not self._ended.is_set():
            await asyncio.sleep(0.1)
            for task in tasks:
                if task.done():
                    task.result()  # nobody ends before the others
        for listener in listeners:
            listener.close()
        await asyncio.gather(*(each.close() for each in self._connections))
        await asyncio.gather(*tasks)

    async def _watch_map(self) -> None:
        async with self._connected(f"{self._live}/map") as connection:
            async for _ in connection:
                self.heard["maps"] += 1

    async def _come_and_go(self) -> None:
        address = f"{self._live}/live"
        while not self._ended.is_set():
            async with self._connected(address) as connection:
                try:
                    for _ in range(20):
                        seq = json.loads(await connection.recv()).get("seq")
                        address = address if seq is None else f"{self._live}/live?since_seq={seq}"
                    self.heard["visits"] += 1
                except ConnectionClosed:
                    self.heard["visits cut"] += 1
            await asyncio.sleep(2.0)

    @asynccontextmanager
    async def _connected(self, address: str) -> AsyncIterator[ClientConnection]:
        async with connect(address, compression=None, ping_interval=None) as connection:
            self._connections.add(connection)
            try:
                yield connection
            finally:
                self._connections.discard(connection)

    async def _stall(self) -> None:
        while not self._ended.is_set():
            with await asyncio.to_thread(open_client, *self._address, 4096) as lazy:
                while not (_hung_up(lazy) or self._ended.is_set()):
                    await asyncio.sleep(0.2)
            self.heard["stalled clients"] += 1

    def _poll(self) -> None:
        asked = ["health", "arrays", "events?limit=200", "tracks", "map", "../../metrics", "openapi.json"]
        for k in range(10**9):
            address = f"{self._url}/api/v1/{asked[k % len(asked)]}".replace("/api/v1/../..", "")
            with urllib.request.urlopen(address) as answer:
                answer.read()
            self.heard["answers"] += 1
            if self._ended.wait(4.0):
                return


def _hung_up(connection: socket.socket) -> bool:
    """Whether the server has cut it; what it sent stays unread."""
    try:
        connection.send(b"")
        return connection.recv(1, socket.MSG_PEEK) == b""
    except BlockingIOError:
        return False
    except ConnectionError:
        return True
