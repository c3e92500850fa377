"""`livessl locate`: its output, and recordings that do not fit."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import soundfile

from cli.command_runs import Recorded, Run
from small_site import RATE_HZ, hiss, write_site, write_wav


def test_locate_prints_every_promised_field(run: Run, recorded: Recorded) -> None:
    done = run("locate", "--site", recorded.site, *recorded.wavs(), "--json")
    assert done.code == 0
    assert done.err == ""
    events = done.objects
    truth = [json.loads(line) for line in (recorded.directory / "truth.jsonl").read_text().splitlines()]
    assert len(events) == len(truth) == 2
    for event, source in zip(events, truth, strict=True):
        assert set(event) >= {
            "kind", "id", "time_utc", "start_s", "duration_s", "position_m", "covariance_m2", "confidence", "arrays",
            "method", "status", "reason",
        }  # fmt: skip
        assert event["kind"] == "event"
        assert event["time_utc"] is None
        assert event["status"] == "located"
        assert event["method"] == "onset"
        assert np.shape(event["covariance_m2"]) == (3, 3)
        # half the diagonal of a cell of 0.25 m; sound travels at most 7 m in 0.02 s, and frames are 0.05 s long
        assert np.linalg.norm(np.subtract(event["position_m"], source["position_m"])) < 0.22
        assert event["start_s"] == pytest.approx(source["start_s"], abs=0.15)


def test_locate_twice_gives_the_same_bytes(run: Run, recorded: Recorded) -> None:
    arguments = ["locate", "--site", recorded.site, *recorded.wavs(), "--json"]
    first, second = run(*arguments), run(*arguments)
    assert first.out == second.out != ""
    swapped = run(*arguments[:3], *recorded.wavs()[2:], *recorded.wavs()[:2], "--json")
    assert swapped.out == first.out  # the order of the arrays does not matter either


def test_locate_prints_one_line_per_event(run: Run, recorded: Recorded) -> None:
    done = run("locate", "--site", recorded.site, *recorded.wavs())
    lines = done.out.splitlines()
    assert len(lines) == 2
    for line in lines:
        assert re.match(
            r" +\d+\.\d\d s .*\(.+,.+,.+\) +± \d\.\d\d m .*confidence \d\.\d\d .*located .*north, south", line
        )


def test_locate_uses_the_given_channels(run: Run, recorded: Recorded, tmp_path: Path) -> None:
    """Microphones on other channels of the file give the same events if --channels lists those channels."""
    samples = soundfile.read(recorded.directory / "north.wav", dtype="float32")[0].T
    shuffled = np.vstack([hiss(samples.shape[1] / RATE_HZ, 4), samples[[3, 2, 1, 0]]])
    path = write_wav(tmp_path / "n.wav", shuffled)
    common = ["locate", "--site", recorded.site, "--json"]
    expected = run(*common, *recorded.wavs()).out
    assert run(*common, *recorded.wavs(north=path), "--channels", "north=8,7,6,5").out == expected
    assert run(*common, *recorded.wavs(north=path)).out != expected


def test_silence_exits_0_with_a_note_why_no_event_was_found(run: Run, recorded: Recorded, tmp_path: Path) -> None:
    path = write_wav(tmp_path / "quiet.wav", hiss(2.0, level=1e-4))
    done = run("locate", "--site", recorded.site, "--wav", f"north={path}", "--json")
    assert (done.code, done.out) == (0, "")
    assert done.err.startswith("livessl: note: no sound found: ")


def bad_file(path: Path, name: str) -> Path:
    good = hiss(0.5)
    if name == "too few channels":
        write_wav(path, good[:3])
    elif name == "another rate":
        write_wav(path, good, 44100)
    elif name == "zero length":
        write_wav(path, good[:, :0])
    elif name == "NaN":
        good[1, 17] = np.nan
        write_wav(path, good)
    elif name == "all zero":
        write_wav(path, 0 * good)
    elif name == "no sound file":
        path.write_text("dear diary", encoding="utf-8")
    return path


BAD_FILES = {
    "too few channels": "expected 4 channels, one for each microphone of array 'north', got 3",
    "another rate": "expected 16000 Hz for array 'north', got 44100 Hz; resample the file or correct nodes.lab-pc.dev",
    "zero length": "expected sound, got a file of zero length; record it again",
    "NaN": "expected finite samples, got NaN or infinity at sample 17 of channel 2; export it again",
    "all zero": "expected sound, got all-zero samples; was the right input recorded?",
    "no sound file": "expected a WAV or FLAC file, cannot read it",
    "missing": "expected a WAV or FLAC file, cannot read it: no such file",
}


@pytest.mark.parametrize("name", BAD_FILES)
@pytest.mark.parametrize("command", ["locate", "capture", "record"])
def test_unusable_recording_is_an_error(run: Run, recorded: Recorded, tmp_path: Path, name: str, command: str) -> None:
    options: dict[str, list[object]] = {
        "locate": [],
        "capture": ["--node", "lab-pc"],
        "record": ["--node", "lab-pc", "--out", tmp_path / "out"],
    }
    path = bad_file(tmp_path / "n.wav", name)
    done = run(command, "--site", recorded.site, *options[command], *recorded.wavs(north=path))
    assert done.code == 2
    assert done.out == ""
    [line] = done.err.splitlines()
    assert line.startswith(f"livessl: error: {path}: {BAD_FILES[name]}")


def test_all_unusable_recordings_are_reported_at_once(run: Run, recorded: Recorded, tmp_path: Path) -> None:
    few, rate = write_wav(tmp_path / "few.wav", hiss(0.1, 2)), write_wav(tmp_path / "rate.wav", hiss(0.1), 48000)
    done = run(
        "locate", "--site", recorded.site, "--wav", f"west={few}", "--wav", f"north={few}", "--wav", f"south={rate}"
    )
    assert done.code == 2
    first, second, third = done.err.splitlines()
    assert "no such array; arrays are north, south" in first
    assert "got 2" in second
    assert "got 48000 Hz" in third


@pytest.mark.parametrize(
    ("channels", "message"),
    [
        ("north=1,2,3", "expected 4 different channel numbers from 1 to 4 for array 'north', got [1, 2, 3]"),
        ("north=1,2,3,5", "expected 4 different channel numbers from 1 to 4"),
        ("north=1,2,3,3", "expected 4 different channel numbers from 1 to 4"),
        ("west=1,2,3,4", "channels of array 'west': expected an array with a recording (north, south)"),
    ],
)
def test_invalid_channels_are_an_error(run: Run, recorded: Recorded, channels: str, message: str) -> None:
    done = run("locate", "--site", recorded.site, *recorded.wavs(), "--channels", channels)
    assert done.code == 2
    assert message in done.err


OWN = """
import numpy as np, livessl

