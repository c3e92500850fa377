"""A second thread for work that mostly leaves the interpreter alone: transforms, kernels, products of matrices."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Final

FEW: Final = 4
"""So many items are done sooner than somebody is called."""


class Helper:
    """Shares work with the thread that asks."""

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(1, "helper")

    def each(self, work: Callable[[Any], None], items: Iterable[Any]) -> None:
        """Call `work` with each item, on this thread and the other one; return when all is done.

        Raises what `work` raises.
        """
        waiting = deque(items)

        def do() -> None:
            while waiting:
                try:
                    item = waiting.popleft()
                except IndexError:  # the other one was quicker
                    return
                work(item)

        if len(waiting) <= FEW:
            do()
            return
        helped = self._pool.submit(do)
        try:
            do()
        finally:
            if not helped.cancel():
                helped.result()

    def stop(self) -> None:
        """End the thread."""
        self._pool.shutdown()
