"""The report on the localizer's campaign: tables against the paper's standard, and how far its confidence is right."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow.parquet as pq

from livessl.core.locate.confidence import LEAST_CONFIDENCE, NEAR_M
from livessl.core.types import BoolArray, FloatArray, Status
from livessl.lab.evaluate.figures.localizer import LocalizerCurve, ScenarioPoint, draw_localizer, draw_scenario
from livessl.lab.evaluate.localizer import METHODS, development_fit
from livessl.lab.evaluate.markdown import Block, Heading, Picture, Table, as_markdown
from livessl.lab.evaluate.scenarios import HALVES, ROOMS, SCENARIOS, Case
from livessl.lab.evaluate.statistics import NINETY_PERCENT, RESAMPLES, area_under_roc, with_interval, write_csv

STANDARD, OURS = METHODS

EDGES: Final = (0.0, 0.5, 0.7, 0.8, 0.9, 0.97, 1.0)
"""Limits of the classes of confidence whose events are compared with the truth."""

Columns = Mapping[str, Any]
"""Columns of the results by name, (n,) each, and `located` (n,) bool."""

SummaryRow = dict[str, Any]


def write_localizer_report(out: Path) -> list[Path]:
    """Write `summary.csv`, `report.md` and the figures into the folder of a campaign; return the two texts."""
    settings = json.loads((out / "campaign.json").read_text(encoding="utf-8"))["settings"]
    columns = read_columns(out / "results.parquet")
    rows = [row for name in settings["scenarios"] for row in summary(columns, name)]
    for name in settings["scenarios"]:
        if name == ROOMS:
            draw_localizer(out / "figures", _curves(columns))
        else:
            draw_scenario(out / "figures", name, _points([row for row in rows if row["scenario"] == name]))
    write_csv(out / "summary.csv", rows)
    (out / "report.md").write_text(as_markdown(_blocks(columns, rows, settings)), encoding="utf-8")
    return [out / name for name in ("summary.csv", "report.md")]


def read_columns(path: Path) -> Columns:
    """Read the columns of `results.parquet`."""
    table = pq.read_table(path)
    columns = {name: np.asarray(table.column(name).to_pylist()) for name in table.column_names}
    for name in ("confidence", "margin", "standing"):  # null for the standard
        columns[name] = columns[name].astype(np.float64)
    return columns | {"located": columns["status"] == Status.LOCATED.value}


def summary(columns: Columns, scenario: str) -> list[SummaryRow]:
    """Summarize each condition, case and method of a scenario, and for `ROOMS` each class of sound: one row each.

    `lost` is the share of events that are not located, or located more than `NEAR_M` off. `more_lost` is that share
    minus the standard's share on the same events. `grown` is the ratio of the median error to that of the scenario's
    first case, by the same method. Intervals are 99 % intervals by bootstrap over positions.
    """
    cases = {case.name: case for case in SCENARIOS[scenario].cases}
    first_case = next(iter(cases))
    sounds = ["all", *(sorted(set(columns["sound"].tolist())) if scenario == ROOMS else ())]
    rows: list[SummaryRow] = []
    for rt60_s, snr_db in _conditions(columns):
        for sound in sounds:
            here = (columns["rt60_s"] == rt60_s) & (columns["snr_db"] == snr_db)
            here &= (columns["sound"] == sound) | (sound == "all")
            for case in cases:
                chosen = {
                    m: np.flatnonzero(here & (columns["case"] == case) & (columns["method"] == m)) for m in METHODS
                }
                first = {
                    m: np.flatnonzero(here & (columns["case"] == first_case) & (columns["method"] == m))
                    for m in METHODS
                }
                for method in METHODS:
                    head = {"scenario": scenario, "case": case, "rt60_s": round(float(rt60_s), 3)}
                    head |= {"snr_db": float(snr_db), "sound": sound, "method": method}
                    row = _measured(columns, chosen[method], chosen[STANDARD], first[method])
                    rows.append(head | row | _outvoted(columns, chosen[method], cases[case]))
    return rows


def _conditions(columns: Columns) -> list[tuple[float, float]]:
    found = sorted(set(zip(columns["snr_db"].tolist(), columns["rt60_s"].tolist(), strict=True)))
    return [(rt60_s, snr_db) for snr_db, rt60_s in sorted(found, key=lambda each: (-each[0], each[1]))]


def _measured(columns: Columns, chosen: Any, standard: Any, first: Any) -> SummaryRow:
    """Summarize the chosen rows; the rows of the standard and of the first case are of the same events."""
    located = columns["located"][chosen]
    error_m, confidence = columns["error_m"][chosen], columns["confidence"][chosen]
    inside = columns["mahalanobis2"][chosen][located] <= NINETY_PERCENT
    lost = _by_position(columns, chosen, _lost(columns, chosen))
    more_lost = (lost - _by_position(columns, standard, _lost(columns, standard))).mean(axis=1)
    drawn = _drawn(len(lost))
    medians_m, first_m = _medians_m(columns, chosen, drawn), _medians_m(columns, first, drawn)
    grown = medians_m / first_m
    row: SummaryRow = {
        "events": len(chosen),
        "located": located.mean(),
        "direction_only": (columns["status"][chosen] == Status.DIRECTION_ONLY.value).mean(),
        **with_interval("median_m", medians_m),
        "p95_m": np.percentile(error_m[located], 95) if located.any() else np.nan,
        "over_0.5_m": (error_m[located] > NEAR_M).mean() if located.any() else np.nan,
        "bearing_deg": np.median(columns["bearing_deg"][chosen]),
        "inside_90": inside.mean() if located.any() else np.nan,
        "confidence": confidence.mean(),
        "right": (error_m <= NEAR_M).mean(),
        "lost": lost.mean(),
        **with_interval("more_lost", np.concatenate([[more_lost.mean()], more_lost[drawn].mean(axis=1)])),
        **with_interval("grown", grown),
    }
    return {name: value if name == "events" else round(float(value), 4) for name, value in row.items()}


def _outvoted(columns: Columns, chosen: Any, case: Case) -> SummaryRow:
    """Return the shares of events in which the faulty array was an outlier, and in which another array was."""
    bad = [case.faulty(number) if case.spoilt else "" for number in columns["position"][chosen].tolist()]
    named = [set(each or "") for each in columns["outvoted"][chosen].tolist()]
    it = np.mean([bool(of & set(which)) for which, of in zip(bad, named, strict=True)]) if case.spoilt else np.nan
    others = np.mean([bool(of - set(which)) for which, of in zip(bad, named, strict=True)])
    return {"outvotes_it": round(float(it), 4), "outvotes_others": round(float(others), 4)}


def _lost(columns: Columns, chosen: Any) -> BoolArray:
    return np.asarray(~columns["located"][chosen] | (columns["error_m"][chosen] > NEAR_M))


def _by_position(columns: Columns, chosen: Any, values: Any) -> FloatArray:
    """Arrange values of the chosen rows by position and class of sound: (positions, events)."""
    order = np.lexsort((columns["sound"][chosen], columns["position"][chosen]))
    positions = len(set(columns["position"][chosen].tolist()))
    return np.asarray(values[order].reshape(positions, -1), dtype=np.float64)


def _drawn(positions: int) -> Any:
    """Draw resamples of positions, (B, positions): the same for all conditions, so that differences are paired."""
    return np.random.default_rng(0).integers(positions, size=(RESAMPLES, positions))


def _medians_m(columns: Columns, chosen: Any, drawn: Any) -> FloatArray:
    """Return the median error of the located events, followed by its resamples: (1 + B,); NaN without such events."""
    error_m = np.where(columns["located"][chosen], columns["error_m"][chosen], np.inf)
    lines = _by_position(columns, chosen, error_m)
    resampled = np.sort(np.concatenate([lines.reshape(1, -1), lines[drawn].reshape(len(drawn), -1)]), axis=1)
    count = np.isfinite(resampled).sum(axis=1)
    rows, middle = np.arange(len(resampled)), np.maximum(count - 1, 0)
    medians = 0.5 * (resampled[rows, middle // 2] + resampled[rows, (middle + 1) // 2])
    return np.where(count > 0, medians, np.nan)


def _blocks(columns: Columns, rows: Sequence[SummaryRow], settings: Mapping[str, Any]) -> list[Block]:
    named = "" if settings["scenarios"] == [ROOMS] else f"--scenario {','.join(settings['scenarios'])} "
    listed = {"rt60": settings["rt60s_s"], "snr": settings["snrs_db"]}
    conditions = " ".join(f"--{name} {','.join(f'{value:g}' for value in values)}" for name, values in listed.items())
    blocks: list[Block] = [
        Heading(1, "The default localizer against the paper's standard"),
        f"{settings['positions']} positions anywhere in the paper's room, with one clip of each class at each "
        f"position; sounds of the {settings['half']} half, seed {settings['seed']}. White sensor noise is added below "
        "the event's mean power at the two arrays 5 m apart, over its whole recording including its reverberation. "
        f"Both methods get the same samples and refine below a grid of {settings['spacing_m']:g} m. An event is "
        f"refused if its confidence is below {LEAST_CONFIDENCE:g}.",
        f"Command: `livessl evaluate localizer {named}--sounds DIR --positions {settings['positions']} {conditions} "
        f"--seed {settings['seed']} --half {settings['half']} --out DIR`, with the sounds of DCASE 2016 task 2.",
        "*Median*, *95 %*, *over 0.5 m* and *in the 90 % ellipsoid* are over the located events; *direction error* is "
        "the median angle at the nearest array, over all events. *Lost* events are not located, or located more than "
        "0.5 m off; *more lost than the standard* is the difference on the same events, and below 0 is better. All "
        "intervals are 99 % intervals (bootstrap over positions).",
    ]
    for name in settings["scenarios"]:
        here = [row for row in rows if row["scenario"] == name]
        blocks += _rooms(columns, here) if name == ROOMS else _scenario(columns, name, here)
    return blocks


def _rooms(columns: Columns, rows: Sequence[SummaryRow]) -> list[Block]:
    of_rooms = columns["case"] == SCENARIOS[ROOMS].cases[0].name
    ours = of_rooms & (columns["method"] == OURS)
    features = {name: columns[name][ours].astype(np.float64) for name in ("error_m", "margin", "standing")}
    intercept, of_margin, of_standing = development_fit(features, NEAR_M)
    return [
        Heading(2, SCENARIOS[ROOMS].title),
        SCENARIOS[ROOMS].about,
        Table(_TITLES, [_cells(row) for row in rows if row["sound"] == "all"]),
        Picture(
            "localizer",
            "Left: share of events within a distance; refused events are never within it. Right: share over 0.5 m off "
            "among the events that are kept when the least confident ones are refused",
        ),
        Heading(3, "By class of sound"),
        Table(("sound", *_TITLES), [(row["sound"], *_cells(row)) for row in rows if row["sound"] != "all"]),
        Heading(3, "Confidence"),
        *_confidence(columns, [SCENARIOS[ROOMS].cases[0].name]),
        f"A logistic fit to these events would be {intercept:.2f} + {of_margin:.2f} margin + {of_standing:.2f} "
        f"peak-to-RMS ratio (the constants in use come from the {HALVES[0]} half).",
    ]


def _scenario(columns: Columns, name: str, rows: Sequence[SummaryRow]) -> list[Block]:
    scenario = SCENARIOS[name]
    first = scenario.cases[0].name
    titles = ["case", *_TITLES, f"ratio of the median to that of {first}"]
    cells = [[row["case"], *_cells(row), _grown(row) if row["case"] != first else ""] for row in rows]
    if any(case.spoilt for case in scenario.cases):
        titles += ["faulty array is an outlier", "another array is an outlier"]
        cells = [[*cell, *_outlier_cells(row)] for cell, row in zip(cells, rows, strict=True)]
    return [
        Heading(2, scenario.title),
        scenario.about,
        Table(titles, cells),
        Picture(
            name,
            "Above: median error of the located events, with its 99 % interval. Below: share of lost events. Filled: "
            f"{OURS}; hollow: {STANDARD}",
        ),
        *_confidence(columns, [case.name for case in scenario.cases]),
    ]


def _confidence(columns: Columns, cases: Sequence[str]) -> list[Block]:
    """Compare the confidence with the truth, over all conditions of each case."""
    classes = [f"{low:g} to {high:g}" for low, high in pairwise(EDGES)]
    rows = []
    for case in cases:
        ours = (columns["case"] == case) & (columns["method"] == OURS)
        confidence, right = columns["confidence"][ours], columns["error_m"][ours] <= NEAR_M
        area = area_under_roc(confidence, right)
        cells = [case, str(len(right)), f"{confidence.mean():.3f}", f"{right.mean():.3f}"]
        cells.append("" if np.isnan(area) else f"{area:.3f}")
        for low, high in pairwise(EDGES):
            within = (confidence >= low) & ((confidence < high) | (high == EDGES[-1]))
            mean, share = (f"{each[within].mean():.2f}" if within.any() else "" for each in (confidence, right))
            cells.append(f"{mean}: {share} of {within.sum()}" if within.any() else "")
        rows.append(cells)
    return [
        "The confidence of all events, located or not: its mean, the share of events that are right to within 0.5 m, "
        "and the area under the ROC curve of the one against the other. For each class of confidence: its mean, the "
        "share of events that are right, and the number of events.",
        Table(("case", "events", "mean confidence", "right", "area under ROC", *classes), rows),
    ]


_TITLES: Final = ("RT60", "SNR", "method", "located", "median", "95 %", "over 0.5 m", "in the 90 % ellipsoid",
                  "direction error", "lost", "more lost than the standard")  # fmt: skip


def _cells(row: SummaryRow) -> tuple[str, ...]:
    more = f"{100 * row['more_lost']:+.1f} ({100 * row['more_lost_low']:+.1f} to {100 * row['more_lost_high']:+.1f})"
    any_located = row["located"] > 0.0
    only = f", direction only {100 * row['direction_only']:.1f} %" if row["direction_only"] > 0.0 else ""
    return (
        f"{row['rt60_s']:g} s",
        _snr(row),
        row["method"],
        f"{100 * row['located']:.1f} %{only}",
        f"{row['median_m']:.3f} ({row['median_m_low']:.3f} to {row['median_m_high']:.3f}) m" if any_located else "",
        f"{row['p95_m']:.2f} m" if any_located else "",
        f"{100 * row['over_0.5_m']:.1f} %" if any_located else "",
        f"{100 * row['inside_90']:.0f} %" if any_located else "",
        f"{row['bearing_deg']:.1f}°",
        f"{100 * row['lost']:.1f} %",
        "" if row["method"] == STANDARD else f"{more} %",
    )


def _outlier_cells(row: SummaryRow) -> tuple[str, str]:
    if row["method"] == STANDARD:
        return "", ""
    it = f"{100 * row['outvotes_it']:.1f} %" if np.isfinite(row["outvotes_it"]) else ""
    return it, f"{100 * row['outvotes_others']:.1f} %"


def _grown(row: SummaryRow) -> str:
    if not np.isfinite(row["grown"]):
        return ""
    return f"{row['grown']:.2f} ({row['grown_low']:.2f} to {row['grown_high']:.2f})"


def _snr(row: SummaryRow) -> str:
    return f"{row['snr_db']:g} dB" if np.isfinite(row["snr_db"]) else "clean"


def _curves(columns: Columns) -> list[LocalizerCurve]:
    found = _conditions(columns)
    hard = [each for each in found if each[0] >= 1.0] or found
    curves = []
    for rt60_s, snr_db in hard:
        here = (columns["rt60_s"] == rt60_s) & (columns["snr_db"] == snr_db)
        here &= columns["case"] == SCENARIOS[ROOMS].cases[0].name
        ours = here & (columns["method"] == OURS)
        by_confidence = np.argsort(-columns["confidence"][ours], kind="stable")
        error_m = np.where(columns["located"], columns["error_m"], np.inf)
        curves.append(
            LocalizerCurve(
                f"RT {rt60_s:g} s, " + (f"{snr_db:g} dB" if np.isfinite(snr_db) else "clean"),
                {method: np.sort(error_m[here & (columns["method"] == method)]) for method in METHODS},
                columns["error_m"][ours][by_confidence] > NEAR_M,
            )
        )
    return curves


def _points(rows: Sequence[SummaryRow]) -> list[ScenarioPoint]:
    return [
        ScenarioPoint(
            row["case"],
            _snr(row),
            f"RT {row['rt60_s']:g} s, {row['method']}",
            row["method"] == OURS,
            (row["median_m"], row["median_m_low"], row["median_m_high"]),
            row["lost"],
        )
        for row in rows
    ]
