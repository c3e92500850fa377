"""Keeps the newest frames of all arrays in memory, for clips that are cut after the event. It knows no event."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterable
from typing import Final

from livessl.core.types import Frame, Message

RING_BYTES: Final = 128 * 1024 * 1024
"""Most memory, in bytes, of the frames' samples: 90 s of two arrays of four microphones at 44.1 kHz that are never
quiet. The fusion holds most of them anyway until their results are final."""


class FrameRing:
    """Frames by array and by the array's own frame index. Every thread may call it.

    Parameters
    ----------
    most_bytes : int
        Beyond it the frames that came first are dropped.
    """

    def __init__(self, most_bytes: int = RING_BYTES) -> None:
        self._most_bytes = most_bytes
        self._lock = threading.Lock()
        self._frames: dict[str, dict[int, Frame]] = {}
        self._came: deque[Frame] = deque()
        self._released_ns: dict[str, int] = {}  # time of the frame that was dropped last, by array
        self.nbytes = 0
        """Memory of the samples that are held, in bytes."""
        self.dropped = 0
        """Frames that were dropped because the ring was full, since the start."""

    def take(self, messages: Iterable[Message], oldest_ns: int | None) -> None:
        """Take in the frames among some messages, and drop those that began before a time.

        Parameters
        ----------
        messages : iterable of Message
            Frames without samples, which an overloaded server makes, are ignored.
        oldest_ns : int or None
            Site time in nanoseconds; None keeps all for which there is room.
        """
        with self._lock:
            for message in messages:
                if isinstance(message, Frame) and message.samples.shape[1]:
                    self._add(message)
            while self._came and self.nbytes > self._most_bytes:
                self._drop()
                self.dropped += 1
            while self._came and oldest_ns is not None and self._came[0].time_ns < oldest_ns:
                self._drop()

    def between(self, array: str, begin_ns: int, end_ns: int) -> list[Frame]:
        """Return an array's frames that begin in a span of its own clock, in order of time."""
        with self._lock:
            found = [frame for frame in self._frames.get(array, {}).values() if begin_ns <= frame.time_ns < end_ns]
        return sorted(found, key=lambda frame: frame.frame_index)

    def has_released(self, array: str, time_ns: int) -> bool:
        """Return whether the frame of an array that was dropped last began at a time of its own clock, or later."""
        with self._lock:
            return array in self._released_ns and self._released_ns[array] >= time_ns

    def clear(self) -> None:
        """Drop all frames."""
        with self._lock:
            self._frames.clear()
            self._came.clear()
            self.nbytes = 0

    def _add(self, frame: Frame) -> None:
        known = self._frames.setdefault(frame.array, {})
        if frame.frame_index not in known:
            known[frame.frame_index] = frame
            self._came.append(frame)
            self.nbytes += frame.samples.nbytes

    def _drop(self) -> None:
        frame = self._came.popleft()
        del self._frames[frame.array][frame.frame_index]
        self.nbytes -= frame.samples.nbytes
        self._released_ns[frame.array] = frame.time_ns
