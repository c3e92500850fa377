"""Time for everyone: the only place that reads a clock, and the text form of an instant."""

from __future__ import annotations

import time
from datetime import UTC, datetime, timedelta
from typing import Final, Protocol

LONGEST_SLEEP_S: Final = 0.1
"""Whoever waits looks up so often: to keep a connection alive, or because he was told to stop."""

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


class Clock(Protocol):
    """Site time, and the means to wait for it; and a time for deadlines, which nobody sets."""

    def now_ns(self) -> int:
        """Nanoseconds since the epoch, UTC: for stamps, never for intervals, for it can be set."""
        ...

    def monotonic_ns(self) -> int:
        """Nanoseconds since some fixed moment, at the machine's own pace: for intervals."""
        ...

    def sleep_until_ns(self, time_ns: int) -> bool:
        """Return at that site time, or after `LONGEST_SLEEP_S`; whether it has come."""
        ...


class SystemClock:
    """The machine's clock."""

    def now_ns(self) -> int:
        """Nanoseconds since the epoch, UTC."""
        return time.time_ns()

    def monotonic_ns(self) -> int:
        """Nanoseconds since some fixed moment."""
        return time.monotonic_ns()

    def sleep_until_ns(self, time_ns: int) -> bool:
        """Sleep the difference, so that a schedule's errors never add up."""
        return _sleep((time_ns - time.time_ns()) / 1e9)


class PacedClock:
    """Site time that runs from `start_ns` at `speed` times the machine's: the clock of a replay."""

    def __init__(self, start_ns: int, speed: float = 1.0) -> None:
        if not speed > 0:
            raise ValueError(f"replay speed: expected > 0, got {speed}")
        self._start_ns = start_ns
        self._speed = speed
        self._began_ns = time.monotonic_ns()

    def now_ns(self) -> int:
        """Nanoseconds since the epoch, in the replayed time."""
        return self._start_ns + round((time.monotonic_ns() - self._began_ns) * self._speed)

    def monotonic_ns(self) -> int:
        """Nanoseconds since some fixed moment."""
        return time.monotonic_ns()

    def sleep_until_ns(self, time_ns: int) -> bool:
        """Sleep until the replayed time gets there."""
        return _sleep((time_ns - self.now_ns()) / self._speed / 1e9)


class UnpacedClock:
    """Site time that jumps to whatever is waited for: as fast as the machine can."""

    def __init__(self, start_ns: int = 0) -> None:
        self._now_ns = start_ns

    def now_ns(self) -> int:
        """The latest time waited for, nanoseconds."""
        return self._now_ns

    def monotonic_ns(self) -> int:
        """Nanoseconds since some fixed moment."""
        return time.monotonic_ns()

    def sleep_until_ns(self, time_ns: int) -> bool:
        """Be there at once."""
        self._now_ns = max(self._now_ns, time_ns)
        return True


def utc_text(time_ns: int) -> str:
    """RFC 3339 text of an instant, in UTC with microseconds: `2026-01-31T12:00:00.050000Z`."""
    instant = _EPOCH + timedelta(microseconds=time_ns // 1000)
    return instant.isoformat(timespec="microseconds").replace("+00:00", "Z")


def utc_ns(text: str) -> int:
    """Nanoseconds since the epoch of an RFC 3339 text.

    Raises
    ------
    ValueError
        Where the text is no instant with an offset.
    """
    try:
        instant = datetime.fromisoformat(text)
    except ValueError:
        instant = None
    if instant is None or instant.tzinfo is None:
        raise ValueError(f"time: expected RFC 3339 with an offset such as 2026-01-31T12:00:00Z, got {text!r}")
    return (instant - _EPOCH) // timedelta(microseconds=1) * 1000


def _sleep(seconds: float) -> bool:
    if seconds > 0:
        time.sleep(min(seconds, LONGEST_SLEEP_S))
    return seconds <= LONGEST_SLEEP_S
