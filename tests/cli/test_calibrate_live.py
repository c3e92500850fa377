"""`livessl calibrate` with a running server asks for claps, and takes the next sound as the clap."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from cli.command_runs import Run
from known_sounds import COUNT, at, events, finish, places_m
from livessl.cli import guided
from livessl.core.types import Event
from livessl.server.app import Server
from livessl.site.load import load_site
from small_site import running_server, site_of, write_site

Clapper = Callable[[Sequence[Event]], list[str]]


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    with running_server(site_of()) as server:
        yield server


@pytest.fixture
def clapper(server: Server, monkeypatch: pytest.MonkeyPatch) -> Clapper:
    """A user who claps whenever asked to; returns the list that fills with what was asked."""

    def with_claps(claps: Sequence[Event]) -> list[str]:
        prompts: list[str] = []
        left = iter(claps)

        def ask_for(text: str) -> None:
            prompts.append(text)
            if text.startswith("clap"):
                finish(server, next(left))

        monkeypatch.setattr(guided, "ask_for", ask_for)
        return prompts

    return with_claps


def test_verify_asks_for_each_clap_and_shows_its_error(server: Server, clapper: Clapper, run: Run) -> None:
    prompts = clapper(events())
    done = run("calibrate", "verify", "--url", server.url, *at(4), "--json")
    assert (done.code, done.err) == (0, "")
    assert [one["kind"] for one in done.objects] == ["clap"] * 4
    assert all(one["error_m"] < 0.15 for one in done.objects)
    assert [re.sub(r"[\d., ]+\(", "(", prompt) for prompt in prompts] == [f"clap at({n} of 4)" for n in range(1, 5)]
    for prompt, place_m in zip(prompts, places_m()[:4], strict=True):
        assert ", ".join(f"{x:.2f}" for x in place_m) in prompt


def test_verify_names_a_swap_with_the_input_of_the_site_file(
    server: Server, clapper: Clapper, run: Run, tmp_path: Path
) -> None:
    clapper(events((0, 2, 1, 3)))
    site = write_site(tmp_path)
    done = run("calibrate", "verify", "--site", site, "--url", server.url, *at(4), "--json")
    (finding,) = [one for one in done.objects if one["kind"] == "finding"]
    assert (done.code, finding["fault"], finding["array"]) == (1, "swapped", "south")


def test_a_sound_that_was_not_received_clearly_is_no_clap(server: Server, clapper: Clapper, run: Run) -> None:
    prompts = clapper([])
    clear = events()[0]
    murmur = replace(clear, received=())

    def ask_for(text: str) -> None:
        prompts.append(text)
        if text.startswith("clap"):
            server.parts.set_up_watch.heard.take(replace(murmur, start_ns=2**62))
        else:
            finish(server, clear)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(guided, "ask_for", ask_for)
        done = run("calibrate", "verify", "--url", server.url, *at(1))
    assert done.code == 0
    assert [prompt.strip()[:7] for prompt in prompts] == ["clap at", "a sound"]


def test_poses_are_measured_until_they_are_good_enough_and_stored(
    server: Server, clapper: Clapper, run: Run, tmp_path: Path
) -> None:
    prompts = clapper(events())
    site = write_site(tmp_path)
    done = run(
        "calibrate", "poses", "--site", site, "--url", server.url, *at(), "--place-std", "0.005", "--write", "--json"
    )
    assert done.code == 0, done.err
    asked = sum(prompt.startswith("clap") for prompt in prompts)
    assert (prompts[-1] == "good enough") == (asked < COUNT)
    poses = {one["array"]: one for one in done.objects if one["kind"] == "pose"}
    assert set(poses) == {"north", "south"}
    assert all(np.linalg.norm(pose["shift_m"]) < 0.06 for pose in poses.values())
    stored = yaml.safe_load((tmp_path / "calibration" / "small.yaml").read_text())
    assert (stored["method"], stored["sounds"], set(stored["arrays"])) == ("poses", asked, {"north", "south"})
    assert f"the server at {server.url} has other poses: its file is calibration/small.yaml" in done.err


def test_a_running_server_takes_over_what_is_written_and_undone(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    site = write_site(tmp_path, {"arrays.south.orientation_deg": {"yaw": 25.0}})
    left = iter(events())
    with running_server(load_site(site)) as turned:

        def ask_for(text: str) -> None:
            if text.startswith("clap"):
                finish(turned, next(left))

        monkeypatch.setattr(guided, "ask_for", ask_for)
        filed_m = turned.parts.set_up.site.array("south").microphones_m
        options = ["--site", site, "--url", turned.url]
        done = run("calibrate", "poses", *options, *at(), "--place-std", "0.005", "--write")
        assert done.code == 0, done.err
        assert f"the server at {turned.url} has taken over north, south" in done.err
        true_m = site_of().array("south").microphones_m
        assert turned.parts.set_up.site.array("south").microphones_m == pytest.approx(true_m, abs=0.06)
        undone = run("calibrate", "poses", *options, "--undo")
        assert (undone.code, f"the server at {turned.url} has taken over north, south" in undone.err) == (0, True)
        assert np.array_equal(turned.parts.set_up.site.array("south").microphones_m, filed_m)


def test_places_are_proposed_where_none_is_given(server: Server, run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []

    class EnoughError(Exception):
        pass

    def ask_for(text: str) -> None:
        if len(asked) == 3:
            raise EnoughError
        asked.append(text)
        finish(server, events()[len(asked)])

    monkeypatch.setattr(guided, "ask_for", ask_for)
    with pytest.raises(EnoughError):
        run("calibrate", "poses", "--url", server.url)
    assert all("proposed" in prompt for prompt in asked)
    assert len({prompt.split("(")[0] for prompt in asked}) == 3


def test_sounds_that_the_server_keeps_refine_a_turned_array(
    server: Server, clapper: Clapper, run: Run, tmp_path: Path
) -> None:
    count, kept = 14, 5
    sounds = events(count=count)
    server.parts.set_up_watch.forget()
    for event in sounds[:kept]:
        finish(server, event)
    prompts = clapper(sounds[kept:])
    site = write_site(tmp_path, {"arrays.south.orientation_deg": {"yaw": 25.0}})
    options = ["--site", site, "--url", server.url, "--count", str(count)]
    done = run("calibrate", "refine", *options, "--known", "north", "--write", "--json")
    assert len(prompts) == count - kept
    (pose, speed) = done.objects
    assert (done.code, pose["array"], speed["kind"]) == (0, "south", "speed"), done.err
    assert pose["turn_deg"] == pytest.approx([0.0, 0.0, -25.0], abs=3.0)
    assert np.linalg.norm(pose["shift_m"]) < 4.0 * pose["position_std_m"] + 0.02
    assert pose["misfit_us"][1] < 10.0 < pose["misfit_us"][0]
    assert abs(speed["speed_of_sound_m_s"] - site_of().c_m_s) < 4.0 * speed["std_m_s"] + 0.5
    stored = yaml.safe_load((tmp_path / "calibration" / "small.yaml").read_text())
    assert (stored["method"], set(stored["arrays"])) == ("refine", {"south"})
    stranger = run("calibrate", "refine", *options, "--known", "attic")
    assert (stranger.code, "expected an array of the site (north, south), got 'attic'" in stranger.err) == (2, True)


def of_one_array(event: Event, name: str) -> Event:
    return replace(event, received=tuple(one for one in event.received if one.evidence.spec.name == name))


def test_claps_that_different_arrays_received_only_ask_for_more(server: Server, clapper: Clapper, run: Run) -> None:
    prompts = clapper([of_one_array(event, ("north", "south")[k % 2]) for k, event in enumerate(events())])
    done = run("calibrate", "poses", "--url", server.url, *at(), "--place-std", "0.005", "--json")
    assert {one["array"] for one in done.objects if one["kind"] == "pose"} == {"north", "south"}
    assert sum(prompt.startswith("clap") for prompt in prompts) == COUNT
    assert sum("no array has received 4 of the claps clearly yet" in prompt for prompt in prompts) == 3


def test_sounds_that_one_array_received_do_not_count_for_refining(
    server: Server, clapper: Clapper, run: Run, tmp_path: Path
) -> None:
    sounds = events(count=14)
    server.parts.set_up_watch.forget()
    finish(server, of_one_array(sounds[0], "north"))
    prompts = clapper(sounds)
    options = ["--site", write_site(tmp_path), "--url", server.url, "--count", "10", "--known", "north"]
    run("calibrate", "refine", *options, "--json")
    assert [prompt.partition(" place ")[2] for prompt in prompts] == [f"({n} of 10)" for n in range(10)]


def test_a_server_that_joins_arrays_needs_its_site_file_to_write(run: Run, tmp_path: Path) -> None:
    with running_server(site_of({"joint": {"both": ["north", "south"]}, "fusion.min_arrays": 1})) as joining:
        options = ["--url", joining.url, "--at=1,1,1"]
        done = run("calibrate", "poses", *options, "--write", tmp_path / "lab.yaml", "--wait", "0.3")
        refined = run("calibrate", "refine", "--url", joining.url)
    assert done.code == 2
    assert "--write: the server joins arrays; give its site file as --site" in done.err
    assert (refined.code, "expected two arrays or more, got 1" in refined.err) == (2, True)


def test_a_clap_that_does_not_come_is_told(server: Server, run: Run) -> None:
    done = run("calibrate", "verify", "--url", server.url, *at(1), "--wait", "0.3")
    assert done.code == 1
    assert "within 0.3 s, and the server finished no sound" in done.err


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--url", "http://127.0.0.1:9", "--session", "x", "--at=1,1,1"], "give one of them"),
        (["--url", "http://127.0.0.1:9"], "expected --at X,Y,Z for each clap"),
    ],
)
def test_wrong_use_is_told(run: Run, options: list[str], words: str) -> None:
    done = run("calibrate", "verify", *options)
    assert done.code == 2
    assert words in done.err


def test_a_site_file_of_another_server_is_told(server: Server, run: Run, tmp_path: Path) -> None:
    site = write_site(tmp_path, {"arrays.west": {"microphones_m": [[1, 1, 1], [1.2, 1, 1]]}})
    done = run("calibrate", "verify", "--site", site, "--url", server.url, "--at=1,1,1")
    assert done.code == 2
    assert "expected the site file that the server at" in done.err
    open_port = run("calibrate", "verify", "--site", site, "--at=1,1,1")
    assert (open_port.code, "no fixed port of the server" in open_port.err) == (2, True)
