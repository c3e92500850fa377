"""A node's link to the server: greeting, acknowledgements, when the server counts as unreachable, and reconnection.

It logs the reason for which a server refuses the node, as `server/ingest.py` sends it. It never blocks.

Live sound is sent first. Kept frames follow in order of time in the remaining bandwidth, with only a few frames that
are not acknowledged.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Iterable
from dataclasses import replace
from typing import Final

from livessl import wire
from livessl.capture.dealer import Dealer
from livessl.capture.outbox import Outbox
from livessl.capture.spool import Spool
from livessl.clock import Clock
from livessl.core.types import FRAME_NS, BackfillRequest, Message
from livessl.site.keys import NodeKeys
from livessl.traces import traces_in_use

HELLO_NS: Final = 1_000_000_000
"""Interval of greetings, in nanoseconds, while the server does not answer, or while there is nothing else to send."""

SILENT_NS: Final = 2_000_000_000
"""Silence of the server, in nanoseconds, after which it counts as unreachable; it acknowledges four times a second."""

CONNECT_TIMEOUT_NS: Final = 10_000_000_000
"""Longest wait of `wait_connected`, in nanoseconds. A replay then gives up, because a person is waiting."""

_BYE_TRIES: Final = 25
_BYE_WAIT_MS: Final = 20
"""Number of attempts to send the last sound and a good-bye, and the wait between them in milliseconds: half a second in
all."""

_BYE_LINGER_MS: Final = 500
"""Time, in milliseconds, that the operating system has to send a good-bye."""

_log = logging.getLogger(__name__)


class Link:
    """Connection of a node to the server over which no frame is lost while the spool has room.

    Frames stay in the spool until the server no longer needs them. After an interruption, frames that the server has
    not received are sent again.

    Parameters
    ----------
    endpoint : str
        The server's ZeroMQ address.
    hello : Hello
        The node's greeting.
    clock : Clock
    keys : NodeKeys or None
        The node's own keys and the server's public key; None if the site uses no keys.
    spool : Spool or None
        Store of the frames; None for a spool in memory. It is closed with the link.
    dealer : Dealer or None
        The connection; None for a new one.
    backfill : callable or None
        Returns the messages that answer a backfill request; None if the node cannot answer any.
    """

    def __init__(
        self,
        endpoint: str,
        hello: wire.Hello,
        clock: Clock,
        keys: NodeKeys | None = None,
        *,
        spool: Spool | None = None,
        dealer: Dealer | None = None,
        backfill: Callable[[BackfillRequest], list[Message]] | None = None,
    ) -> None:
        self.endpoint = endpoint
        self._clock = clock
        self._backfill = backfill
        self._spool = Spool() if spool is None else spool
        self._traces = None if hello.replay else traces_in_use()
        self._outbox = Outbox(self._spool, None if self._traces is None else self._trace_frame)
        self._dealer = Dealer(endpoint, keys, len(hello.arrays)) if dealer is None else dealer
        self._keyed = keys is not None
        self._hello = replace(hello, backlog=self._outbox.backlog_spans())
        self._begun_ns = clock.monotonic_ns()
        self._answered_ns = self._hello_ns = self._sent_ns = -SILENT_NS
        self._accepted = False  # the server has acknowledged our greeting
        self._warned = False  # that no server has ever answered
        self._hello_due = False
        self._refused: str | None = None
        self._invalid: str | None = None  # what was wrong with the last invalid message; it is logged once

    @property
    def connected(self) -> bool:
        """True if the server has accepted the node, and has sent an acknowledgement within `SILENT_NS`."""
        return self._accepted and self._clock.monotonic_ns() - self._answered_ns < SILENT_NS

    @property
    def refused(self) -> str | None:
        """The server's reason for refusing the node; None if it has not."""
        return self._refused

    @property
    def pending(self) -> int:
        """Number of messages that the server has not acknowledged."""
        return self._outbox.pending

    @property
    def dropped(self) -> int:
        """Number of frames that were lost before the server got them."""
        return self._outbox.dropped

    @property
    def settled(self) -> int | None:
        """Frame index before which the server needs no frames; None as long as the server has not reported one."""
        return self._outbox.settled

    @property
    def kept(self) -> int:
        """Number of frames that the server may still need, whether or not it has received them."""
        return len(self._spool)

    def report(self, problem: str | None) -> None:
        """Report a problem of the device to the server; None reports that the problem is over."""
        if problem != self._hello.problem:
            self._hello = replace(self._hello, problem=problem)
            self._hello_due = True
            self.service()

    @property
    def arrays(self) -> Collection[str]:
        """Names of the arrays whose sound the server gets."""
        return self._hello.arrays

    def queue(self, message: Message) -> None:
        """Queue a message, which `service` sends."""
        self._outbox.add(message, self._clock.monotonic_ns(), connected=self._accepted)

    def send(self, messages: Iterable[Message]) -> None:
        """Queue messages, and send as many as the connection accepts."""
        for message in messages:
            self.queue(message)
        self.service()

    def service(self) -> None:
        """Read acknowledgements, greet if necessary, and send as many messages as the connection accepts."""
        self._receive()
        if self._dealer.broken() and self._accepted:
            _log.info("the connection to the server at %s broke; unacknowledged frames are sent again", self.endpoint)
            self._disconnect()
            self._hello_ns = -SILENT_NS  # greet at once, before anything else uses the new connection
        now_ns = self._clock.monotonic_ns()
        if not self.connected:
            self._seek(now_ns)
            return
        if self._hello_due or (not self._outbox.has_live and now_ns - self._sent_ns >= HELLO_NS):
            self._say_hello()  # also a sign of life while there is no sound
        if not self._hello_due and self._outbox.send(self._try_send, now_ns) and not self._outbox.has_backlog:
            self._end_backlog()
        if self._outbox.is_late(now_ns) and not self._hello.replay:
            self._fall_behind()

    def wait_connected(self, stop: Callable[[], bool]) -> None:
        """Wait until the server has accepted or refused the node, at most `CONNECT_TIMEOUT_NS` or until `stop`."""
        while not (self.connected or self.refused or stop()):
            if self._clock.monotonic_ns() - self._begun_ns > CONNECT_TIMEOUT_NS:
                return
            self.service()
            self._dealer.wait(20)

    def close(self, *, bye: bool) -> None:
        """Close the connection and the spool; with `bye` the server is informed that the node ends on purpose."""
        said = bye and self._say_bye()
        self._dealer.close(_BYE_LINGER_MS if said else 0)
        self._spool.close()

    def _seek(self, now_ns: int) -> None:
        """Greet a server that does not answer, and log once that it does not."""
        if self._accepted:
            _log.warning("server at %s unreachable; buffering and retrying", self.endpoint)
            self._disconnect()
        elif not (self._warned or self._refused) and now_ns - self._begun_ns >= SILENT_NS:
            self._warned = True
            hint = " Check also that this node's key is enrolled there, and that server.public is the server's key."
            _log.warning(
                "no server answers at %s; buffering and retrying. Check that `livessl serve` runs there, and that the "
                "port is that of server.bind, not of the dashboard. A server of another version of livessl may not "
                "answer either; its log says so.%s",
                self.endpoint,
                hint if self._keyed else "",
            )
        if now_ns - self._hello_ns >= HELLO_NS:
            self._say_hello()

    def _receive(self) -> None:
        while (data := self._dealer.receive()) is not None:
            try:
                message = wire.decode(data)
            except wire.WireError as error:
                if str(error) != self._invalid:
                    _log.warning("the server at %s sent an invalid message: %s", self.endpoint, error)
                self._invalid = str(error)
                continue
            if isinstance(message, wire.Ack):
                self._acknowledge(message)
            elif isinstance(message, wire.Request) and message.run_id == self._hello.run_id:
                self._answer(message)
            elif isinstance(message, wire.Welcome) and message.run_id == self._hello.run_id:
                self._outbox.send_sections(wire.SECTIONS in message.reads)

    def _answer(self, request: wire.Request) -> None:
        if self._backfill is None:
            return
        if not self._hello.answers:
            self._hello = replace(self._hello, answers=True)
            self._say_hello()
        for array, (first, last) in request.wanted.items():
            if array in self._hello.arrays:  # the node has others, which this server does not get
                self._outbox.add_requested(self._backfill(BackfillRequest(array, first, last - 1)))

    def _acknowledge(self, ack: wire.Ack) -> None:
        if ack.who_are_you:
            self._disconnect()
            self._say_hello()
            return
        if ack.run_id != self._hello.run_id:
            return
        if ack.refused is not None:
            if ack.refused != self._refused:
                _log.error("the server at %s refuses this node: %s", self.endpoint, ack.refused)
            self._refused = ack.refused
            return
        self._answered_ns = self._clock.monotonic_ns()
        self._refused = None
        self._outbox.acknowledge(ack.received, ack.settled)
        if not self._accepted:
            _log.info("connected to the server at %s", self.endpoint)
            self._accepted = True
            self._outbox.reconnected(self._hello.arrays)
            self._announce_backlog()

    def _fall_behind(self) -> None:
        if not self._hello.backlog:
            _log.warning(
                "the connection to the server at %s is too slow; late frames are sent when there is room", self.endpoint
            )
        self._outbox.demote_live()
        self._announce_backlog()

    def _announce_backlog(self) -> None:
        """Greet with the spans of the backlog; frames after them are live."""
        self._hello = replace(self._hello, backlog=self._outbox.backlog_spans())
        self._outbox.queue_marks(self._clock.monotonic_ns())
        self._say_hello()

    def _end_backlog(self) -> None:
        """Greet once more when all of the backlog has been sent."""
        if self._hello.backlog:
            self._hello = replace(self._hello, backlog={})
            self._say_hello()

    def _trace_frame(self, array: str, frame_index: int) -> None:
        assert self._traces is not None
        self._traces.frame_sent(array, frame_index, (frame_index + 1) * FRAME_NS, self._clock.now_ns())

    def _disconnect(self) -> None:
        """Treat the connection as lost; unacknowledged frames are sent again when the server answers."""
        self._accepted = False
        self._outbox.disconnected()
        self._outbox.send_sections(False)
        # The next server may be an older one that does not understand `answers` or sections.
        self._hello = replace(self._hello, backlog=self._outbox.backlog_spans(), answers=False)

    def _say_hello(self) -> None:
        self._hello_due = not self._try_send(wire.encode(self._hello))
        if not self._hello_due:
            self._hello_ns = self._clock.monotonic_ns()

    def _say_bye(self) -> bool:
        """Send a good-bye after the last live sound, which may have to wait for space; return True if it was sent."""
        farewell = wire.encode(wire.Bye(self._hello.node, self._hello.run_id))
        for _ in range(_BYE_TRIES):
            if not self._outbox.has_live and self._try_send(farewell):
                return True
            if not self.connected:
                break
            self._dealer.wait(_BYE_WAIT_MS)
            self.service()
        return self._try_send(farewell)

    def _try_send(self, data: bytes) -> bool:
        """Stamp a message with the present time and send it; return True if the connection accepted it."""
        if not self._dealer.send(wire.stamped(data, self._clock.now_ns())):
            return False
        self._sent_ns = self._clock.monotonic_ns()
        return True
