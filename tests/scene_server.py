"""A server that has located the scene of the small site, for the tests of the API, and clients of it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import count
from typing import Any, Final

import httpx
from websockets.sync.client import connect
from websockets.typing import Origin

from livessl.capture.node import capture_recordings, send_session
from livessl.clock import SystemClock, UnpacedClock
from livessl.core.types import FRAME_NS
from livessl.recordings.assign import AssignedRecording
from livessl.server.app import Server
from small_site import HANG_S, running_server, scene_recordings, site_of, wait_until

CLOCK: Final = SystemClock()
_RUNS = count()


@contextmanager
def located_scene() -> Iterator[Server]:
    """A server that has just located both sounds of the scene, live."""
    with running_server(site_of({"zones.room": {"bounds_m": [[0, 4], [0, 5], [0, 3]]}})) as server:
        capture_scene(server)
        yield server


def capture(server: Server, recordings: Callable[[int], list[AssignedRecording]]) -> None:
    """Send recordings, which a function makes for their start, to the server as a live node does."""
    node_site = site_of({"nodes.lab-pc.server": server.endpoint})
    start_ns = (CLOCK.now_ns() // FRAME_NS + 20) * FRAME_NS  # in the future: old sound would not be published as live
    capture_recordings(node_site, "lab-pc", recordings(start_ns), CLOCK, f"run-{next(_RUNS)}", lambda: False)


def capture_scene(server: Server, published: int = 2) -> None:
    """Send the scene to the server as a live node does, and wait until so many events are published in all."""
    capture(server, scene_recordings)
    wait_until(lambda: server.parts.event_log.published == published, "both events")


def replay_scene(server: Server) -> None:
    """Send the scene to the server as a replay, and wait for its end."""
    run = f"run-{next(_RUNS)}"
    send_session(site_of(), server.endpoint, scene_recordings(0), UnpacedClock(), CLOCK, run, lambda: False)
    server.wait_idle()


def get(client: httpx.Client, path: str, status: int = 200, /, **query: Any) -> dict[str, Any]:
    """Answer to a request of the API, whose status is checked."""
    response = client.get(f"/api/v1/{path}", params=query)
    assert response.status_code == status, response.text
    found = response.json()
    assert isinstance(found, dict)
    if status == 200:
        assert found["v"] == 1
    return found


def live(server: Server, query: str = "", origin: str | None = None) -> Any:
    """Open the WebSocket of messages."""
    url = f"ws{server.url.removeprefix('http')}/api/v1/live{query}"
    return connect(url, origin=None if origin is None else Origin(origin), open_timeout=HANG_S)


def watch(server: Server, query: str = "", origin: str | None = None) -> Any:
    """Open the WebSocket of maps."""
    url = f"ws{server.url.removeprefix('http')}/api/v1/map{query}"
    return connect(url, origin=None if origin is None else Origin(origin), open_timeout=HANG_S)
