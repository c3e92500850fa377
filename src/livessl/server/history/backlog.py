"""Holds what waits to be written into the history, retries while the database is away, and gives up the oldest."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from livessl.server.history.database import RejectedError, StoreError

RETRY_NS: Final = 1_000_000_000
"""Interval, in nanoseconds, at which the database is offered again what it did not take."""

MAX_UNSAVED: Final = 10_000
"""Most events that wait to be written, about 10 MB; beyond it the oldest are given up, and counted."""

MAX_WRITES: Final = 50_000
"""Most writes that wait, with and without events."""

MAX_BYTES: Final = 64_000_000
"""Most bytes that wait; beyond it the oldest writes are given up, and counted. A track alone may have 10 kB."""

SETTLE_S: Final = 1.0
"""Longest wait, in seconds, of a reader for what was to be written before it asked."""

END_S: Final = 3.0
"""Longest time, in seconds, in which the thread writes what is left when the server ends."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Write:
    """Something to be written.

    Parameters
    ----------
    work : callable
        Writes it; raises `StoreError` if it is to be tried again.
    events : int
        Number of events in it.
    is_final : bool
        Whether it holds final events of a live run.
    others : int
        Number of entries of the journal, and of messages for the hub, in it.
    nbytes : int
        Bytes that it holds until it is written.
    """

    work: Callable[[], None]
    events: int
    is_final: bool
    others: int = 0
    nbytes: int = 0


class Backlog:
    """Writes in the order in which they came.

    Until `start`, and after `stop`, the caller of `put` or `retry` does the work, as tests and stepped servers want it.
    From `start` on a thread does, and neither method waits for it. What is being done may put more, which is done next.

    Parameters
    ----------
    prepare : callable
        Makes the database usable; raises `StoreError` if it is to be tried again.
    """

    def __init__(self, prepare: Callable[[], object]) -> None:
        self._prepare = prepare
        self._waiting: deque[Write] = deque()
        self._changed = threading.Condition()
        self._draining = threading.Lock()  # a caller may still be at work when the thread starts
        self._drainer: int | None = None  # the thread that holds it
        self._thread: threading.Thread | None = None
        self._is_ending = self._is_writing = False
        self._put = self._done = self._nbytes = 0
        self._tried_ns = 0
        self.is_failing = False
        """True if the last attempt to write has failed."""
        self.unsaved = 0
        """Events that wait to be written."""
        self.discarded = 0
        """Events that were given up."""
        self.discarded_others = 0
        """Entries of the journal, and messages for the hub, that were given up."""
        self.failure: BaseException | None = None
        """The error that has ended the thread, if one has."""

    @property
    def is_saved(self) -> bool:
        """True if no final event of a live run waits; until then no node may forget their frames."""
        with self._changed:
            return not any(write.is_final for write in self._waiting)

    def put(self, write: Write, now_ns: int) -> None:
        """Have something written, after what came before.

        Parameters
        ----------
        write : Write
        now_ns : int
            Monotonic time.
        """
        with self._changed:
            self._waiting.append(write)
            self._put += 1
            self.unsaved += write.events
            self._nbytes += write.nbytes
            spared = 1 if self._is_writing else 0
            while self._is_full and len(self._waiting) > spared:
                self._give_up(self._take(spared))
            self._changed.notify_all()
        if self._thread is None:
            self._try(now_ns)

    @property
    def _is_full(self) -> bool:
        return self.unsaved > MAX_UNSAVED or len(self._waiting) > MAX_WRITES or self._nbytes > MAX_BYTES

    def retry(self, now_ns: int) -> None:
        """Try again what failed, if it is time to and no thread does it."""
        if self._thread is None and self._waiting and now_ns - self._tried_ns >= RETRY_NS:
            self._try(now_ns)

    def settle(self, within_s: float = SETTLE_S) -> None:
        """Return when all that was put before is written, after a time in seconds, or at once if the database fails."""
        if self._thread is None or self._drainer == threading.get_ident():
            return
        with self._changed:
            wanted = self._put
            self._changed.wait_for(lambda: self._done >= wanted or self.is_failing or self._is_ending, within_s)

    def start(self) -> None:
        """Start the thread."""
        self._is_ending = False
        self._thread = threading.Thread(target=self._work, name="history", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End the thread, after it has tried to write what waits."""
        thread = self._thread
        if thread is None:
            return
        with self._changed:
            self._is_ending = True
            self._changed.notify_all()
        thread.join(timeout=END_S)
        self._thread = None
        if self.unsaved:
            _log.warning("server.events_db: the server ends with %d events that were not stored", self.unsaved)

    def _work(self) -> None:
        try:
            while True:
                self._drain()
                with self._changed:
                    if self._is_ending:
                        return
                    if self.is_failing:
                        self._changed.wait_for(lambda: self._is_ending, RETRY_NS / 1e9)
                    else:
                        self._changed.wait_for(lambda: self._waiting or self._is_ending)
        except BaseException as error:
            self.failure = error
            _log.exception("the thread of the history has failed; the server ends")
            raise

    def _try(self, now_ns: int) -> None:
        if self._drainer == threading.get_ident():  # what this thread writes has put more: it is written next
            return
        self._tried_ns = now_ns
        self._drain()

    def _drain(self) -> None:
        """Write what waits until it is done or the database fails; one thread at a time."""
        with self._draining:
            self._drainer = threading.get_ident()
            try:
                self._write_waiting()
            finally:
                self._drainer = None

    def _write_waiting(self) -> None:
        try:
            self._prepare()
            while (write := self._first()) is not None:
                try:
                    write.work()
                except RejectedError as error:  # it would be refused again, and everything else would wait for it
                    _log.error("%s", error)
                    self._give_up(write)
                with self._changed:
                    self._take(0)
                    self._changed.notify_all()
            failing = False
        except StoreError as error:
            if not self.is_failing:
                _log.error("%s", error)
            failing = True
        if self.is_failing and not failing:
            _log.info("server.events_db: the database takes events again")
        with self._changed:
            self.is_failing, self._is_writing = failing, False
            self._changed.notify_all()

    def _first(self) -> Write | None:
        with self._changed:
            self._is_writing = bool(self._waiting)
            return self._waiting[0] if self._waiting else None

    def _take(self, place: int) -> Write:
        write = self._waiting[place]
        del self._waiting[place]
        self._done += 1
        self.unsaved -= write.events
        self._nbytes -= write.nbytes
        return write

    def _give_up(self, write: Write) -> None:
        self.discarded += write.events
        self.discarded_others += write.others
