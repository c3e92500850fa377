"""A node's links to all its servers: what it sends goes to each of them, and none waits for another."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Final

from livessl import wire
from livessl.capture.link import Link
from livessl.clock import Clock
from livessl.core.types import Frame, Message
from livessl.errors import RunError

DRAIN_NS: Final = 3_000_000_000
"""Longest wait, in ns, for the last acknowledgement while a server does not answer. While it answers, the wait has no
limit."""

WAIT_NS: Final = 20_000_000
"""Interval, in ns, at which a waiting node serves its links."""


class UndeliveredError(RunError):
    """Sound that a server refused or never acknowledged."""


class EncodeOnce:
    """Encodes frames for spools that all get the same frames, one after the other, and share the bytes.

    So the spools in memory of several servers that are away need no more memory than that of one.
    """

    def __init__(self) -> None:
        self._frame: Frame | None = None
        self._data = b""

    def __call__(self, frame: Frame) -> bytes:
        """Return a frame as it goes over the wire."""
        if frame is not self._frame:
            self._frame, self._data = frame, wire.encode(frame)
        return self._data


class Links:
    """The links of a node; each has a spool of its own.

    Parameters
    ----------
    links : sequence of Link
        One for each server.
    """

    def __init__(self, links: Sequence[Link]) -> None:
        self._links = tuple(links)

    def report(self, problem: str | None) -> None:
        """Report a problem of the device to the servers; None reports that the problem is over."""
        for link in self._links:
            link.report(problem)

    def send(self, messages: Iterable[Message]) -> None:
        """Queue messages for each server that gets their arrays, and send as many as the connections accept."""
        for message in messages:  # one message to all links before the next one: they share its bytes
            for link in self._links:
                if message.array in link.arrays:
                    link.queue(message)
        self.service()

    def service(self) -> None:
        """Read acknowledgements, greet if necessary, and send as many messages as the connections accept."""
        for link in self._links:
            link.service()

    def in_words(self, problem: str | None = None) -> str:
        """Return the state of the node: the problem of its device if there is one, and which servers take its sound."""
        states = [_in_words(link) for link in self._links]
        return "; ".join(states if problem is None else [problem, *states])

    def drain(self, clock: Clock, stop: Callable[[], bool], turn: Callable[[], None] | None = None) -> None:
        """Wait for the last acknowledgements, which may be long in coming, then close the links with a good-bye.

        Parameters
        ----------
        clock : Clock
        stop : callable
            Returns True when the wait is to end.
        turn : callable or None
            Called again and again meanwhile.

        Raises
        ------
        UndeliveredError
            If a server has refused the sound, or has not acknowledged everything.
        """
        answered_ns = [clock.monotonic_ns()] * len(self._links)
        while not stop():
            now_ns = clock.monotonic_ns()
            answered_ns = [now_ns if link.connected else t for link, t in zip(self._links, answered_ns, strict=True)]
            if not any(
                link.pending and not link.refused and now_ns - last_ns < DRAIN_NS
                for link, last_ns in zip(self._links, answered_ns, strict=True)
            ):
                break
            if turn is not None:
                turn()
            clock.sleep_until_ns(clock.now_ns() + WAIT_NS)
            self.service()
        failures = [failure for link in self._links if (failure := _failure(link)) is not None]
        self.close(bye=True)
        if failures and not stop():
            raise UndeliveredError("; ".join(failures))

    def close(self, *, bye: bool) -> None:
        """Close the connections and the spools; with `bye` the servers are informed that the node ends on purpose."""
        for link in self._links:
            link.close(bye=bye)


def _failure(link: Link) -> str | None:
    """Return what a server has not taken, as a sentence; None if it has everything."""
    if link.refused:
        return f"the server at {link.endpoint} refused the sound: {link.refused}"
    undelivered = link.pending + link.dropped
    if not undelivered:
        return None
    return f"{undelivered} messages were never acknowledged by the server at {link.endpoint}; is one running there?"


def _in_words(link: Link) -> str:
    if link.refused is not None:
        return f"the server at {link.endpoint} refuses this node: {link.refused}"
    if link.connected:
        return f"connected to the server at {link.endpoint}"
    return f"no answer of the server at {link.endpoint}; {link.kept} frames wait for it"
