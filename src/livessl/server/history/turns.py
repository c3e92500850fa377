"""A fair lock for the one connection that writes."""

from __future__ import annotations

import threading
from collections import deque


class Turns:
    """A lock that goes to the thread that has waited longest: one that writes all the time keeps out no other."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._is_taken = False
        self._waiting: deque[threading.Event] = deque()

    def __enter__(self) -> None:
        turn = threading.Event()
        with self._lock:
            if not self._is_taken:
                self._is_taken = True
                return
            self._waiting.append(turn)
        turn.wait()

    def __exit__(self, *_: object) -> None:
        with self._lock:
            if self._waiting:
                self._waiting.popleft().set()  # the lock stays taken
            else:
                self._is_taken = False
