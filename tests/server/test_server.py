"""The whole server: sound in at one socket, answers out at the other."""

from __future__ import annotations

import json
import math
import socket
from contextlib import ExitStack
from dataclasses import replace
from itertools import count
from pathlib import Path
from threading import Thread
from typing import Any

import httpx
import pytest
from websockets.exceptions import ConnectionClosed
from websockets.frames import Close
from websockets.sync.client import connect

from livessl import offline, wire
from livessl.capture.link import Link
from livessl.capture.node import send_session
from livessl.clock import PacedClock, SystemClock, UnpacedClock
from livessl.core.types import FRAME_NS, Event
from livessl.recordings.recording import SplicedRecording
from livessl.server import site_time
from livessl.server.api.encode import Messages
from livessl.server.app import Server
from livessl.server.receiver import BindError
from livessl.server.store import StoreError
from livessl.site.tokens import add_token
from small_site import HANG_S, Changes, frame, running_server, scene, scene_recordings, site_of, wait_until

CLOCK = SystemClock()
START_NS = 1_767_225_600_000_000_000
RUNS = count()
NEAR_M = 0.25 * math.sqrt(3) / 2
"""Half the diagonal of a grid cell."""


class Subscriber:
    """Reads the WebSocket until the server ends."""

    def __init__(self, server: Server, query: str = "") -> None:
        self.messages: list[dict[str, Any]] = []
        self.ended: Close | None = None
        self._connected = ExitStack()
        url = f"ws{server.url.removeprefix('http')}/api/v1/live{query}"
        self._socket = self._connected.enter_context(connect(url, open_timeout=HANG_S))
        self._thread = Thread(target=self._read)
        self._thread.start()
        wait_until(lambda: self.of("hello"), "the greeting")

    def _read(self) -> None:
        try:
            for text in self._socket:
                self.messages.append(json.loads(text))
        except ConnectionClosed as error:
            self.ended = error.rcvd

    def of(self, kind: str) -> list[dict[str, Any]]:
        return [message for message in self.messages if message["kind"] == kind]

    def close(self) -> None:
        self._connected.close()
        self._thread.join(timeout=HANG_S)


def play(server: Server, speed: float | None = None) -> None:
    """Send the scene as a replay, as fast as it goes or at a speed."""
    pace = UnpacedClock(START_NS) if speed is None else PacedClock(START_NS, speed)
    send_session(
        site_of(), server.endpoint, scene_recordings(START_NS), pace, CLOCK, f"run-{next(RUNS)}", lambda: False
    )
    server.wait_idle()


def offline_events() -> list[dict[str, Any]]:
    """Return the events of the scene, located without a server."""
    site = site_of()
    encoder = Messages(site, START_NS, utc=True)
    outputs = offline.run(site, scene_recordings(START_NS), UnpacedClock(START_NS))
    return [encoder.event(output) for output in outputs if isinstance(output, Event)]


def without_delays(event: dict[str, Any]) -> dict[str, Any]:
    """Return an event without what depends on the speed of the replay and on its place among the messages."""
    return {name: value for name, value in event.items() if name not in ("latency_s", "start_s", "seq", "v")}


def test_replay_gives_subscribers_and_rest_the_same_events_as_offline() -> None:
    with running_server(site_of()) as server:
        subscriber, events_only = Subscriber(server), Subscriber(server, "?kinds=event")
        play(server)
        wait_until(lambda: len(subscriber.of("event")) == 2, "both events")
        wait_until(lambda: len(events_only.of("event")) == 2, "both events")
        rest = httpx.get(f"{server.url}/api/v1/events").json()["events"]
        subscriber.close()
        events_only.close()
    events = subscriber.of("event")
    assert [without_delays(event) for event in events] == [without_delays(event) for event in offline_events()]
    assert [without_delays(event) for event in reversed(rest)] == [without_delays(event) for event in events]
    for event, source in zip(events, scene().sources, strict=True):
        assert math.dist(event["position_m"], source.position_m) < NEAR_M
        updates = [m for m in subscriber.of("update") if m["event_id"] == event["id"]]
        assert updates
        assert all(math.dist(update["position_m"], source.position_m) < 2 * NEAR_M for update in updates)
        assert all(m["seq"] < event["seq"] for m in updates)
    numbers = [message["seq"] for message in subscriber.messages[1:]]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    assert {message["kind"] for message in subscriber.messages} == {"hello", "arrays", "update", "track", "event"}
    assert {message["kind"] for message in events_only.messages} == {"hello", "event"}
    states = [message["state"] for message in subscriber.of("track")]
    assert states[0] == "new"
    assert states[-1] == "end"


def test_replay_twice_gives_the_same() -> None:
    with running_server(site_of()) as server:
        subscriber = Subscriber(server, "?kinds=event")
        play(server)
        play(server)
        wait_until(lambda: len(subscriber.of("event")) == 4, "both events, twice")
        stored = httpx.get(f"{server.url}/api/v1/events").json()["events"]
        subscriber.close()
    told = [without_delays(event) for event in subscriber.of("event")]
    assert told[:2] == told[2:]
    assert told[0] != told[1]
    assert len(stored) == 2  # the same events, not four


