"""Notifies systemd (sd_notify) that this process is ready, alive (watchdog), reloading or stopping.

A notification is a datagram to the socket that the environment variable NOTIFY_SOCKET names: see sd_notify(3). Other
service managers with the same protocol work as well. If the variable is not set, nothing is sent.
"""

from __future__ import annotations

import logging
import os
import socket
from collections.abc import Callable, Iterator, MutableMapping
from contextlib import contextmanager
from typing import Final

from livessl.clock import Clock

VARIABLES: Final = ("NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID")
"""Environment variables of the protocol: address of the socket, longest time without a sign of life in microseconds,
and id of the process that must send signs of life."""

STATUS_NS: Final = 1_000_000_000
"""Shortest time, in nanoseconds, between two descriptions of the status."""

SIGNS: Final = 4
"""Number of signs of life within the longest permitted silence, so that one of them may be late or lost."""

MAX_STATUS: Final = 500
"""Largest number of characters of a status; `systemctl status` cuts longer lines."""

_log = logging.getLogger(__name__)


class ServiceManager:
    """The service manager of this process, if one has started it.

    One thread calls `turn`; any thread may call the others.

    Parameters
    ----------
    clock : Clock
    address : str or None
        Path of its socket, or `@` and an abstract name; None without a service manager.
    silence_ns : int or None
        Time without a sign of life, in nanoseconds, after which it kills this process; None for no limit.
    """

    def __init__(self, clock: Clock, address: str | None = None, silence_ns: int | None = None) -> None:
        self._clock = clock
        self._address = address
        self._silence_ns = silence_ns
        self._is_ready = self._is_stopping = self._fails = False
        self._sign_ns: int | None = None
        self._looked_ns: int | None = None
        self._status = ""

    @classmethod
    def of_environment(cls, clock: Clock, environment: MutableMapping[str, str] = os.environ) -> ServiceManager:
        """Return the service manager that the environment names, and remove the variables from the environment.

        Programs that this process starts then cannot report in its name.
        """
        address, silence_us, process = (environment.pop(name, "") for name in VARIABLES)
        is_for_this = process in ("", str(os.getpid()))
        if not (silence_us.isdecimal() and int(silence_us) > 0 and is_for_this):
            return cls(clock, address or None)
        return cls(clock, address or None, int(silence_us) * 1000)

    @property
    def is_there(self) -> bool:
        """True if a service manager has started this process."""
        return self._address is not None

    @property
    def watches(self) -> bool:
        """True if the service manager kills this process when signs of life are missing."""
        return self.is_there and self._silence_ns is not None

    def turn(self, describe: Callable[[], str]) -> None:
        """Report that this process is ready and alive; call it from the loop that must not hang, as often as it turns.

        It never waits. The first call reports that the process is ready.

        Parameters
        ----------
        describe : callable
            Returns the state of the process in words. It is called at most once in `STATUS_NS`.
        """
        if self._address is None or self._is_stopping:
            return
        now_ns = self._clock.monotonic_ns()
        is_due = self._silence_ns is not None and _is_over(self._sign_ns, self._silence_ns // SIGNS, now_ns)
        status = self._status
        if _is_over(self._looked_ns, STATUS_NS, now_ns):
            self._looked_ns = now_ns
            status = self._in_words(describe)
        lines = [
            *(() if self._is_ready else ("READY=1",)),
            *(("WATCHDOG=1",) if is_due else ()),
            *(() if status == self._status else (f"STATUS={status}",)),
        ]
        if lines and self._send(*lines):
            self._is_ready, self._status = True, status
            self._sign_ns = now_ns if is_due else self._sign_ns

    @contextmanager
    def reloading(self) -> Iterator[None]:
        """Report, while the context lasts, that settings are being read again."""
        if not self._is_ready or self._is_stopping:  # a process that is not ready is reported by `turn` later
            yield
            return
        self._send("RELOADING=1", f"MONOTONIC_USEC={self._clock.monotonic_ns() // 1000}")
        try:
            yield
        finally:
            if not self._is_stopping:
                self._is_ready = self._send("READY=1")  # if it fails, `turn` sends it

    def stopping(self) -> None:
        """Report that this process ends; nothing is reported after that."""
        if not self._is_stopping:
            self._is_stopping = True
            self._send("STOPPING=1", "STATUS=stopping")

    def _in_words(self, describe: Callable[[], str]) -> str:
        """Return the state in one line; if `describe` fails, the previous state, as a sign of life needs no words."""
        try:
            return " ".join(describe().split())[:MAX_STATUS]
        except Exception:  # noqa: BLE001 - whatever fails there, the process is alive
            _log.exception("the state of this process could not be described to the service manager")
            return self._status

    def _send(self, *lines: str) -> bool:
        """Send lines, and return whether they were sent; if they were not, this process goes on."""
        if self._address is None:
            return False
        address = "\0" + self._address[1:] if self._address.startswith("@") else self._address
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
                sender.sendto(
                    "\n".join(lines).encode(errors="replace"), socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL, address
                )
        except OSError as error:
            if not self._fails:
                _log.warning(
                    "%s: cannot report to the service manager at %s: %s; trying again. If it restarts this process, "
                    "see WatchdogSec= of its unit",
                    VARIABLES[0],
                    self._address,
                    error.strerror,
                )
            self._fails = True
            return False
        self._fails = False
        return True


def _is_over(since_ns: int | None, interval_ns: int, now_ns: int) -> bool:
    return since_ns is None or now_ns - since_ns >= interval_ns
