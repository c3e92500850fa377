"""Pan and tilt of a camera by the API; the geometry is tested with the core."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import httpx
import numpy as np
import pytest

from livessl.server.app import Server
from messages import START_NS, event_message
from small_site import HANG_S, running_server, site_of

CAMERAS = {"wall": {"position_m": [1.0, 0.0, 2.0], "orientation_deg": {"yaw": 90}}, "mast": {"position_m": [2, 2, 2.5]}}


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    with running_server(site_of({"cameras": CAMERAS})) as server:
        past: list[dict[str, Any]] = [
            {"id": "small-1", "position_m": [3.0, 2.0, 2.0]},
            {"id": "small-2", "status": "direction-only"},
        ]
        server.parts.store.add_all([(event_message(**event), START_NS + i) for i, event in enumerate(past)])
        yield server


def point(server: Server, status: int = 200, **query: str) -> dict[str, Any]:
    answer = httpx.get(f"{server.url}/api/v1/point", params=query, timeout=HANG_S)
    assert answer.status_code == status, answer.text
    found: dict[str, Any] = answer.json()
    return found


def test_camera_is_pointed_at_an_event_or_a_place(server: Server) -> None:
    at_event = point(server, camera="wall", event="small-1")
    assert (at_event["event_id"], at_event["position_m"]) == ("small-1", [3.0, 2.0, 2.0])
    assert at_event["pan_deg"] == pytest.approx(45.0)
    assert at_event["tilt_deg"] == pytest.approx(0.0)
    assert at_event["distance_m"] == pytest.approx(np.sqrt(8.0), abs=1e-3)
    at_place = point(server, camera="wall", position_m="3.0,2.0,2.0")
    assert at_place == {**at_event, "event_id": None}
    below = point(server, camera="mast", position_m="2,2,0.5")
    assert (below["tilt_deg"], below["distance_m"]) == (-90.0, 2.0)


@pytest.mark.parametrize(
    ("query", "status", "told"),
    [
        ({"camera": "dor", "event": "small-1"}, 404, "no camera 'dor'; cameras are wall, mast"),
        ({"camera": "wall", "event": "small-9"}, 404, "no event 'small-9'"),
        ({"camera": "wall", "event": "small-2"}, 409, "is direction-only: no camera can be pointed at it"),
        ({"camera": "wall"}, 422, "expected either event or position_m, got neither"),
        ({"camera": "wall", "event": "small-1", "position_m": "1,1,1"}, 422, "got both"),
        ({"camera": "wall", "position_m": "1,0,2"}, 422, "expected a place that is not the camera's own"),
        *[
            ({"camera": "wall", "position_m": text}, 422, "expected x,y,z in metres, got")
            for text in ("1,2", "1,2,3,4", "1,2,nan", "1,2,inf", "1,2,z", "")
        ],
    ],
)
def test_what_cannot_be_pointed_at_is_told(server: Server, query: dict[str, str], status: int, told: str) -> None:
    assert told in str(point(server, status, **query)["detail"])
