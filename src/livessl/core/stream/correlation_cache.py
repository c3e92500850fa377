"""Caches the correlation of every frame, so that the early and the final pass compute it once.

A run is a sequence of an array's frames with consecutive frame indices. The result of a front end for a frame depends
on the whole run up to that frame, so a key computed from the frames of the run identifies the correlation. If a pass
processes a run that another pass has processed before, it finds the correlations in the cache, and continues after
them.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from livessl.core.correlate.onset_gcc import OnsetFrontEnd, OnsetGCC
from livessl.core.locate.estimator import Estimator
from livessl.core.types import Frame

CACHED_FRAMES: Final = 4096
"""Number of frames whose correlations are cached: a few seconds of 64 arrays."""

CACHED_FRONT_ENDS: Final = 4
"""Number of front ends that are cached for each array, with the states at the ends of the latest runs."""

ForEach = Callable[[Callable[[Any], None], Iterable[Any]], None]
"""A parallel `for_each(function, items)`: applies `function` to every item, in any order; returns when all are done."""


@dataclass(slots=True)
class Correlations:
    """Correlations of one array's frames, by frame index, and the run to which they belong."""

    run: int | None = None  # key of the run; None where the last frame index had no frame
    first: int = 0  # frame index at which the run begins
    onsets: dict[int, OnsetGCC] = field(default_factory=dict)

    def has(self, frame_indices: Iterable[int]) -> bool:
        """Return whether there are correlations for all of these frame indices."""
        return all(frame_index in self.onsets for frame_index in frame_indices)

    def at(self, frame_indices: Iterable[int]) -> tuple[OnsetGCC, ...]:
        """Return the existing correlations for these frame indices."""
        return tuple(self.onsets[frame_index] for frame_index in frame_indices if frame_index in self.onsets)


Followed = tuple[str, Correlations, Mapping[int, Frame]]
"""An array's name, its correlations so far, and its frames by frame index."""


class CorrelationCache:
    """The front ends of an estimator, and the correlations that they returned.

    Parameters
    ----------
    estimator : Estimator
    for_each : ForEach or None
        Applies a function to several arrays, perhaps in parallel; None does one after the other.
    """

    def __init__(self, estimator: Estimator, for_each: ForEach | None = None) -> None:
        self._estimator = estimator
        self._for_each = _one_by_one if for_each is None else for_each
        self._onsets: dict[tuple[str, int], OnsetGCC] = {}
        self._front_ends: defaultdict[str, dict[int, OnsetFrontEnd]] = defaultdict(dict)

    def extend(self, followed: Iterable[Followed], frame_indices: Sequence[int]) -> None:
        """Extend the correlations of some arrays by these frame indices; a missing frame ends the run."""
        self._for_each(lambda one: self._extend(one, frame_indices), followed)
        _limit(self._onsets, CACHED_FRAMES)

    def clear(self) -> None:
        """Empty the cache."""
        self._onsets.clear()
        self._front_ends.clear()

    def _extend(self, followed: Followed, frame_indices: Sequence[int]) -> None:
        array, correlations, frames = followed
        for frame_index in frame_indices:
            if frame_index in correlations.onsets:
                continue
            frame = frames.get(frame_index)
            if frame is None or not frame.samples.size:
                correlations.run = None
                continue
            before = correlations.run
            if before is None:
                correlations.first = frame_index
            run = hash((before, frame_index, frame.time_ns, frame.active, frame.sample_rate_hz))
            correlations.run = run
            onsets = self._onsets.get((array, run))
            if onsets is None:
                front_end = None if before is None else self._front_ends[array].pop(before, None)
                if front_end is None or front_end.sample_rate_hz != frame.sample_rate_hz:
                    span = range(correlations.first, frame_index)
                    front_end = self._caught_up(array, frame.sample_rate_hz, span, frames)
                if front_end is None:
                    continue
                onsets = self._onsets[array, run] = _push(front_end, frame)
                self._front_ends[array][run] = front_end
                _limit(self._front_ends[array], CACHED_FRONT_ENDS)
            correlations.onsets[frame_index] = onsets

    def _caught_up(
        self, array: str, sample_rate_hz: float, frame_indices: range, frames: Mapping[int, Frame]
    ) -> OnsetFrontEnd | None:
        """Make a front end and push the rest of a run; return None if the estimator uses no front end."""
        front_end = self._estimator.onset_front_end(array, sample_rate_hz)
        if front_end is not None:
            for frame_index in frame_indices:
                frame = frames.get(frame_index)
                if frame is None or not frame.samples.size or frame.sample_rate_hz != sample_rate_hz:
                    front_end.reset()
                else:
                    _push(front_end, frame)
        return front_end


def _one_by_one(function: Callable[[Any], None], items: Iterable[Any]) -> None:
    for item in items:
        function(item)


def _push(front_end: OnsetFrontEnd, frame: Frame) -> OnsetGCC:
    return front_end.push(frame.samples, quiet=not frame.active)


def _limit(kept: dict[int, OnsetFrontEnd] | dict[tuple[str, int], OnsetGCC], most: int) -> None:
    while len(kept) > most:
        kept.pop(next(iter(kept)))  # type: ignore[call-overload]
