"""The nodes' socket: whatever another peer sends to it, a good node is served."""

from __future__ import annotations

import random
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
import zmq

from livessl import wire
from livessl.capture.dealer import Dealer
from livessl.capture.link import Link
from livessl.clock import SystemClock
from livessl.core.types import Frame
from livessl.server.admission import OTHER_SITE, OTHER_VERSION
from livessl.server.inlet import QUEUE_MESSAGES
from livessl.server.receiver import BindError, Joined, Left, Receiver
from small_site import frame, mark, site_of, wait_until

CLOCK = SystemClock()
HELLO = wire.Hello("lab-pc", "run-1", {"north": 16000.0})


@contextmanager
def receiving() -> Iterator[Receiver]:
    receiver = Receiver(site_of(), CLOCK)
    receiver.start()
    try:
        yield receiver
    finally:
        receiver.stop()


@contextmanager
def stranger(receiver: Receiver) -> Iterator[zmq.Socket[bytes]]:
    """Connect a peer that sends what it likes."""
    with zmq.Context() as context, context.socket(zmq.DEALER) as socket:
        socket.setsockopt(zmq.LINGER, 0)
        socket.connect(receiver.endpoint)
        yield socket


@contextmanager
def node(receiver: Receiver) -> Iterator[Link]:
    link = Link(receiver.endpoint, HELLO, CLOCK)
    try:
        link.wait_connected(lambda: False)
        yield link
    finally:
        link.close(bye=False)


def assert_works(receiver: Receiver, link: Link, first: int) -> None:
    """Ten frames of the good node arrive and are acknowledged."""
    numbers = list(range(first, first + 10))
    got: list[int] = []
    link.send([frame(k) for k in numbers])

    def arrived() -> bool:
        link.service()
        got.extend(item.sequence for item in receiver.take(100, 0.001) if isinstance(item, Frame))
        return got == numbers and link.pending == 0

    wait_until(arrived, "the good node's frames")


def test_malformed_messages_hinder_no_other_node() -> None:
    rng = random.Random(2)
    good = [wire.encode(message) for message in (frame(), mark(), HELLO)]
    with receiving() as receiver, node(receiver) as link, stranger(receiver) as socket:
        sent = 0
        for turn in range(4):
            for data in 10 * good:
                mutated = bytearray(data)
                mutated[rng.randrange(6)] ^= 1 << rng.randrange(8)  # in the head: surely no message any more
                socket.send(bytes(mutated))
                socket.send(rng.randbytes(rng.randrange(50)))
                socket.send_multipart([b"LSSL", b"", data[6:20]])
                sent += 3
            assert_works(receiver, link, 10 * turn + 1)
        wait_until(lambda: receiver.ingest.malformed >= 0.9 * sent, "the count of what was refused")
        assert receiver.failure is None


def test_refused_greetings_are_counted_by_their_cause() -> None:
    newer = bytearray(wire.encode(HELLO))
    newer[4] = wire.VERSION + 1
    unknown = wire.Hello("lab-pc", "run-2", {"cellar": 16000.0})
    with receiving() as receiver, stranger(receiver) as socket:
        for data in (bytes(newer), bytes(newer), wire.encode(unknown)):
            socket.send(data)
        assert socket.poll(5000), "there is no reply"
        assert socket.recv()[4] == wire.VERSION + 1
        wait_until(lambda: receiver.refusals.count("nodes") == 3, "the count of refusals")
        assert receiver.refusals.counts() == {("nodes", OTHER_VERSION): 2, ("nodes", OTHER_SITE): 1}
        assert {refused.who for refused in receiver.refusals.known()} == {"node 'lab-pc'"}


class NewerDealer(Dealer):
    """The connection of a node that has the next version of the format, with the same greeting and acknowledgement."""

    def send(self, data: bytes) -> bool:
        return super().send(data[:4] + bytes([wire.VERSION + 1]) + data[5:])

    def receive(self) -> bytes | None:
        data = super().receive()
        if data is not None:
            assert data[4] == wire.VERSION + 1
            data = data[:4] + bytes([wire.VERSION]) + data[5:]
        return data


