"""The thread for work that no event waits for: its share of a core, its haste, its end, and its errors."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest
from world_parts import HandClock

from livessl.server import spare_time
from livessl.server.overload import Overload
from livessl.server.spare_time import SpareTimeThread
from small_site import HANG_S, wait_until

PIECE_S = 0.02


class Work:
    """Work that takes processor time; it notes when it began and ended, and what it took."""

    def __init__(self, pieces: int) -> None:
        self.spans: list[tuple[float, float]] = []
        self.taken_s: list[float] = []
        self.done = threading.Event()
        self._pieces = pieces

    def __call__(self) -> None:
        began_s, cpu_s = time.monotonic(), time.thread_time()
        while time.thread_time() < cpu_s + PIECE_S:
            pass
        self.spans.append((began_s, time.monotonic()))
        self.taken_s.append(time.thread_time() - cpu_s)
        if len(self.spans) >= self._pieces:
            self.done.set()


@contextmanager
def working(
    work: Callable[[], None],
    *,
    share: float,
    is_urgent: Callable[[], bool] = lambda: False,
    overload: Overload | None = None,
) -> Iterator[SpareTimeThread]:
    """A thread that works, until the end of the context."""
    thread = SpareTimeThread(
        "spare",
        work,
        overload or Overload(HandClock()),
        wait_s=0.001,
        share=share,
        what="the work",
        is_urgent=is_urgent,
    )
    thread.start()
    try:
        yield thread
    finally:
        thread.stop()


def test_work_rests_until_it_has_taken_its_share_of_a_core_at_most() -> None:
    work = Work(3)
    with working(work, share=0.2):
        assert work.done.wait(HANG_S)
    rests_s = [after[0] - before[1] for before, after in zip(work.spans, work.spans[1:], strict=False)]
    for rest_s, taken_s in zip(rests_s, work.taken_s, strict=False):
        assert rest_s >= 0.99 * 4.0 * taken_s  # one part of work, four parts of rest


def test_urgent_work_takes_a_larger_share() -> None:
    work = Work(3)
    with working(work, share=1e-6, is_urgent=lambda: True):  # would rest for hours
        assert work.done.wait(HANG_S)


def test_thread_that_is_woken_does_not_rest_to_the_end() -> None:
    work = Work(1)
    with working(work, share=1e-6) as thread:
        assert work.done.wait(HANG_S)
        thread.wake()
        wait_until(lambda: len(work.spans) == 2, "the second piece of work")


def test_nothing_is_done_under_overload() -> None:
    clock = HandClock()
    overload, work = Overload(clock), Work(1)
    while overload.message is None:
        clock.time_ns += 100_000_000
        overload.note(1.0, 40, 0, sheds=True)
    with working(work, share=1.0, overload=overload):
        assert not work.done.wait(0.1)
        while overload.message is not None:
            clock.time_ns += 100_000_000
            overload.note(0.0, 0, 100_000_000, sheds=True)
        assert work.done.wait(HANG_S)


def test_the_end_does_not_wait_for_work_that_is_under_way(monkeypatch: pytest.MonkeyPatch) -> None:
    reached, release = threading.Event(), threading.Event()

    def work() -> None:
        reached.set()
        release.wait()

    monkeypatch.setattr(spare_time, "JOIN_S", 0.05)
    with working(work, share=1.0):
        assert reached.wait(HANG_S)
    (thread,) = [one for one in threading.enumerate() if one.name == "spare"]
    assert thread.daemon
    release.set()
    thread.join(HANG_S)
    assert not thread.is_alive()


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_an_error_ends_the_thread_and_is_kept(caplog: pytest.LogCaptureFixture) -> None:
    error = RuntimeError("no such sound")

    def work() -> None:
        raise error

    with working(work, share=1.0) as thread:
        wait_until(lambda: thread.failure is error, "the error")
    wait_until(lambda: "the work has failed; the server ends" in caplog.text, "its report")
