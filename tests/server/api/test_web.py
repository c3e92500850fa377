"""The HTTP face: every promised route, its errors, its headers, and the live WebSocket."""

from __future__ import annotations

import json
import math
import re
import socket
import sqlite3
from collections import deque
from collections.abc import Iterator
from contextlib import closing, suppress
from itertools import count
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from prometheus_client.parser import text_string_to_metric_families
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Origin

from livessl.capture.node import capture_recordings, send_session
from livessl.clock import SystemClock, UnpacedClock, utc_ns, utc_text
from livessl.core.types import FRAME_NS
from livessl.server import http
from livessl.server.api.app import STATIC
from livessl.server.app import Server
from livessl.site.tokens import add_token
from small_site import SMALL, running_server, scene, scene_recordings, site_of, wait_until

CLOCK = SystemClock()
RUNS = count()
PUBLIC = {"host": "0.0.0.0", "port": 0, "tokens": "tokens.yaml"}
ROUTES = {
    "/api/v1/site",
    "/api/v1/arrays",
    "/api/v1/arrays/{name}/enabled",
    "/api/v1/events",
    "/api/v1/events/{event_id}",
    "/api/v1/tracks",
    "/api/v1/map",
    "/api/v1/health",
    "/api/v1/access",
    "/metrics",
}
"""The contract's, but for the WebSocket, which OpenAPI cannot tell of."""


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    """A server that has just heard the scene, live."""
    with running_server(site_of({"zones.room": {"bounds_m": [[0, 4], [0, 5], [0, 3]]}})) as server:
        node_site = site_of({"nodes.lab-pc.server": server.endpoint})
        start_ns = (CLOCK.now_ns() // FRAME_NS + 20) * FRAME_NS  # live: what was kept for long is no news
        capture_recordings(node_site, "lab-pc", scene_recordings(start_ns), CLOCK, "run-1", lambda: False)
        wait_until(lambda: server.parts.event_log.published == 2, "both events")
        yield server


def play(server: Server) -> None:
    """Let the server hear the scene as a replay."""
    send_session(
        site_of(), server.endpoint, scene_recordings(0), UnpacedClock(), CLOCK, f"run-{next(RUNS)}", lambda: False
    )
    server.wait_idle()


@pytest.fixture
def client(server: Server) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=server.url) as client:
        yield client


@pytest.fixture(scope="module")
def fresh() -> Iterator[httpx.Client]:
    """A client of a server that has heard nothing."""
    with running_server(site_of()) as server, httpx.Client(base_url=server.url) as client:
        yield client


def get(client: httpx.Client, path: str, status: int = 200, **query: Any) -> dict[str, Any]:
    response = client.get(f"/api/v1/{path}", params=query)
    assert response.status_code == status, response.text
    found = response.json()
    assert isinstance(found, dict)
    if status == 200:
        assert found["v"] == 1
    return found


def test_openapi_is_complete(client: httpx.Client) -> None:
    described = client.get("/api/v1/openapi.json").json()
    assert set(described["paths"]) == ROUTES
    for path, methods in described["paths"].items():
        assert set(methods) == {"put" if path.endswith("/enabled") else "get"}
        assert all(method["description"] for method in methods.values()), path
    parameters = {p["name"] for p in described["paths"]["/api/v1/events"]["get"]["parameters"]}
    assert parameters == {"since", "until", "zone", "min_confidence", "limit", "cursor"}
    assert set(described["paths"]["/api/v1/map"]["get"]["responses"]) >= {"200", "204", "422"}


@pytest.mark.parametrize("path", [*sorted(ROUTES), "/", "/static/index.html", "/api/v1/nothing"])
def test_headers_are_safe(client: httpx.Client, path: str) -> None:
    response = client.get(path)
    assert response.headers["X-Content-Type-Options"] == "nosniff"
    policy = response.headers["Content-Security-Policy"]
    assert "default-src 'self'" in policy
    assert "unsafe" not in policy
    assert response.headers["Cache-Control"] == "no-cache"


