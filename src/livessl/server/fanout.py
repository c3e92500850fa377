"""Fans numbered messages out to subscribers: filters, rate limits, how many wait for a slow client, and its `gap`."""

from __future__ import annotations

import asyncio
import zlib
from collections import OrderedDict, deque
from collections.abc import Hashable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from livessl.server.api.encode import API_VERSION, JsonObject, json_text

LAGGING: Final = 32
"""Messages behind, about one second of one sound, from which on a client gets only the newest state of each sound, each
track and the arrays: older states of the same subject are dropped from its queue."""

BACKLOG: Final = 256
"""Most messages that wait for a client. Beyond it the oldest are dropped, events last, and a `gap` reports how many."""

PAST: Final = 2048
"""Messages kept for clients that reconnect: one minute or more of a sound that never ends. They are kept as compressed
text, because as objects those of 64 arrays would take about 50 MB."""

_FILTERED_BY: Final = ("seq", "kind", "confidence", "zones", "id", "track_id")
"""Fields of a kept message that decide whether a client gets it."""


@dataclass(frozen=True, slots=True)
class Filter:
    """A client's choice of messages.

    Parameters
    ----------
    kinds : frozenset of str or None
        Message kinds; None for all.
    min_confidence : float
        Least confidence of events and updates.
    zone : str or None
        Only events, updates and tracks inside this zone.
    track : int or None
        Only the track of this number, and its changes in zones. Messages about no track pass.
    max_rate_hz : float or None
        Most messages a second on the state of one subject: a sound, a track, or the arrays. See `Pace`.
    """

    kinds: frozenset[str] | None = None
    min_confidence: float = 0.0
    zone: str | None = None
    track: int | None = None
    max_rate_hz: float | None = None

    def passes(self, message: Mapping[str, Any]) -> bool:
        """Return whether a message passes the filter."""
        if self.kinds is not None and message["kind"] not in self.kinds:
            return False
        if message.get("confidence", 1.0) < self.min_confidence:
            return False
        if self.track is not None and self.track != _track_of(message, self.track):
            return False
        return self.zone is None or "zones" not in message or self.zone in message["zones"]


def _track_of(message: Mapping[str, Any], otherwise: int) -> Any:
    """Return the number of the track that a message is about; `otherwise` if it is about none."""
    return {"track": message.get("id"), "zone": message.get("track_id")}.get(message["kind"], otherwise)


class Pace:
    """Leaves out states of a subject that follow too soon after another one.

    A state that is left out is replaced by the next one. The first and the last state of a track always pass, as do
    events, alerts and changes in zones.

    Parameters
    ----------
    rate_hz : float
        Most states of a subject a second.
    """

    def __init__(self, rate_hz: float) -> None:
        self._interval_s = 1.0 / rate_hz
        self._sent_s: OrderedDict[Hashable, float] = OrderedDict()

    def admits(self, numbered: Numbered, now_s: float) -> bool:
        """Return whether a message is sent at `now_s`, a time in seconds by any clock that does not go back."""
        subject = numbered.subject
        if subject is None or numbered.message.get("state") in ("new", "end"):
            return True
        while self._sent_s and now_s - next(iter(self._sent_s.values())) >= self._interval_s:
            self._sent_s.popitem(last=False)
        if subject in self._sent_s:
            return False
        self._sent_s[subject] = now_s
        return True


