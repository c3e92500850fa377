"""Everyone who subscribed: numbered messages, filters, and a bounded place for each client to fall behind in."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from livessl.messages import API_VERSION, JsonObject

BACKLOG: Final = 256
"""Messages a client may lag by: some ten seconds of updates. Beyond it the oldest are dropped and the client told."""


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


@dataclass(slots=True, eq=False)
class Subscription:
    """One client's queue."""

    wanted: Filter
    _waiting: deque[JsonObject] = field(default_factory=deque)
    _news: asyncio.Event = field(default_factory=asyncio.Event)
    _missed: int = 0

    def offer(self, message: JsonObject) -> None:
        """Queue a message; on a full queue the oldest one that is no event goes, else the oldest."""
        if not self.wanted.passes(message):
            return
        if len(self._waiting) >= BACKLOG:
            victim = next((k for k, old in enumerate(self._waiting) if old["kind"] != "event"), 0)
            del self._waiting[victim]
            self._missed += 1
        self._waiting.append(message)
        self._news.set()

    async def next(self) -> JsonObject:
        """The next message, waiting for one; first of all how many were missed."""
        while not self._waiting:
            self._news.clear()
            await self._news.wait()
        if self._missed:
            missed, self._missed = self._missed, 0
            reason = f"this client reads too slowly; {missed} messages were dropped, events last"
            return {"kind": "gap", "v": API_VERSION, "missed": missed, "reason": reason}
        return self._waiting.popleft()


class Hub:
    """Numbers messages and hands them to every subscriber. All calls on the event loop's thread."""

    def __init__(self) -> None:
        self._subscriptions: set[Subscription] = set()
        self.last_seq = 0

    @property
    def clients(self) -> int:
        """How many subscribe."""
        return len(self._subscriptions)

    def subscribe(self, wanted: Filter) -> Subscription:
        """Begin to receive; end with `unsubscribe`."""
        subscription = Subscription(wanted)
        self._subscriptions.add(subscription)
        return subscription

    def unsubscribe(self, subscription: Subscription) -> None:
        """Receive no more."""
        self._subscriptions.discard(subscription)

    def publish(self, message: JsonObject) -> None:
        """Number a message and offer it to everyone."""
        self.last_seq += 1
        numbered = {"v": API_VERSION, "seq": self.last_seq, **message}
        for subscription in self._subscriptions:
            subscription.offer(numbered)
