"""Campaigns: their bytes do not depend on workers, order or interruptions."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from evaluate.small_campaign import CLASSES, small_job, write_sounds
from livessl.cli.main import main
from livessl.lab.evaluate import campaign
from livessl.lab.evaluate.campaign import run_campaign
from livessl.lab.evaluate.job import read_clips
from small_site import HANG_S, started, wait_until

POSITIONS = 10


@pytest.fixture
def one_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compute in this process, because a worker takes seconds to start."""
    monkeypatch.setattr(
        campaign, "on_cores", lambda compute, job, wanted, cores: (compute(job, number) for number in wanted)
    )


def arguments(sounds: Path, out: Path, jobs: int = 1) -> list[str]:
    given = {"events": sounds, "positions": POSITIONS, "rt": "0,0.2", "grid": 1.0, "seed": 5, "jobs": jobs, "out": out}
    options = [text for name, value in given.items() for text in (f"--{name}", str(value))]
    return ["evaluate", "one-array", "--classes", ",".join(CLASSES), *options]


def children(pid: int) -> list[int]:
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def finished(folder: Path) -> list[Path]:
    return list((folder / "parts").glob("*.parquet"))


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.processes
@pytest.mark.skipif(sys.platform != "linux", reason="looks at /proc")
def test_a_killed_and_resumed_campaign_gives_the_same_bytes(tmp_path: Path) -> None:
    sounds = write_sounds(tmp_path / "sounds")
    cut, whole = tmp_path / "cut", tmp_path / "whole"
    command = [sys.executable, "-m", "livessl", *arguments(sounds, cut)]
    with started(*command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        wait_until(lambda: len(finished(cut)) >= 3 or process.poll() is not None, "three positions")
        workers = children(process.pid)
        os.kill(process.pid, signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL, "the campaign ended before it could be killed"
        wait_until(lambda: not any(map(alive, workers)), f"the end of the workers {workers} of the killed command")
    kept = {path: path.read_bytes() for path in (cut / "parts").glob("*.parquet")}
    assert 3 <= len(kept) < POSITIONS
    assert not (cut / "results.parquet").exists()

    stamps = {path: path.stat().st_mtime_ns for path in kept}
    assert main(arguments(sounds, cut)) == 0
    assert {path: path.stat().st_mtime_ns for path in kept} == stamps  # no position was computed twice
    assert main(arguments(sounds, whole, jobs=2)) == 0
    for name in ("results.parquet", "summary.csv", "claims.csv"):
        assert (cut / name).read_bytes() == (whole / name).read_bytes()
    assert (
        pq.read_metadata(whole / "results.parquet").num_rows == POSITIONS * 2 * 2 * 2 * 3
    )  # RTs, sounds, sizes, methods


@pytest.mark.processes
@pytest.mark.parametrize("compiling", [False, True])
def test_an_interrupted_campaign_ends_soon(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, compiling: bool) -> None:
    """Thousands of positions are minutes, and so is the compilation of the kernels where there is no cache of them."""
    sounds, out = write_sounds(tmp_path / "sounds"), tmp_path / "out"
    if compiling:
        monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "kernels"))
    command = [sys.executable, "-m", "livessl", *arguments(sounds, out), "--positions", "5000"]
    with started(*command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:

        def begun() -> bool:
            return len(children(process.pid)) > 1 if compiling else bool(finished(out))

        wait_until(lambda: begun() or process.poll() is not None, "the first work")
        workers = children(process.pid)
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=HANG_S) == 130
        wait_until(lambda: not any(map(alive, workers)), f"the end of the workers {workers}")
    assert len(finished(out)) < 1000


@pytest.mark.filterwarnings("ignore::DeprecationWarning:distributed", "ignore::ResourceWarning")
def test_a_dask_cluster_gives_the_same_rows(tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    job = small_job(tmp_path / "sounds")
    here = run_campaign(job, tmp_path / "here", jobs=1)
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, dashboard_address=None, host="127.0.0.1"
    ) as cluster:
        there = run_campaign(job, tmp_path / "there", jobs=1, scheduler=cluster.scheduler_address)
    assert there.read_bytes() == here.read_bytes()


def test_a_larger_number_of_positions_continues_the_campaign(one_process: None, tmp_path: Path) -> None:
    few = run_campaign(small_job(tmp_path / "sounds", 1), tmp_path / "out", jobs=1)
    first = pq.read_table(few)
    seen: list[tuple[int, int]] = []
    more = run_campaign(
        small_job(tmp_path / "sounds", 2), tmp_path / "out", jobs=1, progress=lambda *done: seen.append(done)
    )
    table = pq.read_table(more)
    assert seen == [(1, 2), (2, 2)]
    assert table.slice(0, first.num_rows).to_pylist() == first.to_pylist()
    assert table.num_rows == 2 * first.num_rows
    one, other = (set(table.column("x_m").to_pylist()[part]) for part in (slice(0, 24), slice(24, 48)))
    assert one.isdisjoint(other)  # two positions


