"""Work shared between two threads: each item is done once, and errors are raised."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest

from livessl.server.parallel import FEW, Parallel
from small_site import HANG_S


@pytest.fixture
def parallel() -> Iterator[Parallel]:
    parallel = Parallel()
    yield parallel
    parallel.stop()


@pytest.mark.parametrize("count", [0, 1, FEW, FEW + 1, 500])
def test_each_item_is_done_once(parallel: Parallel, count: int) -> None:
    done: list[int] = []
    parallel.for_each(done.append, range(count))
    assert sorted(done) == list(range(count))


def test_two_threads_work(parallel: Parallel) -> None:
    both = threading.Barrier(2, timeout=HANG_S)  # no thread passes alone

    def meet(number: int) -> None:
        if number < 2:
            both.wait()

    parallel.for_each(meet, range(FEW + 1))


@pytest.mark.parametrize("wrong", [0, 40])
def test_error_of_either_thread_is_raised(parallel: Parallel, wrong: int) -> None:
    def work(number: int) -> None:
        if number == wrong:
            raise ValueError(f"number {number}")

    with pytest.raises(ValueError, match=f"number {wrong}"):
        parallel.for_each(work, range(80))
    parallel.for_each(lambda _: None, range(80))  # it works on
