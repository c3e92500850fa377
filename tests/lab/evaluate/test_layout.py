"""The experiments with a site file's room and arrays; the paper's own experiments stay as they were."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from evaluate.small_campaign import CLASSES, write_sounds
from livessl.cli.main import main
from livessl.lab.evaluate import campaign
from livessl.lab.evaluate.job import Job
from livessl.lab.evaluate.layout import layout_of
from livessl.lab.evaluate.paper import EXPERIMENTS, METHODS, Settings, experiment_of
from small_site import Changes, site_of, write_site

JOINT: Changes = {"joint.both": ["north", "south"]}
WEST: Changes = {"arrays.west": {"geometry": {"tetrahedron": {"edge_m": 0.2}}, "position_m": [0.5, 2.6, 1.1]}}


@pytest.fixture(autouse=True)
def _one_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compute in this process, because a worker takes seconds to start."""
    monkeypatch.setattr(
        campaign, "on_cores", lambda compute, job, wanted, cores: (compute(job, number) for number in wanted)
    )


def arguments(directory: Path, experiment: str, changes: Changes | None = None, *more: str) -> list[str]:
    sounds, site = write_sounds(directory / "sounds"), write_site(directory, changes)
    options = f"--positions 3 --rt60 0,0.3 --classes {','.join(CLASSES)} --jobs 1".split()
    folders = ["--site", str(site), "--sounds", str(sounds), "--out", str(directory / "out")]
    return ["evaluate", experiment, *options, *folders, *more]


def test_one_array_locates_with_each_array_of_a_site(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bounds = {"grid.bounds_m": [[0.5, 4.5], [1.0, 4.0], [1.2, 1.2]], "speed_of_sound_m_s": 340.0}
    assert main(arguments(tmp_path, "one-array", bounds)) == 0
    written = {Path(line).name for line in capsys.readouterr().out.split()}
    assert written == {"results.parquet", "summary.csv", "report.md"}, "without claims of the paper"
    rows = pq.read_table(tmp_path / "out" / "results.parquet").to_pylist()
    assert {(row["system"], row["method"]) for row in rows} == {(a, m) for a in ("north", "south") for m in METHODS}
    for row in rows:
        assert 0.5 <= row["x_m"] <= 4.0, "in the search volume, and in the room"
        assert 1.0 <= row["y_m"] <= 4.0
        assert row["z_m"] == row["found_z_m"] == pytest.approx(1.2)
    held = json.loads((tmp_path / "out" / "campaign.json").read_text())["settings"]
    assert held["layout"]["c_m_s"] == 340.0
    assert held["spacing_m"] == 0.25
    report = (tmp_path / "out" / "report.md").read_text()
    assert report.startswith("# The paper's experiments with other arrays")
    assert "![Median error against reverberation time: one-array-small](figures/one-array-small.png)" in report
    assert [path.name for path in (tmp_path / "out" / "figures").iterdir()] == ["one-array-small.png"]


def test_diversity_sums_all_arrays_and_joins_those_that_the_site_joins(tmp_path: Path) -> None:
    assert main(arguments(tmp_path, "diversity", JOINT, "--positions", "4")) == 0
    rows = pq.read_table(tmp_path / "out" / "results.parquet").to_pylist()
    systems = ("north", "south", "both", "all arrays")
    assert {(row["system"], row["method"]) for row in rows} == {(system, "srp-phat") for system in systems}
    dry = {s: [row["error_m"] for row in rows if row["system"] == s and row["rt60_s"] == 0.0] for s in systems}
    # the peak is in the source's cell or in one that touches it: less than a diagonal and a half of 0.25 m
    for system in ("both", "all arrays"):
        assert np.median(dry[system]) < 1.5 * 0.25 * np.sqrt(3.0), system
        assert np.median(dry[system]) < np.median(dry["north"])
    # another room, or other arrays, is another campaign
    assert main(arguments(tmp_path, "diversity", None)) == 2


def test_systems_are_single_arrays_joint_arrays_and_sums() -> None:
    layout = layout_of(site_of({**JOINT, **WEST}))
    systems = {system.name: system for system in experiment_of("diversity", layout).systems}
    assert {name: [spec.name for spec in system.arrays] for name, system in systems.items()} == {
        "north": ["north"],
        "south": ["south"],
        "west": ["west"],
        "both": ["both"],
        "all arrays": ["north", "south", "west"],
        "all arrays, joint ones as one": ["west", "both"],
    }
    both = systems["both"].arrays[0]
    np.testing.assert_array_equal(both.microphones_m, site_of(JOINT).array("both").microphones_m)


def test_campaigns_of_the_paper_keep_their_digest() -> None:
    """The digest is of a campaign that is older than layouts; with another digest it could not be continued."""
    settings = Settings("diversity", 10, (0.0, 0.2))
    assert Job(settings, {}).digest == "457c83e5be95efb80cdf334480b59e4b117c58b2b144b64f3e7555230c5f8090"
    assert experiment_of("diversity") is EXPERIMENTS["diversity"]
    assert EXPERIMENTS["diversity"].lag_rate_hz == 14000.0
    other = Settings("diversity", 10, (0.0, 0.2), layout=layout_of(site_of()))
    assert Job(other, {}).digest != Job(settings, {}).digest


@pytest.mark.parametrize(
    ("experiment", "changes", "more", "said"),
    [
        ("office", {}, (), "--site: expected one of one-array, diversity, got office, which has its own room"),
        ("report", {}, (), r"evaluate: --site and .* no effect with report, which simulates nothing; remove them"),
        ("diversity", {"arrays.south": ..., "nodes": {}}, (), "diversity expects two arrays or more, got north only"),
        ("one-array", {"arrays.north.band_hz": [4000, 6000]}, (), "array 'north': evaluate expects a band that begins"),
        ("one-array", {"arrays.north.band_hz": [100, 7000]}, (), "ends at 7000 Hz, expected 16334 Hz or more, got"),
        ("one-array", {"fusion.method": "music"}, (), r"site.yaml:\d+: fusion.method: expected one of"),
        ("one-array", {}, ("--rt60", "0.05"), "Sabine"),
    ],
)
def test_impossible_combinations_are_refused(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    experiment: str,
    changes: Changes,
    more: tuple[str, ...],
    said: str,
) -> None:
    assert main(arguments(tmp_path, experiment, changes, *more)) == 2
    [complaint] = capsys.readouterr().err.strip().splitlines()
    assert complaint.startswith("livessl: error: ")
    assert re.search(said, complaint), complaint
    assert not (tmp_path / "out").exists()
