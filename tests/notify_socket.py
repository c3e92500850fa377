"""Stands in for a service manager: the socket that processes report to."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Event as Flag
from threading import Lock, Thread

from small_site import HANG_S


class NotifySocket:
    """What has been reported, one report a line of `said`.

    Parameters
    ----------
    address : str
        Path, or `@` and an abstract name.
    """

    def __init__(self, address: str) -> None:
        self.address = address
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind("\0" + address[1:] if address.startswith("@") else address)
        self._socket.setblocking(False)
        self._said: list[str] = []
        self._reading, self._end = Lock(), Flag()

    @property
    def said(self) -> list[str]:
        """All reports so far, in order."""
        with self._reading:
            while self._socket.fileno() >= 0:
                try:
                    self._said += self._socket.recv(65536).decode().splitlines()
                except BlockingIOError:
                    break
            return list(self._said)

    def count(self, line: str) -> int:
        """Return how often something was reported."""
        return self.said.count(line)

    def environment(self, silence_s: float) -> dict[str, str]:
        """Return this process's environment, as a service has it."""
        return {**os.environ, "NOTIFY_SOCKET": self.address, "WATCHDOG_USEC": str(round(silence_s * 1e6))}

    def keep_reading(self) -> None:
        """Read until the end: Linux keeps ten reports that nobody has read, and refuses others."""
        while not self._end.wait(0.02):
            assert self.said is not None

    def close(self) -> None:
        """Stop to listen."""
        self._end.set()
        with self._reading:
            self._socket.close()


@contextmanager
def listening(directory: Path, *, reads: bool = False) -> Iterator[NotifySocket]:
    """A socket in a folder, which is read all the time, or whenever it is asked for what was said."""
    manager = NotifySocket(str(directory / "notify"))
    reader = Thread(target=manager.keep_reading)
    if reads:
        reader.start()
    try:
        yield manager
    finally:
        manager.close()
        if reads:
            reader.join(HANG_S)
