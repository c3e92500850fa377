"""The synchronous client (`connect`): live messages by iteration, and questions to the server."""

from __future__ import annotations

import threading
from collections.abc import Generator, Iterator
from datetime import datetime
from types import TracebackType
from typing import Self, TypeVar, Unpack
from urllib.parse import quote

from pydantic import BaseModel
from websockets.sync.client import ClientConnection
from websockets.sync.client import connect as open_socket

from livessl.client.address import Address, UnreachableError
from livessl.client.options import Options, Wanted
from livessl.client.questions import event_query, health_of
from livessl.client.reading import read_answer
from livessl.client.resumption import Deliver, Get, Memory, Receive, Received, Steps, conversation, live_query
from livessl.client.retry import LOST, MAX_MESSAGE_BYTES, SILENCE_S, Patience, monotonic_s, socket_log
from livessl.schema.answers import Arrays, EventPage, Health, HealthStatus, OneEvent, Site, Tracks
from livessl.schema.values import Event

M = TypeVar("M", bound=BaseModel)


def connect(url: str, token: str | None = None, **options: Unpack[Options]) -> Client:
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
    return Client(Address.of(url, token, options.get("ca_file")), options)


class Client:
    """A client of a server; iterate over it for live messages. One thread may do so, and any thread may `close`.

    It connects again until it is closed. Every event that the server stores is delivered, and none twice; of other
    messages a `Gap` says how many were lost. An event whose sound arrived late is delivered again, with its better
    answer.

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
        self._closed = threading.Event()
        self._socket: ClientConnection | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the iteration, which may wait in another thread."""
        self._closed.set()
        socket = self._socket
        if socket is not None:
            socket.close()

    def __iter__(self) -> Iterator[Received]:
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
                yield from self._converse(patience)
            except (*LOST, UnreachableError) as error:
                if not self._closed.is_set():
                    self._closed.wait(patience.next_wait_s(error))

    def events(
        self,
        since: datetime | str | None = None,
        until: datetime | str | None = None,
        *,
        zone: str | None = None,
        min_confidence: float | None = None,
    ) -> Iterator[Event]:
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
            page = self._ask("events", EventPage, query)
            yield from page.events
            if page.next_cursor is None:
                return
            query["cursor"] = page.next_cursor

    def event(self, event_id: str) -> Event:
        """Return the stored event of an id."""
        return self._ask(f"events/{quote(event_id, safe='')}", OneEvent)

    def site(self) -> Site:
        """Return room, grid, arrays and settings."""
        return self._ask("site", Site)

    def arrays(self) -> Arrays:
        """Return the state of every array."""
        return self._ask("arrays", Arrays)

    def tracks(self) -> Tracks:
        """Return the tracks that live now."""
        return self._ask("tracks", Tracks)

    def health(self) -> Health | HealthStatus:
        """Return the condition of the server; without a token that it wants, the status alone."""
        return health_of(self._address.get("health"))

    def _ask(self, path: str, model: type[M], query: dict[str, str] | None = None) -> M:
        return read_answer(model, self._address.get(path, query), path)

    def _converse(self, patience: Patience) -> Generator[Received, None, None]:
        """Carry out the steps of one connection."""
        with open_socket(
            self._address.live(live_query(self._memory, self._wanted)),
            additional_headers=self._address.headers,
            ssl=self._address.context,
            max_size=MAX_MESSAGE_BYTES,
            ping_interval=None,  # `_receive` pings
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
                        answer = _receive(socket, step.patience_s)
                    case Get():
                        answer = self._get(step)
                    case Deliver():
                        yield step.message

    def _get(self, step: Get) -> bytes | None:
        try:
            return self._address.get(step.path, step.query)
        except UnreachableError:  # the connection itself may work all the same
            return None


def _receive(socket: ClientConnection, patience_s: float | None) -> str | bytes | None:
    """Return the next message; None after so many seconds, if there is a number.

    Raises
    ------
    TimeoutError
        If the server does not answer a ping.
    """
    while True:
        try:
            return socket.recv(timeout=SILENCE_S if patience_s is None else patience_s)
        except TimeoutError:
            if patience_s is not None:
                return None
            if not socket.ping().wait(SILENCE_S):
                raise TimeoutError(f"no answer to a ping for {SILENCE_S:g} s") from None
