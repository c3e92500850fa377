"""Stored events are located again from their recordings: by a real server, and what it says where it cannot."""

from __future__ import annotations

import json
import shutil
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from clip_desk import ServedClips, served_clips
from livessl.cli.main import main
from livessl.core.types import Frame
from livessl.server.clips import relocate as relocation
from livessl.server.clips.relocate import SetUp
from livessl.server.clips.relocate_many import Task
from livessl.server.clips.stored_sound import stored_frames
from livessl.server.overload import Overload
from messages import event_message
from small_site import HANG_S, Changes, running_server, scene, site_of

pytestmark = pytest.mark.usefixtures("nothing_is_shed")


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServedClips]:
    with served_clips(tmp_path_factory.mktemp("site"), enhanced=False) as desk:
        yield desk


def test_answers_stand_beside_each_other(desk: ServedClips) -> None:
    known = ["onset", "srp-phat", "cepstral", "averaged"]
    for event, source in zip(desk.events(), scene().sources, strict=True):
        assert desk.get(f"events/{event['id']}/clips", role="viewer")["methods"] == known
        found = desk.relocate(event["id"], method="srp-phat")
        stored, again = found["stored"], found["again"]
        for name in ("method", "status", "reason", "position_m", "covariance_m2", "confidence", "arrays", "candidates"):
            assert stored[name] == event[name]
        assert (stored["method"], again["method"], again["status"]) == ("onset", "srp-phat", "located")
        assert again["arrays"] == ["north", "south"]
        assert np.linalg.norm(np.subtract(again["position_m"], source.position_m)) < 0.2
        apart_m = np.linalg.norm(np.subtract(again["position_m"], event["position_m"]))
        assert found["distance_m"] == pytest.approx(apart_m, abs=2e-3)
        assert found["digest"] == stated(desk, "srp-phat", "then")
        for answer in (stored, again):
            assert answer["std_m"] == pytest.approx(np.linalg.norm(answer["covariance_m2"], 2) ** 0.5, abs=1e-3)


def test_event_stays_as_it_is(desk: ServedClips) -> None:
    before = desk.events()
    found = desk.relocate(before[0]["id"])  # by its own method, with the poses of then
    assert (found["again"]["method"], found["set_up"], found["moved_arrays"]) == ("onset", "then", [])
    assert found["distance_m"] < 0.01
    assert found["digest"] == stated(desk, None, "then")
    again = desk.relocate(before[0]["id"], set_up="now")
    assert (again["set_up"], again["digest"]) == ("now", stated(desk, None, "now"))
    assert desk.events() == before


def stated(desk: ServedClips, method: str | None, set_up: SetUp) -> str:
    """The digest that the server states, which is that of the command for folders."""
    wanted = {"set_up": set_up} if method is None else {"method": method, "set_up": set_up}
    digest: str = desk.get("relocation-settings", role="viewer", **wanted)["digest"]
    assert digest == Task(desk.server.parts.site, desk.folder, method, set_up).digest
    return digest


def test_what_cannot_be_is_refused(desk: ServedClips) -> None:
    event = desk.events()[0]["id"]
    assert "no event 'nothing'" in desk.refusal(404, "nothing")
    refusal = desk.refusal(422, event, method="os:system")
    assert "expected one of onset, srp-phat, cepstral, averaged, got 'os:system'" in refusal
    assert "then" in desk.refusal(422, event, set_up="tomorrow")
    assert "extra_forbidden" in desk.refusal(422, event, methods=["onset"])
    assert desk.ask(f"events/{event}/relocate", "POST", "viewer", json={}).status_code == 403


def test_one_event_at_a_time(desk: ServedClips, monkeypatch: pytest.MonkeyPatch) -> None:
    event = desk.events()[0]["id"]
    begun, may_end = threading.Event(), threading.Event()
    usual = relocation.relocate

    def slow(*wanted: Any) -> relocation.Relocation:
        begun.set()
        assert may_end.wait(HANG_S)
        return usual(*wanted)

    monkeypatch.setattr(relocation, "relocate", slow)
    answers: list[dict[str, Any]] = []
    first = threading.Thread(target=lambda: answers.append(desk.relocate(event)))
    first.start()
    assert begun.wait(HANG_S)
    assert "another event is being located again; try again in some seconds" in desk.refusal(503, event)
    may_end.set()
    first.join(HANG_S)
    assert [answer["event_id"] for answer in answers] == [event]
    monkeypatch.undo()
    assert desk.relocate(event)["event_id"] == event


def test_live_sound_comes_first(desk: ServedClips, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Overload, "message", "behind")
    refusal = desk.refusal(503, desk.events()[0]["id"])
    assert "the server is overloaded, and live sound comes first; try again when it is not" in refusal


def blocking_frames(monkeypatch: pytest.MonkeyPatch) -> tuple[threading.Event, threading.Event]:
    """Make a relocation wait once it has read its first array; return events for that and for going on."""
    begun, may_go_on = threading.Event(), threading.Event()

    def slow(*wanted: Any) -> list[Frame]:
        begun.set()
        assert may_go_on.wait(HANG_S)
        return stored_frames(*wanted)

    monkeypatch.setattr(relocation, "stored_frames", slow)
    return begun, may_go_on


def test_relocation_gives_way_when_an_overload_begins(desk: ServedClips, monkeypatch: pytest.MonkeyPatch) -> None:
    event = desk.events()[0]["id"]
    begun, may_go_on = blocking_frames(monkeypatch)
    fusions: list[Any] = []
    with monkeypatch.context() as patch, ThreadPoolExecutor(1) as pool:
        patch.setattr(relocation, "events_of", lambda *wanted, **_: fusions.append(wanted))
        refused = pool.submit(desk.refusal, 503, event)
        assert begun.wait(HANG_S)
        patch.setattr(Overload, "message", "behind")
        may_go_on.set()
        assert "the server is overloaded, and live sound comes first" in refused.result(HANG_S)
    assert fusions == []
    assert desk.relocate(event)["event_id"] == event


