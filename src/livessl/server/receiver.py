"""Receives messages of nodes on a ZeroMQ socket, on its own thread, and words why an address cannot be bound.

`ingest` decides which messages are accepted and acknowledged.
"""

from __future__ import annotations

import errno
import logging
import threading
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Protocol

import zmq

from livessl import wire
from livessl.clock import Clock
from livessl.core.types import BackfillRequest, Frame, Message
from livessl.errors import RunError
from livessl.server.guard import DOOR, guard
from livessl.server.ingest import Ingest
from livessl.server.inlet import Inlet
from livessl.server.latency import Arrival, Arrivals
from livessl.server.refusals import Refusals
from livessl.site.addresses import needs_ipv6
from livessl.site.keys import server_keys
from livessl.site.models import Site

POLL_MS: Final = 20
"""Longest wait for messages, in milliseconds, before the thread sends the acknowledgements that are due."""

PEER_MESSAGES: Final = 64
"""Most messages of one node that ZeroMQ receives before they are read: 1.6 s of two arrays. Further messages wait in
the node, whose memory is bounded. With ZeroMQ's default, each node would fill 35 MB of the server's memory. With 8
messages, a node that ended on a busy machine could not deliver its last messages in time."""

DRAIN: Final = 64
"""Most messages that are read before they are put into the queue: one frame index of 64 arrays. Waking the fusion
thread for a message costs more than decoding the message."""

BUSY_MESSAGES: Final = 100
"""Queue length from which the fast acknowledgements (`ingest.SOON_NS`) pause, so that backlogs do not delay live
sound."""

_log = logging.getLogger(__name__)


class BindError(RunError):
    """The server cannot bind to one of its addresses."""


def address_cure(number: int | None) -> str:
    """Return the cure for an address that the server cannot bind to, by the system's error number."""
    if number == errno.EADDRINUSE:
        return "is another server running? Stop it or choose another port"
    if number == errno.EACCES:
        return "choose a port from 1024 on"
    if number == errno.EAFNOSUPPORT:
        return "this machine has no IPv6; write an IPv4 address of it"
    return "write an address of this machine"


@dataclass(frozen=True, slots=True)
class Joined:
    """A node has begun a run."""

    hello: wire.Hello


@dataclass(frozen=True, slots=True)
class Greeted:
    """A node has greeted again because its backlog changed: larger after an interruption, empty once it was sent."""

    hello: wire.Hello


@dataclass(frozen=True, slots=True)
class Left:
    """A node has said good-bye."""

    hello: wire.Hello


Item = Message | Joined | Greeted | Left


class Inbox(Protocol):
    """Source of the nodes' messages: a `Receiver`, or a replacement in a simulation."""

    @property
    def ingest(self) -> Ingest:
        """The protocol with the nodes, which keeps the list of connected nodes."""
        ...

    @property
    def arrivals(self) -> Arrivals:
        """Times at which messages were sent and received."""
        ...

    @property
    def refusals(self) -> Refusals:
        """The peers and requests that were refused."""
        ...

    @property
    def enrolled(self) -> Sequence[str]:
        """Names of the nodes whose keys are accepted; empty if the site uses no keys."""
        ...

    @property
    def endpoint(self) -> str:
        """The address to which nodes connect."""
        ...

    @property
    def failure(self) -> BaseException | None:
        """The error that has ended its thread, if it has ended."""
        ...

    @property
    def delay_s(self) -> float:
        """Time, in seconds, that the first item of the last `take` had waited; 0 if there was none."""
        ...

    def start(self) -> None:
        """Begin to receive."""
        ...

    def stop(self) -> None:
        """End, and release the address."""
        ...

    def take(self, most: int, wait_s: float) -> list[Item]:
        """Return up to `most` items that have arrived, in order; wait up to `wait_s` for the first one."""
        ...

    def request(self, request: BackfillRequest) -> None:
        """Send a request for missing frames to the node of an array."""
        ...