def test_site(client: httpx.Client) -> None:
    found = get(client, "site")
    assert found["site"] == "small"
    assert found["mode"] == "live"
    assert found["room"] == {"size_m": [4.0, 5.0, 3.0]}
    assert found["grid"] == {"bounds_m": [[0, 4], [0, 5], [0, 3]], "spacing_m": 0.25, "shape": [16, 20, 12]}
    assert found["speed_of_sound_m_s"] == 343.0
    assert found["method"] == "onset"
    north = found["arrays"]["north"]
    assert north["position_m"] == [1.9, 1.3, 1.4]
    assert np.shape(north["microphones_m"]) == (4, 3)
    assert north["band_hz"] == [100, 6000]
    assert found["zones"]["door"] == SMALL["zones"]["door"]


def test_arrays(client: httpx.Client) -> None:
    found = get(client, "arrays")
    assert abs(utc_ns(found["now_utc"]) - CLOCK.now_ns()) < 5e9
    assert [array["name"] for array in found["arrays"]] == ["north", "south"]
    for array in found["arrays"]:
        assert array["state"] == "lost"
        assert array["reason"] == "its node has ended"
        assert array["node"] == "lab-pc"
        assert array["age_s"] >= 0
        assert len(array["channel_levels_dbfs"]) == 4
        assert array["level_dbfs"] < -40
        # four times the noise's power, the default factor; both levels are rounded to 0.1 dB
        assert array["activity_threshold_dbfs"] == pytest.approx(array["noise_floor_dbfs"] + 6.02, abs=0.1)
        assert array["sample_rate_hz"] == 16000.0
        assert array["drift_ppm"] == 0.0
        assert array["counters"]["frames"] > 10
        assert array["counters"]["marks"] > 0
        assert set(array["counters"]) >= {"late", "rejected", "lost_frames", "overflows", "duplicates", "sequence_gaps"}


def test_activity_threshold_follows_the_site_file() -> None:
    with (
        running_server(site_of({"activity.floor_factor": 100.0})) as server,
        httpx.Client(base_url=server.url) as client,
    ):
        play(server)
        for array in get(client, "arrays")["arrays"]:
            assert array["activity_threshold_dbfs"] == pytest.approx(array["noise_floor_dbfs"] + 20.0, abs=0.1)


def test_arrays_not_heard_from(fresh: httpx.Client) -> None:
    for array in get(fresh, "arrays")["arrays"]:
        assert (array["state"], array["reason"], array["age_s"]) == ("starting", "no message yet", None)


def test_events_are_where_the_sounds_were(client: httpx.Client) -> None:
    newest, oldest = get(client, "events")["events"]
    for event, source in zip((oldest, newest), scene().sources, strict=True):
        assert event["status"] == "located"
        # half the diagonal of a cell of 0.25 m
        assert math.dist(event["position_m"], source.position_m) < 0.25 * math.sqrt(3) / 2
        assert event["arrays"] == ["north", "south"]
        assert event["zones"] == ["room"]
    between_s = scene().sources[1].start_s - scene().sources[0].start_s
    assert newest["start_s"] - oldest["start_s"] == pytest.approx(between_s, abs=0.1)  # a frame at either start


def test_event_by_its_id(client: httpx.Client) -> None:
    event = get(client, "events")["events"][0]
    assert get(client, f"events/{event['id']}") == {"v": 1, **event}
    assert get(client, "events/small-0", 404)["detail"] == "no event 'small-0'"


def test_events_page_by_page(client: httpx.Client) -> None:
    newest, oldest = get(client, "events")["events"]
    first = get(client, "events", limit=1)
    assert first["events"] == [newest]
    second = get(client, "events", limit=1, cursor=first["next_cursor"])
    assert second["events"] == [oldest]
    assert second["next_cursor"] is None


def test_events_of_a_time(client: httpx.Client) -> None:
    newest, oldest = get(client, "events")["events"]
    at = newest["time_utc"]
    before = utc_text(utc_ns(at) - 1000)
    assert get(client, "events", since=at)["events"] == [newest]
    assert get(client, "events", until=before)["events"] == [oldest]
    assert get(client, "events", since=before, until=before)["events"] == []
    local = at.replace("Z", "+00:00")
    assert client.get(f"/api/v1/events?since={local}").json()["events"] == [newest]  # the plus sign not escaped
    assert get(client, "events", since="0001-01-01T00:00:00Z", until="9999-12-31T00:00:00Z")["events"] == [
        newest,
        oldest,
    ]


def test_events_of_a_zone_and_confidence(client: httpx.Client) -> None:
    assert len(get(client, "events", zone="room")["events"]) == 2
    assert get(client, "events", zone="door")["events"] == []
    assert len(get(client, "events", min_confidence=0)["events"]) == 2
    assert get(client, "events", min_confidence=1)["events"] == []


