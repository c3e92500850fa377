"""Computes many items on several cores, in processes that are killed with the work or with their parent."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import active_children, get_context, parent_process
from typing import Any, TypeVar

Shared = TypeVar("Shared")
Item = TypeVar("Item")
Result = TypeVar("Result")


def on_cores(
    compute: Callable[[Shared, Item], Result], shared: Shared, items: Sequence[Item], cores: int
) -> Iterator[Result]:
    """Yield the results of `compute(shared, item)` as they come, in any order.

    Parameters
    ----------
    compute : callable
        A function of a module, which each process imports.
    shared : object
        Is sent to each process once.
    items : sequence
    cores : int
        Most processes; no more are begun than there are items.
    """
    others = set(active_children())
    pool = ProcessPoolExecutor(
        min(cores, len(items)), mp_context=get_context("spawn"), initializer=_begin, initargs=(compute, shared)
    )
    try:  # a `with` would wait, on Ctrl-C, for every item not yet computed
        for future in as_completed([pool.submit(_compute, item) for item in items]):
            yield future.result()
    except BaseException:
        for worker in set(active_children()) - others:
            worker.kill()  # it may be compiling for a minute, and has nothing to lose
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


_sent: list[tuple[Callable[[Any, Any], Any], Any]] = []


def _begin(compute: Callable[[Any, Any], Any], shared: object) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C
    _sent[:] = [(compute, shared)]
    parent = parent_process()
    assert parent is not None

    def end_with_parent() -> None:
        parent.join()
        os._exit(1)  # a killed parent cannot stop its workers

    threading.Thread(target=end_with_parent, daemon=True).start()


def _compute(item: object) -> Any:
    [(compute, shared)] = _sent
    return compute(shared, item)
