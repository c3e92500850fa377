"""A parallel `for_each` on two threads, for work that releases the interpreter: FFTs, kernels, matrix products."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Final

FEW: Final = 16
"""Up to this many items, waking the second thread costs more processor time than it saves waiting, most of all on a
busy machine."""


class Parallel:
    """A second thread that shares the work of the calling one."""

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(1, "parallel")

    def for_each(self, function: Callable[[Any], None], items: Iterable[Any]) -> None:
        """Apply `function` to every item, in any order and on both threads; return when all are done.

        Raises what `function` raises.
        """
        waiting = deque(items)

        def work() -> None:
            while waiting:
                try:
                    item = waiting.popleft()
                except IndexError:  # the other thread took the last one
                    return
                function(item)

        if len(waiting) <= FEW:
            work()
            return
        shared = self._pool.submit(work)
        try:
            work()
        finally:
            if not shared.cancel():
                shared.result()

    def stop(self) -> None:
        """End the second thread."""
        self._pool.shutdown()
