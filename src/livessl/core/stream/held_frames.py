"""Frames that wait for the final pass: in order of the joint frame index, for a limited time and in limited memory.

When memory gets short, the samples of the less clear arrays of each sound go first: the sound is still found, at its
time and with all arrays that detected it, and located from the clearest ones. Only when that is not enough are missing
frames no longer awaited.
"""

from __future__ import annotations

import heapq
from collections import Counter, deque
from collections.abc import Callable, Iterator
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

KEPT_ARRAYS: Final = 4
"""Arrays of each sound whose samples stay when memory gets short: the clearest, as many as an overloaded server locates
a sound from (`load_policy.LEVELS`)."""

LONGEST_FRAMES: Final = 200
"""Frames after which a sound that goes on counts as another one when its clearest arrays are chosen: 10 s."""

FORCED_FRAMES: Final = 40
"""Frames that are no longer awaited when there is no memory left: 2 s at a time."""


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
        self._thinned_bytes = 0  # what was held after samples were dropped last
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
        frames: list[Frame] = []
        while self._waiting and self._waiting[0][0] <= last:
            frame = heapq.heappop(self._waiting)[2]
            self.nbytes -= _bytes_of(frame)
            frames.append(frame)
        self._thinned_bytes = min(self._thinned_bytes, self.nbytes)
        return frames

    def expire(self, now_ns: int, position: int | None, *, shedding: bool = False) -> Counter[str]:
        """Advance `overdue_until`, and make room: drop samples, then advance `forced_until`.

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
        full = self.nbytes > THINNED_FROM * most
        dropped = self._thin() if full and self.nbytes - self._thinned_bytes > THINNED_EVERY * most else Counter[str]()
        has_gone = self.forced_until is None or position is None or position >= self.forced_until
        if self.nbytes > most and self.first is not None and has_gone:
            self.forced_until = later(self.forced_until, self.first + FORCED_FRAMES)
        return dropped

    def reindex(self, frames_ahead: Callable[[str], int]) -> None:
        """Order the frames anew after the correction of clocks; `frames_ahead` returns an array's offset in frames."""
        self._waiting = [(f.frame_index - frames_ahead(f.array), f.array, f) for _, _, f in self._waiting]
        heapq.heapify(self._waiting)

    def _thin(self) -> Counter[str]:
        """Keep the samples of the clearest arrays of each sound only; return the frames of each array without."""
        dropped: Counter[str] = Counter()
        thinned: list[tuple[int, str, Frame]] = []
        for sound in _sounds(sorted(self._waiting, key=lambda held: held[:2])):
            kept = _clearest([frame for _, _, frame in sound])
            for frame_index, array, frame in sound:
                if frame.samples.size and array not in kept:
                    self.nbytes -= frame.samples.nbytes
                    dropped[array] += 1
                    thinned.append((frame_index, array, frame.without_samples()))
                else:
                    thinned.append((frame_index, array, frame))
        self._waiting = thinned  # sorted, and so a heap
        self._thinned_bytes = self.nbytes
        return dropped


def _bytes_of(frame: Frame) -> int:
    return HEADER_BYTES + int(frame.samples.nbytes)


def _sounds(held: list[tuple[int, str, Frame]]) -> Iterator[list[tuple[int, str, Frame]]]:
    """Yield the frames of each sound: between two sounds are frame indices of which no array has sent any."""
    sound: list[tuple[int, str, Frame]] = []
    for one in held:
        if sound and (one[0] > sound[-1][0] + 1 or one[0] >= sound[0][0] + LONGEST_FRAMES):
            yield sound
            sound = []
        sound.append(one)
    if sound:
        yield sound


def _clearest(frames: list[Frame]) -> frozenset[str]:
    """Return the arrays whose samples stay: the clearest ones of those that have any."""
    clearest = Clearest()
    for frame in frames:
        if frame.samples.size:
            clearest.note(frame.array, frame.power, active=frame.active)
    clearest.choose(KEPT_ARRAYS)
    return clearest.chosen
