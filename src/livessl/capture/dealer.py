"""The ZeroMQ socket of a node: how soon it tries to reconnect, and how much it queues. It never blocks.

`link` greets the server and notes that it is unreachable; `server/ingest.py` accepts or refuses the node.
"""

from __future__ import annotations

from typing import Final

import zmq

from livessl import wire
from livessl.capture.outbox import BACKLOG_FRAMES
from livessl.site.addresses import needs_ipv6
from livessl.site.keys import NodeKeys

QUEUED_MESSAGES: Final = 10
"""Messages of each array that ZeroMQ holds. Together with `QUEUED_BYTES` in the operating system they bound how much a
slow connection delays live sound."""

QUEUED_BYTES: Final = 256 * 1024
"""Bytes that the operating system holds: enough for 10 Mbit/s at a round trip of 0.2 s."""

RECONNECT_MS: Final = 100
"""Wait before the first new attempt to connect, in ms; it doubles up to `MAX_RECONNECT_MS`."""

MAX_RECONNECT_MS: Final = 2000


class Dealer:
    """A DEALER socket that connects to the server.

    Parameters
    ----------
    endpoint : str
        The server's ZeroMQ address.
    keys : NodeKeys or None
        The node's own keys and the server's public key; None if the site uses no keys.
    arrays : int
        Number of arrays whose sound the socket carries.
    """

    def __init__(self, endpoint: str, keys: NodeKeys | None = None, arrays: int = 1) -> None:
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.DEALER)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.IPV6, needs_ipv6(endpoint))
        self._socket.setsockopt(zmq.IMMEDIATE, 1)  # while disconnected, frames wait in our spool, not in ZeroMQ's queue
        self._socket.setsockopt(zmq.SNDHWM, max(BACKLOG_FRAMES, QUEUED_MESSAGES * arrays))
        self._socket.setsockopt(zmq.SNDBUF, QUEUED_BYTES)
        self._socket.setsockopt(zmq.RECONNECT_IVL, RECONNECT_MS)
        self._socket.setsockopt(zmq.RECONNECT_IVL_MAX, MAX_RECONNECT_MS)
        self._socket.setsockopt(zmq.MAXMSGSIZE, wire.MAX_MESSAGE_BYTES)
        if keys is not None:
            self._socket.setsockopt(zmq.CURVE_SERVERKEY, keys.server)
            self._socket.setsockopt(zmq.CURVE_PUBLICKEY, keys.own.public)
            self._socket.setsockopt(zmq.CURVE_SECRETKEY, keys.own.secret)
        self._monitor = self._socket.get_monitor_socket(zmq.EVENT_DISCONNECTED)
        self._socket.connect(endpoint)

    def broken(self) -> bool:
        """Return True if the connection has broken since the last call; messages on their way are lost then.

        ZeroMQ reconnects by itself without notice, at the earliest after `RECONNECT_MS`.
        """
        broken = False
        while self._monitor.poll(0):
            self._monitor.recv_multipart()
            broken = True
        return broken

    def send(self, data: bytes) -> bool:
        """Hand a message over; return False if there is no room or no connection."""
        try:
            self._socket.send(data, zmq.NOBLOCK)
        except zmq.Again:
            return False
        return True

    def receive(self) -> bytes | None:
        """Return the next message; None if there is none."""
        try:
            return self._socket.recv(zmq.NOBLOCK)
        except zmq.Again:
            return None

    def wait(self, milliseconds: int) -> None:
        """Return when there is a message, or after `milliseconds`."""
        self._socket.poll(milliseconds)

    def close(self, linger_ms: int) -> None:
        """Close the connection; messages that were handed over have `linger_ms` to leave. Closing twice is harmless."""
        if self._socket.closed:
            return
        self._socket.disable_monitor()
        self._monitor.close()
        self._socket.setsockopt(zmq.LINGER, linger_ms)
        self._socket.close()
        self._context.term()
