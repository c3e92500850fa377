"""Clocks, the text form of an instant, and time zones. Only this module reads the machine's clock.

It has the clock of the machine, those that pace a replay, and the UTC text of every time stamp.
"""

from __future__ import annotations

import time
from datetime import UTC, datetime, timedelta
from typing import Final, NamedTuple, Protocol
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

LONGEST_SLEEP_S: Final = 0.1
"""Longest single sleep, in seconds, so that waiting code can keep its connection alive and notice a stop request."""

_FARTHEST_NS: Final = 269 * 365 * 86_400 * 10**9
"""Greatest distance of a recording from 1970, in nanoseconds: times are sent in 64 bits, which hold 292 years."""

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


class Clock(Protocol):
    """Site time, a means to wait for it, and a monotonic time for deadlines."""

    def now_ns(self) -> int:
        """Return nanoseconds since the epoch, UTC: for stamps, not for intervals, because this clock can be set."""
        ...

    def monotonic_ns(self) -> int:
        """Return nanoseconds by the monotonic clock: for intervals."""
        ...

    def sleep_until_ns(self, time_ns: int) -> bool:
        """Wait until that site time, but at most `LONGEST_SLEEP_S`; return True if it has been reached."""
        ...


class SystemClock:
    """The machine's clock."""

    def now_ns(self) -> int:
        """Return nanoseconds since the epoch, UTC."""
        return time.time_ns()

    def monotonic_ns(self) -> int:
        """Return nanoseconds by the monotonic clock."""
        return time.monotonic_ns()

    def sleep_until_ns(self, time_ns: int) -> bool:
        """Sleep for the difference to the present time, so that the errors of a schedule do not add up."""
        return _sleep((time_ns - time.time_ns()) / 1e9)


def thread_time_s() -> float:
    """Return the processor time, in seconds, that the calling thread has taken."""
    return time.thread_time()


class PacedClock:
    """Site time that runs from `start_ns` on at `speed` times the machine's pace: the clock of a replay."""

    def __init__(self, start_ns: int, speed: float = 1.0) -> None:
        if not speed > 0:
            raise ValueError(f"replay speed: expected > 0, got {speed}")
        self._start_ns = start_ns
        self._speed = speed
        self._began_ns = time.monotonic_ns()

    def now_ns(self) -> int:
        """Return nanoseconds since the epoch in replayed time."""
        return self._start_ns + round((time.monotonic_ns() - self._began_ns) * self._speed)

    def monotonic_ns(self) -> int:
        """Return nanoseconds by the monotonic clock."""
        return time.monotonic_ns()

    def sleep_until_ns(self, time_ns: int) -> bool:
        """Sleep until the replayed time is reached."""
        return _sleep((time_ns - self.now_ns()) / self._speed / 1e9)


class UnpacedClock:
    """Site time that jumps to each time that is waited for: for processing as fast as the machine can."""

    def __init__(self, start_ns: int = 0) -> None:
        self._now_ns = start_ns

    def now_ns(self) -> int:
        """Return the latest time that was waited for, in nanoseconds."""
        return self._now_ns

    def monotonic_ns(self) -> int:
        """Return nanoseconds by the monotonic clock."""
        return time.monotonic_ns()

    def sleep_until_ns(self, time_ns: int) -> bool:
        """Set the time, and return True at once."""
        self._now_ns = max(self._now_ns, time_ns)
        return True


def utc_text(time_ns: int) -> str:
    """Return an instant as RFC 3339 text in UTC with microseconds: `2026-01-31T12:00:00.050000Z`."""
    instant = _EPOCH + timedelta(microseconds=time_ns // 1000)
    return instant.isoformat(timespec="microseconds").replace("+00:00", "Z")


def recordable_ns(text: str) -> int:
    """Return the nanoseconds since the epoch of an RFC 3339 text at which a recording can begin.

    Raises
    ------
    ValueError
        If the text is not an instant with an offset from UTC, or too far from 1970 to be sent in 64 bits.
    """
    time_ns = utc_ns(text)
    if abs(time_ns) > _FARTHEST_NS:
        raise ValueError(f"time: expected one in the years 1701 to 2239, got {text!r}")
    return time_ns


def utc_ns(text: str) -> int:
    """Return the nanoseconds since the epoch of an RFC 3339 text.

    Raises
    ------
    ValueError
        If the text is not an instant with an offset from UTC.
    """
    try:
        instant = datetime.fromisoformat(text)
    except ValueError:
        instant = None
    if instant is None or instant.tzinfo is None:
        raise ValueError(f"time: expected RFC 3339 with an offset such as 2026-01-31T12:00:00Z, got {text!r}")
    return instant_ns(instant)


def instant_ns(instant: datetime) -> int:
    """Return the nanoseconds since the epoch of an instant that has an offset from UTC."""
    return (instant - _EPOCH) // timedelta(microseconds=1) * 1000


class LocalTime(NamedTuple):
    """A moment of the week in some time zone: the day, 0 for Monday, and the minutes since its midnight."""

    weekday: int
    minute: int


def local_time(time_ns: int, zone: str | None) -> LocalTime:
    """Return what wall clocks show at an instant; without a zone, those of this machine's zone."""
    instant = _EPOCH + timedelta(microseconds=time_ns // 1000)
    local = instant.astimezone(None if zone is None else ZoneInfo(zone))
    return LocalTime(local.weekday(), 60 * local.hour + local.minute)


def check_time_zone(name: str) -> None:
    """Check that this machine knows a time zone.

    Raises
    ------
    ValueError
        If it does not.
    """
    try:
        ZoneInfo(name)
    except (ZoneInfoNotFoundError, ValueError, OSError) as error:
        raise ValueError(f"expected a time zone such as Europe/Berlin or UTC, got {name!r}") from error


def _sleep(seconds: float) -> bool:
    if seconds > 0:
        time.sleep(min(seconds, LONGEST_SLEEP_S))
    return seconds <= LONGEST_SLEEP_S
