"""The server's load: how far it is behind the sound, what it sheds for that, and what people are told about it.

The fusion thread measures; `core.stream.load_policy` decides. Every thread may read the figures.
"""

from __future__ import annotations

import logging
import threading
from collections import deque
from typing import Final, NamedTuple

from livessl.clock import Clock, utc_text
from livessl.core.stream.load_policy import LEVELS, NOTHING_SHED, PROMPT_S, LoadPolicy, Relief
from livessl.server.api.encode import JsonObject

MEMORY_NS: Final = 5_000_000_000
"""Time, in nanoseconds, of which the figures are means and maxima."""

_WORDS: Final = {
    "updates": "some updates",
    "maps": "power maps",
    "arrays": "arrays with the least evidence",
    "quiet": "frames of quiet",
}

_log = logging.getLogger(__name__)


class _Turn(NamedTuple):
    """One turn of the fusion thread."""

    ended_ns: int
    lasted_ns: int
    waited_ns: int
    frames: int
    delay_s: float


class Overload:
    """Measures the fusion's delay, and decides what is shed.

    `note` is for the fusion thread.

    Parameters
    ----------
    clock : Clock
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._policy = LoadPolicy()
        self._turns: deque[_Turn] = deque()
        self._lock = threading.Lock()
        self._ended_ns = clock.monotonic_ns()
        self._since_ns: int | None = None
        self.relief = NOTHING_SHED
        """What is shed now."""
        self.updates_shed = 0
        """Windows that were not located for the load, since the start."""

    @property
    def level(self) -> int:
        """Level of shedding: 0 sheds nothing."""
        return self._policy.level

    def note(self, delay_s: float, frames: int, waited_ns: int, *, sheds: bool) -> Relief:
        """Take in a turn of the fusion thread; return what is shed from now on.

        Parameters
        ----------
        delay_s : float
            How long the first message of the turn had waited; 0 if there was none.
        frames : int
            Number of messages of the turn.
        waited_ns : int
            How long the thread waited for them.
        sheds : bool
            Whether anything may be shed: not in a replay, which can wait.
        """
        now_ns = self._clock.monotonic_ns()
        turn = _Turn(now_ns, now_ns - self._ended_ns, waited_ns, frames, delay_s)
        self._ended_ns = now_ns
        with self._lock:
            self._turns.append(turn)
            while self._turns[0].ended_ns < now_ns - MEMORY_NS:
                self._turns.popleft()
        before = self._policy.level
        if not sheds:
            self._policy = LoadPolicy()
        level = self._policy.note(delay_s, self._busy(), now_ns) if sheds else 0
        if level != before:
            self._report(before, level)
        relief = LEVELS[level]
        if level and delay_s > PROMPT_S:
            relief = Relief(None, relief.maps, relief.arrays, relief.ahead)
        self.relief = relief
        return relief

    def describe(self) -> JsonObject:
        """Return the figures as the API reports them."""
        with self._lock:
            turns = list(self._turns)
        lasted_s = max(1e-9, sum(turn.lasted_ns for turn in turns) / 1e9)
        relief = LEVELS[self._policy.level]
        since_ns = self._since_ns
        delay_s = max((turn.delay_s for turn in turns), default=0.0)
        rate = sum(turn.frames for turn in turns) / lasted_s
        message = None
        if relief.shed:
            what = " and ".join(_WORDS[name] for name in relief.shed)
            message = (
                f"overloaded: results are up to {delay_s:.2f} s behind and the fusion works {100 * self._busy():.0f} % "
                f"of the time on {rate:.0f} messages a second; shed: {what}. {CURE}"
            )
        return {
            "state": "overloaded" if relief.shed else "normal",
            "level": self._policy.level,
            "since_utc": None if since_ns is None else utc_text(since_ns),
            "delay_s": round(delay_s, 4),
            "busy": round(self._busy(), 3),
            "messages_per_s": round(rate, 1),
            "shed": list(relief.shed),
            "updates_shed": self.updates_shed,
            "message": message,
        }

    def _busy(self) -> float:
        turns = self._turns
        lasted_ns = sum(turn.lasted_ns for turn in turns)
        return min(1.0, max(0.0, 1.0 - sum(turn.waited_ns for turn in turns) / lasted_ns)) if lasted_ns else 0.0

    def _report(self, before: int, level: int) -> None:
        if before == 0:
            self._since_ns = self._clock.now_ns()
            _log.warning("%s", self.describe()["message"])
        elif level == 0:
            self._since_ns = None
            _log.info("no longer overloaded: nothing is shed")


CURE: Final = (
    "Use a faster machine, fewer arrays per server, or raise fusion.update_s; stop other programs on this machine"
)
"""What helps against an overload."""
