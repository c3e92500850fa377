"""The guard of the nodes' socket: enrolled nodes are received, and no other peer is, whatever it tries."""

from __future__ import annotations

import logging
import random
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from threading import Thread

import httpx
import pytest
import zmq
from zmq.utils import z85

from livessl import wire
from livessl.capture.link import Link
from livessl.capture.node import capture_recordings, send_session
from livessl.clock import SystemClock, UnpacedClock
from livessl.core.types import FRAME_NS, Frame
from livessl.errors import ConfigError
from livessl.server.receiver import Joined, Receiver
from livessl.site import keys
from livessl.site.keys import KeyPair, NodeKeys
from livessl.site.models import Site
from small_site import HANG_S, Changes, frame, running_server, scene, scene_recordings, site_of, wait_until

CLOCK = SystemClock()
HELLO = wire.Hello("lab-pc", "run-1", {"north": 16000.0})
NODES = ("lab-pc", "other", "replay")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a site's folder, its keys made and its nodes enrolled; `stranger` has keys, but is not enrolled."""
    directory = tmp_path_factory.mktemp("site")
    keys.make_server_keys(directory / "keys")
    for name in NODES:
        keys.enrol(directory / "keys", name, keys.make_node_keys(directory / "keys", name))
    keys.make_node_keys(directory / "keys", "stranger")
    return directory


def keyed(folder: Path, changes: Changes | None = None) -> Site:
    return site_of({"keys": "keys", **(changes or {})}, folder)


def keys_of(folder: Path, name: str) -> NodeKeys:
    held = keys.node_keys(keyed(folder), name)
    assert held is not None
    return held


@contextmanager
def receiving(folder: Path) -> Iterator[Receiver]:
    receiver = Receiver(keyed(folder), CLOCK)
    receiver.start()
    try:
        yield receiver
    finally:
        receiver.stop()


@contextmanager
def linked(endpoint: str, held: NodeKeys | None, hello: wire.Hello = HELLO) -> Iterator[Link]:
    link = Link(endpoint, hello, CLOCK, held)
    try:
        yield link
    finally:
        link.close(bye=False)


def until(link: Link, condition: Callable[[], object], what: str) -> None:
    """Serve the link until a condition holds."""

    def holds() -> object:
        link.service()
        return condition()

    wait_until(holds, what)


def taken(receiver: Receiver) -> list[object]:
    return list(receiver.take(100, 0.001))


def assert_received(receiver: Receiver, held: NodeKeys, sequence: int) -> None:
    """A good node greets, and its frame arrives."""
    with linked(receiver.endpoint, held, replace(HELLO, run_id=f"good-{sequence}")) as link:
        until(link, lambda: link.connected or link.refused, "an answer")
        assert link.refused is None
        link.send([frame(sequence)])
        got: list[int] = []

        def arrived() -> bool:
            got.extend(item.sequence for item in taken(receiver) if isinstance(item, Frame))
            return got == [sequence]

        until(link, arrived, "the good node's frame")
        link.close(bye=True)
    wait_until(lambda: not receiver.ingest.live_nodes(CLOCK.monotonic_ns()), "its good-bye")
    taken(receiver)


def test_enrolled_node_is_received(folder: Path) -> None:
    with receiving(folder) as receiver:
        assert_received(receiver, keys_of(folder, "lab-pc"), 1)
        assert receiver.refusals.count("nodes") == 0
        assert receiver.enrolled == sorted(NODES)


def test_messages_cannot_be_read_on_the_way(folder: Path) -> None:
    with receiving(folder) as receiver, Tap(receiver.endpoint) as tap:
        with linked(tap.endpoint, keys_of(folder, "lab-pc")) as link:
            until(link, lambda: link.connected, "the connection")
            link.send([frame(1)])
            until(link, lambda: link.pending == 0, "its acknowledgement")
        said = b"".join(tap.said())
        assert len(said) > 1000
        for plain in (b"lab-pc", b"run-1", b"north", wire.encode(frame(1))[100:200]):
            assert plain not in said


NOT_ENROLLED = "its key is not enrolled"
WITHOUT_KEYS = "without keys, or with another server's"
BROKE_OFF = "broke off the handshake"


def pretenders(folder: Path) -> dict[str, tuple[NodeKeys | None, set[str]]]:
    """Return the keys of every kind of peer that is not enrolled, and the reasons one of which is counted."""
    good = keys_of(folder, "lab-pc")
    other = KeyPair(*(z85.decode(half) for half in zmq.curve_keypair()))
    return {
        "not enrolled": (keys_of(folder, "stranger"), {NOT_ENROLLED}),
        "a new pair": (replace(good, own=other), {NOT_ENROLLED}),
        "no keys": (None, {WITHOUT_KEYS, BROKE_OFF}),  # whoever reads the other's greeting first hangs up
        "wrong server": (replace(good, server=other.public), {WITHOUT_KEYS}),
        "half a pair": (replace(good, own=KeyPair(good.own.public, other.secret)), {WITHOUT_KEYS}),
    }


