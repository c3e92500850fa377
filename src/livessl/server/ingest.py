"""The server's side of the link to the nodes: greetings, sequence numbers, acknowledgements. It owns no socket.

`admission` decides which greetings are refused.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Final

from livessl import wire
from livessl.core.types import BackfillRequest, Frame, Mark, Message
from livessl.server.admission import Refusal, refusal_of, refusal_of_version
from livessl.server.node_clocks import NodeClocks
from livessl.server.node_reports import NodeReports
from livessl.site.models import Site

ACK_NS: Final = 250_000_000
"""Longest interval, in nanoseconds, between two acknowledgements to a node."""

SOON_NS: Final = 20_000_000
"""Interval, in nanoseconds, of acknowledgements to a node that sends a backlog or a recording, because it sends only a
limited number of frames that are not acknowledged."""

GONE_NS: Final = 2_000_000_000
"""Silence, in nanoseconds, after which another node may take a node's name and arrays."""

REFUSED_NS: Final = 5_000_000_000
"""Time, in nanoseconds, for which the reason of a refusal explains why an array is silent. A refused node greets again
every second."""

NODE_ALIVE_NS: Final = 1_400_000_000
"""Silence, in nanoseconds, after which a node counts as dead: longer than the second between two greetings, shorter
than the time after which its array is lost."""

NOTICE_NS: Final = 60_000_000_000
"""Shortest interval, in nanoseconds, between two log lines about malformed messages."""

_log = logging.getLogger(__name__)


@dataclass(slots=True)
class Peer:
    """One run of a node."""

    routing_id: bytes
    hello: wire.Hello
    last_ns: int
    sequences: dict[str, int] = field(default_factory=dict)
    received: dict[str, int] = field(default_factory=dict)
    live: dict[str, int] = field(default_factory=dict)
    acked_ns: int = 0
    ended: bool = False

    def is_backlog(self, message: Message) -> bool:
        """Return whether a message is older than the first live frame of the node."""
        return message.array in self.hello.backlog and message.frame_index < self.hello.backlog[message.array][1]

    def greet(self, hello: wire.Hello) -> None:
        """Record the node's backlog. Older frames are lost; without a backlog, all earlier frames have arrived."""
        for array, (oldest, _) in hello.backlog.items():
            self.received[array] = max(self.received.get(array, oldest - 1), oldest - 1)
        for array in self.live.keys() - hello.backlog.keys():
            self.received[array] = max(self.received.get(array, self.live[array]), self.live[array])
        self.hello = hello

    def take(self, frame: Frame) -> None:
        """Record a frame. All earlier frames of the same stream, backlog or live, have arrived."""
        waits = frame.array in self.hello.backlog and not self.is_backlog(frame)
        known = self.live if waits else self.received
        known[frame.array] = max(known.get(frame.array, frame.frame_index), frame.frame_index)


@dataclass(slots=True)
class Received:
    """The result of one message.

    `joined` is set by a new run, `greeted` by a known run whose backlog changed. `welcome` lists the extensions that
    the server reads, and `offer` announces requests for frames. Both are sent before the reply. `refused` is set by a
    refused greeting; the reply then contains the reason, in the version of the format that the node reads.
    """

    message: Message | None = None
    joined: wire.Hello | None = None
    greeted: wire.Hello | None = None
    left: wire.Hello | None = None
    reply: wire.Ack | None = None
    offer: wire.Request | None = None
    welcome: wire.Welcome | None = None
    refused: Refusal | None = None
    reply_version: int = wire.VERSION


