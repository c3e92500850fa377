"""A node's link over real sockets: no frame is lost while the server is away, and the spool is bounded."""

from __future__ import annotations

from collections.abc import Callable
from itertools import groupby, islice

import pytest

from link_router import HELLO, HandClock, Router, connect, free_endpoint, linked, together
from livessl import wire
from livessl.capture.dealer import Dealer
from livessl.capture.link import SILENT_NS, Link
from livessl.capture.outbox import LATE_NS
from livessl.clock import SystemClock
from livessl.core.types import Frame, Mark
from livessl.server.receiver import Receiver
from small_site import FIRST_FRAME_INDEX, frame, mark, site_of, wait_until


def test_node_may_start_before_the_server() -> None:
    endpoint = free_endpoint()
    with linked(endpoint) as link:
        link.send([frame(k) for k in range(1, 6)])
        assert not link.connected
        assert link.pending == 5
        with Router(endpoint) as router:
            connect(link, router)
            assert router.hellos()[0] == HELLO
            together(link, router, lambda: len(router.frames()) == 5, "the frames")
            assert router.frames() == [1, 2, 3, 4, 5]
            assert link.pending == 5
            router.ack(north=3)
            together(link, router, lambda: link.pending == 2, "the acknowledgement")
            router.ack(north=5)
            together(link, router, lambda: link.pending == 0, "the acknowledgement")


def test_frames_arrive_unchanged() -> None:
    with Router() as router, linked(router.endpoint) as link:
        connect(link, router)
        sent: list[Frame | Mark] = [frame(1), mark(2), frame(3, seed=5)]
        link.send(sent)
        together(link, router, lambda: len(router.frames()) == 2, "the frames")
        arrived = [message for message in router.got if isinstance(message, Frame | Mark)]
        assert [wire.encode(message) for message in arrived] == [wire.encode(message) for message in sent]


def test_no_sound_is_sent_before_the_greeting_is_answered() -> None:
    with Router() as router, linked(router.endpoint) as link:
        link.send([frame()])
        together(link, router, router.hellos, "a greeting")
        link.service()
        router.read()
        assert router.frames() == []


def test_restarted_server_gets_all_unacknowledged_frames() -> None:
    with linked(free_endpoint()) as link:
        with Router(link.endpoint) as router:
            connect(link, router)
            link.send([frame(k) for k in range(1, 5)])
            together(link, router, lambda: len(router.frames()) == 4, "the frames")
            router.ack(north=2)
            together(link, router, lambda: link.pending == 2, "the acknowledgement")
        link.send([frame(5)])
        with Router(link.endpoint) as router:
            together(link, router, lambda: router.got, "anything")
            router.send(wire.encode(wire.Ack("?", {}, who_are_you=True)))
            together(link, router, router.hellos, "a greeting")
            router.ack()
            together(link, router, lambda: router.frames()[-3:] == [3, 4, 5], "the frames")


def test_broken_connection_is_detected_before_the_next_one_is_used() -> None:
    """Messages on their way are lost with it, so the next greeting must count them as backlog."""
    with linked(free_endpoint()) as link:
        with Router(link.endpoint) as router:
            connect(link, router)
            link.send([frame(k) for k in range(1, 5)])
            together(link, router, lambda: len(router.frames()) == 4, "the frames")
        with Router(link.endpoint) as router:
            link.report("a greeting for another reason")
            together(link, router, lambda: router.got, "anything")
            first = router.got[0]
            assert isinstance(first, wire.Hello)
            assert first.backlog == {"north": (FIRST_FRAME_INDEX + 1, FIRST_FRAME_INDEX + 5)}


def test_silent_server_is_detected_and_survived() -> None:
    clock = HandClock()
    with Router() as router, linked(router.endpoint, clock) as link:
        connect(link, router)
        link.send([frame(1)])
        together(link, router, lambda: router.frames() == [1], "the frame")
        clock.time_ns += SILENT_NS
        assert not link.connected
        link.send([frame(2)])
        connect(link, router)
        together(link, router, lambda: router.frames()[-2:] == [1, 2], "both frames")


def test_only_the_newest_mark_waits_for_the_server() -> None:
    endpoint = free_endpoint()
    with linked(endpoint) as link:
        for k in range(1, 101):
            link.send([mark(k), mark(k, array="south")])
        assert link.pending == 2
        link.send([frame(101), mark(102)])
        assert link.pending == 3
        with Router(endpoint) as router:
            connect(link, router)
            together(link, router, lambda: router.marks("north"), "the mark")
            assert router.marks("south") == [100]
            assert router.frames() == [101]
            assert router.marks("north") == [102]
            # marks are not sent again, because they describe a past state
            router.ack(north=101, south=100)
            together(link, router, lambda: link.pending == 0, "the acknowledgement")


