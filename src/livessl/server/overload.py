"""Measures the load of the server, and words an overload; `core/stream/load_policy.py` decides what is shed.

The fusion thread measures its own delay in every turn, one pass of its loop. Every thread may read the figures.
"""

from __future__ import annotations

import logging
import threading
from collections import deque
from dataclasses import replace
from typing import Final, NamedTuple

from livessl.clock import Clock, utc_text
from livessl.core.stream.load_policy import LEVELS, NOTHING_SHED, PROMPT_S, LoadPolicy, Relief
from livessl.server.api.encode import JsonObject

MEMORY_NS: Final = 5_000_000_000
"""Length, in nanoseconds, of the span over which the figures are means and maxima."""

_WORDS: Final = {
    "updates": "some updates",
    "second_looks": "second looks at unsure events",
    "maps": "power maps",
    "arrays": "arrays with the least evidence",
    "quiet": "the correlation of quiet frames",
}

CURE: Final = "Use a faster machine or fewer arrays per server, raise fusion.update_s, or stop other programs on it"
"""Cure of an overload, in words."""

_log = logging.getLogger(__name__)


class _Turn(NamedTuple):
    """Figures of one turn of the fusion thread."""

    ended_ns: int
    lasted_ns: int
    waited_ns: int
    messages: int
    delay_s: float


class _Figures(NamedTuple):
    """Figures over the turns of the last `MEMORY_NS`."""

    busy: float
    messages_per_s: float
    delay_s: float


class Overload:
    """Measures the delay of the fusion, and keeps which work is shed.

    Only the fusion thread may call `note`.

    Parameters
    ----------
    clock : Clock
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._policy = LoadPolicy()
        self._turns: deque[_Turn] = deque()
        self._lasted_ns = self._waited_ns = self._messages = 0  # sums over the turns
        self._lock = threading.Lock()  # protects the turns and their sums
        self._ended_ns = clock.monotonic_ns()
        self._taken = self._ended_ns, 0.0  # time of the last turn, and how long its first message had waited
        self._since_ns: int | None = None
        self.relief = NOTHING_SHED
        """The work that is shed now."""
        self.updates_shed = 0
        """Number of windows that were not located because of overload, since the start."""

    def note(self, delay_s: float, messages: int, waited_ns: int, *, sheds: bool) -> Relief:
        """Take in the figures of a turn of the fusion thread; return the work that is shed from now on.

        Parameters
        ----------
        delay_s : float
            Time for which the first message of the turn had waited, seconds; 0 without a message.
        messages : int
            Number of messages of the turn.
        waited_ns : int
            Time for which the thread waited for these messages, nanoseconds.
        sheds : bool
            Whether work may be shed; False in a replay, which can wait.
        """
        now_ns = self._clock.monotonic_ns()
        self._add(_Turn(now_ns, now_ns - self._ended_ns, waited_ns, messages, delay_s), 1)
        self._ended_ns = now_ns
        self._taken = now_ns, delay_s
        while self._turns[0].ended_ns < now_ns - MEMORY_NS:
            self._add(self._turns[0], -1)
        before = self._policy.level
        if not sheds:
            self._policy = LoadPolicy()
        level = self._policy.note(delay_s, self._busy(), now_ns) if sheds else 0
        if level != before:
            self._report(before, level)
        relief = LEVELS[level]
        if level and delay_s > PROMPT_S:
            relief = replace(relief, update_every=None, second_looks=False)
        self.relief = relief
        return relief

    def unheard_ns(self) -> int:
        """Return the age, in nanoseconds, of the messages that the fusion took last.

        Later messages are not known yet. An array that seems silent for a shorter time may therefore have sent sound.
        """
        taken_ns, delay_s = self._taken
        return self._clock.monotonic_ns() - taken_ns + round(1e9 * delay_s)

    def describe(self) -> JsonObject:
        """Return the figures as the API reports them."""
        level, since_ns = self._policy.level, self._since_ns
        busy, messages_per_s, delay_s = self._figures()
        return {
            "state": "overloaded" if level else "normal",
            "level": level,
            "since_utc": None if since_ns is None else utc_text(since_ns),
            "delay_s": round(delay_s, 4),
            "busy": round(busy, 3),
            "messages_per_s": round(messages_per_s, 1),
            "shed": list(LEVELS[level].shed),
            "updates_shed": self.updates_shed,
            "message": self.message,
        }

    @property
    def message(self) -> str | None:
        """Figures and cure in words; None while nothing is shed."""
        shed = LEVELS[self._policy.level].shed
        if not shed:
            return None
        busy, messages_per_s, delay_s = self._figures()
        what = " and ".join(filter(None, [", ".join(_WORDS[name] for name in shed[:-1]), _WORDS[shed[-1]]]))
        return (
            f"overloaded: sound waited up to {delay_s:.2f} s, and the fusion works {100 * busy:.0f} % of the time on "
            f"{messages_per_s:.0f} messages a second; it sheds {what}. {CURE}"
        )

    def _add(self, turn: _Turn, sign: int) -> None:
        """Add the newest turn to the sums, or with a negative sign remove the oldest one."""
        with self._lock:
            if sign > 0:
                self._turns.append(turn)
            else:
                self._turns.popleft()
            self._lasted_ns += sign * turn.lasted_ns
            self._waited_ns += sign * turn.waited_ns
            self._messages += sign * turn.messages

    def _figures(self) -> _Figures:
        with self._lock:
            delay_s = max((turn.delay_s for turn in self._turns), default=0.0)
            return _Figures(self._busy(), 1e9 * self._messages / max(1, self._lasted_ns), delay_s)

    def _busy(self) -> float:
        return min(1.0, max(0.0, 1.0 - self._waited_ns / max(1, self._lasted_ns)))

    def _report(self, before: int, level: int) -> None:
        if before == 0:
            self._since_ns = self._clock.now_ns()
            _log.warning("%s", self.message)
        elif level == 0:
            self._since_ns = None
            _log.info("no longer overloaded: nothing is shed")
