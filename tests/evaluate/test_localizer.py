"""The localizer's campaign, in seconds: what is compared with what, and what its numbers mean."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from evaluate.small_campaign import CLASSES, RATE_HZ, write_sounds
from livessl.evaluate.campaign import Job, compute, read_clips, run_campaign
from livessl.evaluate.localizer import METHODS, LocalizerSettings, development_fit
from livessl.evaluate.localizer_report import area_under_roc, read_columns, summary, write_localizer_report

RT60S_S = (0.2,)
SNRS_DB = (float("inf"), 20.0)


def job(directory: Path, half: str = "test") -> Job:
    settings = LocalizerSettings(2, RT60S_S, SNRS_DB, seed=3, spacing_m=0.5, half=half)
    return Job(settings, read_clips(write_sounds(directory), CLASSES, RATE_HZ))


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("localizer")
    run_campaign(job(out / "sounds"), out / "out", jobs=1)
    return out / "out"


def test_every_event_is_located_by_both_and_ours_is_near(finished: Path) -> None:
    columns = read_columns(finished / "results.parquet")
    assert len(columns["position"]) == 2 * len(CLASSES) * len(RT60S_S) * len(SNRS_DB) * len(METHODS)
    assert {name.rstrip("0123456789")[-3:] + name[-1] for name in columns["clip"]} == {"lam2", "eys2"}  # the test half
    ours = columns["method"] == "onset"
    assert np.median(columns["error_m"][ours]) < 0.05  # dry: below half of any grid
    found = np.stack([columns[f"found_{axis}_m"] - columns[f"{axis}_m"] for axis in "xyz"], axis=1)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), columns["error_m"], atol=1e-4)
    assert (columns["confidence"][~ours] == 1.0).all()
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


def test_report_says_what_is_better_on_the_same_events(finished: Path) -> None:
    written = write_localizer_report(finished)
    assert all(path.stat().st_size for path in written)
    text = (finished / "report.md").read_text(encoding="utf-8")
    assert "more lost than the standard" in text
    assert (finished / "figures" / "localizer.png").exists()
    rows = summary(read_columns(finished / "results.parquet"))
    assert len(rows) == len(SNRS_DB) * (1 + len(CLASSES)) * len(METHODS)
    for row in rows:
        if row["method"] == "srp-phat":
            assert row["more_lost"] == 0.0
        assert row["more_lost_low"] <= row["more_lost"] <= row["more_lost_high"]


def test_area_under_roc_is_the_share_of_pairs_in_order() -> None:
    rng = np.random.default_rng(0)
    score, good = rng.integers(0, 9, 60).astype(float), rng.random(60) < 0.7
    pairs = [(g > b) + 0.5 * (g == b) for g in score[good] for b in score[~good]]
    assert area_under_roc(score, good) == pytest.approx(np.mean(pairs))
    assert np.isnan(area_under_roc(score, np.ones(60, dtype=bool)))


def test_fit_finds_the_odds_that_made_the_events() -> None:
    rng = np.random.default_rng(1)
    margin, standing = rng.uniform(0.0, 0.8, 40000), rng.uniform(0.0, 8.0, 40000)
    odds = -3.0 + 2.0 * margin + 1.0 * standing
    error_m = np.where(rng.random(40000) < 1.0 / (1.0 + np.exp(-odds)), 0.1, 2.0)
    fitted = development_fit({"margin": margin, "standing": standing, "error_m": error_m}, 0.5)
    # standard errors here, from the inverse of the information, are 0.06, 0.08 and 0.02
    np.testing.assert_allclose(fitted, (-3.0, 2.0, 1.0), atol=0.3)
    assert abs(development_fit({"margin": margin, "standing": standing, "error_m": -error_m + 2.0}, 0.5)[2] - 1.0) > 0.3