def test_running_replay_has_maps_tracks_and_its_own_time() -> None:
    with running_server(site_of()) as server:
        playing = Thread(target=play, args=(server, 2.0))
        playing.start()
        url = f"{server.url}/api/v1"
        wait_until(lambda: httpx.get(f"{url}/map").status_code == 200, "a map")
        tracks: list[dict[str, Any]] = []

        def tracked() -> bool:
            tracks[:] = httpx.get(f"{url}/tracks").json()["tracks"]
            return bool(tracks)

        wait_until(tracked, "a track")
        picture, numbers = httpx.get(f"{url}/map"), httpx.get(f"{url}/map?format=float32&array=north&view=volume")
        site, arrays = httpx.get(f"{url}/site").json(), httpx.get(f"{url}/arrays").json()
        playing.join()
        after = httpx.get(f"{url}/site").json(), httpx.get(f"{url}/tracks").json(), httpx.get(f"{url}/map")
    assert picture.headers["Content-Type"] == "image/png"
    assert len(numbers.content) == 4 * 16 * 20 * 12
    off_m = (math.dist(tracks[0]["position_m"], source.position_m) for source in scene().sources)
    assert min(off_m) < 2 * NEAR_M
    assert site["mode"] == "replay"
    assert arrays["now_utc"].startswith("2026-01-01T00:00:0")
    assert {array["state"] for array in arrays["arrays"]} == {"healthy"}
    assert after[0]["mode"] == "replay"  # its end stays to be looked at, until a live node comes
    assert after[1]["tracks"] == []
    assert after[2].status_code == 200


