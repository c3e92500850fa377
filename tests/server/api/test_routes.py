"""The REST routes: every promised one, its errors and its headers; metrics and dashboard."""

from __future__ import annotations

import csv
import io
import json
import math
import re
import socket
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from prometheus_client.parser import text_string_to_metric_families
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from livessl.clock import utc_ns, utc_text
from livessl.server.api import history_routes
from livessl.server.api.app import STATIC
from livessl.server.app import Server
from livessl.server.event_log import EventLog
from livessl.server.store import Store
from livessl.site.tokens import add_token
from scene_server import CLOCK, get, live, located_scene, replay_scene
from small_site import HANG_S, SMALL, running_server, scene, site_of, wait_until

PUBLIC = {"host": "0.0.0.0", "port": 0, "tokens": "tokens.yaml"}
ROUTES = {
    "/api/v1/site",
    "/api/v1/arrays",
    "/api/v1/arrays/{name}/enabled",
    "/api/v1/events",
    "/api/v1/events.csv",
    "/api/v1/events.jsonl",
    "/api/v1/events.parquet",
    "/api/v1/events/{event_id}",
    "/api/v1/history/heat-map",
    "/api/v1/tracks",
    "/api/v1/map",
    "/api/v1/findings",
    "/api/v1/sounds",
    "/api/v1/set-up/verify",
    "/api/v1/health",
    "/api/v1/access",
    "/api/v1/alerts",
    "/api/v1/alerts/dead-letters",
    "/api/v1/alerts/dead-letters/{number}",
    "/api/v1/alerts/dead-letters/{number}/resend",
    "/api/v1/alerts/rules",
    "/api/v1/alerts/rules/{name}/armed",
    "/api/v1/alerts/rules/{name}/dry-run",
    "/api/v1/zones",
    "/api/v1/zones/{name}",
    "/api/v1/zone-changes",
    "/api/v1/floor-plan",
    "/api/v1/clips",
    "/api/v1/events/{event_id}/clips",
    "/api/v1/events/{event_id}/relocate",
    "/api/v1/relocation-settings",
    "/api/v1/events/{event_id}/clips/best",
    "/api/v1/events/{event_id}/clips/keep",
    "/api/v1/events/{event_id}/clips/{name}",
    "/api/v1/alerts/{key}/picture.png",
    "/api/v1/event-log",
    "/api/v1/links",
    "/api/v1/point",
    "/api/v1/history/journal",
    "/api/v1/log",
    "/api/v1/reload",
    "/api/v1/set-up",
    "/api/v1/set-up/accept",
    "/api/v1/set-up/measure",
    "/api/v1/set-up/move",
    "/api/v1/set-up/refine",
    "/api/v1/set-up/reload",
    "/api/v1/set-up/undo",
    "/api/v1/stream",
    "/metrics",
}
"""Every promised path but the WebSockets, which OpenAPI cannot describe."""


CHANGES = {
    "/relocate": {"post"},
    "/enabled": {"put"},
    "/armed": {"put"},
    "/resend": {"post"},
    "/links": {"post"},
    "/reload": {"post"},
    **{f"/set-up/{name}": {"post"} for name in ("accept", "measure", "move", "refine", "reload", "undo", "verify")},
    "/dead-letters": {"get", "delete"},
    "/dead-letters/{number}": {"delete"},
    "/zones/{name}": {"put", "delete"},
    "/{event_id}/clips": {"get", "delete"},
    "/clips/keep": {"put"},
}
"""Methods of the paths that are not only read, by their ends."""


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    with located_scene() as server:
        yield server


@pytest.fixture
def client(server: Server) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=server.url) as client:
        yield client


@pytest.fixture(scope="module")
def fresh() -> Iterator[httpx.Client]:
    """A client of a server that has received nothing."""
    with running_server(site_of()) as server, httpx.Client(base_url=server.url) as client:
        yield client


