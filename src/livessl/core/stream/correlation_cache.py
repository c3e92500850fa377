"""What is made of the arrays' frames, in order, and kept for all fusions of the same messages: each is heard once.

An array's frames from some first one on, none missing, are a chain; its number tells all that a listener went by. Who
follows a chain that another one has followed already finds there what it is to find, and goes on where that one ends.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from livessl.core.correlate.onset_gcc import OnsetFrontEnd, OnsetGCC
from livessl.core.locate.estimators import Estimator
from livessl.core.types import Frame

SHARED_FRAMES: Final = 4096
"""Frames of which it is kept what listeners made of them: some seconds of many arrays."""

LISTENERS: Final = 4
"""Of each array, kept at the ends of the chains that were followed last: somebody may go on there."""


Each = Callable[[Callable[[Any], None], Iterable[Any]], None]
"""Calls the first with each of the second, in any order, and returns when all is done."""


@dataclass(slots=True)
class Ear:
    """How far one array has been followed, and what was heard of it, by frame index."""

    chain: int = 0
    begin: int = 0
    onsets: dict[int, OnsetGCC] = field(default_factory=dict)

    def has(self, frame_indices: Iterable[int]) -> bool:
        """Whether all of these were heard."""
        return all(frame_index in self.onsets for frame_index in frame_indices)

    def at(self, frame_indices: Iterable[int]) -> tuple[OnsetGCC, ...]:
        """What was heard at `rasters`."""
        return tuple(self.onsets[frame_index] for frame_index in frame_indices if frame_index in self.onsets)


Followed = tuple[str, Ear, Mapping[int, Frame]]
"""An array, how far it has been followed, and its frames by frame index."""


class Listening:
    """The listeners of an estimator.

    Parameters
    ----------
    estimator : Estimator
    each : callable or None
        Does some work on each of some arrays, several at once perhaps; None does one after the other.
    """

    def __init__(self, estimator: Estimator, each: Each | None = None) -> None:
        self._estimator = estimator
        self._each = _in_turn if each is None else each
        self._onsets: dict[tuple[str, int], OnsetGCC] = {}
        self._listeners: defaultdict[str, dict[int, OnsetFrontEnd]] = defaultdict(dict)

    def hear(self, followed: Iterable[Followed], frame_indices: Sequence[int]) -> None:
        """Let ears follow their arrays through some frame indices; where a frame is missing another chain begins."""
        self._each(lambda one: self._follow(one, frame_indices), followed)
        _limit(self._onsets, SHARED_FRAMES)

    def _follow(self, followed: Followed, frame_indices: Sequence[int]) -> None:
        array, ear, frames = followed
        for frame_index in frame_indices:
            if frame_index in ear.onsets:
                continue
            frame = frames.get(frame_index)
            if frame is None:
                ear.chain = 0
                continue
            before = ear.chain
            ear.begin = ear.begin if before else frame_index
            ear.chain = hash((before, frame_index, frame.time_ns, frame.active, frame.sample_rate_hz))
            onsets = self._onsets.get((array, ear.chain))
            if onsets is None:
                listener = self._listeners[array].pop(before, None) if before else None
                if listener is None or listener.sample_rate_hz != frame.sample_rate_hz:
                    listener = self._caught_up(array, frame.sample_rate_hz, range(ear.begin, frame_index), frames)
                if listener is None:
                    continue
                onsets = self._onsets[array, ear.chain] = _push(listener, frame)
                self._listeners[array][ear.chain] = listener
                _limit(self._listeners[array], LISTENERS)
            ear.onsets[frame_index] = onsets

    def clear(self) -> None:
        """Forget all."""
        self._onsets.clear()
        self._listeners.clear()

    def _caught_up(
        self, array: str, sample_rate_hz: float, frame_indices: range, frames: Mapping[int, Frame]
    ) -> OnsetFrontEnd | None:
        """A new listener that has heard what is still there of a chain; None where the estimator has none."""
        listener = self._estimator.listener(array, sample_rate_hz)
        if listener is not None:
            for frame_index in frame_indices:
                frame = frames.get(frame_index)
                if frame is None or not frame.samples.size or frame.sample_rate_hz != sample_rate_hz:
                    listener.reset()
                else:
                    _push(listener, frame)
        return listener


def _in_turn(work: Callable[[Any], None], items: Iterable[Any]) -> None:
    for item in items:
        work(item)


def _push(listener: OnsetFrontEnd, frame: Frame) -> OnsetGCC:
    return listener.push(frame.samples, quiet=not frame.active)


def _limit(kept: dict[int, OnsetFrontEnd] | dict[tuple[str, int], OnsetGCC], most: int) -> None:
    while len(kept) > most:
        kept.pop(next(iter(kept)))  # type: ignore[call-overload]