@pytest.mark.parametrize(
    ("query", "status", "said"),
    [
        ({"zone": "hall"}, 404, "no zone 'hall'; zones are door, room"),
        ({"since": "yesterday"}, 422, "since: time: expected RFC 3339 .* got 'yesterday'"),
        ({"until": "2026-01-01T00:00:00"}, 422, "until: time: expected RFC 3339"),
        ({"min_confidence": 1.5}, 422, "less than or equal to 1"),
        ({"min_confidence": "nan"}, 422, "min_confidence"),
        ({"limit": 0}, 422, "greater than or equal to 1"),
        ({"limit": 1001}, 422, "less than or equal to 1000"),
        ({"limit": "many"}, 422, "valid integer"),
        ({"cursor": "rubbish"}, 422, "cursor: expected the next_cursor of the page before, got 'rubbish'"),
        ({"cursor": 10**30}, 422, "cursor: expected the next_cursor of the page before"),
    ],
)
def test_events_asked_for_wrongly(client: httpx.Client, query: dict[str, Any], status: int, said: str) -> None:
    assert re.search(said, json.dumps(get(client, "events", status, **query), ensure_ascii=False))


def test_tracks(client: httpx.Client, fresh: httpx.Client) -> None:
    assert get(fresh, "tracks") == {"v": 1, "tracks": []}
    for track in get(client, "tracks")["tracks"]:
        assert track["kind"] == "track"


def test_health(client: httpx.Client, fresh: httpx.Client) -> None:
    starting = get(fresh, "health")
    assert starting["status"] == "starting"
    assert starting["arrays"] == {"north": "starting", "south": "starting"}
    ended = get(client, "health")
    assert ended["status"] == "degraded"
    assert ended["mode"] == "live"
    assert ended["uptime_s"] > 0
    assert ended["reasons"] == ["north: its node has ended", "south: its node has ended"]


def test_database_that_takes_nothing_ends_nothing(tmp_path: Path) -> None:
    """Events are published all the same, and everyone is told that their history is lost."""
    path = tmp_path / "events.db"
    with running_server(site_of({"server.events_db": str(path)})) as server, closing(sqlite3.connect(path)) as other:
        other.execute("BEGIN IMMEDIATE")
        with live(server, "?kinds=event") as socket:
            play(server)
            told = [json.loads(socket.recv(timeout=10))["kind"] for _ in range(3)]
        other.rollback()
        assert told == ["hello", "event", "event"]
        with httpx.Client(base_url=server.url) as client:
            assert get(client, "events")["events"] == []
            assert "\nlivessl_events_unkept_total 2.0\n" in client.get("/metrics").text
            lost = "server.events_db: 2 events were not kept; free space or release the file"
            assert lost in get(client, "health")["reasons"]
            play(server)
            wait_until(lambda: len(get(client, "events")["events"]) == 2, "both events, now that the file is free")


def floats(response: httpx.Response) -> np.ndarray[Any, np.dtype[np.float32]]:
    assert response.status_code == 200, response.text
    assert response.headers["Content-Type"] == "application/octet-stream"
    shape = [int(n) for n in response.headers["X-Map-Shape"].split(",")]
    return np.frombuffer(response.content, dtype="<f4").reshape(shape)


def test_map_as_numbers(client: httpx.Client) -> None:
    def ask(**query: str) -> np.ndarray[Any, np.dtype[np.float32]]:
        return floats(client.get("/api/v1/map", params={"format": "float32", **query}))

    volume = ask(view="volume")
    assert volume.shape == (16, 20, 12)
    assert np.array_equal(ask(view="floor"), volume.max(axis=2).T)
    assert np.array_equal(ask(view="side"), volume.max(axis=0).T)
    assert np.array_equal(ask(view="front"), volume.max(axis=1).T)
    assert np.array_equal(ask(), ask(view="floor", array="fused"))
    parts = [ask(view="volume", array=name) for name in ("north", "south")]
    assert np.allclose(parts[0] + parts[1], volume, rtol=0, atol=1e-6)
    assert not np.array_equal(parts[0], parts[1])
    # of the last window, that is the last sound: no further off than a cell
    node = np.array(np.unravel_index(volume.argmax(), volume.shape))
    assert np.abs((node + 0.5) * 0.25 - scene().sources[-1].position_m).max() < 0.25


