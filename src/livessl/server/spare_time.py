"""A thread for work that no event waits for: it takes a small share of one core, and none under overload."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import Final

from livessl.clock import thread_time_s
from livessl.server.overload import Overload

JOIN_S: Final = 1.0
"""Longest wait, in seconds, for work that is under way when the server stops; its result is of no use any more."""

_log = logging.getLogger(__name__)


class SpareTimeThread:
    """Does a piece of work again and again, and rests after each so that it keeps to its share of a core.

    Python runs one thread at a time, so work beside the location of sounds delays it, on many cores as well.

    Parameters
    ----------
    name : str
        Name of the thread.
    work : callable
        Does what there is to do now; an error that it raises ends the thread.
    overload : Overload
        Nothing is done while sound arrives faster than it is located.
    wait_s : float
        Shortest time between two pieces of work, in seconds, and the interval at which the thread looks for work.
    share : float
        Greatest share of one core's time, above 0 and at most 1.
    urgent_share : float, optional
        The same while the work is urgent.
    what : str
        What the work is, for the log.
    is_urgent : callable, optional
        Returns whether the next piece of work is wanted soon.
    """

    def __init__(
        self,
        name: str,
        work: Callable[[], None],
        overload: Overload,
        *,
        wait_s: float,
        share: float,
        what: str,
        urgent_share: float = 1.0,
        is_urgent: Callable[[], bool] = lambda: False,
    ) -> None:
        self._name = name
        self._work = work
        self._overload = overload
        self._wait_s = wait_s
        self._share = share
        self._urgent_share = urgent_share
        self._what = what
        self._is_urgent = is_urgent
        self._wake = threading.Event()
        self._is_stopped = False
        self._thread: threading.Thread | None = None
        self.failure: BaseException | None = None
        """The error that has ended the thread, if one has."""

    def start(self) -> None:
        """Begin."""
        self._thread = threading.Thread(target=self._run, name=self._name, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Stop, and wait a little for the thread."""
        self._is_stopped = True
        self._wake.set()
        if self._thread is not None:
            self._thread.join(timeout=JOIN_S)

    def wake(self) -> None:
        """End a rest: there is work that should not wait. Any thread."""
        self._wake.set()

    def _run(self) -> None:
        rest_s = self._wait_s
        try:
            while True:
                self._wake.wait(rest_s)
                self._wake.clear()
                if self._is_stopped:
                    return
                rest_s = self._wait_s
                if self._overload.message is not None:
                    continue
                began_s = thread_time_s()
                self._work()
                share = self._urgent_share if self._is_urgent() else self._share
                rest_s = max(rest_s, (thread_time_s() - began_s) * (1.0 / share - 1.0))
        except BaseException as error:
            self.failure = error
            _log.exception("%s has failed; the server ends", self._what)
            raise