def test_openapi_is_complete(client: httpx.Client) -> None:
    described = client.get("/api/v1/openapi.json").json()
    assert set(described["paths"]) == ROUTES
    for path, methods in described["paths"].items():
        wanted = next((change for end, change in CHANGES.items() if path.endswith(end)), {"get"})
        assert set(methods) == wanted, path
        assert all(method["description"] for method in methods.values()), path
    parameters = {p["name"] for p in described["paths"]["/api/v1/events"]["get"]["parameters"]}
    filters = {"since", "until", "zone", "status", "min_confidence", "min_level_dbfs", "array", "text", "excluded"}
    assert parameters == filters | {"limit", "cursor", "after"}
    for path in ("/api/v1/events.csv", "/api/v1/events.jsonl", "/api/v1/events.parquet"):
        assert {p["name"] for p in described["paths"][path]["get"]["parameters"]} == filters
    assert set(described["paths"]["/api/v1/map"]["get"]["responses"]) >= {"200", "204", "422"}


@pytest.mark.parametrize("path", [*sorted(ROUTES), "/", "/static/index.html", "/api/v1/nothing"])
def test_headers_are_safe(client: httpx.Client, path: str) -> None:
    with client.stream("GET", path) as response:  # one of them never ends
        pass
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
    assert found["zones"]["door"].items() >= SMALL["zones"]["door"].items()


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
        assert len(array["channels"]) == 4
        for channel in array["channels"]:
            assert channel["rms_dbfs"] < channel["peak_dbfs"] < 0
            assert (channel["clipped"], channel["faults"]) == (0, [])
        assert array["channels_age_s"] >= 0
        assert array["host"] is None or array["host"]["lost_blocks"] == 0
        assert set(array["counters"]) >= {"late", "rejected", "lost_frames", "overflows", "duplicates", "sequence_gaps"}


def test_activity_threshold_follows_the_site_file() -> None:
    with (
        running_server(site_of({"activity.floor_factor": 100.0})) as server,
        httpx.Client(base_url=server.url) as client,
    ):
        replay_scene(server)
        for array in get(client, "arrays")["arrays"]:
            assert array["activity_threshold_dbfs"] == pytest.approx(array["noise_floor_dbfs"] + 20.0, abs=0.1)


def test_arrays_before_their_first_message(fresh: httpx.Client) -> None:
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
    back = get(client, "events", limit=1, after=second["previous_cursor"])
    assert back["events"] == [newest]
    nothing = get(client, "events", after=back["previous_cursor"])
    assert (nothing["events"], nothing["previous_cursor"]) == ([], back["previous_cursor"])


def test_events_by_status_array_level_and_text(client: httpx.Client) -> None:
    newest, oldest = get(client, "events")["events"]
    both, neither = [newest, oldest], list[Any]()
    loud = max(newest, oldest, key=lambda event: event["level_dbfs"])
    for filters, expected in (
        ({"status": "located"}, both),
        ({"status": "refused"}, neither),
        ({"array": "north", "zone": "room"}, both),
        ({"min_level_dbfs": loud["level_dbfs"]}, [loud]),
        ({"text": newest["id"].upper()}, [newest]),
        ({"text": "nowhere"}, neither),
    ):
        assert get(client, "events", **filters)["events"] == expected, filters


def test_unchanged_answer_is_not_sent_again(client: httpx.Client) -> None:
    event_id = get(client, "events")["events"][0]["id"]
    for path in ("events", f"events/{event_id}", "history/heat-map"):
        first = client.get(f"/api/v1/{path}")
        for known in (first.headers["ETag"], f'"other", W/{first.headers["ETag"]}'):
            again = client.get(f"/api/v1/{path}", headers={"If-None-Match": known})
            assert (again.status_code, again.content, again.headers["ETag"]) == (304, b"", first.headers["ETag"])
        assert client.get(f"/api/v1/{path}", headers={"If-None-Match": '"other"'}).status_code == 200