class Corner(livessl.MapEstimator):
    def locate(self, sounds):
        return livessl.Localization(np.array([0.5, 0.5, 0.5]), 0.01 * np.eye(3), 0.5, self.evidence(sounds))

not_a_factory = 3
"""


@pytest.fixture
def own_methods(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A module with an estimator, in the current directory, which Python does not search by itself."""
    (tmp_path / "own_corner.py").write_text(OWN, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [entry for entry in sys.path if entry])
    yield "own_corner"
    sys.modules.pop("own_corner", None)


def test_method_of_ones_own_is_chosen_by_its_import_path(
    run: Run, recorded: Recorded, tmp_path: Path, own_methods: str
) -> None:
    method = f"{own_methods}:Corner"
    by_option = run("locate", "--site", recorded.site, *recorded.wavs(), "--method", method, "--json")
    site = write_site(tmp_path, {"fusion.method": method})
    by_site = run("locate", "--site", site, *recorded.wavs(), "--json")
    assert by_option.code == by_site.code == 0
    assert by_option.objects == by_site.objects
    assert [event["position_m"] for event in by_site.objects] == 2 * [[0.5, 0.5, 0.5]]
    assert {event["method"] for event in by_site.objects} == {method}


@pytest.mark.parametrize(
    ("method", "message"),
    [
        (
            "nowhere:Corner",
            "cannot import 'nowhere' for 'nowhere:Corner' (No module named 'nowhere'); install it",
        ),
        ("own_corner:Middle", "module 'own_corner' has no attribute 'Middle'; correct the name after the colon"),
        ("own_corner:not_a_factory", "expected a factory (arrays, grid, c_m_s) -> Estimator, got int; pass the class"),
    ],
)
@pytest.mark.parametrize("in_site", [False, True], ids=["option", "site file"])
@pytest.mark.usefixtures("own_methods")
def test_method_that_cannot_be_imported_is_one_error(
    run: Run, recorded: Recorded, tmp_path: Path, method: str, message: str, in_site: bool
) -> None:
    site = write_site(tmp_path, {"fusion.method": method}) if in_site else recorded.site
    for command in (["locate", *recorded.wavs()], ["serve"]):
        done = run(command[0], "--site", site, *command[1:], *([] if in_site else ["--method", method]))
        assert (done.code, done.out) == (2, "")
        assert re.match(r"livessl: error: (fusion\.)?method: ", done.err)
        assert message in done.err
        assert len(done.err.splitlines()) == 1


def test_site_file_called_evaluate_is_read_like_any_other(run: Run, recorded: Recorded, tmp_path: Path) -> None:
    site = write_site(tmp_path).rename(tmp_path / "evaluate")
    assert len(run("locate", *recorded.wavs(), "--site", site, "--json").objects) == 2


def test_refused_event_is_printed_without_numbers(run: Run, recorded: Recorded, tmp_path: Path) -> None:
    """One array of two that are needed gives no position, and so no spread."""
    site = write_site(tmp_path, {"fusion.min_arrays": 2})
    done = run("locate", "--site", site, *recorded.wavs()[:2])
    lines = done.out.splitlines()
    assert len(lines) == 2
    for line in lines:
        assert "refused" in line
        assert "nan" not in line
        assert "±" not in line
