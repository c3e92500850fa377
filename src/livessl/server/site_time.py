"""Keeps site time: the machine's clock in a live run, the recording's in a replay, which ends after a silence."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final, Literal

from livessl.clock import Clock
from livessl.core.types import FRAME_NS, Message

REPLAY_SILENT_NS: Final = 5_000_000_000
"""Silence, in nanoseconds, after which a replay has ended, unless its node still sends its greetings."""


class SiteTime:
    """The mode of the server, live or replay, and the site time of that run.

    The fusion thread changes it; every thread may read it.

    Parameters
    ----------
    clock : Clock
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._replayed_ns: int | None = None
        self._last_sound_ns = 0
        self._began_ns = clock.monotonic_ns()
        self.started_ns = clock.now_ns()
        """Site time at which the server started, nanoseconds."""
        self.replay_is_running = False
        """True while a replay sends sound; after its end the mode stays `replay` until a live node joins."""

    @property
    def mode(self) -> Literal["live", "replay"]:
        """`replay` from the first node of a recorded session until a live node joins; otherwise `live`."""
        return "live" if self._replayed_ns is None else "replay"

    @property
    def is_replay(self) -> bool:
        """True if the mode is `replay`."""
        return self._replayed_ns is not None

    def now_ns(self) -> int:
        """Return site time in nanoseconds: the clock's, or in a replay the end of the newest recorded frame."""
        replayed_ns = self._replayed_ns
        return self._clock.now_ns() if replayed_ns is None else replayed_ns

    def uptime_s(self) -> float:
        """Return the seconds since the server started."""
        return (self._clock.monotonic_ns() - self._began_ns) / 1e9

    def begin_live(self) -> None:
        """Take site time from the clock."""
        self._replayed_ns = None
        self.replay_is_running = False

    def begin_replay(self) -> None:
        """Take site time from the recording, whatever its date."""
        self._replayed_ns = 0
        self.replay_is_running = True
        self.note_sound()

    def end_replay(self) -> None:
        """End the replay; site time stays at the end of the recording."""
        self.replay_is_running = False

    def advance(self, messages: Iterable[Message]) -> None:
        """Move a replay's site time to the end of the newest of these messages; a live run's moves by itself."""
        if self._replayed_ns is not None:
            ends_ns = ((message.frame_index + 1) * FRAME_NS for message in messages)
            self._replayed_ns = max(self._replayed_ns, *ends_ns, 0)

    def note_sound(self) -> None:
        """Note that messages have just arrived."""
        self._last_sound_ns = self._clock.monotonic_ns()

    def replay_is_silent(self) -> bool:
        """Return whether a replay is running that has sent no messages for `REPLAY_SILENT_NS`."""
        return self.replay_is_running and self._clock.monotonic_ns() - self._last_sound_ns > REPLAY_SILENT_NS
