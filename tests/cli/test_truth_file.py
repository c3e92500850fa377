"""Places and times of the sounds of a simulated session, for `livessl calibrate --truth`."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cli.command_runs import Recorded, Run
from livessl.calibration import SAME_S, HeardSound, KnownSound, claps_by_time
from livessl.cli.truth_file import read_truth
from livessl.errors import RunError, UseError

BEGIN_S = 1_767_225_600.0


def heard(start_s: float) -> HeardSound:
    return HeardSound(BEGIN_S + start_s, None, "located", None, ())


@given(
    late_s=st.lists(st.floats(-0.9 * SAME_S, 0.9 * SAME_S), min_size=1, max_size=6),
    others=st.lists(st.integers(0, 5), max_size=3),
)
def test_each_sound_gets_the_place_of_its_time(late_s: list[float], others: list[int]) -> None:
    known = [KnownSound(2.0 * k, np.full(3, float(k))) for k in range(len(late_s))]
    sounds = [heard(one.start_s + late) for one, late in zip(known, late_s, strict=True)]
    noise = [heard(2.0 * k + 1.0) for k in others]
    claps = claps_by_time([*noise, *reversed(sounds)], known, BEGIN_S)
    assert [clap.sound.start_s for clap in claps] == [sound.start_s for sound in sounds]
    assert [float(clap.place_m[0]) for clap in claps] == [float(k) for k in range(len(late_s))]


def test_sounds_of_another_session_are_an_error() -> None:
    with pytest.raises(RunError, match="of the same session"):
        claps_by_time([heard(9.0)], [KnownSound(1.0, np.zeros(3))], BEGIN_S)


@pytest.mark.parametrize(
    "text", ["", "[]\n", '{"start_s": 1}\n', '{"start_s": NaN, "position_m": [1, 2, 3]}\n', "\xff"]
)
def test_another_file_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "truth.jsonl"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(UseError, match=r"expected the truth\.jsonl"):
        read_truth(path)


def test_a_simulated_session_is_verified_by_its_truth(run: Run, recorded: Recorded) -> None:
    truth = recorded.directory / "truth.jsonl"
    sounds = [json.loads(line) for line in truth.read_text(encoding="utf-8").splitlines()]
    done = run("calibrate", "verify", "--session", recorded.directory, "--truth", truth, "--json")
    claps = [line for line in done.objects if line["kind"] != "finding"]
    assert len(claps) == len(sounds)
    both = run("calibrate", "verify", "--session", recorded.directory, "--truth", truth, "--at", "1,2,1")
    assert (both.code, "remove one of them" in both.err) == (2, True)
    alone = run("calibrate", "verify", "--site", recorded.site, "--truth", truth)
    assert (alone.code, "give the session as --session DIR" in alone.err) == (2, True)
    without = run("calibrate", "verify", "--session", recorded.directory)
    assert (without.code, "--truth SESSION/truth.jsonl" in without.err) == (2, True)
