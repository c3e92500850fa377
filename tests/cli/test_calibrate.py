"""`livessl calibrate`: claps at known places verify a set-up, and measure the poses of its arrays."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
import soundfile
import yaml

from cli.command_runs import Recorded, Run
from livessl.cli.main import main
from livessl.core.types import Uncertainty as SiteUncertainty
from livessl.site.load import load_site
from small_site import RATE_HZ, write_site, write_wav

TURN_DEG = 25.0


@pytest.fixture(scope="module")
def claps(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    """Eight sounds in the small room; no test changes them."""
    directory = tmp_path_factory.mktemp("claps")
    site = write_site(tmp_path_factory.mktemp("site"))
    options = f"--rt60 0.2 --count 8 --rate {RATE_HZ} --seed 4".split()
    assert main(["simulate", "--site", str(site), "--out", str(directory), *options]) == 0
    return Recorded(directory, site)


def places(recorded: Recorded, count: int = 8) -> list[str]:
    """Options that say where the sounds were made."""
    truth = [json.loads(line) for line in (recorded.directory / "truth.jsonl").read_text().splitlines()]
    return [f"--at={','.join(str(x) for x in source['position_m'])}" for source in truth[:count]]


def test_a_right_set_up_is_verified_with_the_error_of_each_clap(run: Run, claps: Recorded) -> None:
    done = run("calibrate", "verify", "--session", claps.directory, *places(claps), "--json")
    assert (done.code, done.err) == (0, "")
    assert [one["kind"] for one in done.objects] == ["clap"] * 8
    assert all(one["error_m"] < 0.15 for one in done.objects)
    lines = run("calibrate", "verify", "--session", claps.directory, *places(claps)).out.splitlines()
    assert len(lines) == 8
    assert all("m off" in line for line in lines)


def test_four_claps_name_a_swap(run: Run, claps: Recorded, tmp_path: Path) -> None:
    first = [json.loads(line)["start_s"] for line in (claps.directory / "truth.jsonl").read_text().splitlines()][4]
    wavs = []
    for name in ("north", "south"):
        samples, _ = soundfile.read(claps.directory / f"{name}.wav", dtype="float32", always_2d=True)
        four = samples.T[:, : round((first - 0.2) * RATE_HZ)]
        wavs += [
            "--wav",
            f"{name}={write_wav(tmp_path / f'{name}.wav', four[[1, 0, 2, 3]] if name == 'north' else four)}",
        ]
    done = run("calibrate", "verify", "--site", claps.site, *wavs, *places(claps, 4), "--json")
    assert done.code == 1
    (finding,) = [one for one in done.objects if one["kind"] == "finding"]
    assert (finding["fault"], finding["array"]) == ("swapped", "north")
    assert "channels 1 and 2 of 'north' are swapped" in finding["message"]


def test_arrays_that_are_all_too_low_are_named(run: Run, claps: Recorded, tmp_path: Path) -> None:
    site = write_site(
        tmp_path, {"arrays.north.position_m": [1.9, 1.3, 0.9], "arrays.south.position_m": [2.2, 3.8, 1.0]}
    )
    done = run("calibrate", "verify", "--site", site, "--session", claps.directory, *places(claps), "--json")
    (finding,) = [one for one in done.objects if one["kind"] == "finding"]
    assert (done.code, finding["fault"], finding["array"]) == (1, "height", None)
    assert "0.50 m higher than the site file" in finding["message"]


def test_places_far_outside_the_room_are_refused(run: Run, claps: Recorded, tmp_path: Path) -> None:
    far = ["--at", "120,180,90", "--at", "1,2,1"]  # centimetres
    done = run("calibrate", "poses", "--site", write_site(tmp_path), "--session", claps.directory, *far)
    assert done.code == 2
    assert "--at: expected places in the room, 0, 0, 0 to 4, 5, 3 m" in done.err
    assert "got 120, 180, 90" in done.err


def turned_site(directory: Path) -> Path:
    """The small site with an array that is filed with a wrong yaw and place."""
    return write_site(
        directory,
        {"arrays.south.orientation_deg": {"yaw": TURN_DEG}, "arrays.south.position_m": [2.35, 3.7, 1.55]},
    )


def test_measured_poses_mend_a_wrong_site_file(run: Run, claps: Recorded, tmp_path: Path) -> None:
    site, written = turned_site(tmp_path), tmp_path / "calibration" / "lab.yaml"
    session = ["--site", site, "--session", claps.directory, *places(claps)]
    wrong = run("calibrate", "verify", *session, "--json")
    assert wrong.code == 1
    done = run("calibrate", "poses", *session, "--place-std", "0.01", "--write", written, "--json")
    assert done.code == 0
    assert "name it in the site file as calibration: calibration/lab.yaml" in done.err
    assert "it takes effect when the server starts" in done.err
    poses = {one["array"]: one for one in done.objects}
    assert poses["south"]["turn_deg"] == pytest.approx([0.0, 0.0, -TURN_DEG], abs=2.0)
    assert poses["south"]["misfit_us"][1] < 20.0 < poses["south"]["misfit_us"][0]
    assert np.linalg.norm(poses["north"]["shift_m"]) < 0.06

    calibrated = yaml.safe_load(site.read_text()) | {"calibration": "calibration/lab.yaml"}
    site.write_text(yaml.safe_dump(calibrated), encoding="utf-8")
    true = load_site(claps.site).array("south").microphones_m
    assert np.abs(load_site(site).array("south").microphones_m - true).max() < 0.06
    right = run("calibrate", "verify", *session, "--json")
    assert right.code == 0
    errors = [one["error_m"] for one in right.objects if one["kind"] == "clap"]
    assert np.median(errors) < 0.1


def test_a_calibration_file_is_put_back(run: Run, claps: Recorded, tmp_path: Path) -> None:
    written = tmp_path / "lab.yaml"
    written.write_text("arrays: {}\n")
    session = ["--session", claps.directory, *places(claps)]
    assert run("calibrate", "poses", *session, "--write", written).code == 0
    assert "microphones_m" in written.read_text()
    assert run("calibrate", "poses", *session, "--write", written, "--undo").code == 0
    assert written.read_text() == "arrays: {}\n"
    again = run("calibrate", "poses", *session, "--write", written, "--undo")
    assert again.code == 2
    assert "there is none" in again.err


def test_the_site_file_says_where_its_calibration_is_written_and_put_back(
    run: Run, claps: Recorded, tmp_path: Path
) -> None:
    site = turned_site(tmp_path)
    session = ["--site", site, "--session", claps.directory, *places(claps)]
    done = run("calibrate", "poses", *session, "--write")
    assert (done.code, "name it in the site file" in done.err) == (0, False)
    written = tmp_path / "calibration" / "small.yaml"
    first = yaml.safe_load(written.read_text())
    first["arrays"]["north"]["position_std_m"] = 0.05
    written.write_text(yaml.safe_dump({**first, "arrays": {"north": first["arrays"]["north"]}}))
    again = run("calibrate", "poses", *session, "--write")
    assert (again.code, "name it in the site file" in again.err) == (0, False)
    second = yaml.safe_load(written.read_text())
    known = load_site(site).array("south").uncertainty
    assert known.position_m == second["arrays"]["south"]["position_std_m"] != SiteUncertainty().position_m
    assert known.orientation_deg == second["arrays"]["south"]["orientation_std_deg"]
    assert known.temperature_c == SiteUncertainty().temperature_c
    assert "from calibration/small.yaml, and the site's" in run("config", "show", site).out
    assert set(second["arrays"]) == {"north", "south"}
    assert np.shape(second["arrays"]["south"]["covariance"]) == (6, 6)
    assert run("calibrate", "poses", "--site", site, "--undo").code == 0
    assert set(yaml.safe_load(written.read_text())["arrays"]) == {"north"}
    again = run("calibrate", "refine", "--site", site, "--undo")
    assert (again.code, "the file that --write has replaced; there is none" in again.err) == (2, True)
    assert run("calibrate", "refine", "--undo").code == 2


def test_a_calibration_is_put_back_although_its_site_file_does_not_load(run: Run, tmp_path: Path) -> None:
    site = write_site(tmp_path, {"calibration": "measured.yaml"})
    written, kept = tmp_path / "measured.yaml", tmp_path / "measured.yaml.before"
    written.write_text("arrays: {south: {microphones_m: [[99, 0, 0], [1, 1, 1]]}}\n")
    assert run("check", site).code == 2
    kept.write_text("arrays: {}\n")
    assert run("calibrate", "poses", "--site", site, "--undo").code == 0
    assert (written.read_text(), kept.exists()) == ("arrays: {}\n", False)
    site.write_text("[")
    broken = run("calibrate", "poses", "--site", site, "--undo")
    assert (broken.code, "give the calibration file as --write FILE" in broken.err) == (2, True)
    site.write_text("room: {}")
    nameless = run("calibrate", "poses", "--site", site, "--undo")
    assert (nameless.code, "expected site or calibration in" in nameless.err) == (2, True)


def test_a_failed_write_leaves_the_calibration_there(
    run: Run, claps: Recorded, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    written, kept = tmp_path / "lab.yaml", tmp_path / "lab.yaml.before"
    written.write_text("arrays: {}\n")
    kept.write_text("arrays: 1\n")
    session = ["--session", claps.directory, *places(claps)]
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        done = run("calibrate", "poses", *session, "--write", written)
    assert (done.code, "No space left" in done.err) == (2, True)
    assert (written.read_text(), kept.read_text()) == ("arrays: {}\n", "arrays: 1\n")
    written.unlink()
    assert run("calibrate", "poses", *session, "--write", written).code == 0
    assert yaml.safe_load(kept.read_text()) == {"arrays": {}}, "a kept file that is not the one before"


def test_poses_outside_the_room_are_not_written(run: Run, claps: Recorded, tmp_path: Path) -> None:
    site, written = write_site(tmp_path), tmp_path / "lab.yaml"
    written.write_text("arrays: {}\n")
    truth = [json.loads(line) for line in (claps.directory / "truth.jsonl").read_text().splitlines()]
    lower = [f"--at={x},{y},{z - 2.0}" for x, y, z in (source["position_m"] for source in truth)]
    done = run("calibrate", "poses", "--site", site, "--session", claps.directory, *lower, "--write", written)
    assert done.code == 1
    assert "within the room of 4 x 5 x 3 m, got microphone" in done.err
    assert written.read_text() == "arrays: {}\n"
    assert [path.name for path in tmp_path.glob("lab*")] == ["lab.yaml"]


def test_eight_sounds_are_too_few_to_refine(run: Run, claps: Recorded) -> None:
    done = run("calibrate", "refine", "--session", claps.directory)
    assert done.code == 1
    assert "expected 10 sounds or more that another array received, got 8; make 20 short sounds" in done.err


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("arrays: {south: {microphones_m: [[0, 0, 0], [1, 1, 1]]}}", "expected 4 microphones in the calibration file"),
        ("arrays: {east: {microphones_m: [[0, 0, 0], [1, 1, 1]]}}", "east"),
        ("arrays: 3", "arrays"),
        (None, "cannot be read"),
    ],
)
def test_a_calibration_file_that_does_not_fit_is_told(
    run: Run, tmp_path: Path, content: str | None, words: str
) -> None:
    if content is None:
        (tmp_path / "lab.yaml").mkdir()
    else:
        (tmp_path / "lab.yaml").write_text(content, encoding="utf-8")
    done = run("check", write_site(tmp_path, {"calibration": "lab.yaml"}))
    assert done.code == 2
    assert words in done.err + done.out


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--at", "1,2"], "expected x,y,z in metres"),
        (["--at", "1,2,3"], "expected --session DIR, or --wav ARRAY=FILE for each array"),
        (["--at", "1,2,x"], "expected metres"),
    ],
)
def test_wrong_use_is_told(run: Run, options: list[str], words: str) -> None:
    done = run("calibrate", "verify", *options)
    assert done.code == 2
    assert words in done.err


def test_more_places_than_sounds_are_told(run: Run, claps: Recorded) -> None:
    done = run("calibrate", "verify", "--session", claps.directory, *places(claps), "--at=1,1,1")
    assert done.code == 1
    assert "expected 9 sounds, one at each place in this order, got 8" in done.err


def test_three_claps_do_not_measure_a_pose(run: Run, recorded: Recorded) -> None:
    truth = [json.loads(line) for line in (recorded.directory / "truth.jsonl").read_text().splitlines()]
    at = [f"--at={','.join(str(x) for x in source['position_m'])}" for source in truth]
    done = run("calibrate", "poses", "--session", recorded.directory, *at)
    assert done.code == 1
    assert "expected 4 claps or more" in done.err
