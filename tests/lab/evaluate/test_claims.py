"""Medians, their intervals, and the verdicts on the paper's claims."""

from __future__ import annotations

import numpy as np
import pytest

from livessl.lab.evaluate.claims import claims
from livessl.lab.evaluate.markdown import Block, Heading, Table, as_markdown
from livessl.lab.evaluate.paper import RT60S_S
from livessl.lab.evaluate.statistics import Interval, Results, summary
from livessl.lab.evaluate.verdict import Verdict, judged

CLASSES = ("door", "keys", "phone", "speech")


def results(medians_m: dict[str, float], positions: int = 200, methods: tuple[str, ...] = ("srp-phat",)) -> Results:
    rng = np.random.default_rng(3)
    scatter = rng.lognormal(0.0, 0.1, (positions, len(CLASSES)))
    scatter /= np.median(scatter)
    zeros = np.zeros_like(scatter)
    values = {
        (system, method, rt60_s): {
            "error_m": median_m * scatter,
            "radial_m": zeros,
            "azimuth_deg": zeros,
            "elevation_deg": zeros,
        }
        for system, median_m in medians_m.items()
        for method in methods
        for rt60_s in RT60S_S
    }
    return Results("any", values, CLASSES, {rt60_s: np.full(positions, rt60_s) for rt60_s in RT60S_S})


METHODS = ("srp-phat", "cepstral", "averaged")


def by_name(**campaigns: Results) -> dict[str, tuple[Verdict, Interval | None]]:
    known = {name.replace("_", "-"): campaign for name, campaign in campaigns.items()}
    return {claim.name: (claim.verdict, claim.ours) for claim in claims(known)}


def test_every_number_of_the_paper_is_among_the_claims() -> None:
    text = " ".join(f"{claim.name} {claim.paper}" for claim in claims({}))
    for number in ("0.73 m", "0.64 m", "0.87 m", "0.8 s", "0.2 s", "0.4 s", "0.1 m", "0.6 s", "0.4 to 0.5 m", "0.44 m"):
        assert number in text
    for words in ("joint", "9.16", "0.13", "averaging", "cepstral", "2 m is worse", "±0.12", "±0.2 m", "±0.05"):
        assert words in text
    only_theory = [claim.name for claim in claims({}) if claim.verdict is not Verdict.UNDECIDED]
    assert only_theory == ["kd", "coherence"]  # without results nothing else is decided
    assert len({claim.name for claim in claims({})}) == len(claims({}))


def test_results_like_the_papers_reproduce_its_claims_and_others_do_not() -> None:
    good = by_name(
        one_array=results({"small": 0.73, "large": 0.64}, methods=METHODS),
        diversity=results(
            {"small": 0.80, "pair-0m": 0.72, "joint-8": 0.6, "pair-5m": 0.27}
            | {f"pair-{metres}m": 0.5 for metres in (1, 2, 3, 4)}
        ),
    )
    bad = by_name(
        one_array=results({"small": 1.73, "large": 1.64}, methods=METHODS),
        diversity=results({"small": 0.7, "pair-0m": 0.8, "joint-8": 0.9, "pair-5m": 1.4}),
    )
    for name in (
        "anechoic, small",
        "anechoic, large",
        "small within a cell to 0.8 s",
        "eight joint beat two at 0 m",
        "two at 0 m beat one",
        "5 m gain 0.4 m at least",
        "5 m gain 0.5 m at most",
        "large beats small when dry",
    ):
        assert good[name][0] is Verdict.REPRODUCED, name
        if name not in {"5 m gain 0.5 m at most", "large beats small when dry"}:
            assert bad[name][0] is Verdict.NOT_REPRODUCED, name
    assert good["small beats large above 0.4 s"][0] is Verdict.NOT_REPRODUCED
    # methods that are equal gain nothing: equal is not better
    assert good["cepstral helps, small"][0] is Verdict.NOT_REPRODUCED
    assert good["averaging hurts above 0.6 s"][0] is Verdict.NOT_REPRODUCED
    assert good["cepstral by 0.1 m at most, small"][0] is Verdict.REPRODUCED