class Ingest:
    """The protocol without I/O: data in, messages and replies out.

    Parameters
    ----------
    site : Site
        Contains the arrays and their nodes.
    """

    def __init__(self, site: Site) -> None:
        self._site = site
        self._peers: dict[bytes, Peer] = {}
        self._final_until: Mapping[str, int] = {}  # replaced as a whole, never changed, so that readers need no lock
        self._refused: dict[str, tuple[str, int]] = {}  # by array: why its node was refused, and when
        self._notice_ns = -NOTICE_NS
        self.node_clocks = NodeClocks()
        self.node_reports = NodeReports()
        self.malformed = 0
        """Malformed messages since the start."""
        self._kept: frozenset[str] | None = None  # replaced as a whole, never changed
        names = [spec.name for spec in site.processed]
        self.duplicates = dict.fromkeys(names, 0)
        self.sequence_gaps = dict.fromkeys(names, 0)
        self.shed = dict.fromkeys(names, 0)
        """Live frames of each array whose samples were dropped because of overload."""

    def note_final(self, until: Mapping[str, int]) -> None:
        """Acknowledge from now on that nodes may delete the frames before the given frame indices.

        Parameters
        ----------
        until : mapping of array to int
            Frame index, by the array's own clock, before which all events are final.
        """
        self._final_until = until

    def keep_samples_of(self, arrays: frozenset[str] | None) -> None:
        """Drop the samples of live frames of all other arrays from now on; None keeps all samples.

        Such a frame is still acknowledged, and it still counts for the activity.
        """
        self._kept = arrays

    def problem_of(self, array: str) -> str | None:
        """Return why an array's node is refused, or the problem that it reports about its device; None without one."""
        if (refused := self._refused.get(array)) is not None:
            return refused[0]
        return next((p.hello.problem for p in self._peers.values() if array in p.hello.arrays and not p.ended), None)

    def is_live(self, array: str, now_ns: int) -> bool:
        """Return whether an array's node has sent any message in the last `NODE_ALIVE_NS`."""
        return any(
            array in peer.hello.arrays and not peer.ended and now_ns - peer.last_ns < NODE_ALIVE_NS
            for peer in self._peers.values()
        )

    def receive(self, routing_id: bytes, data: bytes, now_ns: int, enrolled: str | None = None) -> Received:
        """Take in one message from one peer; `enrolled` is the node that owns the peer's key, if the site uses keys."""
        try:
            message = wire.decode(data)
        except wire.OtherVersionError as error:
            if not error.is_greeting:
                return self._reject(error, now_ns)
            refused = refusal_of_version(error)
            self._note_refusal(refused, now_ns)
            reply = wire.Ack(error.run_id, {}, refused=refused.text)
            return Received(reply=reply, refused=refused, reply_version=error.reply_version)
        except wire.WireError as error:
            return self._reject(error, now_ns)
        if isinstance(message, wire.Hello):
            return self._greet(routing_id, message, now_ns, enrolled)
        peer = self._peers.get(routing_id)
        if peer is None or peer.ended:
            return Received(reply=wire.Ack(run_id="?", received={}, who_are_you=True))
        peer.last_ns = now_ns
        if isinstance(message, wire.Bye):
            peer.ended = True
            return Received(left=peer.hello)
        if not isinstance(message, Frame | Mark):
            what = "an acknowledgement" if isinstance(message, wire.Ack) else "a request"
            return self._reject(wire.WireError(f"a node sent {what}; only servers do"), now_ns)
        return self._take(peer, message, now_ns)

    def _take(self, peer: Peer, message: Message, now_ns: int) -> Received:
        """Take in a frame or a mark."""
        if message.array not in peer.hello.arrays:
            return self._reject(
                wire.WireError(f"node {peer.hello.node!r} sent array {message.array!r}, which it did not announce"),
                now_ns,
            )
        wrong = self._wrong_rate(peer, message) if isinstance(message, Frame) else None
        if wrong is not None:
            return self._reject(wire.WireError(wrong), now_ns)
        if isinstance(message, Frame) and message.requested:
            return Received(message=message)  # requested frames have no sequence number
        if isinstance(message, Frame) and peer.is_backlog(message):
            peer.take(message)
            return Received(message=message)
        missing = self._missing_before(peer, message)
        if missing is None:
            self.duplicates[message.array] += 1
            return Received()
        self.sequence_gaps[message.array] += missing
        if missing:
            return Received(reply=wire.Ack(run_id="?", received={}, who_are_you=True))  # the node then sends them again
        if isinstance(message, Frame):
            peer.take(message)
            message = self._relieved(message)
        else:
            self.node_reports.note(message, now_ns)
        return Received(message=message)

    def _relieved(self, frame: Frame) -> Frame:
        kept = self._kept
        if kept is None or frame.array in kept:
            return frame
        self.shed[frame.array] += 1
        return frame.without_samples()

    def _wrong_rate(self, peer: Peer, frame: Frame) -> str | None:
        """Return what is wrong with a frame's sampling rate; a backlog may have another rate than was announced."""
        rate_hz, sent = frame.sample_rate_hz, f"node {peer.hello.node!r} sent {frame.sample_rate_hz:g} Hz"
        high_hz, announced_hz = self._site.array(frame.array).band_hz[1], peer.hello.arrays[frame.array]
        if high_hz >= rate_hz / 2:
            return f"{sent} of array {frame.array!r}, which uses up to {high_hz:g} Hz"
        if rate_hz != announced_hz and not peer.is_backlog(frame):
            return f"{sent} of array {frame.array!r}, announced were {announced_hz:g} Hz"
        return None

    def _missing_before(self, peer: Peer, message: Message) -> int | None:
        """Return how many frames are missing before a message of live sound; None if the message is a duplicate."""
        array, number = message.array, message.sequence
        last = peer.sequences.get(array)
        is_frame = isinstance(message, Frame)
        if is_frame and last is not None and number <= last:
            return None
        peer.sequences[array] = number if last is None else max(last, number)
        return 0 if last is None else max(0, number - last - is_frame)

    def acknowledgements(self, now_ns: int, *, soon: bool = True) -> list[tuple[bytes, wire.Ack]]:
        """Return the acknowledgements that are due, with `soon` also the fast ones; forget long silent nodes."""
        self._peers = {
            key: peer for key, peer in self._peers.items() if now_ns - peer.last_ns < 30 * GONE_NS and not peer.ended
        }
        if self._refused:
            self._refused = {array: why for array, why in self._refused.items() if now_ns - why[1] < REFUSED_NS}
        due = []
        for peer in self._peers.values():
            waits = peer.hello.replay or (soon and peer.hello.backlog)
            if now_ns - peer.acked_ns >= (SOON_NS if waits else ACK_NS):
                peer.acked_ns = now_ns
                due.append((peer.routing_id, self._ack(peer)))
        return due

    def requests(self, due: Iterable[BackfillRequest]) -> list[tuple[bytes, wire.Request]]:
        """Return each request with its routing id; drop those to nodes that are gone or do not know requests."""
        found = []
        for request in due:
            able = (peer for peer in self._peers.values() if peer.hello.answers and not peer.ended)
            peer = next((peer for peer in able if request.array in peer.hello.arrays), None)
            if peer is not None:
                wanted = {request.array: (request.first, request.last + 1)}
                found.append((peer.routing_id, wire.Request(peer.hello.run_id, wanted)))
        return found

    def live_nodes(self, now_ns: int) -> list[wire.Hello]:
        """Return the greetings of the nodes that have sent any message in the last `GONE_NS`."""
        return [p.hello for p in self._peers.values() if not p.ended and now_ns - p.last_ns < GONE_NS]

    def _greet(self, routing_id: bytes, hello: wire.Hello, now_ns: int, enrolled: str | None) -> Received:
        live = [
            peer.hello
            for key, peer in self._peers.items()
            if key != routing_id
            and not peer.ended
            and peer.hello.run_id != hello.run_id
            and now_ns - peer.last_ns < GONE_NS
        ]
        refused = refusal_of(self._site, hello, enrolled, live)
        if refused is not None:
            self._note_refusal(refused, now_ns)
            return Received(reply=wire.Ack(hello.run_id, {}, refused=refused.text), refused=refused)
        self._refused = {array: why for array, why in self._refused.items() if array not in hello.arrays}
        same_run = next((p for p in self._peers.values() if p.hello.run_id == hello.run_id), None)
        known = self._peers.get(routing_id)
        unaware = not hello.answers and (known is None or known.hello.answers)
        offer = wire.Request(hello.run_id) if unaware else None
        welcome = wire.Welcome(hello.run_id, (wire.SECTIONS,)) if unaware else None
        peer = Peer(routing_id, hello, now_ns)
        if same_run is not None:
            moved = same_run.routing_id != routing_id or hello.backlog.items() - same_run.hello.backlog.items()
            peer.sequences = {} if moved else same_run.sequences  # live sound begins anew after a backlog
            peer.received, peer.live = same_run.received, same_run.live
        peer.greet(hello)
        others = {
            key: other
            for key, other in self._peers.items()
            if other.hello.node != hello.node and other.hello.replay == hello.replay and key != routing_id
        }
        self._peers = {**others, routing_id: peer}  # replaced, never changed: other threads read it
        if same_run is None:
            _log.info("node %r joined with %s", hello.node, ", ".join(hello.arrays))
        reply = self._ack(peer)
        if same_run is None:
            return Received(joined=hello, reply=reply, offer=offer, welcome=welcome)
        before = same_run.hello
        news = hello.backlog != before.backlog or hello.answers != before.answers
        return Received(greeted=hello if news else None, reply=reply, offer=offer, welcome=welcome)

    def _ack(self, peer: Peer) -> wire.Ack:
        final = [self._final_until[array] for array in peer.hello.arrays if array in self._final_until]
        return wire.Ack(peer.hello.run_id, dict(peer.received), min(final, default=None))

    def _note_refusal(self, refused: Refusal, now_ns: int) -> None:
        """Remember for a while why the arrays of a refused node send nothing, unless another node sends them."""
        sent = {array for hello in self.live_nodes(now_ns) for array in hello.arrays}
        why = f"its node {refused.node!r} is refused: {refused.text}"
        known = [spec.name for spec in self._site.processed if spec.name in refused.arrays and spec.name not in sent]
        self._refused = {**self._refused, **dict.fromkeys(known, (why, now_ns))}

    def _reject(self, error: wire.WireError, now_ns: int) -> Received:
        self.malformed += 1
        if now_ns - self._notice_ns >= NOTICE_NS:
            self._notice_ns = now_ns
            _log.warning("message refused (%d so far): %s", self.malformed, error)
        return Received()