class Narrow(Dealer):
    """A connection that accepts nothing while it is full."""

    def __init__(self) -> None:
        self.full = False
        self.sent: list[wire.WireMessage] = []
        self.coming: list[bytes] = []

    def broken(self) -> bool:
        return False

    def send(self, data: bytes) -> bool:
        if not self.full:
            self.sent.append(wire.decode(data))
        return not self.full

    def receive(self) -> bytes | None:
        return self.coming.pop(0) if self.coming else None

    def close(self, linger_ms: int) -> None:
        self.full = True


def test_mark_is_not_sent_after_later_frames() -> None:
    """A mark carries the number of frames before it; the server would request those that it has not received yet."""
    clock, dealer = HandClock(), Narrow()
    link = Link("", HELLO, clock, dealer=dealer)
    for _ in range(2):
        link.service()
        dealer.coming.append(wire.encode(wire.Ack("run-1", {})))
    link.service()
    dealer.full = True
    link.send([mark(1), frame(2), mark(2, array="south")])
    for _ in range(6):
        clock.time_ns += LATE_NS // 5
        dealer.coming.append(wire.encode(wire.Ack("run-1", {})))
        link.service()
    dealer.full = False
    link.service()
    [hello, quiet, sound, _] = dealer.sent[-4:]
    assert isinstance(hello, wire.Hello)
    assert hello.backlog == {"north": (FIRST_FRAME_INDEX + 2, FIRST_FRAME_INDEX + 3)}
    assert isinstance(quiet, Mark)
    assert quiet.array == "south"
    assert isinstance(sound, Frame)
    assert sound.sequence == 2
    assert not [m for m in dealer.sent if isinstance(m, Mark) and m.array == "north"]
    link.close(bye=False)


def test_refusal_lasts_until_the_server_accepts() -> None:
    clock = HandClock()
    with Router() as router, linked(router.endpoint, clock) as link:
        assert link.refused is None
        together(link, router, router.hellos, "a greeting")
        router.send(wire.encode(wire.Ack("run-1", {}, refused="array 'north' is captured already")))
        together(link, router, lambda: link.refused, "the refusal")
        assert link.refused == "array 'north' is captured already"
        assert not link.connected
        clock.time_ns += 1_000_000_000
        together(link, router, lambda: len(router.hellos()) == 2, "another greeting")
        assert link.refused == "array 'north' is captured already"
        router.ack()
        together(link, router, lambda: link.connected, "the connection")
        assert link.refused is None


def test_greetings_are_sent_at_most_once_a_second() -> None:
    clock = HandClock()
    with Router() as router, linked(router.endpoint, clock) as link:
        together(link, router, router.hellos, "a greeting")
        for _ in range(50):
            link.service()
        router.read()
        assert len(router.hellos()) == 1
        clock.time_ns += 1_000_000_000
        together(link, router, lambda: len(router.hellos()) == 2, "another greeting")


def test_node_without_sound_greets_once_a_second() -> None:
    clock = HandClock()
    with Router() as router, linked(router.endpoint, clock) as link:
        connect(link, router)
        start = len(router.hellos())
        for _ in range(3):
            count = len(router.hellos())
            clock.time_ns += 1_000_000_000
            together(link, router, lambda count=count: len(router.hellos()) > count, "a sign of life")  # type: ignore[misc]
            router.ack()
            together(link, router, lambda: link.connected, "the connection")
        assert len(router.hellos()) - start in (3, 4)  # one of the connection may still have been on its way
        clock.time_ns += 900_000_000
        link.send([frame(1)])
        together(link, router, router.frames, "the frame")
        clock.time_ns += 900_000_000
        link.service()
        router.read()
        assert len(router.hellos()) == count + 1  # a frame is a sign of life, too


def test_messages_other_than_acknowledgements_are_ignored(caplog: pytest.LogCaptureFixture) -> None:
    with Router() as router, linked(router.endpoint) as link:
        connect(link, router)
        link.send([frame(1)])
        together(link, router, router.frames, "the frame")
        for data in (b"", b"rubbish", wire.encode(wire.Bye("x", "y")), wire.encode(wire.Ack("run-0", {"north": 9}))):
            router.send(data)
        router.ack(south=3)
        router.ack(north=1)
        together(link, router, lambda: link.pending == 0, "the acknowledgement")
        assert link.connected
    assert "sent an invalid message" in caplog.text


