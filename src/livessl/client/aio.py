"""The asynchronous client (`aconnect`): live messages with `async for`, and questions to the server."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, AsyncIterator
from contextlib import aclosing, suppress
from datetime import datetime
from types import TracebackType
from typing import Self, TypeVar, Unpack
from urllib.parse import quote

from pydantic import BaseModel
from websockets.asyncio.client import ClientConnection, connect

from livessl.client.address import Address, UnreachableError
from livessl.client.options import Options, Wanted
from livessl.client.questions import event_query, health_of
from livessl.client.reading import read_answer
from livessl.client.resumption import Deliver, Get, Memory, Receive, Received, Steps, conversation, live_query
from livessl.client.retry import LOST, MAX_MESSAGE_BYTES, SILENCE_S, Patience, monotonic_s, socket_log
from livessl.schema.answers import Arrays, EventPage, Health, HealthStatus, OneEvent, Site, Tracks
from livessl.schema.values import Event

M = TypeVar("M", bound=BaseModel)


class _Opening(connect):
    """Opens a WebSocket, and follows no redirect: another host must not get the token."""

    def process_redirect(self, exc: Exception) -> Exception | str:
        """Return the answer as an error."""
        return exc


def aconnect(url: str, token: str | None = None, **options: Unpack[Options]) -> AsyncClient:
    """Return a client of the server at a URL. It connects when it is iterated over or asked.

    Parameters
    ----------
    url : str
        Such as `http://127.0.0.1:8000`, or `https://site.example/livessl` behind a proxy.
    token : str or None
        Access token, where the server wants one.
    **options : Options
        What to subscribe to, and how to reach the server.

    Raises
    ------
    UseError
        If an argument cannot be used.
    """
    return AsyncClient(Address.of(url, token, options.get("ca_file")), options)


class AsyncClient:
    """A client of a server; iterate over it with `async for` for live messages, in one task. See `Client`.

    Parameters
    ----------
    address : Address
    options : Options
    """

    def __init__(self, address: Address, options: Options) -> None:
        self._address = address
        self._wanted = Wanted.of(options)
        self._give_up_s = options.get("give_up_s")
        self._memory = Memory()
        self._closed = asyncio.Event()
        self._socket: ClientConnection | None = None

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    async def close(self) -> None:
        """End the iteration, which may wait in another task."""
        self._closed.set()
        if self._socket is not None:
            await self._socket.close()

    async def __aiter__(self) -> AsyncIterator[Received]:
        """Yield live messages until `close`.

        Raises
        ------
        RefusedError
            If the server refuses the token or a filter.
        UnreachableError
            If there was no connection for `give_up_s`.
        NewerServerError
            If the server sends what this client cannot read.
        """
        patience = Patience(self._address, self._give_up_s)
        while not self._closed.is_set():
            try:
                async with aclosing(self._converse(patience)) as messages:
                    async for message in messages:
                        yield message
            except (*LOST, UnreachableError) as error:
                if not self._closed.is_set():
                    wait_s = patience.next_wait_s(error)
                    with suppress(TimeoutError):
                        await asyncio.wait_for(self._closed.wait(), wait_s)

    async def events(
        self,
        since: datetime | str | None = None,
        until: datetime | str | None = None,
        *,
        zone: str | None = None,
        min_confidence: float | None = None,
    ) -> AsyncIterator[Event]:
        """Yield stored events, the latest start first.

        Parameters
        ----------
        since, until : datetime, str or None
            First and last start; RFC 3339 as text.
        zone : str or None
            Zone that the event lies in.
        min_confidence : float or None
            0 to 1.

        Raises
        ------
        UnreachableError, RefusedError
            If the server does not answer, or refuses.
        """
        query = event_query(since, until, zone, min_confidence)
        while True:
            page = await self._ask("events", EventPage, query)
            for event in page.events:
                yield event
            if page.next_cursor is None:
                return
            query["cursor"] = page.next_cursor

    async def event(self, event_id: str) -> Event:
        """Return the stored event of an id."""
        return await self._ask(f"events/{quote(event_id, safe='')}", OneEvent)

    async def site(self) -> Site:
        """Return room, grid, arrays and settings."""
        return await self._ask("site", Site)

    async def arrays(self) -> Arrays:
        """Return the state of every array."""
        return await self._ask("arrays", Arrays)

    async def tracks(self) -> Tracks:
        """Return the tracks that live now."""
        return await self._ask("tracks", Tracks)

    async def health(self) -> Health | HealthStatus:
        """Return the condition of the server; without a token that it wants, the status alone."""
        return health_of(await asyncio.to_thread(self._address.get, "health"))

    async def _ask(self, path: str, model: type[M], query: dict[str, str] | None = None) -> M:
        return read_answer(model, await asyncio.to_thread(self._address.get, path, query), path)

    async def _converse(self, patience: Patience) -> AsyncGenerator[Received, None]:
        """Carry out the steps of one connection."""
        async with _Opening(
            self._address.live(live_query(self._memory, self._wanted)),
            additional_headers=self._address.headers,
            ssl=self._address.context,
            max_size=MAX_MESSAGE_BYTES,
            ping_interval=SILENCE_S,
            ping_timeout=SILENCE_S,
            logger=socket_log(),
        ) as socket:
            self._socket = socket
            patience.opened()
            steps: Steps = conversation(self._memory, self._wanted, monotonic_s)
            answer: str | bytes | None = None
            while not self._closed.is_set():
                step = steps.send(answer)
                answer = None
                match step:
                    case Receive():
                        if not self._memory.is_behind:
                            patience.proven()
                        answer = await _receive(socket, step.patience_s)
                    case Get():
                        answer = await self._get(step)
                    case Deliver():
                        yield step.message

    async def _get(self, step: Get) -> bytes | None:
        try:
            return await asyncio.to_thread(self._address.get, step.path, step.query)
        except UnreachableError:  # the connection itself may work all the same
            return None


async def _receive(socket: ClientConnection, patience_s: float | None) -> str | bytes | None:
    """Return the next message; None after so many seconds, if there is a number."""
    try:
        async with asyncio.timeout(patience_s):
            return await socket.recv()
    except TimeoutError:
        return None