def test_gap_in_a_recording_does_not_end_its_replay(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nine seconds without sound, at six times the speed, outlast the silence that ends a replay."""
    monkeypatch.setattr(site_time, "REPLAY_SILENT_NS", 200_000_000)
    gap_ns = round(scene().duration_s * 1e9) // FRAME_NS * FRAME_NS + 9_000_000_000
    twice = [
        replace(first, recording=SplicedRecording((first.timed, second.timed)), start_ns=START_NS)
        for first, second in zip(scene_recordings(START_NS), scene_recordings(START_NS + gap_ns), strict=True)
    ]
    with running_server(site_of()) as server:
        send_session(site_of(), server.endpoint, twice, PacedClock(START_NS, 6.0), CLOCK, "run", lambda: False)
        server.wait_idle()
        stored = httpx.get(f"{server.url}/api/v1/events").json()["events"][::-1]
    assert len(stored) == 4
    assert stored[0]["position_m"] == stored[2]["position_m"]
    assert stored[2]["start_s"] - stored[0]["start_s"] == pytest.approx(gap_ns / 1e9)


def test_replay_whose_node_has_died_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(site_time, "REPLAY_SILENT_NS", 200_000_000)
    with running_server(site_of()) as server:
        link = connected(server, REPLAY)
        wait_until(lambda: server.parts.site_time.mode == "replay", "the replay")
        link.close(bye=False)
        server.wait_idle()
        assert server.parts.site_time.mode == "replay"
        live = connected(server, LIVE)
        assert live.connected
        wait_until(lambda: server.parts.site_time.mode == "live", "live again")
        live.close(bye=True)


def test_failed_start_leaves_nothing_open(tmp_path: Path) -> None:
    """An open file or database would be a ResourceWarning here."""
    changes: Changes = {
        "server.sinks": [{"type": "jsonl", "path": str(tmp_path / "events.jsonl")}],
        "server.events_db": str(tmp_path / "events.db"),
    }
    with running_server(site_of()) as server:
        refused(changes | {"server.bind": server.endpoint})
    with pytest.raises(StoreError):
        Server(site_of(changes | {"server.events_db": str(tmp_path)}), CLOCK)


def test_events_are_written_as_lines(tmp_path: Path) -> None:
    path = tmp_path / "events.jsonl"
    with running_server(site_of({"server.sinks": [{"type": "jsonl", "path": str(path)}]})) as server:
        play(server)
        stored = httpx.get(f"{server.url}/api/v1/events").json()["events"][::-1]
    assert [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()] == stored


def connected(server: Server, hello: wire.Hello) -> Link:
    link = Link(server.endpoint, hello, CLOCK)
    link.wait_connected(lambda: False)
    return link


LIVE = wire.Hello("lab-pc", "run-1", {"north": 16000.0})
REPLAY = wire.Hello("replay", "run-2", {"south": 16000.0}, replay=True)


@pytest.mark.parametrize(
    ("first", "second", "reason"),
    [(LIVE, REPLAY, "live nodes are connected; stop them first"), (REPLAY, LIVE, "a replay is running")],
    ids=["live first", "replay first"],
)
def test_live_and_replay_do_not_mix(first: wire.Hello, second: wire.Hello, reason: str) -> None:
    with running_server(site_of()) as server:
        there, other = connected(server, first), connected(server, second)
        assert there.connected
        assert other.refused == reason
        there.close(bye=True)

        def let_in() -> bool:
            other.service()
            return other.connected

        wait_until(let_in, "the place that has become free")
        other.close(bye=True)
        server.wait_idle()


def test_live_frames_far_from_the_servers_time_are_rejected() -> None:
    with running_server(site_of()) as server:
        link = connected(server, LIVE)
        link.send([frame(1, frame_index=1000)])

        def state() -> dict[str, Any]:
            link.service()
            found: dict[str, Any] = httpx.get(f"{server.url}/api/v1/arrays").json()["arrays"][0]
            return found

        wait_until(lambda: state()["counters"]["rejected"] == 1, "the rejection")
        assert state()["state"] == "degraded"
        assert "behind the server's; set both by NTP" in state()["reason"]
        link.close(bye=True)


def test_problem_of_a_device_reaches_subscribers() -> None:
    with running_server(site_of()) as server:
        subscriber = Subscriber(server, "?kinds=arrays")
        link = connected(server, LIVE)
        link.report("input device 'UMC1820' is not connected")

        def told() -> bool:
            link.service()
            return any(
                m["arrays"][0]["reason"] == "input device 'UMC1820' is not connected" for m in subscriber.of("arrays")
            )

        wait_until(told, "the trouble")
        subscriber.close()
        link.close(bye=True)


@pytest.mark.parametrize("query", ["", "?kinds=event"])
def test_server_stops_while_a_client_listens(query: str) -> None:
    began_ns = CLOCK.now_ns()
    with running_server(site_of()) as server:
        subscriber = Subscriber(server, query)
    assert CLOCK.now_ns() - began_ns < 5e9
    subscriber.close()
    assert subscriber.ended is not None
    assert subscriber.ended.code == 1012  # service restart: come again


def refused(changes: Changes, directory: Path | None = None) -> str:
    with pytest.raises(BindError) as caught:
        Server(site_of(changes, directory), CLOCK)
    return str(caught.value)


def test_taken_addresses_are_errors_with_their_cures() -> None:
    with running_server(site_of()) as server:
        port = int(server.url.rpartition(":")[2])
        assert refused({"server.http.port": port}) == (
            f"server.http: cannot listen on 127.0.0.1:{port}: Address already in use; is another server running? "
            "Stop it or choose another port"
        )
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            free = int(probe.getsockname()[1])
        said = refused({"server.bind": server.endpoint, "server.http.port": free})
        assert said.startswith(f"server.bind: cannot listen on {server.endpoint}: Address already in use")
    with running_server(site_of({"server.http.port": free})):
        pass  # the failed start has given its port back


def test_method_of_the_command_line_replaces_the_sites() -> None:
    with running_server(site_of(), method="averaged") as server:
        assert httpx.get(f"{server.url}/api/v1/site").json()["method"] == "averaged"
        play(server)
        wait_until(lambda: server.parts.event_log.published == 2, "both events")
        told = httpx.get(f"{server.url}/api/v1/events").json()["events"]
    assert {event["method"] for event in told} == {"averaged"}


def test_address_of_another_machine_is_an_error(tmp_path: Path) -> None:
    add_token(tmp_path / "tokens.yaml", "tests", "viewer")
    said = refused({"server.http.host": "192.0.2.1", "server.http.tokens": "tokens.yaml"}, tmp_path)
    assert said.startswith("server.http: cannot listen on 192.0.2.1:0: ")
    assert said.endswith("; write an address of this machine")


def test_server_listens_on_an_ipv6_address() -> None:
    with running_server(site_of({"server.http.host": "::1"})) as server:
        assert server.url.startswith("http://[::1]:")
        assert httpx.get(f"{server.url}/api/v1/health").status_code == 200


def test_database_outlives_the_server(tmp_path: Path) -> None:
    site = site_of({"server.events_db": str(tmp_path / "events.db")})
    with running_server(site) as server:
        play(server)
        wait_until(lambda: server.parts.event_log.published == 2, "both events")
    with running_server(site) as server:
        stored = httpx.get(f"{server.url}/api/v1/events").json()["events"]
        assert len(stored) == 2
        assert server.parts.event_log.published == 0


def test_unusable_database_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match=r"server\.events_db: cannot use"):
        Server(site_of({"server.events_db": str(tmp_path)}), CLOCK)


def test_events_are_handed_to_the_embedding_program() -> None:
    taken: list[dict[str, Any]] = []
    server = Server(site_of(), CLOCK, on_event=taken.append)
    thread = Thread(target=server.run)
    thread.start()
    play(server)
    server.stop()
    thread.join(timeout=HANG_S)
    assert [event["id"] for event in taken] == [event["id"] for event in offline_events()]