def test_device_problem_is_reported_once() -> None:
    with Router() as router, linked(router.endpoint) as link:
        connect(link, router)
        for _ in range(3):
            link.report("input device 'UMC' is not connected")
        link.report(None)

        def reported() -> list[str | None]:
            """Return the reported problems without repetitions."""
            return [problem for problem, _ in groupby(hello.problem for hello in router.hellos())]

        together(link, router, lambda: len(reported()) >= 3, "the problem and its end")
        assert reported() == [None, "input device 'UMC' is not connected", None]
        assert [hello.problem for hello in router.hellos()].count("input device 'UMC' is not connected") == 1


def test_device_problem_is_in_the_first_greeting_of_a_later_server() -> None:
    endpoint = free_endpoint()
    with linked(endpoint) as link:
        link.report("unplugged")
        with Router(endpoint) as router:
            together(link, router, router.hellos, "a greeting")
            assert router.hellos()[0].problem == "unplugged"


@pytest.mark.parametrize("bye", [True, False])
def test_good_bye_is_sent_on_request(bye: bool) -> None:
    with Router() as router:
        link = Link(router.endpoint, HELLO, SystemClock())
        connect(link, router)
        link.send([frame(1)])
        together(link, router, router.frames, "the frame")
        link.close(bye=bye)
        if bye:
            wait_until(lambda: router.read() > 0, "the good-bye")
        router.read()
        assert (wire.Bye("lab-pc", "run-1") in router.got) is bye


def test_close_does_not_wait_for_an_absent_server() -> None:
    clock = SystemClock()
    link = Link(free_endpoint(), HELLO, clock)
    link.send([frame(k) for k in range(1, 100)])
    began_ns = clock.now_ns()
    link.close(bye=True)
    assert clock.now_ns() - began_ns < 1_000_000_000


def test_wait_connected_can_be_stopped() -> None:
    with linked(free_endpoint()) as link:
        asked = iter([False, False, True])
        link.wait_connected(lambda: next(asked))
        assert not link.connected


def test_restart_of_the_real_server_neither_loses_nor_repeats_frames() -> None:
    """Each of sixty frames reaches the old or the new server, and neither gets a frame twice."""
    clock = SystemClock()
    site = site_of({"server.bind": free_endpoint()})
    numbers = iter(range(1, 61))

    def receive(link: Link, until: Callable[[list[int]], object]) -> list[int]:
        receiver = Receiver(site, clock)
        receiver.start()
        got: list[int] = []

        def take() -> None:
            got.extend(item.sequence for item in receiver.take(100, 0.001) if isinstance(item, Frame))

        def turn() -> object:
            link.send([frame(k) for k in islice(numbers, 1)])
            take()
            return until(got)

        try:
            wait_until(turn, "frames")
        finally:
            receiver.stop()
        take()
        assert receiver.ingest.sequence_gaps["north"] == 0
        return got

    with linked(site.server.bind) as link:
        first = receive(link, lambda got: len(got) >= 30)
        second = receive(link, lambda got: got and got[-1] == 60 and link.pending == 0)
        assert link.dropped == 0
    assert first[-1] < 60
    for got in (first, second):
        assert len(got) == len(set(got))
    assert set(first) | set(second) == set(range(1, 61))


def test_link_works_while_the_clock_is_set_back() -> None:
    """Stamps may jump; intervals follow the monotonic clock."""

    class SetBack(HandClock):
        def now_ns(self) -> int:
            return self.time_ns - 3_600_000_000_000

    for clock in (HandClock(), SetBack()):
        with Router() as router:
            link = Link(router.endpoint, HELLO, clock)
            try:
                together(link, router, lambda router=router: len(router.hellos()) == 1, "the first greeting")  # type: ignore[misc]
                clock.time_ns += 1_000_000_000
                together(link, router, lambda router=router: len(router.hellos()) == 2, "another greeting")  # type: ignore[misc]
            finally:
                link.close(bye=False)


def test_a_server_that_refuses_is_not_said_to_be_away(caplog: pytest.LogCaptureFixture) -> None:
    clock = HandClock()
    with Router() as router:
        link = Link(router.endpoint, HELLO, clock)
        together(link, router, lambda: router.got, "the greeting")
        router.send(wire.encode(wire.Ack("run-1", {}, refused="another node has this name")))
        together(link, router, lambda: link.refused, "the refusal")
        for _ in range(3):
            clock.time_ns += 2 * SILENT_NS
            link.service()
        link.close(bye=False)
    assert "another node has this name" in caplog.text
    assert "no server answers" not in caplog.text


def test_invalid_message_of_a_server_is_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    newer = wire.encode(wire.Ack("run-1", {}), wire.VERSION + 1)
    with Router() as router, linked(router.endpoint) as link:
        connect(link, router)
        for _ in range(3):
            router.send(newer)
        router.ack(north=1)
        link.send([frame(1)])
        together(link, router, lambda: link.pending == 0, "the acknowledgement")
    assert caplog.text.count("sent an invalid message: expected wire version") == 1
