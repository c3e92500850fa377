"""Who was turned away, at either door: counted without bound, remembered and logged with one."""

from __future__ import annotations

import logging
import threading
from dataclasses import dataclass
from typing import Final

from livessl.clock import Clock

MAX_KNOWN: Final = 256
"""Callers remembered by address. Whoever comes from more of them than that is only counted."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Refused:
    """One caller that was turned away for one reason, and how often."""

    door: str
    who: str
    reason: str
    count: int
    last_ns: int


class Refusals:
    """Everyone who was refused since the start; from any thread.

    Parameters
    ----------
    clock : Clock
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._counts: dict[tuple[str, str], int] = {}
        self._known: dict[tuple[str, str, str], Refused] = {}

    def note(self, door: str, who: str, reason: str) -> None:
        """Somebody was refused: at the door `nodes` or `http`, from an address, for a reason of a fixed text."""
        with self._lock:
            self._counts[door, reason] = self._counts.get((door, reason), 0) + 1
            key = (door, who, reason)
            before = self._known.get(key)
            if before is None and len(self._known) >= MAX_KNOWN:
                return
            count = 1 if before is None else before.count + 1
            self._known[key] = Refused(door, who, reason, count, self._clock.now_ns())
        if before is None:
            _log.warning("%s: %s was refused: %s (told once, counted in /metrics)", door, who, reason)

    def counts(self) -> dict[tuple[str, str], int]:
        """How many were refused, by door and reason."""
        with self._lock:
            return dict(self._counts)

    def count(self, door: str) -> int:
        """How many were refused at a door."""
        return sum(count for (where, _), count in self.counts().items() if where == door)

    def known(self) -> list[Refused]:
        """The callers that are remembered, the latest first."""
        with self._lock:
            return sorted(self._known.values(), key=lambda refused: -refused.last_ns)
