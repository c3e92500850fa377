"""Decides how long and in how much memory frames wait for an array that is away, before results become final.

When memory gets short, the samples of the less clear arrays of each sound go first: the sound is still found, at its
time and with all arrays that detected it, and located from the clearest ones. Only when that is not enough are missing
frames no longer awaited.
"""

from __future__ import annotations

import heapq
from collections import Counter, deque
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Final, NamedTuple

from livessl.core.stream.load_policy import Clearest
from livessl.core.stream.reception import later
from livessl.core.types import Frame

HOLD_NS: Final = 600_000_000_000
"""Longest time, in nanoseconds, that frames are held for an array that is away. A restart, or the change of a cable or
switch, takes less. Early results are reported meanwhile."""

HOLD_BYTES: Final = 256 * 1024 * 1024
"""Most memory, in bytes, of the frames that are held: five minutes of one array that is never quiet."""

SHEDDING: Final = 4
"""Divisor of the memory of frames that are held while arrays are shed, so that the server stays small."""

HEADER_BYTES: Final = 500
"""Memory, in bytes, of a frame besides its samples, as it is counted here."""

THINNED_FROM: Final = 0.75
"""Share of the memory from which on samples are dropped."""

THINNED_EVERY: Final = 0.125
"""Share of the memory that must have come since samples were dropped, before that is tried again."""

CLEAREST_ARRAYS: Final = 4
"""Arrays of each sound whose samples stay when memory gets short: the clearest, as many as an overloaded server locates
a sound from (`load_policy.LEVELS`). An array that becomes clearer while the sound goes on is kept besides them."""

LONGEST_FRAMES: Final = 200
"""Frames after which the clearest arrays of a sound that goes on are chosen anew: 10 s."""

FORCED_FRAMES: Final = 40
"""Most frame indices that are no longer awaited at a time when there is no memory left: 2 s."""


@dataclass(frozen=True, slots=True)
class _Choice:
    """The arrays whose samples stay, from a frame index on."""

    first: int
    arrays: frozenset[str]


class _Held(NamedTuple):
    """A frame that is held. Frames are in the order of their joint frame indices and arrays, which no two share."""

    frame_index: int
    array: str
    frame: Frame
    choice: _Choice | None
    """The choice by which its samples stay or were dropped; None before the first one. It belongs to the frame and not
    to the frame index, which the correction of a clock may give to another sound."""


class _Arrival(NamedTuple):
    """A frame that came, whether it is still held or not."""

    came_ns: int
    array: str
    own_index: int
    frame_index: int