def test_map_as_picture(client: httpx.Client) -> None:
    for view, size in (("floor", (16, 20)), ("side", (20, 12)), ("front", (16, 12))):
        response = client.get("/api/v1/map", params={"view": view})
        assert response.status_code == 200
        assert response.headers["Content-Type"] == "image/png"
        assert response.content.startswith(b"\x89PNG\r\n\x1a\n")
        assert tuple(int.from_bytes(response.content[at : at + 4]) for at in (16, 20)) == size
        assert float(response.headers["X-Map-Min"]) < float(response.headers["X-Map-Max"])
        assert float(response.headers["X-Map-Age-S"]) > 0
        utc_ns(response.headers["X-Map-Time-Utc"])


def test_map_before_anything_was_heard(fresh: httpx.Client) -> None:
    for form in ("png", "float32"):
        response = fresh.get("/api/v1/map", params={"format": form})
        assert (response.status_code, response.content) == (204, b"")


def watch(server: Server, query: str = "", origin: str | None = None) -> Any:
    url = f"ws{server.url.removeprefix('http')}/api/v1/map{query}"
    return connect(url, origin=None if origin is None else Origin(origin), open_timeout=5)


def test_map_is_watched(server: Server, client: httpx.Client) -> None:
    with watch(server, "?array=south&views=floor,side") as socket:
        packed = [socket.recv(timeout=5) for _ in range(2)]
        with pytest.raises(TimeoutError):
            socket.recv(timeout=0.15)  # there is no newer window
    for view, data in zip(("floor", "side"), packed, strict=True):
        numbers = client.get("/api/v1/map", params={"array": "south", "view": view, "format": "float32"})
        assert numbers.headers["X-Map-Shape"] == {"floor": "20,16", "side": "12,20"}[view]
        assert numbers.headers["X-Map-Bounds-M"] == {"floor": "0,5,0,4", "side": "0,3,0,5"}[view]
        powers = floats(numbers).ravel()
        step = (powers.max() - powers.min()) / 255
        levels = np.frombuffer(data, dtype=np.uint8, offset=48)
        assert len(levels) == len(powers)
        assert np.abs(powers.min() + step * levels - powers).max() <= 0.51 * step


def test_watchers_get_new_windows() -> None:
    with running_server(site_of()) as server, watch(server) as socket:
        for _ in range(2):
            play(server)
            assert len(socket.recv(timeout=5)) == 48 + 16 * 20
            with suppress(TimeoutError):
                while True:
                    socket.recv(timeout=0.3)


@pytest.mark.parametrize(
    ("query", "said"),
    [
        ("?array=west", "array: none of that name; there are fused, north, south"),
        ("?views=floor,roof", "views: expected some of floor, side, front"),
    ],
)
def test_map_watched_wrongly(server: Server, query: str, said: str) -> None:
    with watch(server, query) as socket, pytest.raises(ConnectionClosed) as caught:
        socket.recv(timeout=5)
    assert caught.value.rcvd is not None
    assert (caught.value.rcvd.code, caught.value.rcvd.reason) == (1008, said)


def test_page_of_another_server_may_not_watch(server: Server) -> None:
    with watch(server, origin="http://evil.example") as socket, pytest.raises(ConnectionClosed):
        socket.recv(timeout=5)


@pytest.mark.parametrize(
    ("query", "status", "said"),
    [
        ({"array": "west"}, 404, "no array 'west'; there are fused, north, south"),
        ({"view": "volume"}, 422, "use format=float32"),
        ({"view": "roof"}, 422, "floor"),
        ({"format": "gif"}, 422, "float32"),
    ],
)
def test_map_asked_for_wrongly(client: httpx.Client, query: dict[str, str], status: int, said: str) -> None:
    assert said in json.dumps(get(client, "map", status, **query))


