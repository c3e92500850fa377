"""The WebSocket of messages: greeting, resumption, filters, refusals, and limits of clients."""

from __future__ import annotations

import json
import re
from collections import deque
from collections.abc import Iterator
from typing import Any

import httpx
import pytest
from websockets.exceptions import ConnectionClosed

from livessl.clock import utc_ns
from livessl.server import http
from livessl.server.app import Server
from scene_server import CLOCK, capture_scene, live, located_scene
from small_site import HANG_S, running_server, site_of, wait_until


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    with located_scene() as server:
        yield server


@pytest.fixture
def client(server: Server) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=server.url) as client:
        yield client


def test_first_message_is_hello(server: Server) -> None:
    with live(server) as socket:
        hello = json.loads(socket.recv(timeout=HANG_S))
        assert (hello["v"], hello["kind"], hello["site"], hello["mode"]) == (1, "hello", "small", "live")
        assert [array["name"] for array in hello["arrays"]] == ["north", "south"]
        socket.send("messages of clients are ignored")
        following = [json.loads(socket.recv(timeout=HANG_S)) for _ in range(2)]
        assert {message["kind"] for message in following} <= {"arrays", "track", "zone"}
        assert [message["seq"] for message in following] == [hello["last_seq"] + 1, hello["last_seq"] + 2]


def test_client_that_returns_gets_what_it_missed(server: Server) -> None:
    with live(server) as socket:
        hello, first, second = (json.loads(socket.recv(timeout=HANG_S)) for _ in range(3))
    with live(server, f"?since_seq={first['seq']}") as socket:
        greeting, following = (json.loads(socket.recv(timeout=HANG_S)) for _ in range(2))
    assert greeting["kind"] == "hello"
    assert following == second
    assert hello["last_seq"] > 1_600_000_000_000  # above every number before the restart
    with live(server, "?since_seq=5") as socket:
        _, gap = (json.loads(socket.recv(timeout=HANG_S)) for _ in range(2))
    assert (gap["kind"], gap["missed"]) == ("gap", None)


@pytest.mark.parametrize(
    ("query", "reason"),
    [
        (
            "?kinds=events",
            "kinds: expected some of alert, arrays, event, poses, track, update, zone, zones, got 'events'",
        ),
        ("?since_seq=-1", "since_seq: expected the seq of a message, got '-1'"),
        ("?since_seq=x", "since_seq: expected the seq of a message, got 'x'"),
        ("?zone=hall", "zone: no zone 'hall'; zones are door, room"),
        ("?track=one", "track: expected the number of a track, got 'one'"),
        ("?max_rate_hz=-1", "max_rate_hz: expected a number above 0, at most 1000, got '-1'"),
        ("?kind=event", "unknown parameter 'kind'; did you mean 'kinds'?"),
        ("?min_confidence=2", "min_confidence: expected a number from 0 to 1, got '2'"),
    ],
)
def test_wrong_filter_closes_the_socket_with_a_reason(server: Server, query: str, reason: str) -> None:
    with live(server, query) as socket, pytest.raises(ConnectionClosed) as caught:
        socket.recv(timeout=HANG_S)
    assert caught.value.rcvd is not None
    assert (caught.value.rcvd.code, caught.value.rcvd.reason) == (1008, reason)


@pytest.mark.parametrize("origin", ["http://evil.example", "http://evil.example:80", "null", "http://["])
def test_page_of_another_server_may_not_connect(server: Server, origin: str) -> None:
    with live(server, origin=origin) as socket, pytest.raises(ConnectionClosed) as caught:
        socket.recv(timeout=HANG_S)
    assert caught.value.rcvd is not None
    assert caught.value.rcvd.code == 1008
    assert caught.value.rcvd.reason.startswith("origin: ")


def test_page_of_the_server_itself_may_connect(server: Server) -> None:
    with live(server, origin=server.url) as socket:
        assert json.loads(socket.recv(timeout=HANG_S))["kind"] == "hello"


def test_subscriber_that_sends_too_much_is_disconnected(server: Server) -> None:
    with live(server) as talkative:
        talkative.send("x" * 4096)
        assert json.loads(talkative.recv(timeout=HANG_S))["kind"] == "hello"
        talkative.send("x" * 4097)
        with pytest.raises(ConnectionClosed) as caught:
            deque(talkative, maxlen=0)
    assert caught.value.rcvd is not None
    assert caught.value.rcvd.code == 1009  # message too big


def test_connections_are_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(http, "MAX_CONNECTIONS", 2)
    with running_server(site_of()) as server, httpx.Client(base_url=f"{server.url}/api/v1") as holder, live(server):
        assert holder.get("health").status_code == 200  # over one of the two
        with pytest.raises(httpx.TransportError):
            httpx.get(f"{server.url}/api/v1/health")


def test_stages_of_the_latency_add_up() -> None:
    """With one clock every stage is positive, and their sum is at most the delay that the client sees."""
    with running_server(site_of()) as server, live(server, "?kinds=event,update") as socket:
        capture_scene(server)
        messages: list[dict[str, Any]] = []
        while sum(message["kind"] == "event" for message in messages) < 2:  # a busy machine leaves out some updates
            messages.append(json.loads(socket.recv(timeout=HANG_S)))
        now_ns = CLOCK.now_ns()
        metrics = httpx.get(f"{server.url}/metrics").text
    answers = [message for message in messages if message["kind"] in ("event", "update")]
    assert {message["kind"] for message in answers} == {"event", "update"}
    for message in answers:
        stages = message["latency_stages_s"]
        assert set(stages) == {"waited", "sent", "received", "located"}
        assert min(stages.values()) >= 0
        assert sum(stages.values()) == pytest.approx(message["latency_s"], abs=3e-4)  # each is rounded to 0.1 ms
        if message["kind"] == "update":
            assert stages["waited"] == 0
            assert message["latency_s"] <= (now_ns - utc_ns(message["end_utc"])) / 1e9
        else:
            assert stages["waited"] == pytest.approx(0.3)
    [delivered] = re.findall(r'^livessl_latency_seconds_count{kind="update",stage="delivered"} (\S+)$', metrics, re.M)
    assert float(delivered) >= sum(message["kind"] == "update" for message in answers)


def test_only_the_chosen_kinds_are_sent(server: Server) -> None:
    with live(server, "?kinds=event") as events, live(server, "?kinds=arrays") as states:
        assert json.loads(events.recv(timeout=HANG_S))["kind"] == "hello"
        assert json.loads(states.recv(timeout=HANG_S))["kind"] == "hello"
        assert json.loads(states.recv(timeout=HANG_S))["kind"] == "arrays"
        with pytest.raises(TimeoutError):
            events.recv(timeout=0.1)


def test_clients_are_counted_and_forgotten(server: Server, client: httpx.Client) -> None:
    def clients() -> float:
        [line] = re.findall(r"^livessl_websocket_clients (\S+)$", client.get("/metrics").text, re.MULTILINE)
        return float(line)

    wait_until(lambda: clients() == 0, "no client")
    with live(server), live(server):
        wait_until(lambda: clients() == 2, "two clients")
    wait_until(lambda: clients() == 0, "no client")