class Numbered:
    """A numbered message on its way to the subscribers, which share the object and its text.

    Parameters
    ----------
    message : JsonObject
        With its version and number.
    published_ns : int or None
        When the message was published, by the monotonic clock; None if its way to the clients is not measured.
    packed : bytes or None
        Compressed text of the message; `message` then holds only the fields that filters look at.
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
        """Return a small copy for clients that reconnect; the way of the copy to them is not measured."""
        fields: JsonObject = {name: self.message[name] for name in _FILTERED_BY if name in self.message}
        return Numbered(fields, packed=zlib.compress(self.text.encode(), 1))

    @property
    def subject(self) -> Hashable | None:
        """The subject whose state the message is, so that a later one replaces it; None for a message that is kept."""
        kind = self.message["kind"]
        return (
            None
            if kind in ("event", "alert", "zone")
            else (kind, self.message.get("event_id") or self.message.get("id"))
        )


@dataclass(slots=True, eq=False)
class Subscription:
    """The queue of one client: every message in order while it keeps up, then only the newest states and the events."""

    wanted: Filter
    past: deque[Numbered] = field(default_factory=deque)
    _waiting: OrderedDict[int, Numbered] = field(default_factory=OrderedDict)
    _newest: dict[Hashable, int] = field(default_factory=dict)
    _news: asyncio.Event = field(default_factory=asyncio.Event)
    _missed: int = 0
    _pace: Pace | None = None

    def __post_init__(self) -> None:
        if self.wanted.max_rate_hz is not None:
            self._pace = Pace(self.wanted.max_rate_hz)

    def offer(self, seq: int, numbered: Numbered) -> bool:
        """Queue a message if it passes the filter; return whether another one was dropped for it."""
        if not self.wanted.passes(numbered.message):
            return False
        if self._pace is not None and not self._pace.admits(numbered, asyncio.get_running_loop().time()):
            return False
        gone = len(self._waiting) >= LAGGING and self._make_room(numbered.subject)
        self._waiting[seq] = numbered
        if numbered.subject is not None:
            self._newest[numbered.subject] = seq
        self._news.set()
        return gone

    def _make_room(self, subject: Hashable | None) -> bool:
        """Drop the older state of the same subject, or the oldest message of a full queue; return whether any was."""
        older = None if subject is None else self._newest.get(subject)
        if older is not None:
            del self._waiting[older]
        elif len(self._waiting) >= BACKLOG:
            states = (seq for seq, numbered in self._waiting.items() if numbered.subject is not None)
            victim = next(states, next(iter(self._waiting)))
            self._forget(self._waiting.pop(victim), victim)
            self._missed += 1
        else:
            return False
        return True

    @property
    def lags(self) -> bool:
        """True if more messages wait."""
        return bool(self._waiting)

    async def next(self) -> Numbered:
        """Wait for the next message and return it: first the kept ones, then a `gap` if any were dropped."""
        if self.past:
            return self.past.popleft()
        while not self._waiting:
            self._news.clear()
            await self._news.wait()
        if self._missed:
            missed, self._missed = self._missed, 0
            reason = f"this client reads too slowly; {missed} messages were dropped, events last"
            return _gap(missed, reason)
        seq, numbered = self._waiting.popitem(last=False)
        self._forget(numbered, seq)
        return numbered

    def _forget(self, numbered: Numbered, seq: int) -> None:
        if numbered.subject is not None and self._newest.get(numbered.subject) == seq:
            del self._newest[numbered.subject]


class Fanout:
    """Numbers messages and offers them to every subscriber. For the event loop's thread only.

    Parameters
    ----------
    first_seq : int
        The number before the first. A restarted server must begin above all numbers that it gave before.
    """

    def __init__(self, first_seq: int = 0) -> None:
        self._subscriptions: set[Subscription] = set()
        self._past: deque[Numbered] = deque(maxlen=PAST)
        self._first_seq = first_seq
        self.last_seq = first_seq
        self.superseded = 0
        """Messages dropped from the queues of slow clients."""
        self.ended = asyncio.Event()
        """Set when the server stops, so that endless streams end."""

    @property
    def clients(self) -> int:
        """Number of subscribers."""
        return len(self._subscriptions)

    @property
    def lags(self) -> bool:
        """True if messages wait for any subscriber."""
        return any(subscription.lags for subscription in self._subscriptions)

    def subscribe(self, wanted: Filter, since_seq: int | None = None) -> Subscription:
        """Return a new subscription, to end with `unsubscribe`; with `since_seq` it begins after that number."""
        subscription = Subscription(wanted)
        if since_seq is not None:
            subscription.past.extend(self._after(since_seq, wanted))
        self._subscriptions.add(subscription)
        return subscription

    def _after(self, since_seq: int, wanted: Filter) -> Iterator[Numbered]:
        """Yield the kept messages after a number; before them a `gap` if older ones are no longer kept."""
        oldest = self.last_seq - len(self._past) + 1
        if since_seq > self.last_seq:
            yield _gap(None, f"number {since_seq} was not published; the last one is {self.last_seq}")
        elif since_seq < oldest - 1:
            missed = oldest - 1 - since_seq if since_seq >= self._first_seq else None
            gone = "" if missed is None else f"{missed} messages "
            yield _gap(
                missed, f"{gone}after number {since_seq} are gone, up to {oldest - 1}; GET events has the events"
            )
        yield from (t for t in self._past if t.message["seq"] > since_seq and wanted.passes(t.message))

    def unsubscribe(self, subscription: Subscription) -> None:
        """End a subscription."""
        self._subscriptions.discard(subscription)

    def publish(self, message: JsonObject, published_ns: int | None = None) -> None:
        """Number a message and offer it to everyone."""
        self.last_seq += 1
        numbered = Numbered({"v": API_VERSION, "seq": self.last_seq, **message}, published_ns)
        self._past.append(numbered.packed())
        for subscription in self._subscriptions:
            self.superseded += subscription.offer(self.last_seq, numbered)


def _gap(missed: int | None, reason: str) -> Numbered:
    return Numbered({"kind": "gap", "v": API_VERSION, "missed": missed, "reason": reason})
