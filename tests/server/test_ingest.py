"""The server's side of the link, without sockets: who may join, what counts, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from livessl import wire
from livessl.core.types import BackfillRequest
from livessl.server.admission import MOST_LISTED, OTHER_VERSION
from livessl.server.ingest import ACK_NS, GONE_NS, NOTICE_NS, REFUSED_NS, Ingest, Received
from livessl.wire import Ack, Bye, Hello, Request, Welcome
from small_site import frame, mark, site_of

NOW = 1_767_225_600_000_000_000
WHO = Ack("?", {}, who_are_you=True)
HELLO = Hello("lab-pc", "run-1", {"north": 16000.0, "south": 16000.0})
WEST = {"arrays.west": {"microphones_m": [[1, 1, 1], [1, 1.2, 1]], "band_hz": [100, 3000]}}


def ingest() -> Ingest:
    return Ingest(site_of(WEST))


def tell(into: Ingest, message: wire.WireMessage, peer: bytes = b"p1", now_ns: int = NOW) -> Received:
    return into.receive(peer, wire.encode(message), now_ns)


def joined(**changes: Any) -> Ingest:
    into = ingest()
    assert tell(into, replace(HELLO, **changes)).joined is not None
    return into


def refusal(into: Ingest, hello: Hello, peer: bytes = b"p2", now_ns: int = NOW) -> str | None:
    received = tell(into, hello, peer, now_ns)
    assert received.reply is not None
    assert received.reply.run_id == hello.run_id
    assert (received.joined is None) or received.reply.refused is None
    return received.reply.refused


def test_greeting_is_answered_with_what_is_known() -> None:
    into = ingest()
    received = tell(into, HELLO)
    assert received == Received(
        joined=HELLO, reply=Ack("run-1", {}), offer=Request("run-1"), welcome=Welcome("run-1", ("mark-sections",))
    )
    tell(into, frame(1))
    again = tell(into, HELLO)
    assert again == Received(reply=Ack("run-1", {"north": 1000}))  # the same run: nobody new


def test_run_that_reconnects_goes_on() -> None:
    into = joined()
    tell(into, frame(4))
    assert tell(into, HELLO, b"p9").reply == Ack("run-1", {"north": 1003})
    assert tell(into, frame(5), b"p9").message is not None
    assert tell(into, frame(5), b"p9").message is None
    assert tell(into, frame(6), b"p1").reply == WHO  # the old connection is nobody now


def test_new_run_counts_from_the_beginning() -> None:
    into = joined()
    tell(into, frame(100))
    later = NOW + GONE_NS
    assert tell(into, replace(HELLO, run_id="run-2"), b"p2", later).joined is not None
    assert tell(into, frame(1), b"p2", later).message is not None
    assert into.duplicates["north"] == 0
    assert into.sequence_gaps["north"] == 0


@pytest.mark.parametrize("message", [frame(), mark(), Bye("lab-pc", "run-1")])
def test_unknown_peer_is_requested_to_greet(message: wire.WireMessage) -> None:
    assert tell(ingest(), message) == Received(reply=WHO)


def test_messages_pass_once_each() -> None:
    into = joined()
    passed = [tell(into, frame(k)).message for k in (1, 2, 2, 1, 3)]
    assert [None if message is None else message.sequence for message in passed] == [1, 2, None, None, 3]
    assert into.duplicates == {"north": 2, "south": 0, "west": 0}
    assert tell(into, frame(1, array="south")).message is not None  # each array counts for itself


def test_gaps_in_the_sequence_are_counted() -> None:
    into = joined()
    for sequence in (7, 8, 12, 13):
        received = tell(into, frame(sequence))
        assert received == Received(reply=WHO) if sequence == 12 else received.message is not None  # send them again
    assert into.sequence_gaps == {"north": 3, "south": 0, "west": 0}


def test_marks_reveal_lost_frames_and_are_no_loss_themselves() -> None:
    into = joined()
    for message in (mark(4, 1000), mark(4, 1005), frame(5, 1006), mark(5, 1007)):  # four marks were never sent
        assert tell(into, message).message is not None
    assert into.sequence_gaps["north"] == 0
    assert tell(into, mark(8, 1011)) == Received(reply=WHO)  # frames 6 to 8 never came
    assert into.sequence_gaps["north"] == 3
    assert tell(into, frame(9, 1012)).message is not None
    assert into.sequence_gaps["north"] == 3
    assert into.duplicates["north"] == 0


def test_good_bye_ends_a_run() -> None:
    into = joined()
    assert tell(into, Bye("lab-pc", "run-1")) == Received(left=HELLO)
    assert into.live_nodes(NOW) == []
    assert tell(into, frame(1)).reply == WHO
    assert refusal(into, replace(HELLO, run_id="run-2")) is None


def test_acknowledgements_four_times_a_second() -> None:
    into = joined()
    tell(into, frame(3))
    assert into.acknowledgements(NOW) == [(b"p1", Ack("run-1", {"north": 1002}))]
    assert into.acknowledgements(NOW + ACK_NS - 1) == []
    assert into.acknowledgements(NOW + ACK_NS) == [(b"p1", Ack("run-1", {"north": 1002}))]


def test_silent_node_loses_its_place_and_is_forgotten_at_last() -> None:
    into = joined()
    assert into.live_nodes(NOW + GONE_NS - 1) == [HELLO]
    assert into.live_nodes(NOW + GONE_NS) == []
    assert len(into.acknowledgements(NOW + 29 * GONE_NS)) == 1  # it may have missed a few
    assert into.acknowledgements(NOW + 30 * GONE_NS) == []
    assert tell(into, frame(1), now_ns=NOW + 31 * GONE_NS).reply == WHO


OTHER = Hello("other-pc", "run-9", {"west": 16000.0})


@pytest.mark.parametrize(
    ("hello", "reason"),
    [
        (OTHER, None),
        (
            replace(OTHER, arrays={"east": 16000.0}),
            "no array 'east' in the server's site file; it has north, south, west",
        ),
        (replace(OTHER, node="lab-pc"), "a node named 'lab-pc' is connected already; names must differ"),
        (replace(OTHER, arrays={"south": 16000.0}), "array 'south' is captured by node 'lab-pc' already"),
        (replace(OTHER, replay=True), "live nodes are connected; stop them first"),
        (
            replace(OTHER, arrays={"west": 6000.0}),
            "array 'west' uses up to 3000 Hz and needs more than 6000 Hz, got 6000 Hz",
        ),
        (replace(OTHER, arrays={"west": 6001.0}), None),
    ],
)
def test_greeting_that_contradicts_the_site_is_refused(hello: Hello, reason: str | None) -> None:
    into = joined()
    said = refusal(into, hello)
    if reason is None:
        assert said is None
        assert into.live_nodes(NOW) == [HELLO, hello]
    else:
        assert said is not None
        assert said.startswith(reason)
        assert into.live_nodes(NOW) == [HELLO]
        # nothing that a refused node sends gets in
        assert tell(into, mark(1, array="west"), b"p2").reply == WHO


def test_live_node_waits_for_a_replay_to_end() -> None:
    into = joined(replay=True)
    assert refusal(into, OTHER) == "a replay is running"
    tell(into, Bye("lab-pc", "run-1"))
    assert refusal(into, OTHER) is None


def test_refused_node_may_join_when_its_place_is_free() -> None:
    into = joined()
    taken = replace(OTHER, arrays={"north": 16000.0})
    assert refusal(into, taken) is not None
    assert refusal(into, taken, now_ns=NOW + GONE_NS) is None


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"rubbish",
        wire.encode(frame())[:-1],
        wire.encode(Ack("run-1", {"north": 1000})),
        wire.encode(frame(array="west")),
        wire.encode(replace(frame(), sample_rate_hz=8000.0)),
    ],
    ids=["nothing", "rubbish", "truncated", "acknowledgement", "array not announced", "rate not announced"],
)
def test_malformed_message_is_counted_and_changes_nothing(data: bytes) -> None:
    into = joined()
    assert into.receive(b"p1", data, NOW) == Received()
    assert into.malformed == 1
    assert tell(into, frame(1)).message is not None


def of_version(version: int, message: wire.WireMessage) -> bytes:
    data = wire.encode(message)
    return data[:4] + bytes([version]) + data[5:]


@pytest.mark.parametrize(("version", "which"), [(3, "a newer"), (1, "an older")])
def test_node_of_another_version_is_refused_in_words_that_it_can_read(version: int, which: str) -> None:
    into = ingest()
    received = into.receive(b"p1", of_version(version, HELLO), NOW)
    assert received.reply is not None
    assert received.reply.run_id == HELLO.run_id
    assert f"the node runs {which} livessl than the server (wire version {version}" in str(received.reply.refused)
    assert received.reply_version == max(version, wire.VERSION)  # version 1 had another header
    assert received.refused is not None
    assert (received.refused.node, received.refused.cause) == ("lab-pc", OTHER_VERSION)
    assert into.malformed == 0


def test_other_messages_of_another_version_are_malformed() -> None:
    into = joined()
    assert into.receive(b"p1", of_version(3, frame()), NOW) == Received()
    assert into.malformed == 1


@pytest.mark.parametrize("body", [b"", b"[1]", b'{"node": 7, "run_id": null, "arrays": [2]}', b"\xff"])
def test_greeting_of_another_version_that_cannot_be_read_is_refused_as_well(body: bytes) -> None:
    received = ingest().receive(b"p1", of_version(3, HELLO)[:14] + body, NOW)
    assert received.refused is not None
    assert (received.refused.node, received.refused.arrays) == ("?", ())


def test_silent_array_has_the_refusal_of_its_node_as_its_problem() -> None:
    into = ingest()
    into.receive(b"p1", of_version(3, HELLO), NOW)
    assert "its node 'lab-pc' is refused: the node runs a newer livessl" in str(into.problem_of("north"))
    assert into.problem_of("west") is None
    into.acknowledgements(NOW + REFUSED_NS)
    assert into.problem_of("north") is None  # the node greets no more
    into.receive(b"p1", of_version(3, HELLO), NOW)
    assert tell(into, HELLO).joined is not None
    assert into.problem_of("north") is None
    assert refusal(into, replace(HELLO, run_id="run-2"))
    assert into.problem_of("north") is None  # the connected node sends the array


def test_malformed_messages_are_logged_once_a_minute(caplog: pytest.LogCaptureFixture) -> None:
    into = ingest()
    for k in range(100):
        into.receive(b"p1", b"rubbish", NOW + k)
    assert into.malformed == 100
    assert len(caplog.records) == 1
    into.receive(b"p1", b"rubbish", NOW + NOTICE_NS)
    assert len(caplog.records) == 2
    assert "message refused (101 so far): " in caplog.text


def test_problem_of_a_device_is_reported_until_it_is_over() -> None:
    into = joined()
    assert into.problem_of("north") is None
    tell(into, replace(HELLO, problem="unplugged"))
    assert (into.problem_of("north"), into.problem_of("west")) == ("unplugged", None)
    tell(into, HELLO)
    assert into.problem_of("north") is None
    tell(into, replace(HELLO, problem="unplugged"))
    tell(into, Bye("lab-pc", "run-1"))
    assert into.problem_of("north") is None


def test_node_is_informed_once_of_what_the_server_reads_and_may_request() -> None:
    into = ingest()
    both = (Request("run-1"), Welcome("run-1", ("mark-sections",)))

    def news(hello: Hello, peer: bytes = b"p1") -> tuple[Request | None, Welcome | None]:
        received = tell(into, hello, peer)
        return received.offer, received.welcome

    assert news(HELLO) == both
    assert news(HELLO) == (None, None)  # an older one that says nothing of it
    knows = tell(into, replace(HELLO, answers=True))
    assert (knows.offer, knows.welcome, knows.greeted) == (None, None, replace(HELLO, answers=True))
    assert news(HELLO) == both  # it has begun anew on the same connection
    assert news(HELLO, b"p9") == both


def test_requests_go_to_nodes_that_know_them() -> None:
    into = ingest()
    asks = [BackfillRequest("north", 100, 110), BackfillRequest("south", 100, 104)]
    tell(into, HELLO)
    assert into.requests(asks) == []
    tell(into, replace(HELLO, answers=True))
    assert into.requests(asks[:1]) == [(b"p1", Request("run-1", {"north": (100, 111)}))]
    tell(into, Bye("lab-pc", "run-1"))
    assert into.requests(asks) == []


def test_requested_frame_is_handed_on_and_not_counted() -> None:
    into = joined()
    tell(into, frame(1))
    asked = frame(0, frame_index=700, active=False)
    assert tell(into, asked).message is not None
    assert tell(into, asked).message is not None
    assert (into.duplicates["north"], into.sequence_gaps["north"]) == (0, 0)
    assert tell(into, frame(2)).message is not None
    assert into.acknowledgements(NOW + ACK_NS)[0][1].received == {"north": 1001}


def test_request_from_a_node_is_refused() -> None:
    into = joined()
    tell(into, Request("run-1"))
    assert into.malformed == 1


def test_final_frame_index_is_acknowledged_by_each_nodes_own_clock() -> None:
    into = joined()
    final = {"north": 103, "south": 100}
    into.note_final(final)
    (_, ack), *_ = into.acknowledgements(NOW + ACK_NS)
    assert ack.settled == min(final[array] for array in HELLO.arrays)
    into.note_final({})
    (_, ack), *_ = into.acknowledgements(NOW + 2 * ACK_NS)
    assert ack.settled is None


def test_refusal_in_a_large_hall_lists_some_arrays_and_fits_its_message() -> None:
    further = {
        f"arrays.{'long' * 10}-{k:02d}": {"microphones_m": [[1, 0.06 * k, 1], [1, 0.03 + 0.06 * k, 1]]}
        for k in range(60)
    }
    into = Ingest(site_of(further))
    told = refusal(into, replace(HELLO, arrays={"unknown": 16000.0}))
    assert told is not None
    assert told.endswith(f"and {62 - MOST_LISTED} more")
    assert wire.decode(wire.encode(Ack("run-1", {}, refused=told))) == Ack("run-1", {}, refused=told)
