"""Requests for missing frames, and sections of marks: only servers that know them get them."""

from __future__ import annotations

from dataclasses import replace

from link_router import HELLO, HandClock, Router, connect, hellos, sounds, together
from livessl import wire
from livessl.capture.link import SILENT_NS, Link
from livessl.clock import SystemClock
from livessl.core.types import BackfillRequest, ChannelLevel, HostState, Mark, Message
from small_site import frame, mark, wait_until


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


def test_frames_of_arrays_that_a_server_does_not_get_are_not_sent_on_request() -> None:
    asked: list[str] = []

    def backfill(request: BackfillRequest) -> list[Message]:
        asked.append(request.array)
        return remembered(request)

    with Router() as router:
        link = Link(router.endpoint, replace(HELLO, arrays={"south": 16000.0}), SystemClock(), backfill=backfill)
        connect(link, router)
        router.send(wire.encode(wire.Request("run-1", {"north": (40, 42), "west": (1, 9), "south": (70, 72)})))
        together(link, router, lambda: len(sounds(router)) == 2, "the answer")
        assert {m.array for m in sounds(router)} == {"south"}
        link.close(bye=False)
    assert asked == ["south"]


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