@pytest.mark.parametrize("who", ["not enrolled", "a new pair", "no keys", "wrong server", "half a pair"])
def test_pretender_is_not_received(folder: Path, who: str, caplog: pytest.LogCaptureFixture) -> None:
    held, reasons = pretenders(folder)[who]
    with receiving(folder) as receiver, caplog.at_level(logging.WARNING):
        with linked(receiver.endpoint, held) as link:
            link.send([frame(k) for k in range(1, 20)])
            until(link, receiver.refusals.counts, "the refusal")
            assert not link.connected
        [(door, reason)] = receiver.refusals.counts()
        assert door == "nodes"
        assert reason in reasons
        assert taken(receiver) == []
        assert receiver.ingest.live_nodes(CLOCK.monotonic_ns()) == []
        assert_received(receiver, keys_of(folder, "lab-pc"), 1)
    assert len([r for r in caplog.records if f"was refused: {reason}" in r.getMessage()]) == 1


@pytest.mark.parametrize(("stays", "reason"), [(True, WITHOUT_KEYS), (False, BROKE_OFF)])
def test_peer_without_keys_is_told_from_one_that_breaks_off(folder: Path, *, stays: bool, reason: str) -> None:
    """The peer sends the ZMTP 3.1 greeting of a node without keys, mechanism NULL: all of it, or its beginning."""
    greeting = b"\xff" + bytes(8) + b"\x7f\x03\x01" + b"NULL".ljust(20, b"\0") + bytes(32)
    with receiving(folder) as receiver:
        say(receiver, greeting if stays else greeting[:11], wait_s=10.0 if stays else 0.2)
        wait_until(receiver.refusals.counts, "the refusal")
        assert receiver.refusals.counts() == {("nodes", reason): 1}


@pytest.mark.parametrize(
    ("hello", "reason"),
    [
        (replace(HELLO, node="other"), "node 'other' has shown the key of 'lab-pc'; give each node its own"),
        (HELLO, None),
    ],
)
def test_key_is_valid_for_its_own_node_only(folder: Path, hello: wire.Hello, reason: str | None) -> None:
    with receiving(folder) as receiver, linked(receiver.endpoint, keys_of(folder, "lab-pc"), hello) as link:
        until(link, lambda: link.connected or link.refused, "an answer")
        assert link.refused == reason
        assert [isinstance(item, Joined) for item in taken(receiver)] == ([True] if reason is None else [])


def test_node_may_send_its_own_arrays_only(folder: Path) -> None:
    hello = replace(HELLO, node="other")
    with receiving(folder) as receiver, linked(receiver.endpoint, keys_of(folder, "other"), hello) as link:
        until(link, lambda: link.connected or link.refused, "an answer")
        assert link.refused == "array 'north' belongs to node 'lab-pc' in the server's site file"


class Tap:
    """A wire between a node and the server that records what the node sends."""

    def __init__(self, endpoint: str) -> None:
        self._port = int(endpoint.rpartition(":")[2])
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.endpoint = f"tcp://127.0.0.1:{self._listener.getsockname()[1]}"
        self._said: list[bytearray] = []
        self._sockets: list[socket.socket] = [self._listener]
        self._threads = [Thread(target=self._accept)]
        self._threads[0].start()

    def __enter__(self) -> Tap:
        return self

    def __exit__(self, *_: object) -> None:
        self._listener.shutdown(socket.SHUT_RDWR)  # ends the thread that waits for the next connection
        for each in self._sockets:
            each.close()
        for thread in self._threads:
            thread.join(timeout=HANG_S)

    def said(self) -> list[bytes]:
        """Return the stream of bytes of each connection."""
        return [bytes(part) for part in self._said]

    def _accept(self) -> None:
        while True:
            try:
                node, _ = self._listener.accept()
            except OSError:
                return
            server = socket.create_connection(("127.0.0.1", self._port))
            heard = bytearray()
            self._said.append(heard)
            self._sockets += [node, server]
            for source, sink, log in ((node, server, heard), (server, node, None)):
                thread = Thread(target=_pump, args=(source, sink, log), daemon=True)
                self._threads.append(thread)
                thread.start()


def _pump(source: socket.socket, sink: socket.socket, log: bytearray | None) -> None:
    try:
        while data := source.recv(65536):
            if log is not None:
                log += data
            sink.sendall(data)
        sink.shutdown(socket.SHUT_WR)
    except OSError:  # one end has gone
        pass


@pytest.fixture(scope="module")
def overheard(folder: Path) -> bytes:
    """Return all that a good node sent, from the greeting to its frames."""
    with receiving(folder) as receiver, Tap(receiver.endpoint) as tap:
        with linked(tap.endpoint, keys_of(folder, "lab-pc")) as link:
            until(link, lambda: link.connected, "the connection")
            link.send([frame(k) for k in range(1, 6)])
            until(link, lambda: link.pending == 0, "its acknowledgements")
        [said] = tap.said()
    return said


