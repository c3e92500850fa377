"""Reads a node's clock state and load once a minute, in a thread of its own, which may wait."""

from __future__ import annotations

import hashlib
import os
import threading
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Final

from livessl.capture.host_clock import HostClock, read_host_clock
from livessl.core.types import HostState

READ_S: Final = 60.0
"""Interval between two readings, in seconds."""


class HostWatch:
    """Knows the state of this machine; a context manager that reads it from time to time.

    Parameters
    ----------
    read : callable
        Reads the clock; it may take seconds.
    interval_s : float
        Interval between two readings, in seconds.
    """

    def __init__(self, read: Callable[[], HostClock] = read_host_clock, interval_s: float = READ_S) -> None:
        self._read = read
        self._interval_s = interval_s
        self._clock: HostClock | None = None  # replaced as a whole, never changed, so that readers need no lock
        self._machine = machine()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._work, name="host", daemon=True)

    def __enter__(self) -> HostWatch:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()  # the thread may wait for a program, and ends with the process

    def state(self, lost_blocks: int = 0, *, sound_server: bool = False) -> HostState | None:
        """Return the state of the machine; None before the first reading.

        Parameters
        ----------
        lost_blocks : int
            Blocks of the device that were lost because the machine did not keep up.
        sound_server : bool
            Whether the device is read through a sound server.
        """
        clock = self._clock
        if clock is None:
            return None
        return HostState(
            clock.synchronized,
            clock.service,
            clock.reference,
            clock.error_s,
            lost_blocks,
            load(),
            sound_server,
            self._machine,
        )

    def _work(self) -> None:
        while True:
            self._clock = self._read()
            if self._stop.wait(self._interval_s):
                return


def load() -> float | None:
    """Return the programs that run or wait for a processor, per processor, over the last minute; None if unknown."""
    try:
        return os.getloadavg()[0] / (os.cpu_count() or 1)
    except OSError:
        return None


def machine() -> str:
    """Return a sign of the running kernel, which programs on one machine share, also in containers; empty if unknown.

    It is a digest, because the kernel's own number may be used as a secret elsewhere.
    """
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_bytes()
    except OSError:
        return ""
    return hashlib.blake2b(boot, digest_size=8, person=b"livessl").hexdigest()
