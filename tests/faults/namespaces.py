"""Nodes in network namespaces of their own, on virtual cables that can be pulled: real TCP that loses real packets."""

from __future__ import annotations

import os
import random
import subprocess
import time
from ipaddress import IPv4Address
from types import TracebackType
from typing import Final, Self


class Cable:
    """From the host to a network namespace; made with the context, and gone with it.

    `host` is this end's address, as the other end sees it.

    Parameters
    ----------
    number : int
        0 to 7: each cable of a process has a network of its own, of those that are set apart for tests (RFC 2544).
    """

    def __init__(self, number: int) -> None:
        self._namespace = f"livessl-{os.getpid()}-{number}"
        self._here, self._there = (f"lv{os.getpid() % 1_000_000}{end}{number}" for end in "ht")
        network = IPv4Address("198.18.0.0") + 4 * ((8 * os.getpid() + number) % 2**15)
        self.host, self._node = str(network + 1), str(network + 2)

    def __enter__(self) -> Self:
        _ip("netns", "add", self._namespace)
        try:
            _ip("link", "add", self._here, "type", "veth", "peer", "name", self._there, "netns", self._namespace)
            _ip("address", "add", f"{self.host}/30", "dev", self._here)
            _ip("-n", self._namespace, "address", "add", f"{self._node}/30", "dev", self._there)
            _ip("-n", self._namespace, "link", "set", self._there, "up")
            self.plug()
        except OSError:
            _ip("netns", "delete", self._namespace)
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        _ip("link", "delete", self._here)  # the namespace goes in its own time, and the next cable may come before
        _ip("netns", "delete", self._namespace)

    @property
    def inside(self) -> list[str]:
        """What comes before a command to run it at the other end."""
        return ["ip", "netns", "exec", self._namespace]

    def pull(self) -> None:
        """Nothing passes, and nobody's connection is told."""
        _ip("link", "set", self._here, "down")

    def plug(self) -> None:
        """Put it in again."""
        _ip("link", "set", self._here, "up")

    def narrow(self, kbit_s: int) -> None:
        """Let no more than so much pass, each way."""
        for where, end in ((), self._here), (("-n", self._namespace), self._there):
            _run("tc", *where, "qdisc", "replace", "dev", end, "root", "tbf", "rate", f"{kbit_s}kbit", *_QUEUE)

    def loosen(self, rng: random.Random, seconds: float) -> None:
        """A loose contact: whatever is sent in some 0.05 to 0.4 s of every second is lost."""
        until_s = time.monotonic() + seconds
        while time.monotonic() < until_s:
            time.sleep(rng.uniform(0.2, 1.2))
            self.pull()
            time.sleep(rng.uniform(0.05, 0.4))
            self.plug()


def why_not() -> str | None:
    """Why namespaces are not to be had here; None where they are."""
    try:
        with Cable(7):
            return None
    except OSError as error:
        return str(error)


def _ip(*arguments: str) -> None:
    _run("ip", *arguments)


def _run(*command: str) -> None:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise OSError(f"{' '.join(command)}: {done.stderr.strip()}")


_QUEUE: Final = ("burst", "16kb", "latency", "300ms")
"""What a router keeps before it throws away."""
