"""A node's link to the server: sends, keeps what is not yet settled, reconnects for ever. It never blocks.

Live sound goes first. What was kept while the server was away follows in order of time in the spare bandwidth, a few
frames ahead of the server's word for them.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Final

import zmq

from livessl import wire
from livessl.capture.spool import Kept, Spool, SpoolError
from livessl.clock import Clock
from livessl.core.types import BackfillRequest, Frame, Mark, Message
from livessl.site.keys import NodeKeys

BACKLOG_FRAMES: Final = 16
"""Kept frames on their way at a time: what live sound may have to wait behind, a quarter of a second at 3 MB/s."""

HELLO_NS: Final = 1_000_000_000
"""How often a node introduces itself while nobody answers, or while it has nothing else to say."""

SILENT_NS: Final = 2_000_000_000
"""The server acknowledges four times a second; so long without a word means that it is gone."""

BEHIND_NS: Final = 5_000_000_000
"""Sound that has waited so long to be sent is not live any more."""

QUEUED_MESSAGES: Final = 10
"""Of each array, handed over to ZeroMQ: they, and `QUEUED_BYTES` in the system's hands, are what a slow link delays."""

QUEUED_BYTES: Final = 256 * 1024
"""Enough for 10 Mbit/s at a round trip of 0.2 s."""

MOST_ANSWERS: Final = 500
"""Frames asked for that wait to be sent, a quarter of a minute of two arrays; older ones are not worth it any more."""

_BYE_TRIES: Final = 25
_BYE_WAIT_MS: Final = 20

ANSWER_NS: Final = 10_000_000_000
"""A replay, which somebody waits for, gives up after so long; a node never does."""

_log = logging.getLogger(__name__)


class Dealer:
    """The socket: it connects, and reconnects, by itself.

    Parameters
    ----------
    endpoint : str
        The server's ZeroMQ address.
    keys : NodeKeys or None
        Ours and the server's; None where the site uses none.
    arrays : int
        Whose sound goes over it.
    """

    def __init__(self, endpoint: str, keys: NodeKeys | None = None, arrays: int = 1) -> None:
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.DEALER)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.IMMEDIATE, 1)  # what cannot go out now waits in our spool, not in ZeroMQ's
        self._socket.setsockopt(zmq.SNDHWM, max(BACKLOG_FRAMES, QUEUED_MESSAGES * arrays))
        self._socket.setsockopt(zmq.SNDBUF, QUEUED_BYTES)
        self._socket.setsockopt(zmq.RECONNECT_IVL, 100)
        self._socket.setsockopt(zmq.RECONNECT_IVL_MAX, 2000)
        self._socket.setsockopt(zmq.MAXMSGSIZE, wire.MAX_MESSAGE_BYTES)
        if keys is not None:
            self._socket.setsockopt(zmq.CURVE_SERVERKEY, keys.server)
            self._socket.setsockopt(zmq.CURVE_PUBLICKEY, keys.own.public)
            self._socket.setsockopt(zmq.CURVE_SECRETKEY, keys.own.secret)
        self._monitor = self._socket.get_monitor_socket(zmq.EVENT_DISCONNECTED)
        self._socket.connect(endpoint)

    def broken(self) -> bool:
        """Whether the connection has broken since this was last asked, and with it what was on its way.

        ZeroMQ makes another by itself, and says nothing of it; not before it has waited for a tenth of a second.
        """
        broken = False
        while self._monitor.poll(0):
            self._monitor.recv_multipart()
            broken = True
        return broken

    def send(self, data: bytes) -> bool:
        """Whether the message could be handed over."""
        try:
            self._socket.send(data, zmq.NOBLOCK)
        except zmq.Again:
            return False
        return True

    def receive(self) -> bytes | None:
        """The next message; None where there is none."""
        try:
            return self._socket.recv(zmq.NOBLOCK)
        except zmq.Again:
            return None

    def wait(self, milliseconds: int) -> None:
        """Until there is a message, at most."""
        self._socket.poll(milliseconds)

    def close(self, linger_ms: int) -> None:
        """End the connection, once; what was handed over has so long to go out."""
        if self._socket.closed:
            return
        self._socket.disable_monitor()
        self._monitor.close()
        self._socket.setsockopt(zmq.LINGER, linger_ms)
        self._socket.close()
        self._context.term()


