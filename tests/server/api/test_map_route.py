"""Power maps as numbers and as pictures over REST, and as binary messages over the WebSocket."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import httpx
import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed

from livessl.clock import utc_ns
from livessl.server.app import Server
from scene_server import get, located_scene, replay_scene, watch
from small_site import HANG_S, running_server, scene, site_of


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


def floats(response: httpx.Response) -> np.ndarray[Any, np.dtype[np.float32]]:
    assert response.status_code == 200, response.text
    assert response.headers["Content-Type"] == "application/octet-stream"
    shape = [int(n) for n in response.headers["X-Map-Shape"].split(",")]
    return np.frombuffer(response.content, dtype="<f4").reshape(shape)


def test_map_as_numbers(client: httpx.Client) -> None:
    def numbers(**query: str) -> np.ndarray[Any, np.dtype[np.float32]]:
        return floats(client.get("/api/v1/map", params={"format": "float32", **query}))

    volume = numbers(view="volume")
    assert volume.shape == (16, 20, 12)
    assert np.array_equal(numbers(view="floor"), volume.max(axis=2).T)
    assert np.array_equal(numbers(view="side"), volume.max(axis=0).T)
    assert np.array_equal(numbers(view="front"), volume.max(axis=1).T)
    assert np.array_equal(numbers(), numbers(view="floor", array="fused"))
    parts = [numbers(view="volume", array=name) for name in ("north", "south")]
    assert np.allclose(parts[0] + parts[1], volume, rtol=0, atol=1e-6)
    assert not np.array_equal(parts[0], parts[1])
    # the last window is of the last sound; the maximum is within one cell of it
    highest = np.array(np.unravel_index(volume.argmax(), volume.shape))
    assert np.abs((highest + 0.5) * 0.25 - scene().sources[-1].position_m).max() < 0.25


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


def test_map_before_the_first_window_is_204(fresh: httpx.Client) -> None:
    for form in ("png", "float32"):
        response = fresh.get("/api/v1/map", params={"format": form})
        assert (response.status_code, response.content) == (204, b"")


def test_watcher_gets_the_newest_window_of_each_view(server: Server, client: httpx.Client) -> None:
    with watch(server, "?array=south&views=floor,side") as socket:
        packed = [socket.recv(timeout=HANG_S) for _ in range(2)]
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


def test_watcher_gets_each_new_window() -> None:
    with running_server(site_of()) as server, watch(server) as socket:
        for _ in range(2):
            replay_scene(server)
            assert len(socket.recv(timeout=HANG_S)) == 48 + 16 * 20
            with suppress(TimeoutError):
                while True:
                    socket.recv(timeout=0.3)


@pytest.mark.parametrize(
    ("query", "reason"),
    [
        ("?array=west", "array: no array 'west'; there are fused, north, south"),
        ("?views=floor,roof", "views: expected some of floor, side, front, got 'floor,roof'"),
    ],
)
def test_wrong_query_closes_the_socket_with_a_reason(server: Server, query: str, reason: str) -> None:
    with watch(server, query) as socket, pytest.raises(ConnectionClosed) as caught:
        socket.recv(timeout=HANG_S)
    assert caught.value.rcvd is not None
    assert (caught.value.rcvd.code, caught.value.rcvd.reason) == (1008, reason)


def test_page_of_another_server_may_not_watch(server: Server) -> None:
    with watch(server, origin="http://evil.example") as socket, pytest.raises(ConnectionClosed):
        socket.recv(timeout=HANG_S)


@pytest.mark.parametrize(
    ("query", "status", "detail"),
    [
        ({"array": "west"}, 404, "no array 'west'; there are fused, north, south"),
        ({"view": "volume"}, 422, "use format=float32"),
        ({"view": "roof"}, 422, "floor"),
        ({"format": "gif"}, 422, "float32"),
    ],
)
def test_wrong_query_is_refused(client: httpx.Client, query: dict[str, str], status: int, detail: str) -> None:
    assert detail in json.dumps(get(client, "map", status, **query))