def test_metrics(client: httpx.Client) -> None:
    response = client.get("/metrics")
    assert response.headers["Content-Type"].startswith("text/plain; version=0.0.4")
    families = {family.name: family for family in text_string_to_metric_families(response.text)}
    for family in families.values():
        assert family.documentation

    def value(name: str, **labels: str) -> float:
        samples = [s for family in families.values() for s in family.samples if s.name == name]
        [found] = [s.value for s in samples if s.labels == labels]
        return float(found)

    assert value("livessl_events_total") == 2
    assert value("livessl_events_stored") == 2
    assert value("livessl_events_unkept_total") == 0
    assert value("livessl_sink_failures_total") == 0
    assert value("livessl_messages_refused_total") == 0
    assert value("livessl_uptime_seconds") > 0
    for stage in ("sent", "received", "located"):
        assert value("livessl_latency_seconds_count", kind="event", stage=stage) == 2
        assert value("livessl_latency_seconds_count", kind="update", stage=stage) > 2
    assert value("livessl_latency_seconds_count", kind="event", stage="delivered") == 0  # nobody listened
    for array in ("north", "south"):
        assert value("livessl_array_up", array=array) == 0
        assert value("livessl_array_age_seconds", array=array) >= 0
        assert value("livessl_array_level_dbfs", array=array) < 0
        assert value("livessl_array_total", array=array, what="frames") > 10


def test_dashboard_and_all_that_it_loads(client: httpx.Client) -> None:
    page = client.get("/")
    assert page.status_code == 200
    assert page.headers["Content-Type"].startswith("text/html")
    loaded = re.findall(r'(?:src|href)="(/?static/[^"]+)"', page.text)
    assert loaded
    for path in loaded:
        assert client.get(f"/{path.removeprefix('/')}").status_code == 200, path
    for file in STATIC.iterdir():
        response = client.get(f"/static/{file.name}")
        assert response.status_code == 200
        assert response.content == file.read_bytes()
    assert "http://" not in re.sub(r"http://www\.w3\.org/\S*", "", page.text)
    assert "https://" not in page.text


@pytest.mark.parametrize(
    "path", ["/static/nothing.js", "/static/../web.py", "/static/%2e%2e/web.py", "/api/v1/", "/api/v2/site"]
)
def test_what_is_not_there(client: httpx.Client, path: str) -> None:
    assert client.get(path).status_code == 404


def test_reading_only(client: httpx.Client) -> None:
    assert client.post("/api/v1/events", json={}).status_code == 405
    assert client.delete("/api/v1/events/x").status_code == 405


def live(server: Server, query: str = "", origin: str | None = None) -> Any:
    url = f"ws{server.url.removeprefix('http')}/api/v1/live{query}"
    return connect(url, origin=None if origin is None else Origin(origin), open_timeout=5)


def test_live_begins_with_a_greeting(server: Server) -> None:
    with live(server) as socket:
        hello = json.loads(socket.recv(timeout=5))
        assert (hello["v"], hello["kind"], hello["site"], hello["mode"]) == (1, "hello", "small", "live")
        assert [array["name"] for array in hello["arrays"]] == ["north", "south"]
        socket.send("what anyone says is ignored")
        following = [json.loads(socket.recv(timeout=5)) for _ in range(2)]
        assert {message["kind"] for message in following} <= {"arrays", "track"}
        assert [message["seq"] for message in following] == [hello["last_seq"] + 1, hello["last_seq"] + 2]


def test_live_goes_on_where_a_client_was(server: Server) -> None:
    with live(server) as socket:
        hello, first, second = (json.loads(socket.recv(timeout=5)) for _ in range(3))
    with live(server, f"?since_seq={first['seq']}") as socket:
        greeting, following = (json.loads(socket.recv(timeout=5)) for _ in range(2))
    assert greeting["kind"] == "hello"
    assert following == second
    assert hello["last_seq"] > 1_600_000_000_000  # above all numbers of an earlier life
    with live(server, "?since_seq=5") as socket:
        _, gap = (json.loads(socket.recv(timeout=5)) for _ in range(2))
    assert (gap["kind"], gap["missed"]) == ("gap", None)


@pytest.mark.parametrize(
    ("query", "said"),
    [
        ("?kinds=events", "kinds: expected some of arrays, event, track, update"),
        ("?since_seq=-1", "since_seq: expected the seq of a message"),
        ("?since_seq=x", "since_seq: expected the seq of a message"),
        ("?zone=hall", "zone: none of that name; zones are door, room"),
    ],
)
def test_live_with_a_wrong_filter_says_why(server: Server, query: str, said: str) -> None:
    with live(server, query) as socket, pytest.raises(ConnectionClosed) as caught:
        socket.recv(timeout=5)
    assert caught.value.rcvd is not None
    assert (caught.value.rcvd.code, caught.value.rcvd.reason) == (1008, said)