class Link:
    """Greetings, order, acknowledgements.

    Frames stay in the spool until the server needs them no more; what it has not got is sent again after an
    interruption. Marks say how things are now, so only the newest of an array waits for the server to come back.

    Parameters
    ----------
    endpoint : str
        The server's ZeroMQ address.
    hello : Hello
        Who we are.
    clock : Clock
    keys : NodeKeys or None
        Ours and the server's; None where the site uses none.
    spool : Spool or None
        Where frames are kept; None keeps them in memory. It is closed with the link.
    dealer : Dealer or None
        The connection, instead of one of its own.
    recent : callable or None
        Gives what is remembered of an array's sound, whether or not it was sent; None where nothing is.
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
        recent: Callable[[BackfillRequest], list[Message]] | None = None,
    ) -> None:
        self.endpoint = endpoint
        self._clock = clock
        self._recent = recent
        self._spool = Spool() if spool is None else spool
        self._begun_ns = clock.monotonic_ns()
        self._dealer = Dealer(endpoint, keys, len(hello.arrays)) if dealer is None else dealer
        self._hint = (
            ""
            if keys is None
            else " And are the keys right: is this node's enrolled there, is server.public the server's?"
        )
        self._marks: dict[str, Mark] = {}  # while the server is away
        self._live: deque[tuple[int, Kept | Mark]] = deque()  # since when each waits
        self._backlog = deque(self._spool.frames())
        self._hello = replace(hello, backlog=_spans(self._backlog))
        self._backlog_sent: deque[Kept] = deque()
        self._answers: deque[Message] = deque(maxlen=MOST_ANSWERS)
        self._live_sent: deque[Kept] = deque()
        self._received: dict[str, int] = {}
        self._settled: int | None = None
        self._backlog_ns = 0
        self._heard_ns = self._hello_ns = self._sent_ns = -SILENT_NS
        self._greeted = self._missed = self._owes_hello = False
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
        """Messages that the server has not got yet."""
        sent = len(self._live_sent) + len(self._backlog_sent)
        return len(self._live) + len(self._marks) + len(self._backlog) + sent

    @property
    def settled(self) -> int | None:
        """Before this frame index the server needs nothing more, by its last word; None where it has not said."""
        return self._settled

    @property
    def kept(self) -> int:
        """Frames that the server may still need, whether or not it has got them."""
        return len(self._spool)

    def tell(self, problem: str | None) -> None:
        """Let the server know what is wrong with the device, or that nothing is any more."""
        if problem != self._hello.problem:
            self._hello = replace(self._hello, problem=problem)
            self._owes_hello = True
            self.service()

    def send(self, messages: Iterable[Message]) -> None:
        """Queue messages and move what can be moved."""
        for message in messages:
            if isinstance(message, Frame):
                self._keep(message)
            elif self._greeted:
                self._live.append((self._clock.monotonic_ns(), message))
            else:
                self._marks[message.array] = message
        self.service()

    def service(self) -> None:
        """Read acknowledgements, greet if nobody knows us, send what waits."""
        self._receive()
        if self._dealer.broken() and self._greeted:
            _log.info("the connection to the server at %s broke; what was on its way is sent again", self.endpoint)
            self._lose()
            self._hello_ns = -SILENT_NS  # at once, before anything else goes over the new one
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
        if self._owes_hello or (not self._live and now_ns - self._sent_ns >= HELLO_NS):
            self._say_hello()  # no sound for a while, but we are there
        if not self._owes_hello:
            self._send_waiting(now_ns)
        if self._live and now_ns - self._live[0][0] >= BEHIND_NS and not self._hello.replay:
            self._fall_behind()

    def _keep(self, frame: Frame) -> None:
        kept, gone = self._spool.append(frame)
        if self._greeted:
            self._live.append((self._clock.monotonic_ns(), kept))
        else:
            self._backlog.append(kept)
        self._marks.pop(frame.array, None)  # a mark before it says how things were
        if gone:
            self._give_up(gone)

    def _give_up(self, gone: Sequence[Kept]) -> None:
        """Count what had to go before the server got it; it must not be sent any more."""
        lost = [kept for kept in gone if not self._is_received(kept)]
        queues = (self._backlog, self._backlog_sent, self._live_sent)
        self._live = deque(waiting for waiting in self._live if waiting[1] not in lost)
        for kept in lost:
            for queue in queues:
                if kept in queue:
                    queue.remove(kept)
        if lost and not self.dropped:
            _log.warning("the spool is full, and the oldest sound goes; see to the server, or raise spool.max_mb")
        self.dropped += len(lost)

    def _send_waiting(self, now_ns: int) -> None:
        while self._live:
            first = self._live[0][1]
            if not self._try_send(self._data(first)):
                return
            self._live.popleft()
            if isinstance(first, Kept):
                self._live_sent.append(first)
        while self._answers:
            if not self._try_send(wire.encode(self._answers[0])):
                return
            self._answers.popleft()
        if self._backlog_sent and now_ns - self._backlog_ns >= SILENT_NS:
            self._backlog_sent.clear()  # the server has them, or does not want them
        while self._backlog and len(self._backlog_sent) < BACKLOG_FRAMES:
            if not self._try_send(self._data(self._backlog[0])):
                return
            self._backlog_sent.append(self._backlog.popleft())
            self._backlog_ns = now_ns
        if self._hello.backlog and not self._backlog:
            self._hello = replace(self._hello, backlog={})
            self._say_hello()

    def wait_connected(self, stop: Callable[[], bool]) -> None:
        """Return when the server has answered, one way or the other, on `stop`, or after `ANSWER_NS`."""
        while not (self.connected or self.refused or stop()):
            if self._clock.monotonic_ns() - self._begun_ns > ANSWER_NS:
                return
            self.service()
            self._dealer.wait(20)

    def close(self, *, bye: bool) -> None:
        """End the connection; with `bye` the server knows that it is on purpose."""
        said = bye and self._say_bye()
        self._dealer.close(500 if said else 0)
        self._spool.close()

    def _say_bye(self) -> bool:
        """After the last live sound, for which there may be no room at once; it waits for half a second at most."""
        farewell = wire.encode(wire.Bye(self._hello.node, self._hello.run_id))
        for _ in range(_BYE_TRIES):
            if not self._live and self._try_send(farewell):
                return True
            if not self.connected:
                break
            self._dealer.wait(_BYE_WAIT_MS)
            self.service()
        return self._try_send(farewell)

    def _receive(self) -> None:
        while (data := self._dealer.receive()) is not None:
            try:
                message = wire.decode(data)
            except wire.WireError as error:
                _log.warning("server at %s sent something else than an acknowledgement: %s", self.endpoint, error)
                continue
            if isinstance(message, wire.Ack):
                self._acknowledge(message)
            elif isinstance(message, wire.Request) and message.run_id == self._hello.run_id:
                self._answer(message)

    def _answer(self, request: wire.Request) -> None:
        """Send what is wanted, past the spool: an answer that is lost is not missed for long, and nobody waits."""
        if self._recent is None:
            return
        if not self._hello.answers:
            self._hello = replace(self._hello, answers=True)
            self._say_hello()
        for array, (first, last) in request.wanted.items():
            self._answers.extend(self._recent(BackfillRequest(array, first, last - 1)))

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
        self._received, self._settled = ack.received, ack.settled
        for array, received in ack.received.items():
            if ack.settled is not None:
                self._spool.forget(array, min(ack.settled, received + 1))
        self._live_sent = deque(kept for kept in self._live_sent if not self._is_received(kept))
        self._backlog_sent = deque(kept for kept in self._backlog_sent if not self._is_received(kept))
        if not self._greeted:
            _log.info("connected to the server at %s", self.endpoint)
            self._greeted = True
            self._line_up()

    def _is_received(self, kept: Kept) -> bool:
        return kept.array in self._received and kept.frame_index <= self._received[kept.array]

    def _line_up(self) -> None:
        """Everything that the server has not got follows in order of time; what is cut from now on is live."""
        frames = [kept for kept in self._spool.frames() if kept.array in self._hello.arrays]
        self._backlog = deque(kept for kept in frames if not self._is_received(kept))
        self._announce()

    def _fall_behind(self) -> None:
        """What waits is sound of the past now: it follows when there is room, and what is heard next goes first."""
        if not self._hello.backlog:
            _log.warning(
                "the link to the server at %s is too slow; what waits is sent when there is room", self.endpoint
            )
        waiting, self._live = self._live, deque()
        self._backlog.extend(message for _, message in waiting if isinstance(message, Kept))
        self._marks.update(_newest_marks(waiting))
        self._announce()

    def _announce(self) -> None:
        """Say what follows as backlog; what is cut from now on is live, and so is how things are."""
        self._hello = replace(self._hello, backlog=_spans([*self._backlog_sent, *self._backlog]))
        now_ns = self._clock.monotonic_ns()
        self._live.extend((now_ns, mark) for mark in self._marks.values())
        self._marks.clear()
        self._say_hello()

    def _lose(self) -> None:
        """The server may not have got what it has not acknowledged: it is lined up again when it answers."""
        self._greeted = False
        self._received = {}
        self._marks.update(_newest_marks(self._live))
        self._answers.clear()
        for queue in (self._live, self._live_sent, self._backlog_sent):
            queue.clear()
        self._backlog = deque(self._spool.frames())
        spans = _spans(self._backlog)
        self._hello = replace(self._hello, backlog=spans, answers=False)  # the next server may be another, and older

    def _say_hello(self) -> None:
        self._owes_hello = not self._try_send(wire.encode(self._hello))
        if not self._owes_hello:
            self._hello_ns = self._clock.monotonic_ns()

    def _data(self, message: Kept | Mark) -> bytes | None:
        if isinstance(message, Mark):
            return wire.encode(replace(message, lost_frames=message.lost_frames + self.dropped))
        try:
            return self._spool.read(message)
        except SpoolError as error:
            _log.error("%s", error)
            self.dropped += 1
            return None

    def _try_send(self, data: bytes | None) -> bool:
        """Whether it is on its way, or there is nothing to send."""
        if data is None:
            return True
        if not self._dealer.send(wire.stamped(data, self._clock.now_ns())):
            return False
        self._sent_ns = self._clock.monotonic_ns()
        return True


def _spans(frames: Iterable[Kept]) -> dict[str, tuple[int, int]]:
    """Of each array the frame index of its first frame, and that after its last."""
    spans: dict[str, tuple[int, int]] = {}
    for kept in frames:
        spans[kept.array] = (spans.get(kept.array, (kept.frame_index, 0))[0], kept.frame_index + 1)
    return spans


def _newest_marks(waiting: Iterable[tuple[int, Kept | Mark]]) -> dict[str, Mark]:
    """Of each array that falls silent in the end the last mark: a frame after a mark says that things have changed."""
    newest: dict[str, Mark] = {}
    for _, message in waiting:
        if isinstance(message, Mark):
            newest[message.array] = message
        else:
            newest.pop(message.array, None)
    return newest
