"""A node with several servers: each gets everything once, whatever the others do, from bytes that they share."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from link_router import HELLO, Router, free_endpoint
from livessl import wire
from livessl.capture.link import Link
from livessl.capture.links import EncodeOnce, Links, UndeliveredError
from livessl.capture.node import capture_recordings
from livessl.capture.spool import Spool
from livessl.clock import SystemClock
from livessl.core.types import FRAME_NS, Float32Array, Frame
from livessl.errors import ConfigError
from livessl.recordings.assign import AssignedRecording
from livessl.recordings.recording import MemoryRecording
from livessl.server.receiver import Item, Joined, Left, Receiver
from livessl.site.models import Site
from small_site import RATE_HZ, Changes, frame, hiss, mark, site_of, wait_until

CLOCK = SystemClock()
ONE_ARRAY = wire.Hello("lab-pc", "run-1", {"south": 16000.0})


@contextmanager
def linked(*ends: tuple[str, wire.Hello]) -> Iterator[tuple[Links, list[Link]]]:
    """Links to some servers, and each of them."""
    encode = EncodeOnce()
    each = [Link(endpoint, hello, CLOCK, spool=Spool(encode=encode)) for endpoint, hello in ends]
    links = Links(each)
    try:
        yield links, each
    finally:
        links.close(bye=False)


def served(links: Links, routers: list[Router], condition: Callable[[], object], what: str) -> None:
    """Serve links and routers, each of which acknowledges the frames that it has, until the condition holds."""

    def turn() -> object:
        links.service()
        for router in routers:
            if router.read():
                router.ack(**{array: max(numbers) for array in HELLO.arrays if (numbers := router.frames(array))})
        return condition()

    wait_until(turn, what)


def test_each_server_gets_the_frames_and_marks_of_its_arrays() -> None:
    with (
        Router() as first,
        Router() as second,
        linked((first.endpoint, HELLO), (second.endpoint, ONE_ARRAY)) as (links, each),
    ):
        served(links, [first, second], lambda: all(link.connected for link in each), "both connections")
        links.send([frame(number, array=array) for number in range(1, 9) for array in ("north", "south")])
        links.send([mark(9, 1008, "north"), mark(9, 1008, "south")])
        served(links, [first, second], lambda: first.marks("south") and second.marks("south"), "the last marks")
        served(links, [first, second], lambda: all(link.pending == 0 for link in each), "the acknowledgements")
        numbers = list(range(1, 9))
        assert (first.frames("north"), first.frames("south"), second.frames("south")) == (numbers, numbers, numbers)
        assert (second.frames("north"), second.marks("north")) == ([], [])
        assert [set(router.hellos()[-1].arrays) for router in (first, second)] == [{"north", "south"}, {"south"}]


def test_a_server_that_is_away_delays_and_loses_nothing_and_gets_it_later() -> None:
    endpoint = free_endpoint()
    with Router() as first, linked((first.endpoint, HELLO), (endpoint, HELLO)) as (links, each):
        served(links, [first], lambda: each[0].connected, "the connection")
        for number in range(1, 41):
            links.send([frame(number)])
        served(links, [first], lambda: len(first.frames()) == 40, "all frames at the first server")
        first.ack(settled=41, north=40)
        served(links, [first], lambda: each[0].kept == 0, "the settlement")
        assert (each[1].pending, each[1].kept, each[1].dropped) == (40, 40, 0)
        with Router(endpoint) as second:
            served(links, [first, second], lambda: len(second.frames()) == 40, "the backlog")
            served(links, [first, second], lambda: each[1].pending == 0, "its acknowledgement")
            assert sorted(second.frames()) == sorted(first.frames()) == list(range(1, 41))


def test_spools_in_memory_share_the_bytes_of_each_frame() -> None:
    encode = EncodeOnce()
    spools = [Spool(encode=encode), Spool(encode=encode)]
    for number in range(1, 4):
        given = frame(number, seed=number)
        for spool in spools:
            spool.append(given)
    one, other = ([kept.data for kept in spool.frames()] for spool in spools)
    assert all(a is b for a, b in zip(one, other, strict=True))
    assert [wire.decode(data).sequence for data in one if data is not None] == [1, 2, 3]  # type: ignore[union-attr]


class Server:
    """A receiver, and what it has received."""

    def __init__(self, endpoint: str = "tcp://127.0.0.1:*", arrays: Changes | None = None) -> None:
        self.receiver = Receiver(site_of({"server.bind": endpoint, **(arrays or {})}), CLOCK)
        self.receiver.start()
        self.items: list[Item] = []

    def wait_for_the_good_bye(self) -> None:
        def has_left() -> bool:
            self.items += self.receiver.take(1000, 0.001)
            return any(isinstance(item, Left) for item in self.items)

        wait_until(has_left, "the good-bye")

    def frames(self, array: str) -> list[int]:
        """Frame indices, in their order."""
        return sorted(item.frame_index for item in self.items if isinstance(item, Frame) and item.array == array)


ONLY_SOUTH = {
    "arrays.north": ...,
    "nodes.lab-pc.arrays": {"south": [1, 2, 3, 4]},
}


@contextmanager
def server(endpoint: str = "tcp://127.0.0.1:*", arrays: Changes | None = None) -> Iterator[Server]:
    made = Server(endpoint, arrays)
    try:
        yield made
    finally:
        made.receiver.stop()


def node_site(first: str, second: str, folder: Path, **further: object) -> Site:
    changes = {
        "nodes.lab-pc.server": first,
        "nodes.lab-pc.further_servers": [{"server": second, **further}],
        "nodes.lab-pc.spool.directory": "spool",
    }
    return site_of(changes, folder)


def sound() -> Float32Array:
    """1.5 s of quiet noise with a burst after the first second."""
    samples = hiss(1.5, level=1e-3)
    samples[:, RATE_HZ : RATE_HZ + RATE_HZ // 5] += hiss(0.2, seed=1, level=0.2)
    return samples


def capture(site: Site, run: str) -> int:
    """Run a node on the sound, which began a while ago; return its first frame index."""
    first = CLOCK.now_ns() // FRAME_NS - 30
    burst = MemoryRecording("burst", float(RATE_HZ), sound())
    played = [AssignedRecording(array, burst, first * FRAME_NS, (1, 2, 3, 4)) for array in ("north", "south")]
    capture_recordings(site, "lab-pc", played, CLOCK, run, lambda: False)
    return first


def test_a_node_sends_its_recordings_to_both_servers(tmp_path: Path) -> None:
    with server() as one, server(arrays=ONLY_SOUTH) as other:
        site = node_site(one.receiver.endpoint, other.receiver.endpoint, tmp_path, arrays=["south"])
        first = capture(site, "run-1")
        for each in (one, other):
            each.wait_for_the_good_bye()
        wanted = list(range(first + 12, first + 30))
        assert [one.frames(array) for array in ("north", "south")] == [wanted, wanted]
        assert (other.frames("north"), other.frames("south")) == ([], wanted)
        assert next(set(item.hello.arrays) for item in other.items if isinstance(item, Joined)) == {"south"}


def test_what_a_server_missed_waits_in_its_own_folder_for_the_next_run_of_the_node(tmp_path: Path) -> None:
    with server() as one:
        endpoint = free_endpoint()
        site = node_site(one.receiver.endpoint, endpoint, tmp_path)
        with pytest.raises(UndeliveredError) as caught:
            capture(site, "run-1")
        assert str(caught.value).endswith(f"were never acknowledged by the server at {endpoint}; is one running there?")
        one.wait_for_the_good_bye()
        assert len(one.frames("north")) == 18
        with server(endpoint) as other:
            capture(site, "run-2")
            other.wait_for_the_good_bye()
            assert len(other.frames("north")) == len(set(other.frames("north"))) == 36
            assert other.frames("north")[:18] == one.frames("north")
    assert sorted(path.name for path in (tmp_path / "spool").iterdir()) == [
        "lab-pc",
        f"lab-pc@{endpoint.removeprefix('tcp://').replace(':', '_')}",
    ]


@pytest.mark.skipif(sys.platform != "linux", reason="127.0.0.2 is an address of this machine on Linux only")
@pytest.mark.parametrize("further", [{}, {"arrays": ["north"]}])
def test_of_two_addresses_of_one_server_one_delivers_and_the_other_is_refused_in_words(
    tmp_path: Path, further: dict[str, object]
) -> None:
    with server("tcp://0.0.0.0:*") as one:
        port = one.receiver.endpoint.rpartition(":")[2]
        site = node_site(f"tcp://127.0.0.1:{port}", f"tcp://127.0.0.2:{port}", tmp_path, **further)
        with pytest.raises(UndeliveredError, match="a node named 'lab-pc' is connected already; names must differ"):
            capture(site, "run-1")
        one.wait_for_the_good_bye()
        frames = one.frames("north")
        assert len(frames) == len(set(frames)) == 18


def test_frames_for_a_server_that_is_no_longer_named_are_reported(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "spool" / "lab-pc@gone.example_5570").mkdir(parents=True)
    with server() as one, server() as other:
        capture(node_site(one.receiver.endpoint, other.receiver.endpoint, tmp_path), "run-1")
    said = [record.getMessage() for record in caplog.records if "further_servers" in record.getMessage()]
    assert len(said) == 1
    assert "lab-pc@gone.example_5570; delete the folder" in said[0]


@pytest.mark.parametrize(
    ("further", "wanted"),
    [
        ({"server": "tcp://127.0.0.1:5570"}, r"further_servers\[?.?0.*server.*expected each server once"),
        ({"server": "tcp://localhost:5570"}, r"got 'tcp://localhost:5570' which is 'tcp://127.0.0.1:5570' again"),
        ({"server": "tcp://LocalHost:5570"}, r"expected each server once"),
        ({"server": "tcp://[::1]:5570"}, r"expected each server once"),
        ({"server": "tcp://[::ffff:127.0.0.1]:5570"}, r"expected each server once"),
        ({"server": "tcp://127.0.0.1:5571", "arrays": ["noth"]}, r"expected arrays of this node, north, south, got"),
        ({"server": "tcp://127.0.0.1:5571", "public_key": "b.public"}, r"expected keys as well"),
        ({"server": "127.0.0.1"}, r"tcp://"),
        ({"sever": "tcp://127.0.0.1:5571"}, r"did you mean 'server'"),
    ],
)
def test_wrong_further_servers_are_named(further: dict[str, object], wanted: str) -> None:
    with pytest.raises(ConfigError, match=wanted):
        site_of({"nodes.lab-pc.further_servers": [further]})
