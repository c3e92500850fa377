"""The routes of the poses: measuring, accepting and undoing them in a running server."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from known_sounds import events, finish, places_m
from livessl.server.app import Server
from livessl.site.build import set_up
from livessl.site.load import load_site
from livessl.site.models import Site
from scene_server import capture_scene, get, live
from small_site import HANG_S, running_server, scene, site_of, wait_until, write_site

WRONG = {"arrays.south.orientation_deg": {"yaw": 25.0}, "arrays.south.position_m": [2.35, 3.7, 1.55]}
"""A site file whose array south is elsewhere than the sounds were recorded at."""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_site(tmp_path, WRONG)
    return tmp_path


@pytest.fixture
def server(folder: Path) -> Iterator[Server]:
    with running_server(load_site(folder / "site.yaml")) as server:
        yield server


@pytest.fixture
def client(server: Server) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=server.url, timeout=HANG_S) as client:
        yield client


def post(client: httpx.Client, path: str, value: Any = None, status: int = 200) -> dict[str, Any]:
    answer = client.post(f"/api/v1/set-up/{path}", json={} if value is None else value)
    assert answer.status_code == status, answer.text
    found: dict[str, Any] = answer.json()
    return found


def clapped(server: Server, count: int = 8) -> dict[str, Any]:
    """A request to measure by the claps of the true set-up, which the server has finished."""
    claps = [
        {"number": finish(server, event), "place_m": place_m.round(3).tolist()}
        for event, place_m in zip(events()[:count], places_m(), strict=False)
    ]
    return {"claps": claps, "place_std_m": 0.01}


def positions(client: httpx.Client, name: str = "south") -> np.ndarray[Any, Any]:
    """The microphones of an array as `GET arrays` has them; `GET site` says the same."""
    (array,) = [one for one in get(client, "arrays")["arrays"] if one["name"] == name]
    assert get(client, "site")["arrays"][name]["microphones_m"] == array["microphones_m"]
    return np.array(array["microphones_m"])


def test_claps_measure_a_wrong_pose_which_is_accepted_without_a_restart(
    server: Server, client: httpx.Client, folder: Path
) -> None:
    true_m, filed_m = site_of().array("south").microphones_m, site_of(WRONG).array("south").microphones_m
    proposal = post(client, "measure", clapped(server))
    assert proposal["refusal"] is None
    (pose,) = [one for one in proposal["arrays"] if one["array"] == "south"]
    assert np.array(pose["before"]["microphones_m"]) == pytest.approx(filed_m, abs=1e-3)
    assert np.array(pose["after"]["microphones_m"]) == pytest.approx(true_m, abs=0.06)
    assert pose["turn_deg"] == pytest.approx([0.0, 0.0, -25.0], abs=2.0)
    assert 0.0 < pose["position_std_m"] < 0.1
    assert pose["misfit_us"][1] < 20.0 < pose["misfit_us"][0]
    assert len(proposal["claps"]) == 8
    assert (
        np.median([clap["after_m"] for clap in proposal["claps"]]) < 0.1 < max(c["before_m"] for c in proposal["claps"])
    )
    assert positions(client) == pytest.approx(filed_m, abs=1e-3), "nothing is applied without a yes"

    with live(server, "?kinds=poses") as socket:
        socket.recv(timeout=HANG_S)
        accepted = post(client, "accept", {"id": proposal["id"]})
        assert '"poses"' in socket.recv(timeout=HANG_S)
    assert accepted["changed"] == ["north", "south"]
    assert positions(client) == pytest.approx(true_m, abs=0.06)
    assert load_site(folder / "site.yaml").array("south").microphones_m == pytest.approx(true_m, abs=0.06)

    capture_scene(server)  # sounds are located with the new poses
    found = {event["start_s"]: event["position_m"] for event in get(client, "events")["events"]}
    for start_s, source in zip(sorted(found), scene(2).sources, strict=True):
        assert found[start_s] == pytest.approx(source.position_m, abs=0.15)

    assert post(client, "accept", {"id": proposal["id"]}, 409)["detail"].startswith("other poses have come into force")
    undone = post(client, "undo")
    assert undone["changed"] == ["north", "south"]
    assert positions(client) == pytest.approx(filed_m, abs=1e-3)
    assert "no calibration before" in post(client, "undo", status=404)["detail"]


def test_typed_poses_are_proposed_first(server: Server, client: httpx.Client) -> None:
    before_m = site_of(WRONG).array("south").microphones_m
    move = {"arrays": {"south": {"position_m": [2.0, 3.0, 1.0], "turn_deg": [0.0, 0.0, 90.0]}}}
    proposal = post(client, "move", move)
    (pose,) = proposal["arrays"]
    assert (proposal["method"], pose["position_std_m"], pose["determined"]) == ("typed", None, None)
    assert pose["turn_deg"] == pytest.approx([0.0, 0.0, 90.0], abs=0.01)
    assert positions(client) == pytest.approx(before_m, abs=1e-3)
    post(client, "accept", {"id": proposal["id"]})
    arms_m = before_m - before_m.mean(axis=0)
    turned_m = np.column_stack([-arms_m[:, 1], arms_m[:, 0], arms_m[:, 2]]) + np.array([2.0, 3.0, 1.0])
    assert positions(client) == pytest.approx(turned_m, abs=2e-3)
    outside = post(client, "move", {"arrays": {"south": {"position_m": [2.0, 3.0, 7.0]}}})
    assert outside["refusal"] is not None
    assert post(client, "accept", {"id": outside["id"]}, 409)["detail"] == outside["refusal"]


def test_claps_that_leave_a_pose_open_are_refused_and_the_next_place_is_named(
    server: Server, client: httpx.Client
) -> None:
    too_few = post(client, "measure", clapped(server, 3), 422)
    assert "expected 4 sounds or more" in str(too_few["detail"])
    request = clapped(server, 4)
    far = [{**clap, "place_m": [1e4, 1e4, 1e4]} for clap in request["claps"]]
    for path in ("measure", "verify"):
        told = str(post(client, path, {"claps": far}, 422)["detail"])
        assert "expected places in the room" in told
        assert "got 10000, 10000, 10000" in told
    for clap in request["claps"]:  # all claps at almost one place
        clap["number"], clap["place_m"] = request["claps"][0]["number"], request["claps"][0]["place_m"]
    proposal = post(client, "measure", request)
    assert "at most 0.1 m and 3 degrees are accepted" in proposal["refusal"]
    assert not all(pose["determined"] for pose in proposal["arrays"])
    assert len(proposal["next_place_m"]) == 3
    assert post(client, "accept", {"id": proposal["id"]}, 409)["detail"] == proposal["refusal"]


def test_sounds_at_wrong_places_contradict_each_other(server: Server, client: httpx.Client) -> None:
    request = clapped(server)
    for clap in request["claps"][:4]:
        clap["place_m"] = [clap["place_m"][1], clap["place_m"][0], 0.2]
    proposal = post(client, "measure", request)
    assert proposal["refusal"] is not None


def test_claps_are_judged_with_the_speed_of_sound_that_stays_in_force(
    server: Server, client: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    measure, place, speeds = set_up.measure_set_up, set_up.place_sounds, []

    def at_another_speed(*arguments: Any) -> Any:
        return replace(measure(*arguments), c_m_s=300.0)

    def noted(site: Site, *arguments: Any) -> Any:
        speeds.append(site.c_m_s)
        return place(site, *arguments)

    monkeypatch.setattr(set_up, "measure_set_up", at_another_speed)
    monkeypatch.setattr(set_up, "place_sounds", noted)
    proposal = post(client, "measure", clapped(server))
    assert proposal["speed"]["speed_of_sound_m_s"] == 300.0
    assert speeds == [server.parts.site.c_m_s] * 2, "before and after"
    assert proposal["refusal"] is None


def test_the_server_refines_poses_by_the_sounds_that_it_locates(
    server: Server, client: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("livessl.server.proposals.KEPT", 1)
    outside = post(client, "move", {"arrays": {"south": {"position_m": [2.0, 3.0, 7.0]}}})
    assert get(client, "set-up")["refinement"] == {"sounds": 0, "needed": 20, "agrees": None, "proposal": None}
    for event in events(count=22):
        finish(server, event)
    wait_until(lambda: get(client, "set-up")["refinement"]["proposal"] is not None, "the refinement")
    refinement = get(client, "set-up")["refinement"]
    proposal = refinement["proposal"]
    (pose,) = proposal["arrays"]
    assert (refinement["agrees"], proposal["known"], pose["array"]) == (False, ["north"], "south")
    assert pose["turn_deg"] == pytest.approx([0.0, 0.0, -25.0], abs=3.0)
    post(client, "accept", {"id": outside["id"]}, 409)  # the thread's proposals push out no other
    post(client, "accept", {"id": proposal["id"]})
    wait_until(lambda: get(client, "set-up")["refinement"]["agrees"] is True, "the refinement with the new poses")


def test_another_program_that_wrote_the_file_has_it_read(server: Server, client: httpx.Client, folder: Path) -> None:
    assert post(client, "reload")["changed"] == []
    written = folder / "calibration" / "small.yaml"
    written.parent.mkdir()
    written.write_text(f"arrays: {{south: {{microphones_m: {site_of().array('south').microphones_m.tolist()}}}}}")
    assert post(client, "reload")["changed"] == ["south"]
    written.write_text("arrays: 3")
    assert "calibration/small.yaml" in post(client, "reload", status=409)["detail"]


@pytest.mark.parametrize(
    ("path", "value", "status"),
    [
        ("move", {"arrays": {}}, 422),
        ("move", {"arrays": {"attic": {"position_m": [1, 1, 1]}}}, 404),
        ("move", {"arrays": {"south": {"position_m": [1, 1]}}}, 422),
        ("refine", {"known": ["attic"]}, 404),
        ("refine", {"known": ["north"]}, 422),  # too few sounds
        ("measure", {"claps": [{"number": 7, "place_m": [1, 1, 1]}]}, 404),
        ("accept", {"id": "none"}, 404),
        ("accept", {}, 422),
    ],
)
def test_requests_that_cannot_be_met_are_refused(client: httpx.Client, path: str, value: Any, status: int) -> None:
    assert post(client, path, value, status)["detail"]


def test_a_measurement_beside_another_one_does_not_wait(
    server: Server, client: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    reached, release = threading.Event(), threading.Event()

    def slow(*_: Any) -> Any:
        reached.set()
        assert release.wait(HANG_S)
        raise ValueError("released")

    monkeypatch.setattr(set_up, "measure_set_up", slow)
    request = clapped(server, 4)
    first = threading.Thread(target=post, args=(client, "measure", request, 422))
    first.start()
    try:
        assert reached.wait(HANG_S)
        told = "another measurement is running; try again in some seconds"
        assert post(client, "measure", request, 409)["detail"] == told
    finally:
        release.set()
        first.join(HANG_S)
