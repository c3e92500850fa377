"""Frames that wait for the final pass: in order of the joint frame index, for a limited time and in limited memory."""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Callable
from typing import Final

from livessl.core.stream.reception import later
from livessl.core.types import Frame

HOLD_NS: Final = 600_000_000_000
"""Longest time, in nanoseconds, that frames are held for an array that is away. A restart, or the change of a cable or
switch, takes less. Early results are reported meanwhile."""

SHEDDING: Final = 4
"""Divisor of the memory of frames that are held while arrays are shed, so that the server stays small."""

HOLD_BYTES: Final = 256 * 1024 * 1024
"""Most memory, in bytes, of the frames that are held: five minutes of one array that is never quiet."""


class HeldFrames:
    """The frames that are held, and the frame indices up to which missing arrays are no longer awaited.

    Parameters
    ----------
    hold_ns : int
        Longest time that a frame is held for an array that is away.
    hold_bytes : int
        Most memory of the frames' samples.
    """

    def __init__(self, hold_ns: int = HOLD_NS, hold_bytes: int = HOLD_BYTES) -> None:
        self._hold_ns = hold_ns
        self._hold_bytes = hold_bytes
        self._waiting: list[tuple[int, str, Frame]] = []
        self._came: deque[tuple[int, int, int]] = deque()  # when it came, its frame index, its bytes
        self.nbytes = 0
        """Memory of the samples that are held, in bytes."""
        self.overdue_until: int | None = None
        """Last frame index of the frames that have been held for too long; up to it, arrays that are away are no longer
        awaited."""
        self.forced_until: int | None = None
        """Last frame index of the frames for which there is no memory left; up to it, arrays are no longer awaited."""

    @property
    def first(self) -> int | None:
        """First frame index of which a frame is held; None if none is held."""
        return self._waiting[0][0] if self._waiting else None

    def push(self, frame: Frame, frame_index: int, now_ns: int) -> None:
        """Hold a frame whose joint frame index is given."""
        heapq.heappush(self._waiting, (frame_index, frame.array, frame))
        self._came.append((now_ns, frame_index, frame.samples.nbytes))
        self.nbytes += frame.samples.nbytes

    def pop_until(self, last: int) -> list[Frame]:
        """Return the frames up to a frame index in order, and hold them no longer."""
        frames: list[Frame] = []
        while self._waiting and self._waiting[0][0] <= last:
            frame = heapq.heappop(self._waiting)[2]
            self.nbytes -= frame.samples.nbytes
            frames.append(frame)
        return frames

    def expire(self, now_ns: int, position: int | None, *, shedding: bool = False) -> None:
        """Advance `overdue_until` and `forced_until`.

        Parameters
        ----------
        now_ns : int
        position : int or None
            Frame index up to which the final pass has gone.
        shedding : bool
            Whether the server is overloaded and holds less.
        """
        excess = self.nbytes - (self._hold_bytes // SHEDDING if shedding else self._hold_bytes)
        while self._came:
            came_ns, frame_index, size = self._came[0]
            if excess > 0:
                self.forced_until = later(self.forced_until, frame_index)
            elif now_ns - came_ns > self._hold_ns:
                self.overdue_until = later(self.overdue_until, frame_index)
            elif position is None or frame_index > position:
                break
            excess -= size
            self._came.popleft()

    def reindex(self, frames_ahead: Callable[[str], int]) -> None:
        """Order the frames anew after the correction of clocks; `frames_ahead` returns an array's offset in frames."""
        self._waiting = [(f.frame_index - frames_ahead(f.array), f.array, f) for _, _, f in self._waiting]
        heapq.heapify(self._waiting)
