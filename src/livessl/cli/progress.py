"""Progress bars: on stderr, only on a terminal, only for what takes longer than two seconds."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Final

DELAY_S: Final = 2.0


@contextmanager
def counted(what: str, unit: str) -> Iterator[Callable[[int, int], None]]:
    """A bar over things: call what it yields with (done, total)."""
    from tqdm import tqdm

    bar: Any = tqdm(desc=what, unit=unit, delay=DELAY_S, leave=False, disable=None, total=1)

    def show(done: int, total: int) -> None:
        bar.total = total
        bar.update(done - bar.n)

    with bar:
        yield show


@contextmanager
def timed(what: str, start_ns: int, end_ns: int | None) -> Iterator[Callable[[int], None]]:
    """A bar over site time: call what it yields with the time reached. Without an end it only counts seconds."""
    total_s = 0 if end_ns is None else round((end_ns - start_ns) / 1e9)
    with counted(what, "s") as show:
        yield lambda now_ns: show(round((now_ns - start_ns) / 1e9), total_s)
