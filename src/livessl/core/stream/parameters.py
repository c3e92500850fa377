"""Defaults of the fusion: window, update interval, longest event, deadline of late arrays, backfill, sources."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

from livessl.core.stream.activity import ActivityParameters
from livessl.core.types import FRAME_S

BACKFILL_WAIT_S: Final = 0.3
"""Time, in seconds, for which a live event waits for requested frames. It is much longer than the round trip to a node,
but short for a person who waits for the event."""


@dataclass(frozen=True, slots=True)
class FusionParameters:
    """Parameters of joining the arrays' frames into updates and events.

    Parameters
    ----------
    deadline_s : float
        Longest time for which a frame index stays open for a late array.
    backfill_wait_s : float
        Longest time for which an event waits for requested frames.
    window_s, update_s : float
        Length of the windows from which updates are located, and the time between two updates.
    max_event_s : float
        Longest event; a longer sound is split into several.
    min_arrays : int
        Least number of arrays; an event detected by fewer is refused.
    sources, live_sources : int
        Largest number of sources, 1 or 2, that are searched for in an event, and in a window of a continuing sound.
    activity : ActivityParameters
        The activity rule, as the nodes use it. An event ends after a quiet hang-over.
    """

    deadline_s: float = 0.5
    backfill_wait_s: float = BACKFILL_WAIT_S
    window_s: float = 0.2
    update_s: float = 0.1
    max_event_s: float = 10.0
    min_arrays: int = 1
    sources: int = 2
    live_sources: int = 1
    activity: ActivityParameters = field(default_factory=ActivityParameters)

    @property
    def window_frames(self) -> int:
        """Number of frames of a window."""
        return round(self.window_s / FRAME_S)

    @property
    def update_frames(self) -> int:
        """Number of frames from one update to the next."""
        return round(self.update_s / FRAME_S)