def say(receiver: Receiver, data: bytes, *, wait_s: float) -> None:
    """Send bytes to the server's port, and hang up once the server does, or after a while."""
    with socket.create_connection(("127.0.0.1", int(receiver.endpoint.rpartition(":")[2]))) as connection:
        connection.settimeout(wait_s)
        try:
            connection.sendall(data)
            while connection.recv(65536):
                pass
        except (TimeoutError, ConnectionError):
            pass


def test_replayed_connection_is_not_received(folder: Path, overheard: bytes) -> None:
    """Every byte of a good connection is sent again; the server has dropped its half of the session keys since."""
    assert len(overheard) > 5 * 4 * 800 * 2  # with the sound
    with receiving(folder) as receiver:
        for _ in range(3):
            say(receiver, overheard, wait_s=0.5)
        wait_until(lambda: receiver.refusals.count("nodes") >= 3, "the refusals")
        assert taken(receiver) == []
        assert receiver.ingest.malformed == 0
        assert_received(receiver, keys_of(folder, "lab-pc"), 1)


def test_truncated_and_spoilt_handshakes_are_not_received(folder: Path, overheard: bytes) -> None:
    rng = random.Random(5)
    greeting, hello = 64, 64 + 202  # ZMTP 3.1: the greeting's bytes, and the CURVE HELLO command's with its head
    cuts = [0, 1, 10, greeting - 1, greeting, greeting + 1, hello - 1, hello, hello + 1, hello + 100]
    with receiving(folder) as receiver:
        for cut in cuts:
            say(receiver, overheard[:cut], wait_s=0.05)
        for _ in range(40):
            spoilt = bytearray(overheard[: hello + 300])
            for _ in range(rng.randrange(1, 6)):
                spoilt[rng.randrange(len(spoilt))] ^= 1 << rng.randrange(8)
            say(receiver, bytes(spoilt), wait_s=0.05)
        for size in (1, 64, 1000, 100_000):
            say(receiver, rng.randbytes(size), wait_s=0.05)
        wait_until(lambda: receiver.refusals.count("nodes") >= 1, "a refusal")
        assert taken(receiver) == []
        assert receiver.failure is None
        assert_received(receiver, keys_of(folder, "lab-pc"), 1)


def test_silent_connections_keep_no_node_out(folder: Path) -> None:
    with receiving(folder) as receiver:
        port = int(receiver.endpoint.rpartition(":")[2])
        silent = [socket.create_connection(("127.0.0.1", port)) for _ in range(50)]
        try:
            assert_received(receiver, keys_of(folder, "lab-pc"), 1)
        finally:
            for each in silent:
                each.close()


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_guard_that_fails_lets_no_node_in_and_ends_the_server(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise RuntimeError("out of order")

    with receiving(folder) as receiver:
        monkeypatch.setattr(receiver.refusals, "note", fail)
        with linked(receiver.endpoint, keys_of(folder, "stranger")) as link:
            until(link, lambda: receiver.failure is not None, "the failure")
        assert str(receiver.failure) == "out of order"
        with linked(receiver.endpoint, keys_of(folder, "lab-pc")) as link:
            began_ns = CLOCK.monotonic_ns()
            until(link, lambda: CLOCK.monotonic_ns() - began_ns > 500_000_000, "a while")
            assert not link.connected
        assert taken(receiver) == []


def test_server_whose_keys_are_missing_does_not_start(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="make it with `livessl keys server`"):
        Receiver(keyed(tmp_path), CLOCK)


def test_scene_is_located_with_keys_live_and_replayed(folder: Path) -> None:
    """The whole path, and what the API reports of it."""
    with running_server(keyed(folder)) as server:
        site = keyed(folder, {"nodes.lab-pc.server": server.endpoint})
        start_ns = CLOCK.now_ns() // FRAME_NS * FRAME_NS - round(scene().duration_s * 1e9)
        capture_recordings(site, "lab-pc", scene_recordings(start_ns), CLOCK, "run-1", lambda: False)
        wait_until(lambda: server.parts.event_log.published == 2, "both events, live")
        send_session(site, server.endpoint, scene_recordings(0), UnpacedClock(), CLOCK, "run-2", lambda: False)
        wait_until(lambda: server.parts.event_log.published == 4, "both events, replayed")
        with linked(server.endpoint, keys_of(folder, "stranger")) as link:
            until(link, lambda: server.parts.refusals.count("nodes"), "the refusal")
        health = httpx.get(f"{server.url}/api/v1/health").json()
        assert health["secured"]["nodes"] is True
        assert health["refused"]["nodes"] >= 1
        assert 'livessl_refused_total{door="nodes",reason="its key is not enrolled"}' in (
            httpx.get(f"{server.url}/metrics").text
        )
        access = httpx.get(f"{server.url}/api/v1/access").json()
        assert access["nodes"] == sorted(NODES)
        assert (access["refused"][0]["door"], access["refused"][0]["who"]) == ("nodes", "127.0.0.1")
