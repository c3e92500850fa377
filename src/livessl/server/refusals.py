"""Refused nodes and clients: all are counted by their cause, and a bounded number is remembered and logged.

Counted are handshakes that `guard` refuses, greetings that `admission` refuses (those of another version among them),
and requests that `api/auth` and `api/hosts` refuse. Messages that are no valid ones are not refusals of a node:
`Ingest.malformed` counts them.
"""

from __future__ import annotations

import logging
import threading
from dataclasses import dataclass
from typing import Final

from livessl.clock import Clock

MAX_KNOWN: Final = 256
"""Most callers remembered by address or name, and reason; the refusals of any further ones are only counted."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Refused:
    """The refusals of one caller for one reason.

    `door` is the interface, `nodes` or `http`; `who` is the caller's address, or the name of a node that greeted;
    `last_ns` is the site time of the last refusal.
    """

    door: str
    who: str
    reason: str
    count: int
    last_ns: int


class Refusals:
    """All refusals since the start. Every thread may call it.

    Parameters
    ----------
    clock : Clock
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._counts: dict[tuple[str, str], int] = {}
        self._known: dict[tuple[str, str, str], Refused] = {}

    def note(self, door: str, who: str, reason: str, text: str | None = None) -> None:
        """Count a refusal; only the first one of a caller for a reason is logged.

        `reason` is one of a few fixed texts, because it labels a metric. The log has `text`, if there is one, instead.
        """
        with self._lock:
            self._counts[door, reason] = self._counts.get((door, reason), 0) + 1
            key = (door, who, reason)
            before = self._known.get(key)
            if before is None and len(self._known) >= MAX_KNOWN:
                return
            count = 1 if before is None else before.count + 1
            self._known[key] = Refused(door, who, reason, count, self._clock.now_ns())
        if before is None:
            _log.warning("%s: %s was refused: %s (logged once, counted in /metrics)", door, who, text or reason)

    def counts(self) -> dict[tuple[str, str], int]:
        """Return the number of refusals by door and reason."""
        with self._lock:
            return dict(self._counts)

    def count(self, door: str) -> int:
        """Return the number of refusals at a door."""
        return sum(count for (where, _), count in self.counts().items() if where == door)

    def known(self) -> list[Refused]:
        """Return the remembered callers, the latest first."""
        with self._lock:
            return sorted(self._known.values(), key=lambda refused: -refused.last_ns)
