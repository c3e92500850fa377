"""Runs livessl commands as processes for demo and benchmarks: starts them, waits for the server, stops them."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
import urllib.request
from collections.abc import Mapping, Sequence
from typing import Final

from livessl.clock import Clock
from livessl.errors import RunError

READY_NS: Final = 300_000_000_000
"""Longest time, in nanoseconds, that a server may take to start on a very busy machine."""

POLL_NS: Final = 50_000_000
"""Interval, in nanoseconds, at which it is checked whether a server is ready."""

END_S: Final = 5.0
"""Time, in seconds, after which a process that does not stop is killed."""


class NotStartedError(RunError):
    """A command did not start; its own message gives the reason."""


def start(*arguments: str, environment: Mapping[str, str] | None = None) -> subprocess.Popen[bytes]:
    """Start a livessl command with an environment; None for the environment of this process."""
    return subprocess.Popen([sys.executable, "-m", "livessl", *arguments], env=environment)  # noqa: S603 - this package


def wait_until_ready(url: str, started: Sequence[subprocess.Popen[bytes]], clock: Clock) -> None:
    """Wait until the server at `url` answers.

    Raises
    ------
    NotStartedError
        If one of the processes ends first, or the server does not answer in time.
    """
    deadline_ns = clock.monotonic_ns() + READY_NS
    while clock.monotonic_ns() < deadline_ns:
        if any(process.poll() is not None for process in started):
            raise NotStartedError("the server did not start; its message above gives the reason")
        if _answers(url):
            return
        clock.sleep_until_ns(clock.now_ns() + POLL_NS)
    raise NotStartedError(f"the server at {url} did not answer within {READY_NS / 1e9:.0f} s")


def end(started: Sequence[subprocess.Popen[bytes]]) -> None:
    """Stop processes, the last started first, and wait until they have ended."""
    for process in reversed(started):
        if process.poll() is None:
            process.send_signal(signal.SIGTERM)
    for process in started:
        try:
            process.wait(timeout=END_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def free_port() -> int:
    """Return a free TCP port of this machine."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _answers(url: str) -> bool:
    try:
        with urllib.request.urlopen(f"{url}/api/v1/health", timeout=1.0):  # noqa: S310 - our own http address
            return True
    except OSError:
        return False
