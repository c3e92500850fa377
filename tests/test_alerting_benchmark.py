"""The comparison of the service with and without alerts and clips; a run of it is docs/alerts.md."""

from __future__ import annotations

import random
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

import alerting

FIGURE = st.floats(0.5, 500.0)
RUN = st.fixed_dictionaries(
    {
        "latency_ms": st.fixed_dictionaries(dict.fromkeys(alerting.PERCENTILES, FIGURE)),
        "cpu_percent": FIGURE,
        "rss_mb": FIGURE,
    }
)


@given(runs=st.lists(RUN, min_size=1, max_size=5), factor=st.floats(0.5, 3.0), seed=st.integers())
def test_ratio_of_a_round_takes_out_how_fast_the_machine_was(
    runs: list[dict[str, Any]], factor: float, seed: int
) -> None:
    """However much the rounds differ: what costs the same factor in each of them has this ratio, in any order."""

    def scaled(run: dict[str, Any]) -> dict[str, Any]:
        latencies = {name: factor * value for name, value in run["latency_ms"].items()}
        return {"latency_ms": latencies, "cpu_percent": factor * run["cpu_percent"], "rss_mb": run["rss_mb"]}

    random.Random(seed).shuffle(runs)
    found = alerting.compared(runs, [scaled(run) for run in runs])
    for name, row in found.items():
        expected = 1.0 if name == "memory" else factor
        for ratio in ("ratio", "least_ratio", "largest_ratio"):
            assert row[ratio] == pytest.approx(expected, abs=1e-3)


def report(**changes: Any) -> dict[str, Any]:
    """What was measured in one round, with changes of the run with everything."""
    run = {"latency_ms": dict.fromkeys(alerting.PERCENTILES, 10.0), "cpu_percent": 20.0, "rss_mb": 200}
    run["nothing_dropped"] = True
    done = {"alerts": {"delivered": 9, "waiting": 1}, "clips": {"written": 8, "waiting": 1, "shed": 0, "failed": 0}}
    with_all = run | done | changes
    return {
        "machine": {"cpu": "a processor", "cores": 2, "load_before": 0.5},
        "demand": {"arrays": 4, "clients": 20, "seconds": 20.0, "rounds": 1},
        "without": [run],
        "with": [with_all],
        "compared": alerting.compared([run], [with_all]),
    }


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({}, []),
        ({"alerts": {"dead": 1, "delivered": 9}}, ["alerts: expected deliveries and nothing else"]),
        ({"alerts": {}}, ["alerts: expected deliveries and nothing else"]),
        ({"clips": {"written": 8, "failed": 1}}, ["clips: expected some and no failure"]),
        ({"latency_ms": {"p50": 11.5, "p95": 10.0, "p99": 90.0}}, ["latency p50: expected at most 1.1 times"]),
        ({"nothing_dropped": False}, ["1 of 1 runs with dropped or shed sound"]),
    ],
)
def test_what_is_lost_or_slower_is_a_fault(changes: dict[str, Any], said: list[str]) -> None:
    found = alerting.faults(report(**changes), 1.1)
    assert [fault[: len(text)] for fault, text in zip(found, said, strict=True)] == said


def test_table_replaces_the_one_before_and_nothing_else(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(f"before\n\n{alerting.BEGIN}old\n{alerting.END}\n\nafter\n", encoding="utf-8")
    for _ in range(2):
        alerting.write(page, alerting.document(report()))
        text = page.read_text(encoding="utf-8")
        assert (text.startswith("before\n"), text.endswith("after\n"), "old" in text) == (True, True, False)
        assert text.count("| latency p95 (ms) | 10 | 10 | 1.00, 1.00 to 1.00 |") == 1
    page.write_text("nothing", encoding="utf-8")
    with pytest.raises(ValueError, match="expected the lines <!-- begin alerting -->"):
        alerting.write(page, "")
