"""The benchmark of second sources: its intervals, and its fit."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import second_source
from livessl.core.locate.second_source import SecondSourceFeatures
from livessl.lab.evaluate.statistics import wilson


@pytest.mark.parametrize(
    ("count", "total", "low", "high"), [(0, 30, 0.0, 0.1135), (173, 200, 0.8106, 0.9055), (30, 30, 0.8865, 1.0)]
)
def test_intervals_are_those_of_wilson(count: int, total: int, low: float, high: float) -> None:
    assert wilson(count, total) == pytest.approx((low, high), abs=5e-4)


def test_the_fit_recovers_the_log_odds_that_sounds_were_drawn_by() -> None:
    rng = np.random.default_rng(3)
    true = np.array([-4.0, 2.0, 1.0, 3.0, 0.8])
    rows: list[dict[str, Any]] = []
    for _ in range(6000):
        features = {
            "above_all": rng.uniform(0.0, 2.0),
            "above_noise": rng.uniform(0.0, 2.0),
            "margin": rng.uniform(0.0, 0.5),
            "explained": rng.uniform(0.2, 1.0),
        }
        log_odds = true[0] + float(true[1:] @ SecondSourceFeatures(**features).terms)
        right = bool(rng.uniform() < 1.0 / (1.0 + np.exp(-log_odds)))
        rows.append({"kind": "two", "layout": "two", "pairs": [{"features": features, "right": right}]})
    share = np.mean([row["pairs"][0]["right"] for row in rows])
    fitted = second_source.fit(rows)
    assert fitted[1:] == pytest.approx(true[1:], rel=0.2)
    assert fitted[0] == pytest.approx(true[0] - np.log(share / (1.0 - share)), abs=0.4)  # both have the same weight
    near = [row | {"kind": "near", "pairs": [{**row["pairs"][0], "right": False}]} for row in rows]
    np.testing.assert_array_equal(second_source.fit(rows + near), fitted)