def test_exports_are_files_of_the_same_events(client: httpx.Client, monkeypatch: pytest.MonkeyPatch) -> None:
    events = get(client, "events")["events"]
    lines = client.get("/api/v1/events.jsonl")
    assert [json.loads(line) for line in lines.text.splitlines()] == events
    table = client.get("/api/v1/events.csv", params={"text": events[0]["id"]})
    assert table.headers["Content-Disposition"] == 'attachment; filename="small-events.csv"'
    assert [row["id"] for row in csv.DictReader(io.StringIO(table.text, newline=""))] == [events[0]["id"]]
    assert client.get("/api/v1/events.parquet").content.startswith(b"PAR1")
    assert client.get("/api/v1/events.csv", params={"limit": 1}).status_code == 422
    monkeypatch.setattr(Store, "scan", None)  # HEAD reads no event
    head = client.head("/api/v1/events.csv")
    assert (head.status_code, head.headers["Content-Disposition"]) == (200, table.headers["Content-Disposition"])


def test_export_without_its_library_says_what_to_install(client: httpx.Client, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(history_routes, "find_spec", lambda name: None)
    answer = client.get("/api/v1/events.parquet")
    assert (answer.status_code, answer.json()["detail"]) == (
        501,
        "Parquet needs the package pyarrow; pip install 'livessl[export]'",
    )


def test_heat_map_has_each_event_in_its_cell(client: httpx.Client) -> None:
    found = get(client, "history/heat-map", spacing_m=0.5)
    assert (found["bounds_m"], found["shape"], found["events"]) == ([[0, 4], [0, 5]], [8, 10], 2)
    for event in get(client, "events")["events"]:
        x_m, y_m, _ = event["position_m"]
        assert found["counts"][int(x_m / 0.5)][int(y_m / 0.5)] >= 1
    assert get(client, "history/heat-map", status="refused")["events"] == 0
    picture = client.get("/api/v1/history/heat-map", params={"format": "png"})
    assert picture.content.startswith(b"\x89PNG")


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
    ("query", "status", "detail"),
    [
        ({"zone": "hall"}, 404, "no zone 'hall'; zones are door, room"),
        ({"since": "yesterday"}, 422, "since: time: expected RFC 3339 .* got 'yesterday'"),
        ({"until": "2026-01-01T00:00:00"}, 422, "until: time: expected RFC 3339"),
        ({"min_confidence": 1.5}, 422, "less than or equal to 1"),
        ({"min_confidence": "nan"}, 422, "min_confidence"),
        ({"limit": 0}, 422, "greater than or equal to 1"),
        ({"limit": 1001}, 422, "less than or equal to 1000"),
        ({"limit": "many"}, 422, "valid integer"),
        ({"status": "lost"}, 422, "'located', 'direction-only' or 'refused'"),
        ({"array": "west"}, 404, "no array 'west'; there are north, south"),
        ({"min_level_dbfs": "loud"}, 422, "valid number"),
        ({"text": ""}, 422, "at least 1 character"),
        ({"after": "rubbish"}, 422, "after: expected the previous_cursor of a page, got 'rubbish'"),
        ({"after": "1-1", "cursor": "1-1"}, 422, "expected either cursor or after, got both"),
        ({"cursor": "rubbish"}, 422, "cursor: expected the next_cursor of a page, got 'rubbish'"),
        ({"cursor": 10**30}, 422, "cursor: expected the next_cursor of a page"),
    ],
)
def test_wrong_query_is_refused(client: httpx.Client, query: dict[str, Any], status: int, detail: str) -> None:
    assert re.search(detail, json.dumps(get(client, "events", status, **query), ensure_ascii=False))


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


def test_events_are_published_while_the_database_is_locked(tmp_path: Path) -> None:
    """Health and metrics report that these events wait; they are stored when the file is free."""
    path = tmp_path / "events.db"
    with running_server(site_of({"server.events_db": str(path)})) as server, closing(sqlite3.connect(path)) as other:
        other.execute("BEGIN IMMEDIATE")
        with live(server, "?kinds=event") as socket:
            replay_scene(server)
            kinds = [json.loads(socket.recv(timeout=HANG_S))["kind"] for _ in range(3)]
        assert kinds == ["hello", "event", "event"]
        with httpx.Client(base_url=server.url) as client:
            cure = "free space on its disk, or close the program that locks the file"
            waits = f"server.events_db: 2 events wait to be stored; {cure}"
            wait_until(lambda: waits in get(client, "health")["reasons"], "a first attempt")
            assert get(client, "events")["events"] == []
            assert "\nlivessl_events_unsaved 2.0\n" in client.get("/metrics").text
            other.rollback()
            wait_until(lambda: len(get(client, "events")["events"]) == 2, "both events, now that the file is free")
            assert "\nlivessl_events_unkept_total 0.0\n" in client.get("/metrics").text


