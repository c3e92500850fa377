"""A hall on two real servers, to which two nodes send, and a hub that shows each of its sounds once."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from threading import Thread

import httpx
import numpy as np
import pytest

from hall_world import BORDER_M, NODES, TILES, hall_scene, hall_site, node_site, of_node, recorded
from hub_desk import make_hub, running_hub
from link_router import free_endpoint
from livessl.capture.node import capture_recordings
from livessl.clock import SystemClock
from livessl.core.types import FRAME_NS
from livessl.federation.app import HubServer
from livessl.federation.schema import SiteEventPage, Sites
from livessl.server.api.encode import JsonObject
from nats_servers import NatsServer, running_nats
from small_site import HANG_S, running_server, wait_until

pytestmark = pytest.mark.usefixtures("nothing_is_shed")

CLOCK = SystemClock()
HALLS = {"works": list(TILES)}
DEEP_WEST, DEEP_EAST = (2.5, 3.5, 1.2), (9.3, 2.2, 1.3)
AT_BORDER, NEAR_BORDER = (6.1, 3.1, 1.1), (5.6, 1.2, 1.5)
TOGETHER = (1.8, 4.0, 1.2), (10.0, 2.0, 1.3)
SOUNDS = (
    (0.7, DEEP_WEST),
    (2.5, AT_BORDER),
    (4.5, NEAR_BORDER),
    (6.5, DEEP_EAST),
    (8.5, TOGETHER[0]),
    (8.5, TOGETHER[1]),
)


@contextmanager
def nodes(endpoints: Mapping[str, str], sounds: Sequence[tuple[float, tuple[float, float, float]]]) -> Iterator[None]:
    """Both nodes, which send what their arrays record."""
    heard = recorded(hall_scene(sounds))
    start_ns = (CLOCK.now_ns() // FRAME_NS + 20) * FRAME_NS
    threads = [
        Thread(
            target=capture_recordings,
            args=(node_site(node, endpoints), node, of_node(node, heard, start_ns), CLOCK, "run-1", lambda: False),
        )
        for node in NODES
    ]
    for thread in threads:
        thread.start()
    yield
    for thread in threads:
        thread.join(timeout=HANG_S)
        assert not thread.is_alive()


def events_at(hub: HubServer, query: str = "") -> list[JsonObject]:
    """The events that the hub shows, oldest first."""
    page = httpx.get(f"{hub.url}/api/v1/events?limit=100{query}").raise_for_status().json()
    SiteEventPage.model_validate(page)
    events: list[JsonObject] = page["events"][::-1]
    return events


def near(events: Sequence[JsonObject], place_m: Sequence[float]) -> list[JsonObject]:
    """The events within half a metre of a place."""
    placed = [event for event in events if event["position_m"] is not None]
    return [event for event in placed if np.linalg.norm(np.subtract(event["position_m"], place_m)) < 0.5]


@pytest.fixture(scope="module")
def nats(tmp_path_factory: pytest.TempPathFactory) -> Iterator[NatsServer]:
    with running_nats(tmp_path_factory.mktemp("nats")) as server:
        yield server


def test_each_sound_of_a_hall_on_two_servers_is_shown_once(nats: NatsServer, tmp_path: Path) -> None:
    with ExitStack() as stack:
        hub = stack.enter_context(running_hub(make_hub("hub.sqlite", [nats.url], tmp_path, halls=HALLS)))
        sites = {name: hall_site(name, [nats.url], tmp_path) for name in TILES}
        servers = {name: stack.enter_context(running_server(site)) for name, site in sites.items()}
        with nodes({name: server.endpoint for name, server in servers.items()}, SOUNDS):
            wait_until(
                lambda: near(events_at(hub), TOGETHER[0]) and near(events_at(hub), TOGETHER[1]), "the last sounds"
            )
        shown = events_at(hub)
        assert len(shown) == len(SOUNDS)
        for _, place_m in SOUNDS:
            [event] = near(shown, place_m)
            assert event["site"] == ("west" if place_m[0] < BORDER_M else "east")
            assert event["hall"] == {"name": "works", "in_tile": True}
            assert event["copy_of"] is None
            if place_m in (AT_BORDER, NEAR_BORDER):
                [copy] = event["copies"]
                stored = httpx.get(f"{hub.url}/api/v1/sites/{copy['site']}/events/{copy['id']}").json()
                assert copy["site"] != event["site"]
                assert stored["copy_of"] == {"site": event["site"], "id": event["id"]}
        report = httpx.get(f"{hub.url}/api/v1/sites").json()
        Sites.model_validate(report)
        tiles = {site["site"]: site["hall"]["tile_m"][0] for site in report["sites"]}
        assert tiles == {"west": [0.0, 0.0], "east": [BORDER_M, 0.0]}


def test_events_of_a_server_that_was_away_become_copies_when_they_come(tmp_path: Path) -> None:
    """Also at a hub that has restarted in the meantime; the sound that only this server locates appears then."""
    folder = tmp_path / "late"
    folder.mkdir()
    late = free_endpoint()
    sounds = ((0.7, AT_BORDER), (2.5, DEEP_EAST), (4.5, DEEP_WEST), (25.0, DEEP_WEST))
    with running_nats(folder / "nats") as nats, ExitStack() as stack:
        settings = make_hub("hub.sqlite", [nats.url], folder, halls=HALLS)
        west = stack.enter_context(running_server(hall_site("west", [nats.url], folder)))
        with nodes({"west": west.endpoint, "east": late}, sounds):
            with running_hub(settings) as hub:
                wait_until(lambda: near(events_at(hub), DEEP_WEST), "the third sound")
                assert [event["site"] for event in near(events_at(hub), AT_BORDER)] == ["west"]
                assert near(events_at(hub), DEEP_EAST) == []
            hub = stack.enter_context(running_hub(settings))
            stack.enter_context(running_server(hall_site("east", [nats.url], folder, late)))
            wait_until(lambda: near(events_at(hub), DEEP_EAST), "a sound that the second server locates")
            wait_until(lambda: near(events_at(hub), AT_BORDER)[0]["copies"], "the copy")
        [event] = near(events_at(hub), AT_BORDER)
        assert (event["site"], [copy["site"] for copy in event["copies"]]) == ("east", ["west"])
