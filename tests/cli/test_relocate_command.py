"""`livessl relocate`: stored events again, answer beside answer, resumed where it was stopped."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from cli.command_runs import Run
from livessl.server.clips.relocate_many import Task, relocate_one
from livessl.site.load import load_site
from small_site import Changes, write_site
from stored_clips import CLIPS, clipped, events, messages


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A site file beside the clips of its two events."""
    directory = tmp_path_factory.mktemp("site")
    clipped(directory, messages())
    return write_site(directory, {"server.clips": CLIPS})


def test_answers_stand_beside_each_other(run: Run, site: Path) -> None:
    done = run("relocate", "--site", site, "--method", "srp-phat", "--jobs", "1", "--json")
    assert (done.code, done.err) == (0, "")
    assert [found["event_id"] for found in done.objects] == [event.id for event in events()]
    for found, event in zip(done.objects, events(), strict=True):
        assert event.estimate is not None
        assert found["stored"]["position_m"] == pytest.approx(event.estimate.position_m, abs=1e-4)
        assert (found["stored"]["method"], found["again"]["method"]) == ("onset", "srp-phat")
        assert (found["again"]["status"], found["error"], found["set_up"]) == ("located", None, "then")
        assert 0.0 < found["distance_m"] < 0.2


def test_span_is_chosen_and_the_text_ends_with_the_distances(run: Run, site: Path) -> None:
    between = "2026-01-01T00:00:01Z"
    spans = [run("relocate", site.parent / "clips", "--site", site, "--jobs", "1", option, between)
             for option in ("--since", "--until")]  # fmt: skip
    told = [done.out.splitlines() for done in spans]
    assert [lines[0].split()[0] for lines in told] == [event.id for event in events()[::-1]]
    for done, (line, last) in zip(spans, told, strict=True):
        assert done.code == 0
        assert line.count("onset") == 2
        assert last.startswith("1 positions: median 0.00 m apart")
    nothing = run("relocate", "--site", site, "--since", "2027-01-01T00:00:00Z")
    assert (nothing.code, nothing.out) == (0, "")
    assert "no event of that span has recordings" in nothing.err


def test_second_run_goes_on_where_the_first_was_killed(run: Run, site: Path, tmp_path: Path) -> None:
    out = tmp_path / "answers.jsonl"
    common = ("relocate", "--site", site, "--method", "srp-phat", "--out", out)
    assert run(*common, "--jobs", "2").code == 0  # by two processes
    whole = out.read_bytes().splitlines(keepends=True)
    assert {json.loads(line)["event_id"] for line in whole} == {event.id for event in events()}
    out.write_bytes(whole[0] + whole[1][: len(whole[1]) // 2])  # killed while it wrote the second one
    done = run(*common, "--jobs", "1", "--json")
    assert [found["event_id"] for found in done.objects] == [json.loads(whole[1])["event_id"]]
    assert out.read_bytes().splitlines(keepends=True)[0] == whole[0]
    assert len(out.read_bytes().splitlines()) == 2
    assert run(*common, "--json").out == ""
    other = run("relocate", "--site", site, "--method", "averaged", "--out", out)
    assert other.code == 2
    assert "has answers of --method srp-phat --set-up then; name another file" in other.err
    out.write_text("{}\n")
    assert "expected answers of `livessl relocate`" in run(*common).err


def test_failed_event_is_tried_again(run: Run, tmp_path: Path) -> None:
    clipped(tmp_path, messages())
    site, out = write_site(tmp_path, {"server.clips": CLIPS}), tmp_path / "answers.jsonl"
    first, second = (event.id for event in events())
    recording = tmp_path / "clips" / first / "array-north.flac"
    whole = recording.read_bytes()
    common = ("relocate", "--site", site, "--out", out, "--jobs", "1", "--json")
    recording.unlink()
    for tried in ([first, second], [first]):  # still in vain
        done = run(*common)
        assert (done.code, [found["event_id"] for found in done.objects]) == (1, tried)
    recording.write_bytes(whole)
    done = run(*common)
    assert (done.code, [found["event_id"] for found in done.objects]) == (0, [first])
    held = [json.loads(line) for line in out.read_text().splitlines()]
    assert [(found["event_id"], found["error"]) for found in held] == [(second, None), (first, None)]
    assert run(*common).out == ""


@pytest.mark.parametrize(
    ("changes", "options"),
    [
        ({"arrays.south.position_m": [2.25, 3.8, 1.5]}, ()),
        ({"temperature_c": 31.0}, ()),
        ({"band_hz": [200.0, 4000.0]}, ()),
        ({"fusion.max_event_s": 7.0}, ()),
        ({"uncertainty.position_m": 0.03}, ()),
        ({"grid.spacing_m": 0.3}, ()),
        ({}, ("--joint", "both=north,south")),
    ],
)
def test_answers_of_another_calibration_are_refused(
    run: Run, tmp_path: Path, changes: Changes, options: tuple[str, ...]
) -> None:
    """Nothing is located: the file has the answer of one event, and the folder has no other."""
    (tmp_path / "clips").mkdir()
    out, server = tmp_path / "answers.jsonl", {"server.clips": CLIPS}
    site = load_site(write_site(tmp_path, server))
    held = relocate_one(Task(site, tmp_path / "clips", None, "now"), "gone-1")
    out.write_text(json.dumps(held) + "\n")
    command = ("relocate", "--set-up", "now", "--out", out, "--site")
    assert run(*command, tmp_path / "site.yaml").code == 0
    before = out.read_bytes()
    done = run(*command, write_site(tmp_path, {**server, **changes}), *options)
    assert done.code == 2
    assert "has answers of another calibration, --joint, site file, server or release" in done.err
    assert out.read_bytes() == before


def test_what_cannot_be_located_again_is_told(run: Run, tmp_path: Path) -> None:
    clipped(tmp_path, messages())
    first = events()[0].id
    (tmp_path / "clips" / first / "array-north.flac").unlink()
    (tmp_path / "clips" / ".partial-x").mkdir()
    site = write_site(tmp_path)
    done = run("relocate", tmp_path / "clips", "--site", site, "--jobs", "1", "--json")
    assert (done.code, len(done.objects)) == (1, 2)
    assert "its recording 'array-north.flac' is gone" in done.objects[0]["error"]
    assert (done.objects[0]["again"], done.objects[1]["error"]) == (None, None)
    without = run("relocate", "--site", site)
    assert without.code == 2
    assert "expected a folder of clips, as the site file has no server.clips; name it" in without.err
    missing = run("relocate", tmp_path / "nowhere", "--site", site)
    assert missing.code == 2
    assert "expected a folder of clips: No such file or directory; give the folder of the clips as" in missing.err


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--out", "."), "--out .: expected a file that can be written: Is a directory"),
        (("--out", "nowhere/a.jsonl"), "--out nowhere/a.jsonl: expected a file that can be written: No such file"),
        (("--method", "no_such_module:Name"), "method: cannot import 'no_such_module' for 'no_such_module:Name'"),
    ],
)
def test_wrong_option_is_one_error_before_all_events(
    run: Run, site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: tuple[str, str], message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    done = run("relocate", "--site", site, *options)
    assert (done.code, done.out, done.err.count("\n")) == (2, "", 1)
    assert message in done.err
