"""Limits HTTP connections: closes those beyond the most, and decides how long a slow client may take (time-outs).

The most connections, and sizes of requests, are limits in `http` and `api/auth.py`.
"""

from __future__ import annotations

import asyncio
import logging
import socket
from typing import Any, Final
from weakref import WeakSet

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

REQUEST_S: Final = 10.0
"""Longest time, in seconds, in which a client must send a whole request: from the start of its connection or, later,
from the request's first byte. Requests are short, and a client that sends one byte a second would keep a place."""

STALLED_S: Final = 30.0
"""Longest time, in seconds, in which a client may accept no byte of an answer, as long as a WebSocket's."""

RELIEVED: Final = 0.9
"""Share of the most connections below which the limit is left; near it, lines would be logged again and again."""

_log = logging.getLogger(__name__)


class LimitedListener(socket.socket):
    """A listening TCP socket that closes connections beyond a limit at once, before TLS and HTTP.

    uvicorn's own limit only counts when a request is complete, so idle connections would be unlimited.

    Parameters
    ----------
    family : socket.AddressFamily
    most : int
        Most connections at once.
    """

    def __init__(self, family: socket.AddressFamily, most: int) -> None:
        super().__init__(family, socket.SOCK_STREAM)
        self._most = most
        self._open: WeakSet[socket.socket] = WeakSet()
        self._turned_away = 0

    def accept(self) -> tuple[socket.socket, Any]:
        """Accept a connection, as `socket.socket.accept` does.

        Raises
        ------
        ConnectionAbortedError
            If there are too many connections, and the new one was closed.
        """
        connection, address = super().accept()
        for known in [one for one in self._open if one.fileno() < 0]:
            self._open.discard(known)
        if len(self._open) >= self._most:
            connection.close()
            if not self._turned_away:
                _log.warning("HTTP: the most connections, %d, are open; further ones are closed at once", self._most)
            self._turned_away += 1
            raise ConnectionAbortedError(f"{self._most} connections are open")
        if self._turned_away and len(self._open) < RELIEVED * self._most:
            _log.warning("HTTP: %d connections were closed because too many were open", self._turned_away)
            self._turned_away = 0
        self._open.add(connection)
        return connection, address


class TimedRequests(H11Protocol):
    """uvicorn's HTTP/1.1, which closes connections that keep a place for nothing.

    These take longer than `REQUEST_S` to send a request, or accept no byte of an answer for `STALLED_S`.
    """

    _deadline: asyncio.TimerHandle | None = None
    _stalled: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Start to wait for the first request."""
        super().connection_made(transport)
        self._wait()

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop to wait."""
        self._stop_waiting()
        self._resumed()
        super().connection_lost(exc)

    def pause_writing(self) -> None:
        """Make the application wait while the client does not read the data that was sent, up to a limit."""
        super().pause_writing()
        self._watch_reading(self.transport.get_write_buffer_size())

    def resume_writing(self) -> None:
        """Let the application go on."""
        self._resumed()
        super().resume_writing()

    def _watch_reading(self, unread: int) -> None:
        self._stalled = self.loop.call_later(STALLED_S, self._check_reading, unread)

    def _check_reading(self, unread: int) -> None:
        left = self.transport.get_write_buffer_size()
        if left < unread:
            self._watch_reading(left)
            return
        _log.info("HTTP: %s has accepted nothing of an answer for %g s", self.client, STALLED_S)
        self.transport.abort()  # closing would wait until the client has read the rest

    def _resumed(self) -> None:
        if self._stalled is not None:
            self._stalled.cancel()
            self._stalled = None

    def data_received(self, data: bytes) -> None:
        """Take in a part of a request, and wait for the rest of it or no longer."""
        super().data_received(data)
        if self.transport.get_protocol() is not self or self.transport.is_closing():
            self._stop_waiting()  # a WebSocket has taken over, or the request was invalid
        elif self.conn.their_state not in (h11.IDLE, h11.SEND_BODY):
            self._stop_waiting()  # the request is complete
        elif self._deadline is None:
            self._wait()

    def _wait(self) -> None:
        self._deadline = self.loop.call_later(REQUEST_S, self._give_up)

    def _stop_waiting(self) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
            self._deadline = None

    def _give_up(self) -> None:
        self._deadline = None
        _log.debug("HTTP: %s sent no whole request within %g s", self.client, REQUEST_S)
        self.transport.close()
