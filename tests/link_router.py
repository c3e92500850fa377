"""The server's end of a link: a router that records what comes, and a clock that is set by hand."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import TracebackType
from typing import Self

import zmq

from livessl import wire
from livessl.capture.link import Link
from livessl.clock import SystemClock
from livessl.core.types import Frame, Mark
from small_site import FIRST_FRAME_INDEX, wait_until

HELLO = wire.Hello("lab-pc", "run-1", {"north": 16000.0, "south": 16000.0})


class HandClock:
    """A clock that the test sets."""

    def __init__(self) -> None:
        self.time_ns = 1_767_225_600_000_000_000

    def now_ns(self) -> int:
        return self.time_ns

    def monotonic_ns(self) -> int:
        return self.time_ns

    def sleep_until_ns(self, time_ns: int) -> bool:
        self.time_ns = max(self.time_ns, time_ns)
        return True


class Router:
    """A server that only does what the test requests."""

    def __init__(self, endpoint: str = "tcp://127.0.0.1:*") -> None:
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.ROUTER)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.bind(endpoint)
        self.endpoint = self._socket.getsockopt_string(zmq.LAST_ENDPOINT)
        self.got: list[wire.WireMessage] = []
        self.peer = b""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._socket.close()
        self._context.term()

    def read(self) -> int:
        """Read all messages that have arrived; return their number."""
        before = len(self.got)
        while self._socket.poll(2):
            self.peer, data = self._socket.recv_multipart()
            self.got.append(wire.decode(data))
        return len(self.got) - before

    def send(self, data: bytes) -> None:
        self._socket.send_multipart([self.peer, data])

    def ack(self, settled: int | None = None, **received: int) -> None:
        """Acknowledge frames by number, and settle those before a number."""
        frame_indices = {array: FIRST_FRAME_INDEX + number for array, number in received.items()}
        self.send(
            wire.encode(wire.Ack("run-1", frame_indices, None if settled is None else FIRST_FRAME_INDEX + settled))
        )

    def hellos(self) -> list[wire.Hello]:
        return [message for message in self.got if isinstance(message, wire.Hello)]

    def frames(self, array: str = "north") -> list[int]:
        return [m.sequence for m in self.got if isinstance(m, Frame) and m.array == array]

    def marks(self, array: str = "north") -> list[int]:
        return [m.sequence for m in self.got if isinstance(m, Mark) and m.array == array]


@contextmanager
def linked(endpoint: str, clock: HandClock | SystemClock | None = None) -> Iterator[Link]:
    link = Link(endpoint, HELLO, clock or SystemClock())
    try:
        yield link
    finally:
        link.close(bye=False)


def together(link: Link, router: Router, condition: Callable[[], object], what: str) -> None:
    """Serve link and router until the condition holds."""

    def turn() -> object:
        link.service()
        router.read()
        return condition()

    wait_until(turn, what)


def connect(link: Link, router: Router) -> None:
    count = len(router.hellos())
    together(link, router, lambda: len(router.hellos()) > count, "a greeting")
    router.ack()
    together(link, router, lambda: link.connected, "the connection")
    together(link, router, lambda: len(router.hellos()) > count + 1, "the greeting with the backlog")


def free_endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp://127.0.0.1:{probe.getsockname()[1]}"


def hellos(router: Router) -> int:
    return sum(isinstance(message, wire.Hello) for message in router.got)


def sounds(router: Router) -> list[Frame]:
    return [message for message in router.got if isinstance(message, Frame)]