def test_relocation_in_flight_does_not_delay_the_end(
    desk: ServedClips, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The request is answered and the server ends while the computation still hangs in one of its steps."""
    event = desk.events()[0]
    shutil.copytree(desk.folder / event["id"], tmp_path / "clips" / event["id"])
    begun, may_go_on = blocking_frames(monkeypatch)
    with ThreadPoolExecutor(1) as pool:
        with running_server(site_of({"server.clips": {"folder": "clips", "enhanced": False}}, tmp_path)) as server:
            server.parts.store.add(event_message(id=event["id"]), 1)
            url = f"{server.url}/api/v1/events/{event['id']}/relocate"
            waiting = pool.submit(httpx.post, url, json={"method": "onset"}, timeout=HANG_S)
            assert begun.wait(HANG_S)
        answer = waiting.result(HANG_S)
    assert (answer.status_code, "the server is stopping" in answer.text) == (503, True)
    hanging = [thread for thread in threading.enumerate() if thread.name == "relocate"]
    assert len(hanging) == 1
    may_go_on.set()
    hanging[0].join(HANG_S)
    assert not hanging[0].is_alive()


def test_sound_that_would_use_up_the_memory_is_refused(desk: ServedClips, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(relocation, "MOST_BYTES", 1000)
    refusal = desk.refusal(409, desk.events()[0]["id"])
    assert "too large for a running server" in refusal
    assert "locate the event with `livessl relocate`" in refusal


def test_damaged_clip_is_refused(desk: ServedClips) -> None:
    event = desk.events()[0]["id"]
    path = desk.folder / event / "clip.json"
    whole = path.read_bytes()
    about = json.loads(whole)
    about["arrays"]["north"]["uncertainty"]["humidity_percent"] = 5.0
    path.write_text(json.dumps(about))
    assert "expected a clip.json that this release can read" in desk.refusal(409, event)
    path.write_bytes(whole)  # for the other tests


def test_recordings_that_are_made_or_gone_are_told_apart(
    desk: ServedClips, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    event = desk.events()[1]["id"]
    shutil.copytree(desk.folder / event, tmp_path / event)
    with monkeypatch.context() as patch:
        patch.setattr(desk.clips, "is_waiting", lambda _: True)
        assert "are being made; try again in some seconds" in desk.refusal(409, event)
    (desk.folder / event / "array-north.flac").write_bytes(b"")
    assert "array-north.flac cannot be read" in desk.refusal(409, event)
    assert desk.ask(f"events/{event}/clips", "DELETE").status_code == 200
    assert "has no recordings; it cannot be located again without its sound" in desk.refusal(404, event)
    assert desk.get(f"events/{event}/clips")["methods"] == []
    (tmp_path / event).rename(desk.folder / event)  # for the other tests


def test_command_has_the_server_locate_its_events(
    desk: ServedClips, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, second = desk.events()
    token, out = tmp_path / "token", tmp_path / "answers.jsonl"
    token.write_text(desk.tokens["operator"], encoding="utf-8")
    at_server = ["relocate", "--url", desk.server.url, "--token-file", str(token)]
    command = [*at_server, "--json", "--out", str(out), "--method", "srp-phat"]
    clip = desk.folder / first["id"] / "clip.json"
    whole = clip.read_bytes()
    clip.write_bytes(b"")
    assert main(command) == 1
    clip.write_bytes(whole)
    damaged, located = map(json.loads, capsys.readouterr().out.splitlines())
    assert (damaged["event_id"], damaged["again"], located["error"]) == (first["id"], None, None)
    assert "expected a clip.json that this release can read, got another one: it is empty" in damaged["error"]
    assert (located["time_utc"], located["stored"]["method"]) == (second["time_utc"], "onset")
    assert (located["again"]["method"], located["again"]["status"]) == ("srp-phat", "located")
    assert 0.0 < located["distance_m"] < 0.2
    assert main(command) == 0  # only what has failed
    assert [json.loads(line)["event_id"] for line in capsys.readouterr().out.splitlines()] == [first["id"]]
    assert [json.loads(line)["event_id"] for line in out.read_text().splitlines()] == [second["id"], first["id"]]
    assert main([*command, "--set-up", "now"]) == 2
    assert "has answers of --method srp-phat --set-up then; name another file" in capsys.readouterr().err
    assert main([*at_server, "--until", first["time_utc"], "--method", "os:system"]) == 1
    assert "expected one of onset, srp-phat, cepstral, averaged, got 'os:system'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ([], "expected --site FILE or --url ADDRESS, got neither; give one"),
        (["--url", "http://127.0.0.1:9", "--jobs", "2", "clips"], "expected no folder and no --jobs with --url"),
    ],
)
def test_command_needs_a_site_file_or_a_server(
    options: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["relocate", *options]) == 2
    assert said in capsys.readouterr().err


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({}, "the site file has no server.clips; name a folder there"),
        ({"privacy": "positions-only"}, "with privacy: positions-only the server stores no sound"),
    ],
)
def test_server_without_sound_says_why(changes: Changes, why: str) -> None:
    with running_server(site_of(changes)) as server:
        server.parts.store.add(event_message(id="small-1"), 1)
        answer = httpx.post(f"{server.url}/api/v1/events/small-1/relocate", json={})
        assert (answer.status_code, why in answer.json()["detail"]) == (404, True)
