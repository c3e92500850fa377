"""Sessions through the whole fusion, shortened to seconds: dry rooms, synthesised sounds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import soundfile

from evaluate.small_campaign import CLASSES, RATE_HZ, write_sounds
from livessl.cli.evaluate import add_arguments, evaluate
from livessl.lab.evaluate.campaign import run_campaign
from livessl.lab.evaluate.job import Job, read_clips
from livessl.lab.evaluate.moments import APART_M
from livessl.lab.evaluate.scenarios import SESSIONS
from livessl.lab.evaluate.sessions import BEFORE_S, SessionPosition, SessionSettings
from livessl.lab.evaluate.sessions_report import summary
from livessl.simulation.scene import synthesised_sounds

RT60_S = 0.2


def sounds(directory: Path) -> Path:
    write_sounds(directory)
    for seed in (1, 2):
        voice = dict(synthesised_sounds(RATE_HZ, seed))["voice"]
        soundfile.write(directory / f"speech{seed:03d}.wav", voice, int(RATE_HZ))
    return directory


def finished(directory: Path, scenario: str, positions: int = 1) -> Path:
    classes = ("speech",) if scenario == "walking" else CLASSES
    settings = SessionSettings(positions, scenario, (RT60_S,), (30.0,), seed=8)
    run_campaign(Job(settings, read_clips(sounds(directory / "sounds"), classes, RATE_HZ)), directory / "out", jobs=1)
    return directory / "out"


def summed(out: Path, scenario: str) -> dict[tuple[str, str], dict[str, float]]:
    rows = summary(pq.read_table(out / "results.parquet").to_pylist(), scenario)
    assert len(rows) == 2 * len(SESSIONS[scenario].cases)
    return {(row["case"], row["method"]): row for row in rows}


def test_each_sound_is_one_event_near_its_source_whatever_the_clocks(tmp_path: Path) -> None:
    out = finished(tmp_path, "clocks")
    found = summed(out, "clocks")
    right = found["clocks agree", "onset"]
    assert right["one_event"] == right["located"] == 1.0
    assert right["median_m"] < 0.1
    assert right["more_lost_low"] <= right["more_lost"] <= right["more_lost_high"]
    rows = pq.read_table(out / "results.parquet").to_pylist()

    def middles_s(case: str) -> list[float]:
        return [
            row["time_s"] for row in rows if (row["case"], row["kind"]) == (case, "event") and row["method"] == "onset"
        ]

    # the second array's clock is the one that is off, so an event that both make begins or ends late
    assert middles_s("150 ms off") != middles_s("clocks agree")
    assert found["100 ppm fast", "onset"]["grown"] == pytest.approx(1.0, abs=0.5)


def test_pairs_keep_their_distance_and_single_sounds_are_found(tmp_path: Path) -> None:
    out = finished(tmp_path, "two-sources")
    found = summed(out, "two-sources")
    assert found["alone", "onset"]["all_found"] == 1.0
    assert found["two at once", "onset"]["any_found"] == 1.0
    rows = pq.read_table(out / "results.parquet").to_pylist()
    both = [row for row in rows if (row["kind"], row["case"]) == ("truth", "two at once")]
    one, other = (np.array([row[f"{axis}_m"] for axis in "xyz"]) for row in both)
    assert np.linalg.norm(one - other) >= APART_M
    assert one.tolist() == [
        next(row[f"{axis}_m"] for row in rows if (row["kind"], row["case"]) == ("truth", "alone")) for axis in "xyz"
    ]


def test_command_tracks_a_walking_talker(tmp_path: Path) -> None:
    import argparse

    parser = argparse.ArgumentParser()
    add_arguments(parser)
    asked = ["localizer", "--scenario", "walking", "--sounds", str(sounds(tmp_path / "sounds")), "--classes", "speech"]
    asked += ["--positions", "1", "--rt60", f"{RT60_S:g}", "--snr", "30", "--seed", "8", "--out", str(tmp_path / "out")]
    written = evaluate(parser.parse_args(asked), 1, lambda done, total: None)
    assert all(path.stat().st_size for path in written)
    assert (tmp_path / "out" / "figures" / "walks.png").exists()
    found = summed(tmp_path / "out", "walking")
    assert found["walks", "onset"]["detected"] > 0.5
    assert found["walks", "onset"]["rmse_m"] < 0.5
    truths = [row for row in pq.read_table(tmp_path / "out" / "results.parquet").to_pylist() if row["kind"] == "truth"]
    way_m = np.array([[row["x_m"], row["y_m"]] for row in truths if row["case"] == "walks"])
    times_s = np.array([row["time_s"] for row in truths if row["case"] == "walks"])
    steps = np.diff(times_s) < 0.06  # within a clip
    speeds_m_s = np.linalg.norm(np.diff(way_m, axis=0), axis=1)[steps] / np.diff(times_s)[steps]
    assert np.median(speeds_m_s) == pytest.approx(1.0, abs=1e-3)  # at a turn the way is shorter than the walk
    assert len({tuple(place) for place in way_m.tolist()}) > 50
    assert len({(row["x_m"], row["y_m"]) for row in truths if row["case"] == "stands"}) == 1


def test_sessions_are_reproducible_and_events_belong_to_their_moment(tmp_path: Path) -> None:
    clips = read_clips(sounds(tmp_path), CLASSES, RATE_HZ)
    settings = SessionSettings(1, "two-sources", (0.0,), (30.0,), seed=3)
    first, again = (SessionPosition(settings, clips).rows(4) for _ in range(2))
    assert str(first) == str(again)  # as text, because NaN does not equal itself
    events = [row for row in first if row["kind"] == "event"]
    starts_s = {row["moment"]: row["time_s"] for row in first if row["kind"] == "truth"}
    assert all(abs(row["time_s"] - starts_s[row["moment"]]) < 2.0 + BEFORE_S for row in events)


def test_a_walk_without_speech_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="expected speech among them, got door_slam, dropped_keys"):
        SessionPosition(SessionSettings(1, "walking", (0.0,), (30.0,)), read_clips(sounds(tmp_path), CLASSES, RATE_HZ))
