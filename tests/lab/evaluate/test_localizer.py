"""The localizer's campaign, shortened to seconds: its comparisons and the meaning of its numbers."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import pytest

from evaluate.small_campaign import CLASSES, RATE_HZ, write_sounds
from livessl.cli.evaluate import add_arguments, evaluate
from livessl.core.geometry import speed_of_sound_m_s
from livessl.lab.evaluate.campaign import compute, run_campaign
from livessl.lab.evaluate.job import Job, read_clips
from livessl.lab.evaluate.localizer import METHODS, LocalizerSettings, development_fit
from livessl.lab.evaluate.localizer_report import read_columns, summary, write_localizer_report
from livessl.lab.evaluate.scenarios import ARRAYS, ROOM_C, ROOMS, SCENARIOS, Case
from livessl.lab.evaluate.statistics import area_under_roc

RT60S_S = (0.2,)
SNRS_DB = (float("inf"), 20.0)


def job(directory: Path, half: str = "test", scenarios: tuple[str, ...] = (ROOMS,), positions: int = 2) -> Job:
    settings = LocalizerSettings(positions, RT60S_S, SNRS_DB, seed=3, spacing_m=0.5, half=half, scenarios=scenarios)
    return Job(settings, read_clips(write_sounds(directory), CLASSES, RATE_HZ))


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("localizer")
    run_campaign(job(out / "sounds"), out / "out", jobs=1)
    return out / "out"


def test_both_methods_locate_every_event_and_onset_is_near(finished: Path) -> None:
    columns = read_columns(finished / "results.parquet")
    assert len(columns["position"]) == 2 * len(CLASSES) * len(RT60S_S) * len(SNRS_DB) * len(METHODS)
    assert {name.rstrip("0123456789")[-3:] + name[-1] for name in columns["clip"]} == {"lam2", "eys2"}  # the test half
    ours = columns["method"] == "onset"
    assert np.median(columns["error_m"][ours]) < 0.05  # dry: below half of any grid
    found = np.stack([columns[f"found_{axis}_m"] - columns[f"{axis}_m"] for axis in "xyz"], axis=1)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), columns["error_m"], atol=1e-4)
    assert np.isnan(columns["confidence"][~ours]).all()  # the standard gives no confidence
    assert ((columns["confidence"][ours] >= 0.0) & (columns["confidence"][ours] <= 1.0)).all()
    assert columns["located"][~ours].all()


def test_the_halves_share_no_clip(tmp_path: Path) -> None:
    import pyarrow.parquet as pq

    clips = {}
    for half in ("development", "test"):
        path = tmp_path / f"{half}.parquet"
        path.write_bytes(compute(job(tmp_path / "sounds", half), 0).parquet)
        clips[half] = set(pq.read_table(path).column("clip").to_pylist())
    assert clips["development"]
    assert not clips["development"] & clips["test"]


def test_report_compares_methods_on_the_same_events(finished: Path) -> None:
    written = write_localizer_report(finished)
    assert all(path.stat().st_size for path in written)
    text = (finished / "report.md").read_text(encoding="utf-8")
    assert "more lost than the standard" in text
    assert (finished / "figures" / "localizer.png").exists()
    rows = summary(read_columns(finished / "results.parquet"), ROOMS)
    assert len(rows) == len(SNRS_DB) * (1 + len(CLASSES)) * len(METHODS)
    for row in rows:
        if row["method"] == "srp-phat":
            assert row["more_lost"] == 0.0
        assert row["more_lost_low"] <= row["more_lost"] <= row["more_lost_high"]
        assert row["median_m_low"] <= row["median_m"] <= row["median_m_high"]


@pytest.fixture(scope="module")
def spoiled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("scenarios")
    every = tuple(name for name in SCENARIOS if name != ROOMS)
    run_campaign(job(out / "sounds", scenarios=every, positions=3), out / "out", jobs=1)
    return out / "out"


def test_a_case_has_the_same_events_whatever_other_cases_are_run(spoiled: Path, finished: Path) -> None:
    columns = read_columns(spoiled / "results.parquet")
    cases = {case.name for name, scenario in SCENARIOS.items() if name != ROOMS for case in scenario.cases}
    assert set(columns["case"]) == cases
    alone = read_columns(finished / "results.parquet")
    same = (columns["case"] == "two arrays") & (columns["position"] < 2)
    assert same.sum() == len(alone["case"])
    np.testing.assert_array_equal(columns["error_m"][same], alone["error_m"])
    assert (columns["error_m"][columns["case"] == "3 m apart"][:4] != alone["error_m"][:4]).all()


def test_faults_increase_the_error(spoiled: Path) -> None:
    columns = read_columns(spoiled / "results.parquet")
    ours = columns["method"] == "onset"

    def median_m(case: str) -> float:
        return float(np.median(columns["error_m"][ours & (columns["case"] == case)]))

    assert median_m("turned by 2 degrees") > 3.0 * median_m("two arrays")  # 2 degrees are 0.1 m at 3 m
    assert median_m("2 cm off") > 2.0 * median_m("two arrays")
    assert median_m("10 degrees too warm") > median_m("two arrays")
    one = ours & (columns["case"] == "one array")
    assert not columns["located"][one].any()  # one array does not determine the distance
    assert np.median(columns["bearing_deg"][one]) < 2.0


def test_report_relates_every_scenario_to_its_first_case(spoiled: Path) -> None:
    write_localizer_report(spoiled)
    text = (spoiled / "report.md").read_text(encoding="utf-8")
    for name, scenario in SCENARIOS.items():
        if name == ROOMS:
            continue
        assert f"## {scenario.title}\n" in text
        assert (spoiled / "figures" / f"{name}.png").exists()
        rows = summary(read_columns(spoiled / "results.parquet"), name)
        assert len(rows) == len(scenario.cases) * len(SNRS_DB) * len(METHODS)
        for row in rows:
            if row["case"] == scenario.cases[0].name:
                assert row["grown"] == row["grown_low"] == row["grown_high"] == 1.0
    one = [row for row in summary(read_columns(spoiled / "results.parquet"), "arrays") if row["case"] == "one array"]
    assert all(row["located"] == 0.0 and np.isnan(row["median_m"]) and row["lost"] == 1.0 for row in one)


def test_believed_poses_are_off_by_the_amount_of_the_case() -> None:
    case = Case("x", "abc", moved_m=0.3, turned_deg=20.0, of_one=True)
    believed = case.believed(1, np.random.default_rng(0))
    for spec in believed:
        true = ARRAYS[spec.name]
        shift_m = float(np.linalg.norm(spec.centre_m - true.centre_m))
        turned = (spec.microphones_m - spec.centre_m, true.microphones_m - true.centre_m)
        # of a regular tetrahedron about its centre, sum x x^T = s I, so trace(X^T Y) = s trace(R) = s (1 + 2 cos angle)
        cosine = 0.5 * (3.0 * np.trace(turned[0].T @ turned[1]) / np.square(turned[1]).sum() - 1.0)
        off = spec.name == "b"
        assert shift_m == pytest.approx(0.3 if off else 0.0, abs=1e-9)
        assert np.degrees(np.arccos(min(1.0, cosine))) == pytest.approx(20.0 if off else 0.0, abs=1e-3)
    left = Case("y", "abc", of_one=True, without_it=True)
    assert [left.used(number) for number in range(4)] == ["bc", "ac", "ab", "bc"]
    warm = Case("z", "ab", warmer_c=10.0)
    assert warm.c_m_s / 343.0 == pytest.approx(speed_of_sound_m_s(ROOM_C + 10.0) / speed_of_sound_m_s(ROOM_C), abs=1e-4)


def test_area_under_roc_is_the_share_of_pairs_in_order() -> None:
    rng = np.random.default_rng(0)
    score, good = rng.integers(0, 9, 60).astype(float), rng.random(60) < 0.7
    pairs = [(g > b) + 0.5 * (g == b) for g in score[good] for b in score[~good]]
    assert area_under_roc(score, good) == pytest.approx(np.mean(pairs))
    assert np.isnan(area_under_roc(score, np.ones(60, dtype=bool)))


def test_fit_recovers_the_odds_that_made_the_events() -> None:
    rng = np.random.default_rng(1)
    margin, standing = rng.uniform(0.0, 0.8, 40000), rng.uniform(0.0, 8.0, 40000)
    odds = -3.0 + 2.0 * margin + 1.0 * standing
    error_m = np.where(rng.random(40000) < 1.0 / (1.0 + np.exp(-odds)), 0.1, 2.0)
    fitted = development_fit({"margin": margin, "standing": standing, "error_m": error_m}, 0.5)
    # standard errors here, from the inverse of the information, are 0.06, 0.08 and 0.02
    np.testing.assert_allclose(fitted, (-3.0, 2.0, 1.0), atol=0.3)
    assert abs(development_fit({"margin": margin, "standing": standing, "error_m": -error_m + 2.0}, 0.5)[2] - 1.0) > 0.3


@pytest.mark.parametrize(
    ("option", "said"),
    [
        (["--scenario", "poses,walking"], "walking: each of noise, clocks, two-sources, walking is run alone"),
        (["--scenario", "nowhere"], "expected some of rooms, arrays, .*, got nowhere"),
        (["--snr", "loud"], "expected decibels such as 20 or inf,20,10, got 'loud'"),
        (["--snr", "nan"], "got 'nan'"),
        (["--scenario", "walking", "--spacing", "0.2"], "walking takes the spacing of the search grid from its site"),
    ],
)
def test_wrong_options_are_refused(tmp_path: Path, option: list[str], said: str) -> None:
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    asked = ["localizer", "--sounds", str(write_sounds(tmp_path)), "--out", str(tmp_path / "out"), *option]
    with pytest.raises(ValueError, match=said):
        evaluate(parser.parse_args(asked), 1, lambda done, total: None)
