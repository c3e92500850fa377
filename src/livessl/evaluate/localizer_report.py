"""What the localizer's campaign found: tables against the paper's standard, honesty. It simulates and draws nothing."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow.parquet as pq

from livessl.core.certainty import LEAST_CONFIDENCE, NEAR_M, Signs
from livessl.core.types import BoolArray, FloatArray
from livessl.evaluate.command import HALVES
from livessl.evaluate.figures import LocalizerCurve, draw_localizer
from livessl.evaluate.localizer import METHODS, development_fit
from livessl.evaluate.report import Block, Heading, Picture, Table, as_markdown
from livessl.evaluate.statistics import INTERVAL, RESAMPLES, write_csv

NINETY_PERCENT: Final = 6.251
"""Quantile of chi-square with three degrees of freedom: the square of the 90 % ellipsoid."""

STANDARD, OURS = METHODS

Columns = Mapping[str, Any]
"""Name -> (n,) values of the results' rows, with `confidence` and `located` of `onset`."""


def write_localizer_report(out: Path) -> list[Path]:
    """Write `summary.csv`, `report.md` and the figure of the campaign in a folder, beside its results."""
    settings = json.loads((out / "campaign.json").read_text(encoding="utf-8"))["settings"]
    columns = read_columns(out / "results.parquet")
    rows = summary(columns)
    draw_localizer(out / "figures", _curves(columns))
    write_csv(out / "summary.csv", rows)
    (out / "report.md").write_text(as_markdown(_blocks(columns, rows, settings)), encoding="utf-8")
    return [out / name for name in ("summary.csv", "report.md")]


def read_columns(path: Path) -> Columns:
    """Read results; what is confident enough is worked out by today's constants."""
    table = pq.read_table(path)
    columns = {name: np.asarray(table.column(name).to_pylist()) for name in table.column_names}
    ours = columns["method"] == OURS
    confidence = np.ones(len(ours))
    signs = zip(columns["margin"][ours], columns["standing"][ours], strict=True)
    confidence[ours] = [Signs(float(margin), float(standing)).confidence for margin, standing in signs]
    return columns | {"confidence": confidence, "located": confidence >= LEAST_CONFIDENCE}


def summary(columns: Columns) -> list[dict[str, Any]]:
    """One row per condition, method and class of sound, and for all classes together.

    `lost` counts what is over `NEAR_M` off and what is refused; `more_lost` is that share minus the standard's on the
    same events, with a 99 % bootstrap interval over positions.
    """
    rows = []
    for rt60_s, snr_db in _conditions(columns):
        for sound in ("all", *sorted(set(columns["sound"].tolist()))):
            chosen = (columns["rt60_s"] == rt60_s) & (columns["snr_db"] == snr_db)
            chosen &= (columns["sound"] == sound) | (sound == "all")
            lost = {method: _lost(columns, chosen & (columns["method"] == method)) for method in METHODS}
            for method in METHODS:
                ours = chosen & (columns["method"] == method)
                located = ours & columns["located"]
                error = columns["error_m"][located]
                inside = columns["mahalanobis2"][located] <= NINETY_PERCENT
                low, high = _interval(lost[method] - lost[STANDARD])
                rows.append(
                    {
                        "rt60_s": round(float(rt60_s), 3),
                        "snr_db": float(snr_db),
                        "sound": sound,
                        "method": method,
                        "events": int(ours.sum()),
                        "located": round(float(located.sum() / ours.sum()), 4),
                        "median_m": round(float(np.median(error)), 4),
                        "p95_m": round(float(np.percentile(error, 95)), 4),
                        "over_0.5_m": round(float((error > NEAR_M).mean()), 4),
                        "inside_90": round(float(inside.mean()), 4),
                        "lost": round(float(lost[method].mean()), 4),
                        "more_lost": round(float((lost[method] - lost[STANDARD]).mean()), 4),
                        "more_lost_low": round(low, 4),
                        "more_lost_high": round(high, 4),
                    }
                )
    return rows


def area_under_roc(score: FloatArray, good: BoolArray) -> float:
    """Probability that a good event's score exceeds a bad one's; ties count half. NaN without one of either."""
    good_scores, bad_scores = np.sort(score[good]), score[~good]
    if len(good_scores) == 0 or len(bad_scores) == 0:
        return float("nan")
    below = np.searchsorted(good_scores, bad_scores, side="left")
    not_above = np.searchsorted(good_scores, bad_scores, side="right")
    return float(1.0 - (below + not_above).mean() / (2.0 * len(good_scores)))


def _conditions(columns: Columns) -> list[tuple[float, float]]:
    found = sorted(set(zip(columns["snr_db"].tolist(), columns["rt60_s"].tolist(), strict=True)))
    return [(rt60_s, snr_db) for snr_db, rt60_s in sorted(found, key=lambda each: (-each[0], each[1]))]


def _lost(columns: Columns, chosen: BoolArray) -> FloatArray:
    """Share of a position's events that are off or refused: (positions,), in the order of positions."""
    lost = ~columns["located"][chosen] | (columns["error_m"][chosen] > NEAR_M)
    _, place = np.unique(columns["position"][chosen], return_inverse=True)
    return np.asarray(np.bincount(place, weights=lost) / np.bincount(place))


