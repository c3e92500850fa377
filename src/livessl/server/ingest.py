"""Who is connected and what they have sent: greetings, sequence numbers, acknowledgements. It owns no socket."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from typing import Final

from livessl import wire
from livessl.config import Site
from livessl.core.types import Frame, Message

ACK_NS: Final = 500_000_000
"""Every node hears from us at least this often."""

GONE_NS: Final = 2_000_000_000
"""A node silent for so long no longer holds its name and its arrays."""

NOTICE_NS: Final = 60_000_000_000
"""One notice a minute about senders of rubbish, not one a message."""

_log = logging.getLogger(__name__)


@dataclass(slots=True)
class Peer:
    """One node's run."""

    routing_id: bytes
    hello: wire.Hello
    heard_ns: int
    sequences: dict[str, int] = field(default_factory=dict)
    ended: bool = False


@dataclass(slots=True)
class Arrival:
    """What one piece of data brought."""

    message: Message | None = None
    joined: wire.Hello | None = None
    left: wire.Hello | None = None
    reply: wire.Ack | None = None


class Ingest:
    """The server's side of the link, sans I/O: data in, messages and replies out.

    Parameters
    ----------
    site : Site
        Which arrays there are.
    """

    def __init__(self, site: Site) -> None:
        self._site = site
        self._peers: dict[bytes, Peer] = {}
        self._acked_ns = 0
        self._notice_ns = -NOTICE_NS
        self.malformed = 0
        names = [spec.name for spec in site.processed]
        self.duplicates = dict.fromkeys(names, 0)
        self.sequence_gaps = dict.fromkeys(names, 0)

    def problem_of(self, array: str) -> str | None:
        """What the node says is wrong with the device that an array is on."""
        return next((p.hello.problem for p in self._peers.values() if array in p.hello.arrays and not p.ended), None)

    def receive(self, routing_id: bytes, data: bytes, now_ns: int, enrolled: str | None = None) -> Arrival:
        """Take in one message from one peer; `enrolled` is whose key it has shown, where the site uses keys."""
        try:
            message = wire.decode(data)
        except wire.WireError as error:
            return self._reject(error, now_ns)
        if isinstance(message, wire.Hello):
            return self._greet(routing_id, message, now_ns, enrolled)
        peer = self._peers.get(routing_id)
        if peer is None or peer.ended:
            return Arrival(reply=wire.Ack(run_id="?", sequences={}, who_are_you=True))
        peer.heard_ns = now_ns
        if isinstance(message, wire.Bye):
            peer.ended = True
            return Arrival(left=peer.hello)
        if isinstance(message, wire.Ack):
            return self._reject(wire.WireError("a node sent an acknowledgement; only servers do"), now_ns)
        if message.array not in peer.hello.arrays:
            return self._reject(
                wire.WireError(f"node {peer.hello.node!r} sent array {message.array!r}, which it did not announce"),
                now_ns,
            )
        rate_hz = peer.hello.arrays[message.array]
        if isinstance(message, Frame) and message.sample_rate_hz != rate_hz:
            return self._reject(
                wire.WireError(
                    f"node {peer.hello.node!r} sent {message.sample_rate_hz:g} Hz of array {message.array!r}, "
                    f"announced were {rate_hz:g} Hz"
                ),
                now_ns,
            )
        if self._is_duplicate(peer, message):
            return Arrival()
        return Arrival(message=message)

    def _is_duplicate(self, peer: Peer, message: Message) -> bool:
        """Whether the frame was here before; counts it, and the frames that are missing before a new message."""
        array, number = message.array, message.sequence
        last = peer.sequences.get(array)
        is_frame = isinstance(message, Frame)
        if is_frame and last is not None and number <= last:
            self.duplicates[array] += 1
            return True
        if last is not None:
            self.sequence_gaps[array] += max(0, number - last - is_frame)
        peer.sequences[array] = number if last is None else max(last, number)
        return False

    def acknowledgements(self, now_ns: int) -> list[tuple[bytes, wire.Ack]]:
        """Replies due by now; also forgets nodes that have been silent for long."""
        if now_ns - self._acked_ns < ACK_NS:
            return []
        self._acked_ns = now_ns
        self._peers = {
            key: peer for key, peer in self._peers.items() if now_ns - peer.heard_ns < 30 * GONE_NS and not peer.ended
        }
        return [(peer.routing_id, _ack(peer)) for peer in self._peers.values()]

    def live_nodes(self, now_ns: int) -> list[wire.Hello]:
        """Nodes heard from lately."""
        return [p.hello for p in self._peers.values() if not p.ended and now_ns - p.heard_ns < GONE_NS]

    def _greet(self, routing_id: bytes, hello: wire.Hello, now_ns: int, enrolled: str | None) -> Arrival:
        refusal = self._pretence(hello, enrolled) or self._refusal(routing_id, hello, now_ns)
        if refusal is not None:
            return Arrival(reply=wire.Ack(hello.run_id, {}, refused=refusal))
        same_run = next((p for p in self._peers.values() if p.hello.run_id == hello.run_id), None)
        peer = Peer(routing_id, hello, now_ns, same_run.sequences if same_run else {})
        others = {k: other for k, other in self._peers.items() if other.hello.node != hello.node and k != routing_id}
        self._peers = {**others, routing_id: peer}  # replaced, never changed: other threads read it
        if same_run is None:
            _log.info("node %r joined with %s", hello.node, ", ".join(hello.arrays))
        return Arrival(joined=None if same_run else hello, reply=_ack(peer))

    def _pretence(self, hello: wire.Hello, enrolled: str | None) -> str | None:
        """A key speaks for the node that it was enrolled for, and for the arrays that are that node's."""
        if enrolled is None:
            return None
        if hello.node != enrolled:
            return f"node {hello.node!r} has shown the key of {enrolled!r}; give each node its own"
        foreign = next((a for a in hello.arrays if self._site.node_of(a) not in (None, enrolled)), None)
        if foreign is not None and not hello.replay:
            return f"array {foreign!r} belongs to node {self._site.node_of(foreign)!r} in the server's site file"
        return None

    def _refusal(self, routing_id: bytes, hello: wire.Hello, now_ns: int) -> str | None:
        known = [spec.name for spec in self._site.processed]
        unknown = next((name for name in hello.arrays if name not in known), None)
        if unknown is not None:
            joint = next((name for name, members in self._site.joint.items() if unknown in members), None)
            if joint is not None:
                return f"array {unknown!r} is joined in {joint!r} at the server; give node and server the same `joint`"
            return f"no array {unknown!r} in the server's site file; it has {', '.join(known)}"
        for name, rate_hz in hello.arrays.items():
            node = self._site.node_of(name)
            stated_hz = self._site.nodes[node].device.sample_rate_hz if node else None
            if stated_hz is not None and rate_hz != stated_hz:
                where = f"nodes.{node}.device.sample_rate_hz"
                return f"array {name!r}: the server's site file says {stated_hz:g} Hz ({where}), got {rate_hz:g} Hz"
            high_hz = self._site.array(name).band_hz[1]
            if high_hz >= rate_hz / 2:
                needed = f"array {name!r} uses up to {high_hz:g} Hz and needs more than {2 * high_hz:g} Hz"
                return f"{needed}, got {rate_hz:g} Hz; correct the node's sample_rate_hz"
        others = [
            peer
            for key, peer in self._peers.items()
            if key != routing_id
            and not peer.ended
            and peer.hello.run_id != hello.run_id
            and now_ns - peer.heard_ns < GONE_NS
        ]
        for other in others:
            if other.hello.replay != hello.replay:
                return "live nodes are connected; stop them first" if hello.replay else "a replay is running"
            if other.hello.node == hello.node:
                return f"a node named {hello.node!r} is connected already; names must differ"
            taken = sorted(set(other.hello.arrays) & set(hello.arrays))
            if taken:
                return f"array {taken[0]!r} is captured by node {other.hello.node!r} already"
        return None

    def _reject(self, error: wire.WireError, now_ns: int) -> Arrival:
        self.malformed += 1
        if now_ns - self._notice_ns >= NOTICE_NS:
            self._notice_ns = now_ns
            _log.warning("message refused (%d so far): %s", self.malformed, error)
        return Arrival()


def _ack(peer: Peer) -> wire.Ack:
    return wire.Ack(peer.hello.run_id, dict(peer.sequences))