def test_a_campaign_continues_from_the_joined_results_alone(one_process: None, tmp_path: Path) -> None:
    run_campaign(small_job(tmp_path / "sounds", 2), tmp_path / "moved", jobs=1)
    shutil.rmtree(tmp_path / "moved" / "parts")
    seen: list[tuple[int, int]] = []
    moved = run_campaign(
        small_job(tmp_path / "sounds", 3), tmp_path / "moved", jobs=1, progress=lambda *done: seen.append(done)
    )
    assert seen[0] == (2, 3)
    whole = run_campaign(small_job(tmp_path / "sounds", 3), tmp_path / "whole", jobs=1)
    assert moved.read_bytes() == whole.read_bytes()


def test_report_covers_what_was_run(one_process: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run_campaign(small_job(tmp_path / "sounds", 1), tmp_path / "one", jobs=1)
    assert main(["evaluate", "report", "--with", str(tmp_path / "one"), "--out", str(tmp_path / "docs")]) == 0
    written = [Path(line) for line in capsys.readouterr().out.split()]
    assert {path.name for path in written} == {"summary.csv", "claims.csv", "claims.md", "report.md"}
    figures = {path.name for path in (tmp_path / "docs" / "figures").iterdir()}
    assert {"one-array.png", "gcc.png", "topology.png", "maps-pair.png"} <= figures
    assert all(name.endswith(".png") for name in figures)
    assert "office.png" not in figures
    assert main(["evaluate", "report", "--out", str(tmp_path / "docs")]) == 2
    assert main(["evaluate", "one-array", "--out", str(tmp_path / "docs")]) == 2
    assert capsys.readouterr().err.count("livessl: error") == 2


def test_a_folder_with_another_campaign_is_refused(one_process: None, tmp_path: Path) -> None:
    run_campaign(small_job(tmp_path / "sounds", 1), tmp_path / "out", jobs=1)
    with pytest.raises(ValueError, match="expected an empty folder or the same campaign"):
        run_campaign(small_job(tmp_path / "sounds", 1, seed=6), tmp_path / "out", jobs=1)


def test_the_class_of_a_clip_is_its_file_name_without_number(tmp_path: Path) -> None:
    clips = read_clips(write_sounds(tmp_path), ("phone", "door_slam"), 16000.0)
    assert {name: [clip for clip, _ in each] for name, each in clips.items()} == {
        "phone": ["phone001", "phone002"],
        "door_slam": ["door_slam001", "door_slam002"],
    }


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"--sounds": "nowhere"}, "expected a folder of sounds, got no such folder"),
        ({"--sounds": "empty"}, "expected WAV or FLAC files, got none"),
        ({"--classes": "door_slam,cat"}, "expected clips of cat .* door_slam, dropped_keys, phone, voice; .*--classes"),
        ({"--rt60": "fast"}, "--rt60: expected seconds such as 0,0.4,0.8 or 0:2:0.2, got 'fast'"),
        ({"--rt60": "0:2:0"}, "--rt60: expected seconds"),
        ({"--rt60": "0.05"}, "at least 0.17 s by Sabine"),
        ({"--spacing": "0"}, "--spacing: expected 0.02 to 2 metres"),
        ({"--rate": "8000"}, "--rate: the band ends at 6000 Hz"),
        ({"--with": "empty"}, "expected a finished campaign"),
    ],
)
def test_wrong_use_is_one_clear_error(
    changes: dict[str, str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sounds = write_sounds(tmp_path / "sounds")
    (tmp_path / "empty").mkdir()
    given = {"--sounds": "sounds", "--positions": "1", "--rt60": "0", "--spacing": "1", "--jobs": "1"} | changes
    options = []
    for name, value in given.items():
        options += [name, str(tmp_path / value) if name in {"--sounds", "--with"} else value]
    if "--classes" not in given:
        options += ["--classes", ",".join(CLASSES)]
    assert sounds.exists()
    assert main(["evaluate", "one-array", *options, "--out", str(tmp_path / "out")]) == 2
    complaint = capsys.readouterr().err.strip().splitlines()
    assert len(complaint) == 1
    assert complaint[0].startswith("livessl: error: ")
    assert re.search(message, complaint[0])
