"""A node's link to the server: sends, keeps what is not yet acknowledged, reconnects for ever. It never blocks."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Final

import zmq

from livessl import wire
from livessl.clock import Clock
from livessl.core.types import Mark, Message
from livessl.keys import NodeKeys

SPOOL_BYTES: Final = 64 * 1024 * 1024
"""Sound kept for a server that is away: half a minute of six arrays. Oldest first out, counted."""

HELLO_NS: Final = 1_000_000_000
"""How often a node introduces itself while nobody answers, or while it has nothing else to say."""

SILENT_NS: Final = 2_000_000_000
"""The server acknowledges at least twice a second; so long without a word means that it is gone."""

ANSWER_NS: Final = 10_000_000_000
"""A replay, which somebody waits for, gives up after so long; a node never does."""

_log = logging.getLogger(__name__)


@dataclass(slots=True)
class _Kept:
    array: str
    sequence: int
    data: bytes
    is_mark: bool


class Link:
    """DEALER socket, sequence numbers, spool.

    Frames stay in the spool until the server has acknowledged them; after an interruption they are sent again. Marks
    say how things are now, so only the newest of an array waits for the server to come back.

    Parameters
    ----------
    endpoint : str
        The server's ZeroMQ address.
    hello : Hello
        Who we are.
    clock : Clock
    keys : NodeKeys or None
        Ours and the server's; None where the site uses none.
    """

    def __init__(self, endpoint: str, hello: wire.Hello, clock: Clock, keys: NodeKeys | None = None) -> None:
        self.endpoint = endpoint
        self._hello = hello
        self._clock = clock
        self._begun_ns = clock.monotonic_ns()
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.DEALER)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.IMMEDIATE, 1)  # what cannot go out now waits in our spool, not in ZeroMQ's
        self._socket.setsockopt(zmq.SNDHWM, 200)
        self._socket.setsockopt(zmq.RECONNECT_IVL, 100)
        self._socket.setsockopt(zmq.RECONNECT_IVL_MAX, 2000)
        self._socket.setsockopt(zmq.MAXMSGSIZE, wire.MAX_MESSAGE_BYTES)
        self._hint = ""
        if keys is not None:
            self._hint = " And are the keys right: is this node's enrolled there, is server.public the server's?"
            self._socket.setsockopt(zmq.CURVE_SERVERKEY, keys.server)
            self._socket.setsockopt(zmq.CURVE_PUBLICKEY, keys.own.public)
            self._socket.setsockopt(zmq.CURVE_SECRETKEY, keys.own.secret)
        self._socket.connect(endpoint)
        self._unsent: deque[_Kept] = deque()
        self._unacknowledged: deque[_Kept] = deque()
        self._bytes = 0
        self._heard_ns = self._hello_ns = self._sent_ns = -SILENT_NS
        self._greeted = self._missed = False
        self._complaint: str | None = None
        self.dropped = 0

    @property
    def connected(self) -> bool:
        """Whether the server has answered lately."""
        return self._greeted and self._clock.monotonic_ns() - self._heard_ns < SILENT_NS

    @property
    def refused(self) -> str | None:
        """Why the server does not take us, in its words."""
        return self._complaint

    @property
    def pending(self) -> int:
        """Messages not yet acknowledged."""
        return len(self._unsent) + len(self._unacknowledged)

    def tell(self, problem: str | None) -> None:
        """Let the server know what is wrong with the device, or that nothing is any more."""
        if problem != self._hello.problem:
            self._hello = replace(self._hello, problem=problem)
            self._say_hello()

    def send(self, messages: Iterable[Message]) -> None:
        """Queue messages and move what can be moved."""
        for message in messages:
            kept = _Kept(message.array, message.sequence, wire.encode(message), isinstance(message, Mark))
            if kept.is_mark and not self.connected:
                self._forget_mark(message.array)
            self._unsent.append(kept)
            self._bytes += len(kept.data)
        while self._bytes > SPOOL_BYTES:
            oldest = (self._unacknowledged or self._unsent).popleft()
            self._bytes -= len(oldest.data)
            self.dropped += 1
        self.service()

    def service(self) -> None:
        """Read acknowledgements, greet if nobody knows us, send what waits."""
        self._receive()
        now_ns = self._clock.monotonic_ns()
        if not self.connected:
            if self._greeted:
                _log.warning("no word from the server at %s; keeping sound and trying on", self.endpoint)
                self._lose()
            elif not self._missed and now_ns - self._begun_ns >= SILENT_NS:
                self._missed = True
                _log.warning(
                    "no server answers at %s; keeping sound and trying on. Is `livessl serve` running there?%s",
                    self.endpoint,
                    self._hint,
                )
            if now_ns - self._hello_ns >= HELLO_NS:
                self._say_hello()
            return
        if not self._unsent and now_ns - self._sent_ns >= HELLO_NS:
            self._say_hello()  # no sound for a while, but we are there
        while self._unsent:
            kept = self._unsent[0]
            if not self._try_send(kept.data):
                return
            self._unsent.popleft()
            if kept.is_mark:
                self._bytes -= len(kept.data)
            else:
                self._unacknowledged.append(kept)

    def wait_connected(self, stop: Callable[[], bool]) -> None:
        """Return when the server has answered, one way or the other, on `stop`, or after `ANSWER_NS`."""
        while not (self.connected or self.refused or stop()):
            if self._clock.monotonic_ns() - self._begun_ns > ANSWER_NS:
                return
            self.service()
            self._socket.poll(20)

    def close(self, *, bye: bool) -> None:
        """End the connection; with `bye` the server knows that it is on purpose."""
        if bye and self._try_send(wire.encode(wire.Bye(self._hello.node, self._hello.run_id))):
            self._socket.setsockopt(zmq.LINGER, 500)
        self._socket.close()
        self._context.term()

    def _receive(self) -> None:
        while True:
            try:
                data = self._socket.recv(zmq.NOBLOCK)
            except zmq.Again:
                return
            try:
                message = wire.decode(data)
            except wire.WireError as error:
                _log.warning("server at %s sent something else than an acknowledgement: %s", self.endpoint, error)
                continue
            if isinstance(message, wire.Ack):
                self._acknowledge(message)

    def _acknowledge(self, ack: wire.Ack) -> None:
        if ack.who_are_you:
            self._lose()
            self._say_hello()
            return
        if ack.run_id != self._hello.run_id:
            return
        if ack.refused is not None:
            if ack.refused != self._complaint:
                _log.error("the server at %s refuses us: %s", self.endpoint, ack.refused)
            self._complaint = ack.refused
            return
        self._heard_ns = self._clock.monotonic_ns()
        self._complaint = None
        if not self._greeted:
            _log.info("connected to the server at %s", self.endpoint)
        self._greeted = True
        while self._unacknowledged:
            kept = self._unacknowledged[0]
            if kept.sequence > ack.sequences.get(kept.array, 0):
                break
            self._unacknowledged.popleft()
            self._bytes -= len(kept.data)

    def _lose(self) -> None:
        """The server may not have what it did not acknowledge: line it up again."""
        self._greeted = False
        self._unsent.extendleft(reversed(self._unacknowledged))
        self._unacknowledged.clear()

    def _say_hello(self) -> None:
        if self._try_send(wire.encode(self._hello)):
            self._hello_ns = self._clock.monotonic_ns()

    def _forget_mark(self, array: str) -> None:
        for index, kept in enumerate(self._unsent):
            if kept.is_mark and kept.array == array:
                self._bytes -= len(kept.data)
                del self._unsent[index]
                return

    def _try_send(self, data: bytes) -> bool:
        try:
            self._socket.send(wire.stamped(data, self._clock.now_ns()), zmq.NOBLOCK)
        except zmq.Again:
            return False
        self._sent_ns = self._clock.monotonic_ns()
        return True