def test_node_of_another_version_learns_why_it_is_refused(caplog: pytest.LogCaptureFixture) -> None:
    with receiving() as receiver:
        link = Link(receiver.endpoint, HELLO, CLOCK, dealer=NewerDealer(receiver.endpoint))
        try:
            link.wait_connected(lambda: False)
        finally:
            link.close(bye=False)
        assert "the node runs a newer livessl than the server" in str(link.refused)
        assert "its node 'lab-pc' is refused" in str(receiver.ingest.problem_of("north"))
    assert "refuses this node: the node runs a newer livessl" in caplog.text
    assert "nodes: node 'lab-pc' was refused: the node runs a newer livessl" in caplog.text


def test_oversized_message_disconnects_only_its_sender() -> None:
    with receiving() as receiver, node(receiver) as link, stranger(receiver) as socket:
        assert_works(receiver, link, 1)
        with socket.get_monitor_socket(zmq.EVENT_DISCONNECTED) as monitor:
            socket.send(bytes(wire.MAX_MESSAGE_BYTES + 1))
            assert monitor.poll(5000), "the sender is not cut off"
            socket.disable_monitor()
        assert_works(receiver, link, 11)
        assert receiver.failure is None


def test_many_small_parts_are_no_way_around_the_limit() -> None:
    with receiving() as receiver, node(receiver) as link, stranger(receiver) as socket:
        socket.send_multipart([bytes(wire.MAX_MESSAGE_BYTES // 4)] * 5)
        wait_until(lambda: receiver.ingest.malformed == 1, "the refusal")
        assert_works(receiver, link, 1)


def test_message_in_parts_is_the_same_message() -> None:
    with receiving() as receiver, stranger(receiver) as socket:
        data = wire.encode(HELLO)
        socket.send_multipart([data[:4], data[4:9], data[9:]])
        wait_until(lambda: receiver.take(1, 0.001) == [Joined(HELLO)], "the greeting")


def test_items_come_in_order() -> None:
    with receiving() as receiver:
        with node(receiver) as link:
            link.send([frame(1), mark(1), frame(2)])
            link.close(bye=True)
        items: list[object] = []
        wait_until(lambda: items.extend(receiver.take(100, 0.001)) or len(items) == 5, "five items")  # type: ignore[func-returns-value]
        assert items[0] == Joined(HELLO)
        assert [getattr(item, "sequence", None) for item in items[1:4]] == [1, 1, 2]
        assert items[4] == Left(HELLO)


def test_full_queue_leaves_frames_with_the_node() -> None:
    """While nothing is taken, the node still gets acknowledgements of what is in the queue, and loses nothing."""
    total = QUEUE_MESSAGES + 300
    with receiving() as receiver, node(receiver) as link:
        link.send([frame(k) for k in range(1, total + 1)])
        wait_until(lambda: link.service() or receiver.queued == QUEUE_MESSAGES, "a full queue")  # type: ignore[func-returns-value]
        got: list[int] = []

        def all_arrived() -> bool:
            link.service()
            got.extend(item.sequence for item in receiver.take(50, 0.001) if isinstance(item, Frame))
            return len(got) >= total and link.pending == 0

        wait_until(all_arrived, "all frames")
        assert got == list(range(1, total + 1))
        assert link.dropped == 0


def test_taken_address_is_an_error_with_its_cure() -> None:
    with receiving() as receiver:
        with pytest.raises(BindError) as caught:
            Receiver(site_of({"server.bind": receiver.endpoint}), CLOCK)
        assert str(caught.value) == (
            f"server.bind: cannot listen on {receiver.endpoint}: Address already in use; is another server running? "
            "Stop it or choose another port"
        )
        endpoint = receiver.endpoint
    again = Receiver(site_of({"server.bind": endpoint}), CLOCK)  # given back when it ended
    again.stop()


def test_take_waits_no_longer_than_it_may() -> None:
    with receiving() as receiver:
        began_ns = CLOCK.now_ns()
        assert receiver.take(10, 0.05) == []
        assert 0.04e9 < CLOCK.now_ns() - began_ns < 2e9