def _interval(differences: FloatArray) -> tuple[float, float]:
    rng = np.random.default_rng(0)
    drawn = rng.integers(len(differences), size=(RESAMPLES, len(differences)))
    low, high = np.percentile(differences[drawn].mean(axis=1), INTERVAL)
    return float(low), float(high)


def _blocks(columns: Columns, rows: Sequence[dict[str, Any]], settings: Mapping[str, Any]) -> list[Block]:
    ours = columns["method"] == OURS
    good = columns["error_m"] <= NEAR_M
    intercept, of_margin, of_standing = development_fit(
        {name: columns[name][ours].astype(np.float64) for name in ("error_m", "margin", "standing")}, NEAR_M
    )
    return [
        Heading(1, "The localizer against the paper's standard"),
        f"{settings['positions']} positions anywhere in the paper's room, one clip of each class at each; two 0.5 m "
        f"tetrahedra 5 m apart; sounds of the {settings['half']} half, seed {settings['seed']}; white sensor noise "
        "below the event's mean power, over its whole recording with its reverberation. Both methods see the same "
        f"samples and refine below a grid of {settings['spacing_m']:g} m. Refused: confidence below "
        f"{LEAST_CONFIDENCE:g}.",
        f"Command: `livessl evaluate localizer --events DIR --positions {settings['positions']} "
        f"--seed {settings['seed']} --half {settings['half']} --out DIR`, with the sounds of DCASE 2016 task 2.",
        Table(_TITLES, [_cells(row) for row in rows if row["sound"] == "all"]),
        "Lost: more than 0.5 m off, or refused. More lost than the standard: difference on the same events, with its "
        "99 % interval (bootstrap over positions); below 0 is better.",
        Picture(
            "localizer",
            "Left: share of events within a distance, refused ones counted as never. Right: of the "
            "events kept when the least confident are refused, the share over 0.5 m off",
        ),
        Heading(2, "By class of sound"),
        Table(("sound", *_TITLES), [(row["sound"], *_cells(row)) for row in rows if row["sound"] != "all"]),
        Heading(2, "Honesty"),
        f'Area under the ROC of the confidence against "more than 0.5 m off", over all conditions: '
        f"{area_under_roc(columns['confidence'][ours], good[ours]):.3f}.",
        Table(("confidence", "events", "mean confidence", "right"), _calibration(columns, ours, good)),
        f"The logistic fit to these events would be {intercept:.2f} + {of_margin:.2f} margin + {of_standing:.2f} "
        f"standing (the constants come from the {HALVES[0]} half).",
    ]


_TITLES: Final = ("RT60", "SNR", "method", "events", "located", "median", "95 %", "over 0.5 m", "in the 90 % ellipsoid",
                  "lost", "more lost than the standard")  # fmt: skip


def _cells(row: Mapping[str, Any]) -> tuple[str, ...]:
    snr = f"{row['snr_db']:g} dB" if np.isfinite(row["snr_db"]) else "clean"
    more = f"{100 * row['more_lost']:+.1f} ({100 * row['more_lost_low']:+.1f} to {100 * row['more_lost_high']:+.1f})"
    return (
        f"{row['rt60_s']:g} s",
        snr,
        row["method"],
        str(row["events"]),
        f"{100 * row['located']:.1f} %",
        f"{row['median_m']:.3f} m",
        f"{row['p95_m']:.2f} m",
        f"{100 * row['over_0.5_m']:.1f} %",
        f"{100 * row['inside_90']:.0f} %",
        f"{100 * row['lost']:.1f} %",
        "" if row["method"] == STANDARD else f"{more} %",
    )


def _calibration(columns: Columns, ours: BoolArray, good: BoolArray) -> list[tuple[str, ...]]:
    edges = (0.0, 0.5, 0.7, 0.8, 0.9, 0.97, 1.0)
    rows: list[tuple[str, ...]] = []
    for low, high in pairwise(edges):
        within = ours & (columns["confidence"] >= low) & ((columns["confidence"] < high) | (high == 1.0))
        if within.any():
            mean, right = columns["confidence"][within].mean(), good[within].mean()
            rows.append((f"{low:g} to {high:g}", str(int(within.sum())), f"{mean:.3f}", f"{right:.3f}"))
    return rows


def _curves(columns: Columns) -> list[LocalizerCurve]:
    found = _conditions(columns)
    hard = [each for each in found if each[0] >= 1.0] or found
    curves = []
    for rt60_s, snr_db in hard:
        here = (columns["rt60_s"] == rt60_s) & (columns["snr_db"] == snr_db)
        ours = here & (columns["method"] == OURS)
        surest = np.argsort(-columns["confidence"][ours], kind="stable")
        error_m = np.where(columns["located"], columns["error_m"], np.inf)
        curves.append(
            LocalizerCurve(
                f"RT {rt60_s:g} s, " + (f"{snr_db:g} dB" if np.isfinite(snr_db) else "clean"),
                {method: np.sort(error_m[here & (columns["method"] == method)]) for method in METHODS},
                columns["error_m"][ours][surest] > NEAR_M,
            )
        )
    return curves
