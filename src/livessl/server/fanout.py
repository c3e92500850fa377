"""Everyone who subscribed: numbered messages, filters, and a bounded place for each client to fall behind in."""

from __future__ import annotations

import asyncio
import zlib
from collections import OrderedDict, deque
from collections.abc import Hashable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from livessl.server.api.encode import API_VERSION, JsonObject, json_text

LAGGING: Final = 32
"""A client so many messages behind, a second of one sound, is told states only as they are now: what a newer message
of the same sound, track, or of the arrays says again is left out."""

BACKLOG: Final = 256
"""Messages a client may lag by. Beyond it the oldest are dropped, events last, and the client told."""

PAST: Final = 2048
"""Messages kept for clients that come back: a minute or more of one sound that never ends. They are kept as compressed
text: as objects those of 64 arrays would take some 50 MB."""

_LOOKED_AT: Final = ("seq", "kind", "confidence", "zones")
"""What is asked of a message before it is sent again."""


@dataclass(frozen=True, slots=True)
class Filter:
    """What a client asked for.

    Parameters
    ----------
    kinds : frozenset of str or None
        Message kinds; None for all.
    min_confidence : float
        Events and updates below it are left out.
    zone : str or None
        Only events, updates and tracks inside this zone.
    """

    kinds: frozenset[str] | None = None
    min_confidence: float = 0.0
    zone: str | None = None

    def passes(self, message: Mapping[str, Any]) -> bool:
        """Whether a client with this filter wants the message."""
        if self.kinds is not None and message["kind"] not in self.kinds:
            return False
        if message.get("confidence", 1.0) < self.min_confidence:
            return False
        return self.zone is None or "zones" not in message or self.zone in message["zones"]


class Numbered:
    """A numbered message on its way to the subscribers: one object for all of them, one text.

    Parameters
    ----------
    message : JsonObject
        With its version and number.
    published_ns : int or None
        When it was told, by the clock that nobody sets, where its way to the clients is to be measured.
    packed : bytes or None
        Its text, compressed; the message then holds only what it is chosen by.
    """

    __slots__ = ("_packed", "_text", "message", "published_ns")

    def __init__(self, message: JsonObject, published_ns: int | None = None, packed: bytes | None = None) -> None:
        self.message = message
        self.published_ns = published_ns
        self._packed = packed
        self._text: str | None = None

    @property
    def text(self) -> str:
        """The message as JSON."""
        if self._packed is not None:
            return zlib.decompress(self._packed).decode()
        if self._text is None:
            self._text = json_text(self.message)
        return self._text

    def packed(self) -> Numbered:
        """The same for those who come back, small; its delay is not that of the way to a client."""
        chosen_by: JsonObject = {name: self.message[name] for name in _LOOKED_AT if name in self.message}
        return Numbered(chosen_by, packed=zlib.compress(self.text.encode(), 1))

    @property
    def subject(self) -> Hashable | None:
        """What the message gives the state of: a later one of the same subject replaces it. Events are no states."""
        kind = self.message["kind"]
        return None if kind == "event" else (kind, self.message.get("event_id") or self.message.get("id"))


@dataclass(slots=True, eq=False)
class Subscription:
    """One client's queue: everything, in order, as long as the client keeps up; then states only as they are now."""

    wanted: Filter
    past: deque[Numbered] = field(default_factory=deque)
    _waiting: OrderedDict[int, Numbered] = field(default_factory=OrderedDict)
    _newest: dict[Hashable, int] = field(default_factory=dict)
    _news: asyncio.Event = field(default_factory=asyncio.Event)
    _missed: int = 0

    def offer(self, seq: int, told: Numbered) -> bool:
        """Queue a message; whether another one had to go for it."""
        if not self.wanted.passes(told.message):
            return False
        gone = len(self._waiting) >= LAGGING and self._make_room(told.subject)
        self._waiting[seq] = told
        if told.subject is not None:
            self._newest[told.subject] = seq
        self._news.set()
        return gone

    def _make_room(self, subject: Hashable | None) -> bool:
        """Drop the older state of the same subject; of a full queue the oldest state, else the oldest event."""
        older = None if subject is None else self._newest.get(subject)
        if older is not None:
            del self._waiting[older]
        elif len(self._waiting) >= BACKLOG:
            states = (seq for seq, told in self._waiting.items() if told.subject is not None)
            victim = next(states, next(iter(self._waiting)))
            self._forget(self._waiting.pop(victim), victim)
            self._missed += 1
        else:
            return False
        return True

    @property
    def lags(self) -> bool:
        """Whether there is more to send."""
        return bool(self._waiting)

    async def next(self) -> Numbered:
        """The next message, waiting for one; first of all the past that was asked for, then how many were missed."""
        if self.past:
            return self.past.popleft()
        while not self._waiting:
            self._news.clear()
            await self._news.wait()
        if self._missed:
            missed, self._missed = self._missed, 0
            reason = f"this client reads too slowly; {missed} messages were dropped, events last"
            return _gap(missed, reason)
        seq, told = self._waiting.popitem(last=False)
        self._forget(told, seq)
        return told

    def _forget(self, told: Numbered, seq: int) -> None:
        if told.subject is not None and self._newest.get(told.subject) == seq:
            del self._newest[told.subject]


class Fanout:
    """Numbers messages and hands them to every subscriber. All calls on the event loop's thread.

    Parameters
    ----------
    first_seq : int
        The number before the first. A server that starts again begins above all that it told before.
    """

    def __init__(self, first_seq: int = 0) -> None:
        self._subscriptions: set[Subscription] = set()
        self._past: deque[Numbered] = deque(maxlen=PAST)
        self._first_seq = first_seq
        self.last_seq = first_seq
        self.superseded = 0
        """Messages that a slow client never got, for a newer one of the same thing or for want of room."""

    @property
    def clients(self) -> int:
        """How many subscribe."""
        return len(self._subscriptions)

    def subscribe(self, wanted: Filter, since_seq: int | None = None) -> Subscription:
        """Begin to receive, first everything after a number if one is given; end with `unsubscribe`."""
        subscription = Subscription(wanted)
        if since_seq is not None:
            subscription.past.extend(self._after(since_seq, wanted))
        self._subscriptions.add(subscription)
        return subscription

    def _after(self, since_seq: int, wanted: Filter) -> Iterator[Numbered]:
        """What was told after a number, and before it what is gone, if anything is."""
        oldest = self.last_seq - len(self._past) + 1
        if since_seq > self.last_seq:
            yield _gap(None, f"number {since_seq} has not been told; the last one is {self.last_seq}")
        elif since_seq < oldest - 1:
            missed = oldest - 1 - since_seq if since_seq >= self._first_seq else None
            gone = "" if missed is None else f"{missed} messages "
            yield _gap(
                missed, f"{gone}after number {since_seq} are gone, up to {oldest - 1}; GET events has the events"
            )
        yield from (t for t in self._past if t.message["seq"] > since_seq and wanted.passes(t.message))

    def unsubscribe(self, subscription: Subscription) -> None:
        """Receive no more."""
        self._subscriptions.discard(subscription)

    def publish(self, message: JsonObject, published_ns: int | None = None) -> None:
        """Number a message and offer it to everyone."""
        self.last_seq += 1
        told = Numbered({"v": API_VERSION, "seq": self.last_seq, **message}, published_ns)
        self._past.append(told.packed())
        for subscription in self._subscriptions:
            self.superseded += subscription.offer(self.last_seq, told)


def _gap(missed: int | None, reason: str) -> Numbered:
    return Numbered({"kind": "gap", "v": API_VERSION, "missed": missed, "reason": reason})
