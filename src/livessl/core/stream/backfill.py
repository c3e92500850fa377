"""Arrays that did not find a sound active: which of them to ask for their frames of it, and what these say.

An array is asked where the answer of those that heard is not sure, for the very frames that its node would have sent
with it. It takes part if the answer is better with it: evidence is not normalised, so that an array that heard nothing
adds next to nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import takewhile
from typing import Final

import numpy as np

from livessl.core.correlate.onset_gcc import OnsetGCC
from livessl.core.locate.estimators import Estimator
from livessl.core.stream.segmenter import RECENT_S
from livessl.core.types import FRAME_S, ArraySpec, Event, Frame, Status

SURE: Final = 0.95
"""With a confidence from here on nobody is asked."""

MOST_ARRAYS: Final = 4
"""Asked about one event: the nearest to those that heard it."""

MOST_ASKED_S: Final = 3.0
"""Of an event, from its run-up on: what a longer one says besides, those that hear it say, too."""

SHARE: Final = 0.25
"""Of its sound that an array is asked for in the long run, beyond a first `RECENT_S`."""

_RANK: Final = {Status.REFUSED: 0, Status.DIRECTION_ONLY: 1, Status.LOCATED: 2}


def better(event: Event, than: Event) -> bool:
    """Whether an answer is worth more than another of the same sound, or as much."""
    return _worth(event) >= _worth(than)


def is_sure(event: Event) -> bool:
    """Whether nobody need be asked."""
    return event.status is Status.LOCATED and event.estimate is not None and event.estimate.confidence >= SURE


def _worth(event: Event) -> tuple[int, float]:
    return _RANK[event.status], 0.0 if event.estimate is None else event.estimate.confidence


def nearest(silent: Sequence[ArraySpec], heard: Sequence[ArraySpec]) -> list[ArraySpec]:
    """Those of the silent arrays that are worth asking, the nearest to one that heard first."""
    apart_m = [min(float(np.linalg.norm(spec.centre_m - other.centre_m)) for other in heard) for spec in silent]
    return [silent[k] for k in np.argsort(apart_m, kind="stable")[:MOST_ARRAYS]]


@dataclass(slots=True)
class Allowance:
    """How much of one array's sound may still be asked for: it grows with time. In frame indices."""

    left: float = RECENT_S / FRAME_S
    at: int | None = None
    refused: int = 0

    def take(self, frames: int, now: int) -> bool:
        """Whether so many frames may be asked for; then they are taken off."""
        if self.at is not None:
            self.left = min(RECENT_S / FRAME_S, self.left + SHARE * (now - self.at))
        self.at = now
        if frames > self.left:
            self.refused += 1
            return False
        self.left -= frames
        return True


@dataclass(frozen=True, slots=True)
class AskedSound:
    """What an array that was asked heard: its frames from the event's start on, and what they and its run-up say."""

    frames: list[Frame]
    onsets: tuple[OnsetGCC, ...]


@dataclass(slots=True)
class Asked:
    """What one array was asked for, and has answered. In joint frame indices."""

    span: range
    frames: dict[int, Frame] = field(default_factory=dict)

    @property
    def is_answered(self) -> bool:
        """Whether all is there: frames come in order."""
        return self.span[-1] in self.frames

    def sound(self, estimator: Estimator, start: int) -> AskedSound | None:
        """What it heard of an event that began at `start`; None where it has no frames of it, or no listener."""
        last_ones = list(takewhile(lambda frame_index: frame_index in self.frames, reversed(self.span)))[::-1]
        frames = [self.frames[frame_index] for frame_index in last_ones]
        loud = [frame for frame_index, frame in zip(last_ones, frames, strict=True) if frame_index >= start]
        if not loud or len({frame.sample_rate_hz for frame in frames}) > 1:
            return None
        listener = estimator.listener(frames[0].array, frames[0].sample_rate_hz)
        if listener is None:
            return None
        heard = zip(last_ones, frames, strict=True)
        return AskedSound(
            loud, tuple(listener.push(frame.samples, quiet=frame_index < start) for frame_index, frame in heard)
        )
