"""A node's link over real sockets: no frame is lost while the server is away, and the spool is bounded."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import groupby, islice
from types import TracebackType
from typing import Self

import numpy as np
import pytest
import zmq

from livessl import wire
from livessl.capture.dealer import Dealer
from livessl.capture.link import SILENT_NS, Link
from livessl.capture.outbox import BACKLOG_FRAMES, LATE_NS
from livessl.capture.spool import MEMORY_BYTES
from livessl.clock import SystemClock
from livessl.core.types import BackfillRequest, ChannelLevel, Frame, HostState, Mark, Message
from livessl.server.receiver import Receiver
from small_site import FIRST_FRAME_INDEX, frame, mark, site_of, wait_until

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


def test_spool_is_bounded_and_dropped_frames_are_counted() -> None:
    samples = np.zeros((16, wire.MAX_FRAME_SAMPLES), dtype=np.float32)
    size = samples.nbytes
    count = MEMORY_BYTES // size + 20
    endpoint = free_endpoint()
    with linked(endpoint) as link:
        for k in range(1, count + 1):
            link.send([Frame("north", k, k, k, 384_000.0, samples, 0.0, True)])
        assert link.dropped + link.pending == count
        assert 20 <= link.dropped <= 21
        assert link.pending * size <= MEMORY_BYTES < (link.pending + 2) * size
        with Router(endpoint) as router:
            connect(link, router)
            kept = list(range(link.dropped + 1, count + 1))  # the oldest were dropped

            def all_taken() -> bool:
                link.service()
                if router.read() and router.frames():
                    frame_indices = {"north": router.frames()[-1]}
                    router.send(wire.encode(wire.Ack("run-1", frame_indices)))
                return link.pending == 0

            wait_until(all_taken, "the backlog")
            assert router.frames() == kept


def test_live_sound_goes_first_and_the_backlog_follows_in_order_of_time() -> None:
    endpoint = free_endpoint()
    kept = [frame(k) for k in range(1, 51)]
    with linked(endpoint) as link:
        link.send(kept)
        with Router(endpoint) as router:
            together(link, router, router.hellos, "a greeting")
            router.ack()
            together(link, router, lambda: link.connected, "the connection")
            link.send([frame(51), frame(52)])
            together(
                link,
                router,
                lambda: len(router.frames()) == 2 + BACKLOG_FRAMES,
                "live sound, and a part of the backlog",
            )
            assert router.hellos()[-1].backlog == {"north": (FIRST_FRAME_INDEX + 1, FIRST_FRAME_INDEX + 51)}
            assert router.frames() == [*range(1, BACKLOG_FRAMES + 1), 51, 52] or router.frames()[:2] == [51, 52]
            router.ack(north=10)
            together(link, router, lambda: len(router.frames()) == 12 + BACKLOG_FRAMES, "ten more")
            link.send([frame(53)])
            together(link, router, lambda: 53 in router.frames(), "the live frame")
            assert 27 not in router.frames()  # the live frame preceded the rest of the backlog
            for k in (26, 42, 50):
                router.ack(north=k)
                together(link, router, lambda k=k: min(50, k + 16) in router.frames(), "more of the backlog")  # type: ignore[misc]
            together(link, router, lambda: router.hellos()[-1].backlog == {}, "the greeting without backlog")
            assert sorted(router.frames()) == list(range(1, 54))
            router.ack(north=53)
            together(link, router, lambda: link.pending == 0, "the acknowledgement")
            assert link.kept == 53  # until it is settled
            router.ack(settled=50, north=53)
            together(link, router, lambda: link.kept == 4, "the settlement")


def test_settled_frames_that_the_server_never_received_are_sent() -> None:
    """The server may have settled without this node, and shall still receive its frames."""
    endpoint = free_endpoint()
    with linked(endpoint) as link:
        link.send([frame(k) for k in range(1, 6)])
        with Router(endpoint) as router:
            together(link, router, router.hellos, "a greeting")
            router.ack(settled=100)
            together(link, router, lambda: len(router.frames()) == 5, "the frames")
            router.ack(settled=100, north=5)
            together(link, router, lambda: link.kept == 0, "the settlement")


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
        for _ in range(3):
            count = len(router.hellos())
            clock.time_ns += 1_000_000_000
            together(link, router, lambda count=count: len(router.hellos()) == count + 1, "a sign of life")  # type: ignore[misc]
            router.ack()
            together(link, router, lambda: link.connected, "the connection")
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


def remembered(request: BackfillRequest) -> list[Message]:
    return [
        frame(0, frame_index=frame_index, array=request.array, active=False)
        for frame_index in range(request.first, request.last + 1)
    ]


def test_requested_frames_are_sent_and_not_kept() -> None:
    with Router() as router:
        link = Link(router.endpoint, HELLO, SystemClock(), backfill=remembered)
        connect(link, router)
        assert not [
            m for m in router.got if isinstance(m, wire.Hello) and m.answers
        ]  # an older server would refuse the field
        router.send(wire.encode(wire.Request("run-1")))
        greets = [m for m in router.got if isinstance(m, wire.Hello)]
        together(link, router, lambda: hellos(router) > len(greets), "another greeting")
        last = [m for m in router.got if isinstance(m, wire.Hello)][-1]
        assert last.answers
        router.send(wire.encode(wire.Request("run-1", {"south": (700, 703)})))
        together(link, router, lambda: len(sounds(router)) == 3, "the answer")
        assert [(m.array, m.frame_index, m.sequence) for m in sounds(router)] == [
            ("south", k, 0) for k in (700, 701, 702)
        ]
        assert link.kept == link.pending == 0
        router.send(wire.encode(wire.Request("another run", {"south": (700, 703)})))
        router.ack()
        link.service()
        router.read()
        assert len(sounds(router)) == 3
        link.close(bye=False)


def hellos(router: Router) -> int:
    return sum(isinstance(message, wire.Hello) for message in router.got)


def sounds(router: Router) -> list[Frame]:
    return [message for message in router.got if isinstance(message, Frame)]


def test_another_server_is_not_assumed_to_know_requests() -> None:
    clock = HandClock()
    with Router() as router:
        link = Link(router.endpoint, HELLO, clock, backfill=remembered)
        connect(link, router)
        before = hellos(router)
        router.send(wire.encode(wire.Request("run-1")))
        together(link, router, lambda: hellos(router) > before, "another greeting")
        clock.time_ns += 2 * SILENT_NS
        before = hellos(router)
        together(link, router, lambda: hellos(router) > before, "a greeting after silence")
        last = [message for message in router.got if isinstance(message, wire.Hello)][-1]
        assert not last.answers
        link.close(bye=False)


def test_node_without_backfill_does_not_announce_answers() -> None:
    with Router() as router:
        link = Link(router.endpoint, HELLO, SystemClock())
        connect(link, router)
        router.send(wire.encode(wire.Request("run-1")))
        router.ack()
        together(link, router, lambda: link.connected, "an acknowledgement")
        link.close(bye=False)
    assert not any(message.answers for message in router.got if isinstance(message, wire.Hello))


def newest_mark(router: Router) -> Mark:
    return [message for message in router.got if isinstance(message, Mark)][-1]


def test_sections_of_marks_are_sent_only_to_a_server_that_reads_them() -> None:
    """Older servers refuse a mark with sections; one that replaces the first may be older."""
    level = ChannelLevel(-40.0, -50.0, 0, None, None, None, None)
    report = replace(mark(0), levels=(level,) * 4, host=HostState(True, "chrony"))
    clock = HandClock()
    with Router() as router:
        link = Link(router.endpoint, HELLO, clock, backfill=remembered)

        def sent() -> Mark:
            before = len(router.marks())
            link.send([report])
            together(link, router, lambda: len(router.marks()) > before, "a mark")
            return newest_mark(router)

        connect(link, router)
        assert sent() == mark(0)
        router.send(wire.encode(wire.Welcome("another run", (wire.SECTIONS,))))
        router.send(wire.encode(wire.Welcome("run-1", ("a later extension",))))
        router.send(wire.encode(wire.Request("run-1")))  # answered by a greeting: what came before it was read
        together(link, router, lambda: router.hellos()[-1].answers, "a greeting")
        assert sent() == mark(0)
        router.send(wire.encode(wire.Welcome("run-1", (wire.SECTIONS, "a later extension"))))
        wait_until(lambda: sent() == report, "a mark with its sections")
        clock.time_ns += 2 * SILENT_NS
        before = hellos(router)
        together(link, router, lambda: hellos(router) > before, "a greeting after silence")
        router.ack()
        together(link, router, lambda: link.connected, "an acknowledgement")
        assert sent() == mark(0)
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
