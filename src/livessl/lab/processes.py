"""Our own commands as processes: started, waited for, ended."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
import urllib.request
from collections.abc import Sequence
from typing import Final

from livessl.clock import Clock
from livessl.errors import RunError

READY_NS: Final = 60_000_000_000
POLL_NS: Final = 50_000_000
END_S: Final = 5.0


class NotStartedError(RunError):
    """A command did not come up; it has said why itself."""


def start(*arguments: str) -> subprocess.Popen[bytes]:
    """Run a livessl command."""
    return subprocess.Popen([sys.executable, "-m", "livessl", *arguments])  # noqa: S603 - ourselves


def wait_until_ready(url: str, started: Sequence[subprocess.Popen[bytes]], clock: Clock) -> None:
    """Return when the server at `url` answers.

    Raises
    ------
    NotStartedError
        Where one of the processes ends first, or it does not answer in time.
    """
    deadline_ns = clock.monotonic_ns() + READY_NS
    while clock.monotonic_ns() < deadline_ns:
        if any(process.poll() is not None for process in started):
            raise NotStartedError("the server did not start; it says why above")
        if _answers(url):
            return
        clock.sleep_until_ns(clock.now_ns() + POLL_NS)
    raise NotStartedError(f"the server at {url} did not answer within {READY_NS / 1e9:.0f} s")


def end(started: Sequence[subprocess.Popen[bytes]]) -> None:
    """End processes, the youngest first, and wait for them."""
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
    """A port of this machine that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _answers(url: str) -> bool:
    try:
        with urllib.request.urlopen(f"{url}/api/v1/health", timeout=1.0):  # noqa: S310 - our own http address
            return True
    except OSError:
        return False
