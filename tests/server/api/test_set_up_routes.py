"""The routes for setting up: the last sounds with their delays, and verification by known places."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any

import httpx
import numpy as np
import pytest

from known_sounds import events, finish, places_m
from livessl.server.app import Server
from livessl.site.build import set_up
from scene_server import capture_scene, get
from small_site import running_server, scene, site_of, wait_until


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    with running_server(site_of()) as server:
        yield server


@pytest.fixture(scope="module")
def client(server: Server) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=server.url, timeout=60.0) as client:
        yield client


def verify(client: httpx.Client, numbers: list[int], status: int = 200) -> dict[str, Any]:
    claps = [
        {"number": number, "place_m": place_m.round(3).tolist()}
        for number, place_m in zip(numbers, places_m(), strict=False)
    ]
    answer = client.post("/api/v1/set-up/verify", json={"claps": claps})
    assert answer.status_code == status, answer.text
    found: dict[str, Any] = answer.json()
    return found


def test_live_sounds_have_the_delays_of_their_places(client: httpx.Client, server: Server) -> None:
    before = get(client, "sounds")
    capture_scene(server)
    wait_until(lambda: get(client, "sounds")["last"] == before["last"] + 2, "both sounds")
    answer = get(client, "sounds", after=before["last"])
    assert [sound["number"] for sound in answer["sounds"]] == [before["last"] + 1, before["last"] + 2]
    site = site_of()
    for sound, source in zip(answer["sounds"], scene(2).sources, strict=True):
        assert sound["status"] == "located"
        assert sound["id"] in {event["id"] for event in get(client, "events")["events"]}
        for one in sound["observations"]:
            away_m = np.linalg.norm(site.array(one["array"]).microphones_m - source.position_m, axis=1)
            true_us = 1e6 * (away_m - away_m.mean()) / site.c_m_s
            assert np.array(one["delays_us"]) == pytest.approx(true_us, abs=16.0)  # a quarter of a sample


def test_right_and_wrong_set_ups_are_told_apart(client: httpx.Client, server: Server) -> None:
    right = verify(client, [finish(server, event) for event in events()[:4]])
    assert (right["verdict"], right["findings"]) == ("ok", [])
    assert all(clap["error_m"] < 0.15 for clap in right["claps"])
    swapped = verify(client, [finish(server, event) for event in events((0, 2, 1, 3))[:4]])
    (finding,) = swapped["findings"]
    assert (swapped["verdict"], finding["fault"], finding["array"]) == ("wrong", "swapped", "south")


def test_a_clap_far_from_its_place_is_not_explained_by_one_sound(client: httpx.Client, server: Server) -> None:
    number = finish(server, events()[5])  # made elsewhere than at the first place
    found = verify(client, [number])
    assert found["verdict"] != "ok"
    assert found["claps"][0]["error_m"] > 0.3


def test_numbers_of_sounds_are_higher_than_before_a_restart(server: Server) -> None:
    assert server.parts.set_up_watch.heard.last > 1_700_000_000_000  # milliseconds since the epoch


def test_a_verification_beside_another_one_does_not_wait(
    client: httpx.Client, server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    reached, release = threading.Event(), threading.Event()

    def slow(*_: Any) -> list[Any]:
        reached.set()
        assert release.wait(60)
        return []

    monkeypatch.setattr(set_up, "verify_set_up", slow)
    number = finish(server, events()[0])
    first = threading.Thread(target=verify, args=(client, [number]))
    first.start()
    try:
        assert reached.wait(60)
        told = "another verification is running; try again in some seconds"
        assert verify(client, [number], 409)["detail"] == told
    finally:
        release.set()
        first.join(60)
    verify(client, [number])


def test_a_sound_that_is_not_kept_is_told(client: httpx.Client) -> None:
    assert "is not kept any more" in verify(client, [2**40], 404)["detail"]


@pytest.mark.parametrize(
    "claps",
    [
        [],
        [{"number": 1}],
        [{"number": 1, "place_m": [1, 2]}],
        [{"number": 0.5, "place_m": [1, 1, 1]}],
        [{"number": "7", "place_m": [1, 1, 1]}],
    ],
)
def test_a_request_that_is_none_is_refused(client: httpx.Client, claps: list[Any]) -> None:
    assert client.post("/api/v1/set-up/verify", json={"claps": claps}).status_code == 422
