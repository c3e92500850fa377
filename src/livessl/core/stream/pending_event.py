"""Keeps the state of an event (open, ended, awaiting backfill) until it is reported. It decides nothing.

`Fusion` in `fusion` decides when an event begins and ends. Its id, status and reason are made in `verdict`.

Its states are these.

| state | entered when | next state |
|---|---|---|
| `OPEN` | a frame index with an active frame closes | `ENDED`; `REPORTED` if the event is cut short |
| `ENDED` | the sound was quiet for a hang-over, or the event became too long | `AWAITING_BACKFILL`, `REPORTED` |
| `AWAITING_BACKFILL` | frames were requested from arrays that did not detect the sound | `REPORTED` |
| `REPORTED` | the results were handed over, or another pass will make them | none |

An event is cut short if no more frames come: at the end of a recording, before a gap, when all arrays are silent, and
when the server's clock is set back.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Final

from livessl.core.stream.excerpt import Excerpt
from livessl.core.types import Event, Frame


class EventState(StrEnum):
    """A stage in the life of an event."""

    OPEN = "open"
    ENDED = "ended"
    AWAITING_BACKFILL = "awaiting backfill"
    REPORTED = "reported"


_PREDECESSORS: Final[Mapping[EventState, frozenset[EventState]]] = {
    EventState.OPEN: frozenset(),
    EventState.ENDED: frozenset({EventState.OPEN}),
    EventState.AWAITING_BACKFILL: frozenset({EventState.ENDED}),
    EventState.REPORTED: frozenset({EventState.OPEN, EventState.ENDED, EventState.AWAITING_BACKFILL}),
}


@dataclass(slots=True)
class RequestedFrames:
    """The frames that were requested from one array, and those that have arrived. Frame indices are joint ones."""

    span: range
    frames: dict[int, Frame] = field(default_factory=dict)

    def take(self, frame: Frame) -> None:
        """Take in a frame, if it was requested."""
        if frame.frame_index in self.span:
            self.frames[frame.frame_index] = frame

    @property
    def is_complete(self) -> bool:
        """True once the last requested frame has arrived; frames arrive in order, so all others came before it."""
        return self.span[-1] in self.frames


class PendingEvent:
    """An event that has not been reported yet. Frame indices are joint ones.

    Parameters
    ----------
    start : int
        Frame index of its first active frame.
    """

    def __init__(self, start: int) -> None:
        self.state = EventState.OPEN
        self.start = start
        self.last_active = start
        self.closed = start
        """The last frame index that was closed; later frames do not belong to the event."""
        self.became_quiet = False
        """True if the event ended with a quiet hang-over, not by its length."""
        self.late_frames = 0
        self.excerpt: Excerpt | None = None
        """Sound from which the event was located; None before that, and if another pass reports the event."""
        self.results: Sequence[Event] = ()
        """Results, one for each source; empty before the event is located, and if another pass reports the event."""
        self.requested: Mapping[str, RequestedFrames] = {}
        self.requested_ns = 0

    @property
    def has_ended(self) -> bool:
        """True if the sound has ended, by a quiet hang-over or by its length; False if it was cut short."""
        return self.state in (EventState.ENDED, EventState.AWAITING_BACKFILL)

    @property
    def length(self) -> int:
        """Number of frame indices from the start of the event to the last closed one."""
        return self.closed - self.start + 1

    @property
    def quiet_frames(self) -> int:
        """Number of frame indices that were closed since the last active one."""
        return self.closed - self.last_active

    def close(self, frame_index: int, *, active: bool) -> None:
        """Add a closed frame index."""
        self.closed = frame_index
        if active:
            self.last_active = frame_index

    def note_late_frame(self) -> None:
        """Count an active frame that came after its frame index had closed."""
        self.late_frames += 1

    def end(self, *, became_quiet: bool) -> None:
        """End the sound."""
        self._go_to(EventState.ENDED)
        self.became_quiet = became_quiet

    def set_results(self, results: Sequence[Event], excerpt: Excerpt | None) -> None:
        """Set the results, and the excerpt from which they were located."""
        self.results, self.excerpt = results, excerpt

    def await_backfill(self, requested: Mapping[str, RequestedFrames], now_ns: int) -> None:
        """Begin to wait for frames that were requested at `now_ns`."""
        self._go_to(EventState.AWAITING_BACKFILL)
        self.requested, self.requested_ns = requested, now_ns

    def report(self) -> None:
        """Mark the event as reported."""
        self._go_to(EventState.REPORTED)

    def _go_to(self, state: EventState) -> None:
        if self.state not in _PREDECESSORS[state]:
            expected = " or ".join(repr(str(before)) for before in EventState if before in _PREDECESSORS[state])
            raise RuntimeError(
                f"event at frame index {self.start}: expected {expected} before {str(state)!r}, got {str(self.state)!r}"
            )
        self.state = state
