"""Runs the thread of the alerts: judging in turns, and deliveries. It contains no rules."""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import Final

from livessl.server.alerts.delivery import REST_S, Deliverer

POLL_S: Final = 0.5
"""Longest wait, in seconds, between two turns; arrays and findings are judged in every turn."""

STOP_S: Final = 3.0
"""Longest wait, in seconds, for the thread when the server stops."""

_log = logging.getLogger(__name__)


class TurnTooLongError(Exception):
    """A turn of the thread took longer than the caller may wait; the work will not be done."""


class _Claim:
    """Work that is either begun or given up, even if two threads decide at the same time."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._is_begun = self._is_given_up = False

    def begin(self) -> bool:
        """Begin the work; return False if it was given up."""
        with self._lock:
            self._is_begun = not self._is_given_up
            return self._is_begun

    def give_up(self) -> bool:
        """Give the work up; return False if it has begun."""
        with self._lock:
            self._is_given_up = not self._is_begun
            return self._is_given_up


class AlertThread:
    """Judges and delivers on its own event loop; every thread may call it.

    Parameters
    ----------
    turn : callable
        Judges waiting events; returns False if it failed, and the thread then rests before the next turn.
    deliverers : callable
        Returns the deliverers of the actions that are in force.
    """

    def __init__(self, turn: Callable[[], bool], deliverers: Callable[[], Iterable[Deliverer]]) -> None:
        self._turn = turn
        self._deliverers = deliverers
        self._news, self._end, self._replaced = asyncio.Event(), asyncio.Event(), asyncio.Event()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._thread: threading.Thread | None = None
        self.failure: BaseException | None = None
        """The error that has ended the thread, if one has."""

    @property
    def is_started(self) -> bool:
        """True if the thread was started, even if it has ended since."""
        return self._loop is not None

    def start(self) -> None:
        """Begin to judge and to deliver."""
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._run, args=(self._loop,), name="alerts", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Stop the thread; waiting alerts are delivered after the next start."""
        if self._thread is not None:
            self._call(self._end.set)
            self._thread.join(timeout=STOP_S)

    def wake(self) -> None:
        """Take a turn soon."""
        self._call(self._news.set)

    def wake_deliverers(self) -> None:
        """Make the deliverers read new deliveries from the outbox."""
        for deliverer in self._deliverers():
            self._call(deliverer.wake)

    def exchange(self, work: Callable[[], None], longest_s: float) -> None:
        """Do `work` between two turns, then run the deliverers that are in force after it.

        Raises
        ------
        TurnTooLongError
            If no turn ended within `longest_s` seconds. In this case `work` is not done later.
        Exception
            Errors that `work` raises.
        """
        assert self._loop is not None
        claim = _Claim()
        exchanging = asyncio.run_coroutine_threadsafe(self._exchange(work, claim), self._loop)
        try:
            exchanging.result(longest_s)
        except TimeoutError:
            if not claim.give_up():  # it has just been made
                exchanging.result()
                return
            raise TurnTooLongError from None

    async def _exchange(self, work: Callable[[], None], claim: _Claim) -> None:
        if claim.begin():
            work()
            self._replaced.set()
            self._news.set()

    def _run(self, loop: asyncio.AbstractEventLoop) -> None:
        try:
            loop.run_until_complete(self._work())
        except BaseException as error:
            self.failure = error
            _log.exception("the thread of the alerts has failed; the server ends")
            raise
        finally:
            loop.close()

    async def _work(self) -> None:
        """Judge and deliver until `stop`."""
        tasks = [asyncio.create_task(work) for work in (self._judge_all(), self._deliver_all())]
        ending = asyncio.create_task(self._end.wait())
        try:
            done, _ = await asyncio.wait([*tasks, ending], return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in (*tasks, ending):
                task.cancel()
            await asyncio.gather(*tasks, ending, return_exceptions=True)
        for task in done:
            task.result()  # raises the error that ended it, if there was one

    async def _deliver_all(self) -> None:
        """Run the deliverers of the actions that are in force, until cancelled."""
        while True:
            self._replaced.clear()
            replaced = asyncio.create_task(self._replaced.wait())
            deliverers = [asyncio.create_task(deliverer.run()) for deliverer in self._deliverers()]
            try:
                await asyncio.wait([*deliverers, replaced], return_when=asyncio.FIRST_COMPLETED)
            finally:
                for task in (*deliverers, replaced):
                    task.cancel()
                await asyncio.gather(*deliverers, replaced, return_exceptions=True)
            for task in deliverers:
                if not task.cancelled():
                    task.result()  # raises the error that ended it

    async def _judge_all(self) -> None:
        """Judge events until cancelled, and first those from before a restart."""
        while True:
            self._news.clear()
            wait_s = POLL_S if self._turn() else REST_S
            with suppress(TimeoutError):
                async with asyncio.timeout(wait_s):
                    await self._news.wait()
            if wait_s == REST_S:
                await asyncio.sleep(REST_S)

    def _call(self, work: Callable[[], None]) -> None:
        """Do some work on the thread's loop, if it runs."""
        loop = self._loop
        if loop is not None:
            with suppress(RuntimeError):  # it has just been closed
                loop.call_soon_threadsafe(work)
