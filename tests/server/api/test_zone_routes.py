"""The routes of the zones and of the floor plan, and their messages, from a whole server."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from websockets.sync.client import ClientConnection, connect

from alert_desk import after, sound
from livessl.core.stream.final_pass import FinalResults
from livessl.core.types import Event, Track, TrackState
from livessl.server.api.encode import Messages
from livessl.server.app import Server
from livessl.site.tokens import add_token
from small_site import HANG_S, Changes, running_server, site_of

DESK: dict[str, Any] = {"polygon_m": [[1.5, 1.5], [3.0, 1.5], [2.0, 3.0]], "z_m": [0, 2]}
PICTURE = b'<svg xmlns="http://www.w3.org/2000/svg" width="200" height="250"><rect width="9" height="9"/></svg>'


@contextmanager
def drawing(directory: Path, changes: Changes | None = None) -> Iterator[Server]:
    with running_server(site_of({"zones_file": "zones.yaml", **(changes or {})}, directory)) as server:
        yield server


def finish(server: Server, *events: Event) -> None:
    """Let events become final, as the fusion thread does."""
    messages = Messages(server.parts.site, 0, utc=True, zones=lambda: server.parts.zone_book.current)
    server.parts.event_log.add_final(FinalResults(events, after(*events)), messages, {})


@contextmanager
def live(server: Server, query: str) -> Iterator[ClientConnection]:
    url = f"ws{server.url.removeprefix('http')}/api/v1/live?{query}"
    with connect(url, open_timeout=HANG_S) as socket:
        socket.recv(timeout=HANG_S)
        yield socket


def url(server: Server, path: str) -> str:
    return f"{server.url}/api/v1/{path}"


def test_drawn_zone_is_in_force_on_every_route_and_client_without_a_restart(tmp_path: Path) -> None:
    with drawing(tmp_path) as server, live(server, "kinds=zones") as one, live(server, "kinds=zones") as other:
        finish(server, sound(1, (2.0, 2.0, 1.0)))
        answer = httpx.put(url(server, "zones/desk"), json=DESK)
        assert answer.status_code == 200
        assert answer.json()["zone"]["polygon_m"] == DESK["polygon_m"]
        for socket in (one, other):
            message = json.loads(socket.recv(timeout=HANG_S))
            assert (message["kind"], list(message["by_name"])) == ("zones", ["door", "desk"])
        finish(server, sound(2, (2.0, 2.0, 1.0)), sound(3, (2.0, 2.0, 2.5)))
        events = httpx.get(url(server, "events"), params={"zone": "desk"}).json()["events"]
        site, zones = (httpx.get(url(server, path)).json()["zones"] for path in ("site", "zones"))
        assert httpx.get(url(server, "events"), params={"zone": "disk"}).status_code == 404
    assert [event["id"] for event in events] == ["small-2"]
    assert events[0]["membership"][0]["name"] == "desk"
    assert site == zones
    assert zones["desk"] == {
        "bounds_m": [[1.5, 3.0], [1.5, 3.0], [0.0, 2.0]],
        "polygon_m": DESK["polygon_m"],
        "z_m": [0.0, 2.0],
        "exclude": False,
        "loiter_s": None,
        "owner": "drawn",
    }
    assert (zones["door"]["owner"], zones["door"]["polygon_m"]) == ("site-file", None)


def test_changed_and_deleted_zones(tmp_path: Path) -> None:
    with drawing(tmp_path) as server:
        for exclude in (False, True):
            httpx.put(url(server, "zones/desk"), json={**DESK, "exclude": exclude})
            finish(server, sound(int(exclude), (2.0, 2.0, 1.0)))
        events = httpx.get(url(server, "events")).json()["events"]
        assert httpx.delete(url(server, "zones/desk")).json() == {"v": 1, "name": "desk"}
        gone = httpx.delete(url(server, "zones/desk"))
        assert list(httpx.get(url(server, "zones")).json()["zones"]) == ["door"]
    assert (gone.status_code, gone.json()["detail"]) == (404, "no zone 'desk'; zones are door")
    assert [(event["excluded"], event["excluded_by"]) for event in events] == [(True, ["desk"]), (False, [])]


@pytest.mark.parametrize(
    ("method", "path", "body", "status", "expected"),
    [
        ("PUT", "zones/desk", {"polygon_m": [[0, 0], [2, 2], [2, 0], [0, 2]]}, 422, "1-2 crosses 3-4"),
        ("PUT", "zones/desk", {"polygon_m": [[9, 9], [10, 9], [9, 10]]}, 422, "reaches into the room"),
        ("PUT", "zones/a b", DESK, 422, "expected a name of 1 to 64 letters"),
        ("PUT", "zones/desk", {}, 422, "got neither"),
        ("PUT", "zones/door", DESK, 409, "belongs to the site file"),
        ("DELETE", "zones/door", None, 409, "belongs to the site file"),
        ("DELETE", "zones/desk", None, 404, "no zone 'desk'"),
    ],
)
def test_refused_change_says_why_and_changes_nothing(
    tmp_path: Path, method: str, path: str, body: Any, status: int, expected: str
) -> None:
    with drawing(tmp_path) as server:
        answer = httpx.request(method, url(server, path), json=body)
        assert list(httpx.get(url(server, "zones")).json()["zones"]) == ["door"]
    assert answer.status_code == status
    assert expected in answer.text
    assert list(tmp_path.iterdir()) == []


def test_viewer_may_see_zones_and_not_draw(tmp_path: Path) -> None:
    token = add_token(tmp_path / "tokens.yaml", "wall", "viewer")
    headers = {"Authorization": f"Bearer {token}"}
    with drawing(tmp_path, {"server.http.tokens": "tokens.yaml"}) as server:
        assert httpx.get(url(server, "zones"), headers=headers).json()["can_draw"]
        assert httpx.put(url(server, "zones/desk"), json=DESK, headers=headers).status_code == 403
        assert httpx.delete(url(server, "zones/desk"), headers=headers).status_code == 403


def test_tracks_are_reported_in_zones_and_filtered_by_zone(tmp_path: Path) -> None:
    with drawing(tmp_path) as server:
        httpx.put(url(server, "zones/desk"), json=DESK)
        messages = Messages(server.parts.site, 0, utc=True)
        with live(server, "kinds=zone&zone=desk") as socket:
            for second, place in enumerate([(0.5, 0.5, 1.0), (2.1, 2.0, 1.0), (3.5, 4.5, 1.0)]):
                time_ns = sound(second).start_ns
                track = Track(4, TrackState.UPDATE, time_ns, np.array(place), np.zeros(3), 0.0025 * np.eye(3))
                server.parts.tracks.note(track, messages.track(track))
            found = [json.loads(socket.recv(timeout=HANG_S)) for _ in range(2)]
        changes = httpx.get(url(server, "zone-changes")).json()["changes"]
        httpx.delete(url(server, "zones/desk"))  # a zone that was deleted keeps its changes
        of_desk = httpx.get(url(server, "zone-changes"), params={"zone": "desk", "limit": 1}).json()["changes"]
    assert [(each["change"], each["zone"], each["track_id"]) for each in found] == [
        ("enter", "desk", 4),
        ("leave", "desk", 4),
    ]
    assert [(each["change"], each["zone"]) for each in changes] == [
        ("leave", "desk"),
        ("enter", "desk"),
        ("leave", "door"),
        ("enter", "door"),
    ]
    assert of_desk == changes[:1]


def test_picture_of_the_floor_plan_is_served_with_its_place(tmp_path: Path) -> None:
    (tmp_path / "plan.svg").write_bytes(PICTURE)
    plan = {"image": "plan.svg", "m_per_pixel": 0.02, "origin_m": [0, 0]}
    with drawing(tmp_path, {"floor_plan": plan}) as server:
        picture = httpx.get(url(server, "floor-plan"))
        place = httpx.get(url(server, "site")).json()["floor_plan"]
    assert (picture.content, picture.headers["content-type"]) == (PICTURE, "image/svg+xml")
    assert place == {"bounds_m": [[0.0, 4.0], [0.0, 5.0]]}
    with drawing(tmp_path) as server:
        assert httpx.get(url(server, "floor-plan")).status_code == 404
        assert httpx.get(url(server, "site")).json()["floor_plan"] is None
