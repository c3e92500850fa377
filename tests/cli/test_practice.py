"""`livessl simulate` with claps at given places and faults made on purpose, and `livessl capture` on a session."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soundfile
import yaml

from cli.command_runs import Recorded, Run
from livessl.cli.node_input import recordings
from livessl.core.types import FRAME_NS
from livessl.errors import ConfigError
from livessl.recordings.session import SESSION_FILE
from small_site import RATE_HZ, site_of, write_site

NOW_NS = 1_767_225_600_012_345_678


def truth(session: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (session / "truth.jsonl").read_text(encoding="utf-8").splitlines()]


def simulated(run: Run, site: Path, out: Path, *options: object) -> list[dict[str, Any]]:
    done = run("simulate", "--site", site, "--out", out, "--rt60", 0, "--rate", RATE_HZ, *options)
    assert done.code == 0, done.err
    return truth(out)


def samples(session: Path, array: str) -> np.ndarray[Any, Any]:
    found, _ = soundfile.read(session / f"{array}.wav", dtype="float32", always_2d=True)
    return np.asarray(found.T)


def test_claps_are_made_at_the_places_in_their_order_with_the_pause(run: Run, tmp_path: Path) -> None:
    site = write_site(tmp_path)
    sounds = simulated(run, site, tmp_path / "claps", "--clap", "--at", "1,2,1.5", "--at=3,4.5,1", "--pause", 2)
    assert [one["position_m"] for one in sounds] == [[1.0, 2.0, 1.5], [3.0, 4.5, 1.0]]
    assert [one["name"] for one in sounds] == ["clap", "clap"]
    first, second = sounds
    assert 2.0 <= second["start_s"] - first["start_s"] - first["duration_s"] <= 2.6
    done = run("calibrate", "verify", "--session", tmp_path / "claps", "--truth", tmp_path / "claps/truth.jsonl")
    assert done.code == 0, done.out + done.err


def test_only_the_inverted_microphones_have_the_other_sign(run: Run, tmp_path: Path) -> None:
    site = write_site(tmp_path)
    simulated(run, site, tmp_path / "right", "--count", 1)
    simulated(run, site, tmp_path / "wrong", "--count", 1, "--inverted", "south=2,4")
    signs = np.array([[1], [-1], [1], [-1]], dtype=np.float32)
    right, wrong = (samples(tmp_path / name, "south") for name in ("right", "wrong"))
    assert np.abs(right).max() > 0.01
    assert wrong == pytest.approx(signs * right, abs=2.0 / 32768)
    assert (samples(tmp_path / "right", "north") == samples(tmp_path / "wrong", "north")).all()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("--at 1,1,9", "--at: expected a place inside the room of 4 x 5 x 3 m, got 1, 1, 9"),
        ("--at 1,1,1 --count 3", "expected --at or --count, got both; remove one of them"),
        ("--clap --sounds .", "expected --clap or --sounds, got both; remove one of them"),
        ("--inverted nroth=1", "expected one of the arrays north, south, got 'nroth'; did you mean 'north'?"),
        ("--inverted north=0", "--inverted north=0: expected microphones from 1 to 4; correct the number"),
        ("--inverted north=1 --inverted north=2", "expected each array once, got 'north' twice"),
    ],
)
def test_what_cannot_be_simulated_is_one_clear_error(run: Run, tmp_path: Path, options: str, words: str) -> None:
    done = run("simulate", "--site", write_site(tmp_path), "--out", tmp_path / "session", *options.split())
    assert done.code == 2
    assert words in done.err
    assert not (tmp_path / "session").exists() or not any((tmp_path / "session").iterdir())


def played(session: Path, changes: dict[str, Any] | None = None) -> list[Any]:
    arguments = argparse.Namespace(node="lab-pc", session=session, wav=[], channels=[], loop=False, start_at=None)
    return recordings(arguments, site_of(changes), NOW_NS)


def test_session_is_played_from_now_on_with_its_frames_as_they_were(recorded: Recorded) -> None:
    parts = played(recorded.directory)
    assert [part.array for part in parts] == ["north", "south"]
    assert [part.channels for part in parts] == [(1, 2, 3, 4)] * 2
    [start_ns] = {part.start_ns for part in parts}
    assert NOW_NS <= start_ns < NOW_NS + 2 * FRAME_NS
    assert start_ns % FRAME_NS == 0


def test_session_follows_the_order_of_inputs_in_the_site_file(recorded: Recorded) -> None:
    north, south = played(recorded.directory, {"nodes.lab-pc.arrays": {"north": [1, 3, 2, 4], "south": [5, 6, 7, 8]}})
    assert (north.channels, south.channels) == ((1, 3, 2, 4), (1, 2, 3, 4))


def test_session_without_an_array_of_the_node_is_refused(recorded: Recorded, tmp_path: Path) -> None:
    described = yaml.safe_load((recorded.directory / SESSION_FILE).read_text(encoding="utf-8"))
    described["pieces"] = [piece for piece in described["pieces"] if piece["array"] == "north"]
    (tmp_path / SESSION_FILE).write_text(yaml.safe_dump(described), encoding="utf-8")
    with pytest.raises(ConfigError, match="expected a recording of 'south', an array of node 'lab-pc', got north"):
        played(tmp_path)


def test_capture_takes_files_or_a_session(run: Run, recorded: Recorded, tmp_path: Path) -> None:
    options = ("capture", "--site", recorded.site, "--node", "lab-pc")
    done = run(*options, "--session", recorded.directory, *recorded.wavs())
    assert done.code == 2
    assert "capture: expected --wav or --session, got both; remove one of them" in done.err
    done = run(*options, "--session", tmp_path)
    assert done.code == 2
    assert "expected a recorded session" in done.err
