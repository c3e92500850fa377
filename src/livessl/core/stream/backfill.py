"""Chooses which arrays must send missing frames of an event that they did not detect, and whether to use these.

If the result of the arrays that detected the sound is unsure, frames are requested from the others. They are used only
if they improve the result. Evidence is not normalised, so an array that received none of the sound hardly changes the
result.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from itertools import takewhile
from typing import Final

import numpy as np

from livessl.core.locate.estimator import Course, Estimator
from livessl.core.stream.excerpt import BackfilledSound
from livessl.core.stream.pending_event import PendingEvent, RequestedFrames
from livessl.core.stream.segmenter import RECENT_S
from livessl.core.stream.site_state import SiteState
from livessl.core.stream.verdict import Verdicts
from livessl.core.types import FRAME_S, ArraySpec, Event, Frame, Status

SURE_WITHOUT_BACKFILL: Final = 0.95
"""Confidence at and above which no frames are requested."""

MOST_REQUESTED_ARRAYS: Final = 4
"""Largest number of arrays from which frames are requested for one event. The arrays nearest to those that detected the
event come first."""

MOST_REQUESTED_S: Final = 3.0
"""Longest span, in seconds, that is requested for one event, pre-roll included. The arrays that detected a longer event
cover its rest."""

SHARE: Final = 0.25
"""Share of the elapsed time by which an array's allowance of requested sound grows. The allowance begins at `RECENT_S`,
which is also its most."""

_RANK: Final = {Status.REFUSED: 0, Status.DIRECTION_ONLY: 1, Status.LOCATED: 2}


class Backfill:
    """Chooses the frames to request for an event, and locates the event again with the frames that have arrived.

    Parameters
    ----------
    state : SiteState
    verdicts : Verdicts
    """

    def __init__(self, state: SiteState, verdicts: Verdicts) -> None:
        self._state = state
        self._verdicts = verdicts
        self._allowances: dict[str, Allowance] = {}

    def choose(self, event: PendingEvent, span: range, present: Collection[str]) -> dict[str, RequestedFrames]:
        """Choose the arrays that may improve the results of an event, and the frames to request from them.

        Parameters
        ----------
        event : PendingEvent
            Event with the results of the arrays that detected it.
        span : range
            Frame indices of the event up to its last active frame, pre-roll included.
        present : collection of str
            Arrays whose nodes have not ended.
        """
        excerpt = event.excerpt
        if excerpt is None or is_sure(event.results[0]) or not excerpt.sounds.has_onsets:
            return {}  # without onsets the estimator gives every array the same weight, whatever it received
        silent = [name for name in present if self._state.may_request(name) and name not in excerpt.powers]
        if not silent:
            return {}
        span = span[: round(MOST_REQUESTED_S / FRAME_S)]
        nearest_ones = nearest(self._state.specs(silent), self._state.specs(list(excerpt.sounds)))
        return {
            spec.name: RequestedFrames(span)
            for spec in nearest_ones
            if self._allowances.setdefault(spec.name, Allowance()).take(len(span), event.closed)
        }

    def take(self, event: PendingEvent, frame: Frame) -> None:
        """Take in a requested frame, unless the event has not requested it or its number of channels is wrong."""
        requested = event.requested.get(frame.array)
        if requested is not None and len(frame.samples) == len(self._state.arrays[frame.array].microphones_m):
            requested.take(frame)

    def is_over(self, event: PendingEvent, now_ns: int) -> bool:
        """Return whether all requested frames that can still arrive have arrived, or the wait has timed out."""
        if now_ns - event.requested_ns >= self._state.parameters.backfill_wait_s * 1e9:
            return True
        requested = event.requested.items()
        return all(frames.is_complete or not self._state.answers(name) for name, frames in requested)

    def reconsidered(self, event: PendingEvent, now_ns: int) -> Sequence[Event]:
        """Return the best results of an event: without the requested frames, with all of them, or with one array's."""
        estimator, best, excerpt = self._state.estimator, event.results, event.excerpt
        if excerpt is None:
            return best
        sounds = {name: backfilled_sound(frames, estimator, event.start) for name, frames in event.requested.items()}
        useful = {name: sound for name, sound in sounds.items() if sound is not None}
        attempts = [useful, *({name: useful[name]} for name in useful if len(useful) > 1)] if useful else []
        for backfilled in attempts:
            verdict = self._verdicts.locate_event(event, excerpt, now_ns, backfilled)
            if is_as_good(verdict.events[0], best[0]):
                best = verdict.events
                self._verdicts.count_votes(event, excerpt, verdict)
        return best

    def start_over(self) -> None:
        """Forget all earlier requests."""
        self._allowances.clear()


@dataclass(slots=True)
class Allowance:
    """Number of frames that may still be requested from one array, which grows with time. Frame indices are joint."""

    left: float = RECENT_S / FRAME_S
    at: int | None = None
    refused: int = 0

    def take(self, frames: int, now: int) -> bool:
        """Return whether a number of frames may be requested at frame index `now`; if so, subtract them."""
        if self.at is not None:
            self.left = min(RECENT_S / FRAME_S, self.left + SHARE * (now - self.at))
        self.at = now
        if frames > self.left:
            self.refused += 1
            return False
        self.left -= frames
        return True


def nearest(silent: Sequence[ArraySpec], detecting: Sequence[ArraySpec]) -> list[ArraySpec]:
    """Return the `MOST_REQUESTED_ARRAYS` silent arrays nearest to one that detected the event, nearest first."""
    apart_m = [min(float(np.linalg.norm(spec.centre_m - other.centre_m)) for other in detecting) for spec in silent]
    return [silent[k] for k in np.argsort(apart_m, kind="stable")[:MOST_REQUESTED_ARRAYS]]


def backfilled_sound(requested: RequestedFrames, estimator: Estimator, start: int) -> BackfilledSound | None:
    """Correlate the requested frames of an event that began at frame index `start`.

    Only the unbroken run of frames at the end is used. Return None if all of it is older than the event, if
    sampling rates differ, or if the estimator does not correlate frames.
    """
    indices = list(takewhile(lambda frame_index: frame_index in requested.frames, reversed(requested.span)))[::-1]
    frames = [requested.frames[frame_index] for frame_index in indices]
    loud = [frame for frame_index, frame in zip(indices, frames, strict=True) if frame_index >= start]
    if not loud or len({frame.sample_rate_hz for frame in frames}) > 1:
        return None
    front_end = estimator.onset_front_end(frames[0].array, frames[0].sample_rate_hz)
    if front_end is None:
        return None
    pushed = zip(indices, frames, strict=True)
    onsets = tuple(front_end.push(frame.samples, quiet=frame_index < start) for frame_index, frame in pushed)
    powers = np.array([frame.power for frame in frames])
    return BackfilledSound(loud, onsets, Course(np.array(indices, dtype=np.int64), powers, start))


def is_sure(event: Event) -> bool:
    """Return whether an event is located with a confidence of at least `SURE_WITHOUT_BACKFILL`."""
    return (
        event.status is Status.LOCATED
        and event.estimate is not None
        and event.estimate.sound_confidence >= SURE_WITHOUT_BACKFILL
    )


def is_as_good(event: Event, than: Event) -> bool:
    """Return whether an event is at least as good as another result of the same sound."""
    return _worth(event) >= _worth(than)


def _worth(event: Event) -> tuple[int, float]:
    return _RANK[event.status], 0.0 if event.estimate is None else event.estimate.sound_confidence
