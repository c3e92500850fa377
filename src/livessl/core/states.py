"""Names of states: `Status` of an event (located, direction_only, refused), of tracks and of clocks; without NumPy.

Which status an event gets is decided in `core/stream/verdict.py`.
"""

from __future__ import annotations

from enum import StrEnum


class Status(StrEnum):
    """Kind of an event's answer: a position, a direction only, or none."""

    LOCATED = "located"
    DIRECTION_ONLY = "direction-only"
    REFUSED = "refused"


class TrackState(StrEnum):
    """Stage in the life of a track."""

    NEW = "new"
    UPDATE = "update"
    END = "end"


class ClockState(StrEnum):
    """Reliability of a node's mapping from sample index to site time."""

    SETTLING = "settling"
    LOCKED = "locked"
    STEPPED = "stepped"