class HeldFrames:
    """The frames that are held, and the frame indices up to which missing arrays are no longer awaited.

    Parameters
    ----------
    hold_ns : int
        Longest time that a frame is held for an array that is away.
    hold_bytes : int
        Most memory of the frames.
    """

    def __init__(self, hold_ns: int = HOLD_NS, hold_bytes: int = HOLD_BYTES) -> None:
        self._hold_ns = hold_ns
        self._hold_bytes = hold_bytes
        self._waiting: list[_Held] = []  # a heap
        self._came: deque[_Arrival] = deque()
        self._thinned_bytes = 0  # what is left of what was held after samples were dropped last
        self.nbytes = 0
        """Memory of the frames that are held, in bytes."""
        self.overdue_until: int | None = None
        """Last frame index of the frames that have been held for too long; up to it, arrays that are away are no longer
        awaited."""
        self.forced_until: int | None = None
        """Frame index up to which arrays are no longer awaited, because there was no memory left."""

    @property
    def first(self) -> int | None:
        """First frame index of which a frame is held; None if none is held."""
        return self._waiting[0].frame_index if self._waiting else None

    def push(self, frame: Frame, frame_index: int, now_ns: int) -> None:
        """Hold a frame whose joint frame index is given."""
        heapq.heappush(self._waiting, _Held(frame_index, frame.array, frame, None))
        self._came.append(_Arrival(now_ns, frame.array, frame.frame_index, frame_index))
        self.nbytes += _bytes_of(frame)

    def pop_until(self, last: int) -> list[Frame]:
        """Return the frames up to a frame index in order, and hold them no longer."""
        before = self.nbytes
        frames: list[Frame] = []
        while self._waiting and self._waiting[0].frame_index <= last:
            frame = heapq.heappop(self._waiting).frame
            self.nbytes -= _bytes_of(frame)
            frames.append(frame)
        self._thinned_bytes = max(0, self._thinned_bytes - (before - self.nbytes))
        return frames

    def expire(self, now_ns: int, position: int | None, *, shedding: bool = False) -> Counter[str]:
        """Advance `overdue_until`, and make room: drop samples, and only if that is not enough advance `forced_until`.

        Parameters
        ----------
        now_ns : int
        position : int or None
            Frame index up to which the final pass has gone.
        shedding : bool
            Whether the server is overloaded and holds less.

        Returns
        -------
        Counter of str
            Number of frames of each array whose samples were dropped.
        """
        while self._came:
            came_ns, _, _, frame_index = self._came[0]
            if now_ns - came_ns > self._hold_ns:
                self.overdue_until = later(self.overdue_until, frame_index)
            elif position is None or frame_index > position:
                break
            self._came.popleft()
        most = self._hold_bytes // SHEDDING if shedding else self._hold_bytes
        has_gone = self.forced_until is None or position is None or position >= self.forced_until
        must_force = self.nbytes > most and has_gone
        is_due = self.nbytes > THINNED_FROM * most and self.nbytes - self._thinned_bytes > THINNED_EVERY * most
        dropped = self._thin() if must_force or is_due else Counter[str]()
        if must_force and self.nbytes > most and self.first is not None:
            newest = max(held.frame_index for held in self._waiting)
            self.forced_until = later(self.forced_until, min(self.first + FORCED_FRAMES, newest))
        return dropped

    def reindex(self, frames_ahead: Callable[[str], int]) -> None:
        """Order the frames anew after the correction of clocks; `frames_ahead` returns an array's offset in frames."""
        self._waiting = [
            held._replace(frame_index=held.frame.frame_index - frames_ahead(held.array)) for held in self._waiting
        ]
        heapq.heapify(self._waiting)
        self._came = deque(
            arrival._replace(frame_index=arrival.own_index - frames_ahead(arrival.array)) for arrival in self._came
        )

    def _thin(self) -> Counter[str]:
        """Keep the samples of the clearest arrays of each sound only; return the frames of each array without.

        Where samples were dropped before, the same arrays stay: with others, nothing might be left of a sound.
        """
        rows = [list(row) for _, row in groupby(sorted(self._waiting, key=_place), key=lambda held: held.frame_index)]
        dropped: Counter[str] = Counter()
        self._waiting = []  # filled in order: what is sorted is a heap as well
        choice: _Choice | None = None
        previous: int | None = None
        for place, row in enumerate(rows):
            frame_index = row[0].frame_index
            if previous is not None and frame_index > previous + 1:  # no array has sent this far: another sound
                choice = None
            previous = frame_index
            before = _joined({held.choice for held in row if held.choice is not None})
            if before is not None:
                choice = before
            elif choice is None or frame_index >= choice.first + LONGEST_FRAMES:
                choice = _Choice(frame_index, _clearest(rows[place : place + LONGEST_FRAMES]))
            for held in row:
                if held.choice is None:
                    held = held._replace(choice=choice)
                    if held.frame.samples.size and held.array not in choice.arrays:
                        self.nbytes -= held.frame.samples.nbytes
                        dropped[held.array] += 1
                        held = held._replace(frame=held.frame.without_samples())
                self._waiting.append(held)
        self._thinned_bytes = self.nbytes
        return dropped


def _place(held: _Held) -> tuple[int, str]:
    return held.frame_index, held.array


def _joined(choices: Collection[_Choice]) -> _Choice | None:
    """Return the one choice of these; all of their arrays if the correction of clocks has brought several together."""
    if len(choices) < 2:
        return next(iter(choices), None)
    return _Choice(max(each.first for each in choices), frozenset().union(*(each.arrays for each in choices)))


def _bytes_of(frame: Frame) -> int:
    return HEADER_BYTES + int(frame.samples.nbytes)


def _clearest(rows: Sequence[Sequence[_Held]]) -> frozenset[str]:
    """Return the arrays whose samples stay, of a sound that begins with the first of these rows.

    They are chosen as the passes choose the arrays that they locate an event from: while the sound goes on.
    """
    clearest, kept = Clearest(), frozenset[str]()
    previous = rows[0][0].frame_index
    for row in rows:
        if row[0].frame_index > previous + 1:
            break
        previous = row[0].frame_index
        for held in row:
            clearest.note(held.array, held.frame.power, active=held.frame.active)
        clearest.choose(CLEAREST_ARRAYS)
        kept |= clearest.chosen
    return kept