class Receiver:
    """Receives the messages of all nodes on a ZeroMQ ROUTER socket, on its own thread.

    Parameters
    ----------
    site : Site
    clock : Clock

    Raises
    ------
    BindError
        If the address is taken.
    ConfigError
        If the site uses keys that cannot be read.
    """

    def __init__(self, site: Site, clock: Clock) -> None:
        keys = server_keys(site)
        self.ingest = Ingest(site)
        self.arrivals = Arrivals()
        self.refusals = Refusals(clock)
        self.enrolled = [] if keys is None else sorted(keys.nodes)
        self._guarded = keys is not None
        self._clock = clock
        self._inlet: Inlet[Item] = Inlet(clock)
        self._requests: deque[BackfillRequest] = deque()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="receiver", daemon=True)
        self.failure: BaseException | None = None
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.ROUTER)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.RCVHWM, PEER_MESSAGES)
        self._socket.setsockopt(zmq.IPV6, needs_ipv6(site.server.bind))
        self._socket.setsockopt(zmq.MAXMSGSIZE, wire.MAX_MESSAGE_BYTES)
        if keys is not None:
            guard(self._context, self._socket, keys, self.refusals, self._fail)
        try:
            self._socket.bind(site.server.bind)
        except zmq.ZMQError as error:
            self._socket.close()
            self._context.term()
            raise BindError(
                f"server.bind: cannot listen on {site.server.bind}: {zmq.strerror(error.errno or 0)}; "
                f"{address_cure(error.errno)}"
            ) from error
        self.endpoint: str = self._socket.getsockopt_string(zmq.LAST_ENDPOINT)

    def start(self) -> None:
        """Begin to receive."""
        self._thread.start()

    def stop(self) -> None:
        """End, and release the address."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(timeout=2.0)
        self._socket.close()
        self._context.term()

    @property
    def queued(self) -> int:
        """Number of items in the queue."""
        return len(self._inlet)

    @property
    def queued_bytes(self) -> int:
        """Bytes of sound in the queue."""
        return self._inlet.nbytes

    @property
    def delay_s(self) -> float:
        """Time, in seconds, that the first item of the last `take` had waited; 0 if there was none."""
        return self._inlet.delay_s

    def request(self, request: BackfillRequest) -> None:
        """Send a request for missing frames to the node of an array; from any thread."""
        self._requests.append(request)

    def take(self, most: int, wait_s: float) -> list[Item]:
        """Return up to `most` items that have arrived, in order; wait up to `wait_s` for the first one."""
        return self._inlet.take(most, wait_s)

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                if self._socket.poll(POLL_MS):
                    while not self._stop.is_set() and self._drain():
                        self._acknowledge()
                self._acknowledge()
                self._send_requests()
        except BaseException as error:
            self._fail(error)
            _log.exception("the receiving thread has failed")
            raise

    def _fail(self, error: BaseException) -> None:
        self.failure = error

    def _drain(self) -> bool:
        """Read up to `DRAIN` messages and put them into the queue; return whether there may be more."""
        read: list[tuple[int, Item]] = []
        more = True
        while more and len(read) < DRAIN:
            try:
                address, *parts = self._socket.recv_multipart(zmq.NOBLOCK, copy=False)
            except zmq.Again:
                more = False
                break
            enrolled = str(parts[0].get("User-Id")) if self._guarded else None
            self._take_in(address.bytes, b"".join(part.bytes for part in parts), enrolled, read)
        self._put(read)
        return more

    def _take_in(self, routing_id: bytes, data: bytes, enrolled: str | None, read: list[tuple[int, Item]]) -> None:
        """Take in one message; add the resulting items for the fusion to `read`, each with its number of bytes."""
        received = self.ingest.receive(routing_id, data, self._clock.monotonic_ns(), enrolled)
        if received.joined is not None:
            read.append((0, Joined(received.joined)))
        if received.greeted is not None:
            read.append((0, Greeted(received.greeted)))
        if received.left is not None:
            read.append((0, Left(received.left)))
        if received.refused is not None:
            refused = received.refused
            self.refusals.note(DOOR, f"node {refused.node!r}", refused.cause, refused.text)
        message = received.message
        if message is not None:
            arrival = Arrival(wire.sent_ns(data), self._clock.now_ns())
            self.arrivals.note(message.frame_index, arrival)
            self.ingest.node_clocks.note(message.array, *arrival)
            read.append((message.samples.nbytes if isinstance(message, Frame) else 0, message))
        for announcement in (received.welcome, received.offer):
            if announcement is not None:
                self._reply(routing_id, announcement)
        if received.reply is not None:
            self._reply(routing_id, received.reply, received.reply_version)

    def _put(self, items: Sequence[tuple[int, Item]]) -> None:
        while items and not self._stop.is_set():
            items = items[self._inlet.put(items, 0.1) :]
            if items:
                self._acknowledge()

    def _acknowledge(self) -> None:
        soon = self.queued < BUSY_MESSAGES
        for routing_id, ack in self.ingest.acknowledgements(self._clock.monotonic_ns(), soon=soon):
            self._reply(routing_id, ack)

    def _send_requests(self) -> None:
        due = [self._requests.popleft() for _ in range(len(self._requests))]
        for routing_id, request in self.ingest.requests(due):
            self._reply(routing_id, request)

    def _reply(
        self, routing_id: bytes, reply: wire.Ack | wire.Request | wire.Welcome, version: int = wire.VERSION
    ) -> None:
        try:
            self._socket.send_multipart([routing_id, wire.encode(reply, version)], zmq.NOBLOCK)
        except zmq.ZMQError as error:  # the node is gone or does not read; it will greet again
            _log.debug("no reply to %r: %s", routing_id, error)
