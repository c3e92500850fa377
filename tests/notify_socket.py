"""Stands in for a service manager: the socket that processes report to."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


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

    @property
    def said(self) -> list[str]:
        """All reports so far, in order."""
        while True:
            try:
                self._said += self._socket.recv(65536).decode().splitlines()
            except BlockingIOError:
                return list(self._said)

    def count(self, line: str) -> int:
        """Return how often something was reported."""
        return self.said.count(line)

    def environment(self, silence_s: float) -> dict[str, str]:
        """Return this process's environment, as a service has it."""
        return {**os.environ, "NOTIFY_SOCKET": self.address, "WATCHDOG_USEC": str(round(silence_s * 1e6))}

    def close(self) -> None:
        """Stop to listen."""
        self._socket.close()


@contextmanager
def listening(directory: Path) -> Iterator[NotifySocket]:
    """A socket in a folder."""
    manager = NotifySocket(str(directory / "notify"))
    try:
        yield manager
    finally:
        manager.close()