def test_too_few_positions_decide_nothing() -> None:
    few = by_name(one_array=results({"small": 0.73, "large": 0.64}, positions=10, methods=METHODS))
    assert few["anechoic, small"][0] is Verdict.UNDECIDED
    assert few["anechoic, small"][1] is not None


@pytest.mark.parametrize(
    ("interval", "verdict"),
    [
        (Interval(0.5, 0.4, 0.6), Verdict.REPRODUCED),
        (Interval(0.5, 0.0, 1.0), Verdict.REPRODUCED),
        (Interval(0.9, 0.8, 1.1), Verdict.UNDECIDED),
        (Interval(1.5, 1.1, 1.6), Verdict.NOT_REPRODUCED),
        (Interval(-0.5, -0.6, -0.1), Verdict.NOT_REPRODUCED),
        (Interval(0.5, -0.1, 1.1), Verdict.UNDECIDED),
    ],
)
def test_verdict_follows_from_the_interval(interval: Interval, verdict: Verdict) -> None:
    assert judged(interval, (0.0, 1.0)) is verdict


def test_intervals_hold_the_median_and_narrow_with_the_root_of_the_number() -> None:
    widths = []
    for positions in (100, 1600):
        one = results({"small": 1.0}, positions)
        interval = Interval.of(one.medians("small", "srp-phat", 0.0))
        assert interval.low <= 1.0 <= interval.high
        widths.append(interval.high - interval.low)
    # the standard error of a median of n lognormals of scale s is 1.253 s / sqrt(n); 99 % are +-2.58 of it
    expected = 2.0 * 2.58 * 1.253 * 0.1 / np.sqrt(1600 * 4)
    assert widths[1] == pytest.approx(expected, rel=0.3)  # one sample's interval itself scatters
    assert widths[0] / widths[1] == pytest.approx(4.0, rel=0.4)


def test_differences_are_paired() -> None:
    both = results({"small": 1.0, "large": 1.1})
    difference = Interval.of(both.medians("large", "srp-phat", 0.0) - both.medians("small", "srp-phat", 0.0))
    alone = Interval.of(both.medians("small", "srp-phat", 0.0))
    # the same scatter at the same positions: what is left of the interval is a tenth of it
    assert difference.high - difference.low < 0.2 * (alone.high - alone.low)
    assert difference.low > 0.0


def test_positions_are_resampled_not_events() -> None:
    rng = np.random.default_rng(0)
    spread = rng.lognormal(0.0, 0.3, (200, 1))
    zero = np.zeros((200, 4))
    errors = {"error_m": np.repeat(spread, 4, axis=1), "radial_m": zero, "azimuth_deg": zero, "elevation_deg": zero}
    same = Results("any", {("small", "srp-phat", 0.0): errors}, CLASSES, {0.0: np.zeros(200)})
    interval = Interval.of(same.medians("small", "srp-phat", 0.0))
    # four equal errors at each place are worth one: twice the width that 800 would have
    as_if_independent = 2.0 * 2.58 * 1.253 * 0.3 / np.sqrt(800)
    assert interval.high - interval.low > 1.4 * as_if_independent


def test_summary_has_every_class_and_the_tails() -> None:
    rows = summary(results({"small": 0.6}))
    assert len(rows) == len(RT60S_S) * (1 + len(CLASSES))
    every = rows[0]
    assert every["sound"] == "all"
    assert every["events"] == 800
    assert every["q25_m"] < every["median_m"] < every["q75_m"] < every["p95_m"]
    assert every["over_0.5_m"] > 0.9
    assert every["over_1_m"] < 0.05


def test_markdown_escapes_bars_in_tables() -> None:
    blocks: list[Block] = [Heading(1, "a < b"), Table(("one",), [["|rho| < 1"]]), ("item",)]
    assert as_markdown(blocks) == "# a < b\n\n| one |\n| --- |\n| \\|rho\\| < 1 |\n\n- item\n"
