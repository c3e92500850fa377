"""Progress bars on stderr, only on a terminal and only once a command has run for `DELAY_S`."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Final

DELAY_S: Final = 2.0
"""Time in seconds before a bar appears, so that quick commands show none."""


@contextmanager
def counted(what: str, unit: str) -> Iterator[Callable[[int, int], None]]:
    """Show a bar that counts items; yield a function to be called with the number done and the total."""
    from tqdm import tqdm

    bar: Any = tqdm(desc=what, unit=unit, delay=DELAY_S, leave=False, disable=None, total=1)

    def show(done: int, total: int) -> None:
        bar.total = total
        bar.update(done - bar.n)

    with bar:
        yield show


@contextmanager
def timed(what: str, start_ns: int, end_ns: int | None) -> Iterator[Callable[[int], None]]:
    """Show a bar over site time; yield a function to be called with the time that was reached, in nanoseconds.

    With `end_ns` None the bar counts seconds without a total.
    """
    total_s = 0 if end_ns is None else round((end_ns - start_ns) / 1e9)
    with counted(what, "s") as show:
        yield lambda now_ns: show(round((now_ns - start_ns) / 1e9), total_s)
