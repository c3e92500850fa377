"""The queue between the nodes' socket and the fusion, bounded in messages and bytes; measures its delay."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Sequence
from typing import Final, Generic, TypeVar

from livessl.clock import Clock

T = TypeVar("T")

QUEUE_MESSAGES: Final = 1000
"""Length of the queue: ten seconds of five arrays. While it is full, the socket is not read and nodes keep frames."""

QUEUE_BYTES: Final = 24_000_000
"""Most bytes in the queue: half a second of 64 arrays of four microphones at 44.1 kHz. Further frames wait in the
nodes."""


class Inlet(Generic[T]):
    """A queue with one writer and one reader.

    Parameters
    ----------
    clock : Clock
    messages, nbytes : int
        Limits of the queue. An empty queue always accepts a single item.
    """

    def __init__(self, clock: Clock, messages: int = QUEUE_MESSAGES, nbytes: int = QUEUE_BYTES) -> None:
        self._clock = clock
        self._most = messages, nbytes
        self._changed = threading.Condition()
        self._items: deque[tuple[int, int, T]] = deque()  # when each was put in, and its bytes
        self.nbytes = 0
        """Bytes in the queue."""
        self.delay_s = 0.0
        """Time, in seconds, that the first item of the last `take` had waited; 0 if there was none."""

    def __len__(self) -> int:
        return len(self._items)

    def put(self, items: Sequence[tuple[int, T]], wait_s: float) -> int:
        """Put items with their numbers of bytes into the queue until it is full; return how many were put in.

        If the queue is already full, wait up to `wait_s` for space.
        """
        with self._changed:
            if self._is_full():
                self._changed.wait_for(lambda: not self._is_full(), wait_s)
            now_ns, count = self._clock.monotonic_ns(), 0
            for size, item in items:
                if self._is_full():
                    break
                self._items.append((now_ns, size, item))
                self.nbytes += size
                count += 1
            if count:
                self._changed.notify_all()
            return count

    def take(self, most: int, wait_s: float) -> list[T]:
        """Take out up to `most` items in order; wait up to `wait_s` for the first one."""
        with self._changed:
            if not self._items:
                self._changed.wait_for(lambda: bool(self._items), wait_s)
            taken = [self._items.popleft() for _ in range(min(most, len(self._items)))]
            self.nbytes -= sum(size for _, size, _ in taken)
            self.delay_s = (self._clock.monotonic_ns() - taken[0][0]) / 1e9 if taken else 0.0
            if taken:
                self._changed.notify_all()
        return [item for _, _, item in taken]

    def _is_full(self) -> bool:
        messages, nbytes = self._most
        return len(self._items) >= messages or self.nbytes >= nbytes