def test_events_that_are_being_stored_are_no_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(EventLog, "unsaved", property(lambda _: 3))
    with running_server(site_of()) as server, httpx.Client(base_url=server.url) as client:
        assert not any("wait to be stored" in reason for reason in get(client, "health")["reasons"])


def test_search_without_a_database_says_what_to_do(tmp_path: Path) -> None:
    with running_server(site_of({"server.events_db": "postgresql://127.0.0.1:1/events"})) as server:
        for path in ("events", "events/small-1", "history/heat-map"):
            answer = httpx.get(f"{server.url}/api/v1/{path}")
            assert (answer.status_code, "see that PostgreSQL runs" in answer.json()["detail"]) == (503, True)
        assert "livessl_events_stored" not in httpx.get(f"{server.url}/metrics").text
        health = httpx.get(f"{server.url}/api/v1/health").json()
        assert (health["status"], "cannot use" in " ".join(health["reasons"])) == ("starting", True)


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
        assert value("livessl_latency_seconds_count", kind="update", stage=stage) >= 1
    assert value("livessl_latency_seconds_count", kind="event", stage="delivered") == 0  # there was no subscriber
    for array in ("north", "south"):
        assert value("livessl_array_up", array=array) == 0
        assert value("livessl_array_age_seconds", array=array) >= 0
        assert value("livessl_array_level_dbfs", array=array) < 0
        assert value("livessl_array_total", array=array, what="frames") > 10
        for channel in "1234":
            assert value("livessl_channel_rms_dbfs", array=array, channel=channel) < 0
            assert value("livessl_channel_peak_dbfs", array=array, channel=channel) < 0
            assert value("livessl_channel_clipped_samples_total", array=array, channel=channel) == 0


def test_dashboard_and_its_files_are_served(client: httpx.Client) -> None:
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
    "path", ["/static/nothing.js", "/static/../app.py", "/static/%2e%2e/app.py", "/api/v1/", "/api/v2/site"]
)
def test_other_paths_are_404(client: httpx.Client, path: str) -> None:
    assert client.get(path).status_code == 404


def test_other_methods_are_405(client: httpx.Client) -> None:
    assert client.post("/api/v1/events", json={}).status_code == 405
    assert client.delete("/api/v1/events/x").status_code == 405


def test_requests_to_another_host_name_are_refused(server: Server, client: httpx.Client) -> None:
    """DNS rebinding: a page's own host name points to the server, so that the browser lets the page read answers."""
    port = server.url.rpartition(":")[2]
    for host in ("evil.example", f"evil.example:{port}", "127.0.0.1.evil.example", ""):
        assert client.get("/api/v1/site", headers={"Host": host}).status_code == 400, host
    for host in (f"127.0.0.1:{port}", f"localhost:{port}", "LocalHost", f"[::1]:{port}", "[::1]"):
        assert client.get("/api/v1/site", headers={"Host": host}).status_code == 200, host
    with pytest.raises(InvalidStatus):
        connect(f"ws://evil.example:{port}/api/v1/live", sock=socket.create_connection(("127.0.0.1", int(port))))


def test_server_with_tokens_answers_to_any_host_name(tmp_path: Path) -> None:
    add_token(tmp_path / "tokens.yaml", "wall", "viewer")
    with running_server(site_of({"server.http": PUBLIC}, tmp_path)) as server:
        url = server.url.replace("0.0.0.0", "127.0.0.1")
        assert httpx.get(f"{url}/api/v1/health", headers={"Host": "lab-pc.local:8000"}).status_code == 200