@pytest.mark.parametrize("origin", ["http://evil.example", "http://evil.example:80", "null", "http://["])
def test_page_of_another_server_may_not_listen(server: Server, origin: str) -> None:
    with live(server, origin=origin) as socket, pytest.raises(ConnectionClosed) as caught:
        socket.recv(timeout=5)
    assert caught.value.rcvd is not None
    assert caught.value.rcvd.code == 1008
    assert caught.value.rcvd.reason.startswith("origin: ")


def test_our_own_page_may_listen(server: Server) -> None:
    with live(server, origin=server.url) as socket:
        assert json.loads(socket.recv(timeout=5))["kind"] == "hello"


def test_name_that_was_made_to_point_here_is_refused(server: Server, client: httpx.Client) -> None:
    """DNS rebinding: the browser believes that we are its own page's server."""
    port = server.url.rpartition(":")[2]
    for host in ("evil.example", f"evil.example:{port}", "127.0.0.1.evil.example", ""):
        assert client.get("/api/v1/site", headers={"Host": host}).status_code == 400, host
    for host in (f"127.0.0.1:{port}", f"localhost:{port}", "LocalHost", f"[::1]:{port}", "[::1]"):
        assert client.get("/api/v1/site", headers={"Host": host}).status_code == 200, host
    with pytest.raises(InvalidStatus):
        connect(f"ws://evil.example:{port}/api/v1/live", sock=socket.create_connection(("127.0.0.1", int(port))))


def test_open_to_the_network_it_has_any_name(tmp_path: Path) -> None:
    add_token(tmp_path / "tokens.yaml", "wall", "viewer")
    with running_server(site_of({"server.http": PUBLIC}, tmp_path)) as server:
        url = server.url.replace("0.0.0.0", "127.0.0.1")
        assert httpx.get(f"{url}/api/v1/health", headers={"Host": "lab-pc.local:8000"}).status_code == 200


def test_subscriber_who_says_too_much_is_cut_off(server: Server) -> None:
    with live(server) as talkative:
        talkative.send("x" * 4096)
        assert json.loads(talkative.recv(timeout=5))["kind"] == "hello"
        talkative.send("x" * 4097)
        with pytest.raises(ConnectionClosed) as caught:
            deque(talkative, maxlen=0)
    assert caught.value.rcvd is not None
    assert caught.value.rcvd.code == 1009  # message too big


def test_connections_are_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(http, "MAX_CONNECTIONS", 2)
    with running_server(site_of()) as server:
        assert httpx.get(f"{server.url}/api/v1/health").status_code == 200
        with live(server):
            assert httpx.get(f"{server.url}/api/v1/health").status_code == 503


def test_answers_say_where_their_time_went() -> None:
    """One machine, one clock: every stage is positive, and they add up to what the client sees at least."""
    with running_server(site_of()) as server, live(server, "?kinds=event,update") as socket:
        node_site = site_of({"nodes.lab-pc.server": server.endpoint})
        start_ns = (CLOCK.now_ns() // FRAME_NS + 20) * FRAME_NS  # live: what was kept for long is no news
        capture_recordings(node_site, "lab-pc", scene_recordings(start_ns), CLOCK, "run-1", lambda: False)
        wait_until(lambda: server.parts.event_log.published == 2, "both events")
        told = [json.loads(socket.recv(timeout=5)) for _ in range(8)]
        now_ns = CLOCK.now_ns()
        metrics = httpx.get(f"{server.url}/metrics").text
    answers = [message for message in told if message["kind"] in ("event", "update")]
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


def test_live_filters_kinds(server: Server) -> None:
    with live(server, "?kinds=event") as quiet, live(server, "?kinds=arrays") as loud:
        assert json.loads(quiet.recv(timeout=5))["kind"] == "hello"
        assert json.loads(loud.recv(timeout=5))["kind"] == "hello"
        assert json.loads(loud.recv(timeout=5))["kind"] == "arrays"
        with pytest.raises(TimeoutError):
            quiet.recv(timeout=0.1)


def test_clients_are_counted_and_forgotten(server: Server, client: httpx.Client) -> None:
    def clients() -> float:
        [line] = re.findall(r"^livessl_websocket_clients (\S+)$", client.get("/metrics").text, re.MULTILINE)
        return float(line)

    wait_until(lambda: clients() == 0, "nobody")
    with live(server), live(server):
        wait_until(lambda: clients() == 2, "two clients")
    wait_until(lambda: clients() == 0, "nobody")
