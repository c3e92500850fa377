"""Disabled arrays: they are shown and acknowledged, but neither used nor waited for."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from unittest.mock import patch

import httpx
import pytest
from world import ARRAY_OF, World

from livessl.server.store import StoreError
from small_site import running_server, site_of


def put(url: str, array: str, body: Any) -> httpx.Response:
    return httpx.put(f"{url}/api/v1/arrays/{array}/enabled", json=body)


def array(url: str, name: str) -> dict[str, Any]:
    arrays = httpx.get(f"{url}/api/v1/arrays").json()["arrays"]
    return next(dict(each) for each in arrays if each["name"] == name)


def test_disabled_array_is_shown_as_such() -> None:
    with running_server(site_of()) as server:
        assert put(server.url, "north", {"enabled": False}).json() == {"v": 1, "name": "north", "enabled": False}
        north = array(server.url, "north")
        assert (north["state"], north["enabled"]) == ("disabled", False)
        assert north["reason"] == (
            "an operator has disabled it, and its sound is not used; otherwise starting: no message yet"
        )
        assert array(server.url, "south")["enabled"]
        health = httpx.get(f"{server.url}/api/v1/health").json()
        assert health["arrays"]["north"] == "disabled"
        assert f"north: {north['reason']}" in health["reasons"]
        assert 'livessl_array_enabled{array="north"} 0.0' in httpx.get(f"{server.url}/metrics").text
        put(server.url, "north", {"enabled": True})
        assert array(server.url, "north")["state"] == "starting"


def test_server_is_degraded_while_all_its_arrays_are_disabled() -> None:
    """With one array disabled, only the other one counts."""

    def health(url: str) -> tuple[str, bool]:
        found = httpx.get(f"{url}/api/v1/health").json()
        return found["status"], "all arrays are disabled, so nothing is located; enable one" in found["reasons"]

    with running_server(site_of()) as server:
        put(server.url, "north", {"enabled": False})
        assert health(server.url) == ("starting", False)
        put(server.url, "south", {"enabled": False})
        assert health(server.url) == ("degraded", True)
        put(server.url, "south", {"enabled": True})
        assert health(server.url) == ("starting", False)


@pytest.mark.parametrize("body", [{}, {"enabled": "no"}, {"enabled": 0}, {"enabled": False, "why": "noise"}, [], None])
def test_malformed_switch_is_refused(body: Any) -> None:
    with running_server(site_of()) as server:
        assert put(server.url, "north", body).status_code == 422
        assert array(server.url, "north")["enabled"]


def test_switch_of_an_unknown_array_is_refused() -> None:
    with running_server(site_of()) as server:
        answer = put(server.url, "east", {"enabled": False})
        assert (answer.status_code, answer.json()["detail"]) == (404, "no array 'east'; there are north, south")


@pytest.mark.parametrize("kept", [True, False])
def test_database_remembers_a_disabled_array(tmp_path: Path, kept: bool) -> None:
    site = site_of({"server.events_db": str(tmp_path / "events.db")} if kept else {})
    with running_server(site) as server:
        put(server.url, "north", {"enabled": False})
    with running_server(site) as server:
        assert array(server.url, "north")["enabled"] is not kept


def test_array_stays_enabled_if_the_database_is_full() -> None:
    with running_server(site_of()) as server:
        with patch.object(server.parts.store, "enable", side_effect=StoreError("server.events_db: disk full")):
            answer = put(server.url, "north", {"enabled": False})
        assert (answer.status_code, answer.json()["detail"]) == (503, "server.events_db: disk full")
        assert array(server.url, "north")["enabled"]


def heard(world: World) -> set[str]:
    return {name for event in world.events() for name in event["heard_by"]}


def test_frames_of_a_disabled_array_are_acknowledged_and_not_used() -> None:
    world, as_ever = World(1), World(1)
    assert world.server is not None
    world.server.array_states.enable("north", False)
    world.recover()
    as_ever.recover()
    assert (heard(world), heard(as_ever)) == ({"south"}, {"north", "south"})
    assert max(node.link.kept for node in world.nodes.values()) <= 60


def test_no_result_waits_for_a_disabled_array() -> None:
    """The disabled array is away, too: events of the others are final at once, and their nodes forget the frames."""
    for disabled in (True, False):
        world = World(1)
        world.run(20)
        world.kill_node("a")
        assert world.server is not None
        if disabled:
            world.server.array_states.enable(ARRAY_OF["a"], False)
        world.run(world.end - world.frame_index + 50)
        assert heard(world) == {"south"}
        assert (world.nodes["b"].link.kept <= 60) is disabled


def test_array_enabled_again_is_used_again() -> None:
    world = World(1)
    assert world.server is not None
    world.server.array_states.enable("north", False)
    sounds = world.groups()
    world.run(min(sounds[4]) - world.frame_index - 20)
    assert heard(world) == {"south"}
    world.server.array_states.enable("north", True)
    world.recover()
    assert heard(world) == {"north", "south"}
