"""Decides that a node's clock is behind the server's, from when its messages were sent and received, and words it.

Clocks that are ahead of the server's are found in `core/stream/alignment.py`, and differences between nodes in
`core/stream/clock_offsets.py`.

A message that was sent by a clock that is behind seems to have taken that long. A real delay varies, so the least one
of some seconds is taken; it is the clock's, or that of a network which never is faster. Frames from the future are
rejected by `core.stream.alignment`, and arrays are compared with each other by `core.stream.clock_offsets`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from livessl.core.commission.finding import Finding, Severity

WINDOW_NS: Final = 5_000_000_000
"""Time, in nanoseconds, of which the least delay is taken. Sounds are located at the latest after two of these."""

MOST_BEHIND_S: Final = 0.3
"""Least delay, in seconds, from which a clock is reported. Frames are awaited for less, and sounds whose times differ
by more are not one event."""


@dataclass(slots=True)
class _Delays:
    """The least delay of the window that goes on, and of the one before."""

    began_ns: int
    least_ns: int
    before_ns: int | None = None


class NodeClocks:
    """The least delay of each array's messages. The receiver's thread writes, every thread may read."""

    def __init__(self) -> None:
        self._delays: dict[str, _Delays] = {}

    def note(self, array: str, sent_ns: int, received_ns: int) -> None:
        """Note a message of an array.

        Parameters
        ----------
        array : str
        sent_ns : int
            When it was sent, by the node's clock; 0 if that is unknown.
        received_ns : int
            When it was received, by the server's clock.
        """
        if not sent_ns:
            return
        delay_ns, known = received_ns - sent_ns, self._delays.get(array)
        if known is None:
            self._delays[array] = _Delays(received_ns, delay_ns)
        elif 0 <= received_ns - known.began_ns < WINDOW_NS:
            known.least_ns = min(known.least_ns, delay_ns)
        else:
            self._delays[array] = _Delays(received_ns, delay_ns, known.least_ns)

    def behind_s(self, array: str) -> float | None:
        """Return by how many seconds an array's clock is behind; None if it is less than `MOST_BEHIND_S`, or unknown.

        At least one whole window must have shown it.
        """
        known = self._delays.get(array)
        if known is None or known.before_ns is None:
            return None
        behind_s = min(known.least_ns, known.before_ns) / 1e9
        return behind_s if behind_s > MOST_BEHIND_S else None


CURE: Final = "set both clocks by NTP"


def clock_is_behind(behind_s: float) -> str:
    """Return the reason why an array whose clock is so far behind, in seconds, is degraded."""
    return f"its node's clock is {_behind(behind_s)}; {CURE}"


def clock_finding(array: str, behind_s: float) -> Finding:
    """Return the finding about an array whose clock is so far behind, in seconds."""
    message = f"the clock of the node of {array!r} is {_behind(behind_s)}"
    return Finding("clock", array, None, Severity.ERROR, 0.99, message, CURE)


def _behind(behind_s: float) -> str:
    return f"{behind_s:.1f} s behind the server's, or its network is never faster than that"
