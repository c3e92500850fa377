"""Measures how long a message of a site has been missing at the hub; `intake` decides when it is given up."""

from __future__ import annotations

from collections.abc import Mapping, Set
from typing import Final, NamedTuple

STEP_S: Final = 1.0
"""Most seconds that count from one stored batch to the next, so that a time without a database or stream counts little:
the missing message may have waited as well."""


class _Gap(NamedTuple):
    """The number before the gap, the seconds for which it has been seen, and the monotonic time of the last look."""

    last: int
    seen_s: float
    at_ns: int


class Gaps:
    """The gaps of all outboxes, each under its site and name.

    Not safe for several threads.
    """

    def __init__(self) -> None:
        self._gaps: dict[tuple[str, str], _Gap] = {}

    def seen_s(self, key: tuple[str, str], last: int, now_ns: int) -> float:
        """Return for how many seconds, at a monotonic time, the message after `last` has been missing."""
        gap = self._gaps.get(key)
        if gap is None or gap.last != last:
            return 0.0
        return gap.seen_s + min(STEP_S, (now_ns - gap.at_ns) / 1e9)

    def note(self, last: Mapping[tuple[str, str], int], lacking: Set[tuple[str, str]], now_ns: int) -> None:
        """Note the gaps that a batch had, once what could be stored of it is stored.

        Parameters
        ----------
        last : mapping of (str, str) to int
            Number of the last stored message of each outbox in the batch.
        lacking : set of (str, str)
            Outboxes of which messages wait for earlier ones.
        now_ns : int
            Monotonic time, in nanoseconds.
        """
        for key, number in last.items():
            if key in lacking:
                self._gaps[key] = _Gap(number, self.seen_s(key, number, now_ns), now_ns)
            elif key in self._gaps and self._gaps[key].last != number:
                del self._gaps[key]
