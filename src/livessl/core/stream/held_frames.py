"""Frames that wait for the final pass: in order of the joint frame index, for a limited time and in limited memory.

When memory gets short, the samples of the less clear arrays of each sound go first: the sound is still found, at its
time and with all arrays that detected it, and located from the clearest ones. Only when that is not enough are missing
frames no longer awaited.
"""

from __future__ import annotations

import heapq
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Final

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
        self._waiting: list[tuple[int, str, Frame]] = []
        self._came: deque[tuple[int, int]] = deque()  # when it came, its frame index
        self._thinned_bytes = 0  # what is left of what was held after samples were dropped last
        self._choices: dict[int, _Choice] = {}  # by frame index, where samples were dropped
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
        return self._waiting[0][0] if self._waiting else None

    def push(self, frame: Frame, frame_index: int, now_ns: int) -> None:
        """Hold a frame whose joint frame index is given."""
        heapq.heappush(self._waiting, (frame_index, frame.array, frame))
        self._came.append((now_ns, frame_index))
        self.nbytes += _bytes_of(frame)

    def pop_until(self, last: int) -> list[Frame]:
        """Return the frames up to a frame index in order, and hold them no longer."""
        before = self.nbytes
        frames: list[Frame] = []
        while self._waiting and self._waiting[0][0] <= last:
            frame_index, _, frame = heapq.heappop(self._waiting)
            self._choices.pop(frame_index, None)
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
            came_ns, frame_index = self._came[0]
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
            newest = max(frame_index for frame_index, _, _ in self._waiting)
            self.forced_until = later(self.forced_until, min(self.first + FORCED_FRAMES, newest))
        return dropped

    def reindex(self, frames_ahead: Callable[[str], int]) -> None:
        """Order the frames anew after the correction of clocks; `frames_ahead` returns an array's offset in frames."""
        self._waiting = [(f.frame_index - frames_ahead(f.array), f.array, f) for _, _, f in self._waiting]
        heapq.heapify(self._waiting)

    def _thin(self) -> Counter[str]:
        """Keep the samples of the clearest arrays of each sound only; return the frames of each array without.

        Where samples were dropped before, the same arrays stay: with others, nothing might be left of a sound.
        """
        ordered = sorted(self._waiting, key=lambda held: held[:2])  # sorted, it is a heap as well
        rows = [(k, [frame for _, _, frame in held]) for k, held in groupby(ordered, key=lambda held: held[0])]
        dropped: Counter[str] = Counter()
        self._waiting = []
        choice: _Choice | None = None
        for place, (frame_index, frames) in enumerate(rows):
            if place and frame_index > rows[place - 1][0] + 1:  # no array has sent this far: another sound
                choice = None
            choice = self._choices.get(frame_index, choice)
            if choice is None or frame_index >= choice.first + LONGEST_FRAMES:
                choice = _Choice(frame_index, _clearest(rows[place : place + LONGEST_FRAMES]))
            self._choices[frame_index] = choice
            for frame in frames:
                if frame.samples.size and frame.array not in choice.arrays:
                    self.nbytes -= frame.samples.nbytes
                    dropped[frame.array] += 1
                    frame = frame.without_samples()
                self._waiting.append((frame_index, frame.array, frame))
        self._thinned_bytes = self.nbytes
        return dropped


def _bytes_of(frame: Frame) -> int:
    return HEADER_BYTES + int(frame.samples.nbytes)


def _clearest(rows: Sequence[tuple[int, list[Frame]]]) -> frozenset[str]:
    """Return the arrays whose samples stay, of a sound that begins with the first of these rows.

    They are chosen as the passes choose the arrays that they locate an event from: while the sound goes on.
    """
    clearest, kept = Clearest(), frozenset[str]()
    previous = rows[0][0]
    for frame_index, frames in rows:
        if frame_index > previous + 1:
            break
        previous = frame_index
        for frame in frames:
            clearest.note(frame.array, frame.power, active=frame.active)
        clearest.choose(CLEAREST_ARRAYS)
        kept |= clearest.chosen
    return kept
