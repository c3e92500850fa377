"""Frames and events whose clips a test makes at a desk of clips."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from alert_desk import START, refused, sound
from clip_desk import ClipDesk
from livessl.core.types import FRAME_NS, Event, Frame
from small_site import RATE_HZ, Changes, frame


def desk_of(directory: Path, changes: Changes | None = None, **clips: Any) -> ClipDesk:
    """A desk whose clock begins when the sounds do."""
    return ClipDesk(directory, START * FRAME_NS, changes, **clips)


def heard(indices: Sequence[int], array: str = "north", ahead_ns: int = 0) -> list[Frame]:
    """Frames of an array around the sound that begins at `START`; its own clock is ahead."""
    found = []
    for n in indices:
        first = frame(n + 1000, START + n, array, active=0 <= n < 10, seed=n + 100)
        level = np.float32(1.0 if first.active else 0.01)
        found.append(
            Frame(
                array,
                n + 1000,
                first.frame_index,
                first.time_ns + ahead_ns,
                RATE_HZ,
                level * first.samples,
                0.01,
                first.active,
            )
        )
    return found


def event(number: int = 0, **more: Any) -> Event:
    made = sound(number, **more)
    return Event(**{name: getattr(made, name) for name in made.__slots__} | {"heard_by": ("north", "south")})


def refused_one(number: int = 0) -> Event:
    """A refused event that both arrays detected."""
    return replace(refused(number), heard_by=("north", "south"))
