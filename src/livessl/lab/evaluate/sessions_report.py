"""What the sessions found: sounds, pairs of sources and tracks held against the truth. It simulates nothing."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow.parquet as pq

from livessl.core.locate.confidence import NEAR_M
from livessl.core.types import FloatArray, Status
from livessl.lab.evaluate.figures import Walk, draw_walks
from livessl.lab.evaluate.localizer import METHODS
from livessl.lab.evaluate.localizer_report import NINETY_PERCENT, area_under_roc
from livessl.lab.evaluate.report import Block, Heading, Picture, Table, as_markdown
from livessl.lab.evaluate.scenarios import SESSIONS
from livessl.lab.evaluate.sessions import COVARIANCE
from livessl.lab.evaluate.statistics import INTERVAL, RESAMPLES, write_csv
from livessl.lab.evaluate.tracking import CUT_OFF_M, assigned, ospa_m, score
from livessl.lab.evaluate.unit import Row

DRAWN: Final = 6
"""Walks that are shown."""

STANDARD, OURS = METHODS

Measured = Mapping[str, FloatArray]
"""What each session's sounds, pairs or walks came to: name -> (sessions, items), NaN where there is no such thing."""

SummaryRow = dict[str, Any]


def write_sessions_report(out: Path) -> list[Path]:
    """Write `summary.csv`, `report.md` and a figure of walks in a folder, beside its results."""
    settings = json.loads((out / "campaign.json").read_text(encoding="utf-8"))["settings"]
    rows = pq.read_table(out / "results.parquet").to_pylist()
    summed = summary(rows, settings["scenario"])
    write_csv(out / "summary.csv", summed)
    walks = _walks(rows)
    if walks:
        draw_walks(out / "figures", walks)
    (out / "report.md").write_text(as_markdown(_blocks(summed, settings, drawn=bool(walks))), encoding="utf-8")
    return [out / name for name in ("summary.csv", "report.md")]


def summary(rows: Sequence[Row], scenario: str) -> list[SummaryRow]:
    """One row per condition, case and method: each measure with its 99 % interval (bootstrap over sessions).

    `more_lost` is what is lost minus what the standard loses in the same sessions; `grown` is a median error over that
    of the scenario's first case.
    """
    measure, columns = _MEASURES[scenario]
    cases = [case.name for case in SESSIONS[scenario].cases]
    measured = _measured(rows, measure)
    summed: list[SummaryRow] = []
    for snr_db, rt60_s in sorted({key[:2] for key in measured}, key=lambda each: (-each[0], each[1])):
        for case in cases:
            for method in METHODS:
                here = measured[snr_db, rt60_s, case, method]
                row: SummaryRow = {"case": case, "rt60_s": round(rt60_s, 3), "snr_db": snr_db, "method": method}
                row["sessions"] = len(next(iter(here.values())))
                for name, (values, statistic) in columns.items():
                    row |= _with_interval(name, _resampled(here[values], statistic))
                if scenario == "clocks":
                    standard = measured[snr_db, rt60_s, case, STANDARD]
                    row |= _with_interval("more_lost", _resampled(here["lost"]) - _resampled(standard["lost"]))
                    first = measured[snr_db, rt60_s, cases[0], method]
                    medians = [_resampled(each["error_m"], np.nanmedian) for each in (here, first)]
                    row |= _with_interval("grown", medians[0] / medians[1])
                    row["area_under_roc"] = area_under_roc(here["confidence"].ravel(), here["right"].ravel() > 0.0)
                summed.append(
                    {name: round(value, 4) if isinstance(value, float) else value for name, value in row.items()}
                )
    return summed


def _measured(
    rows: Sequence[Row], measure: Callable[[Sequence[Row], Sequence[Row]], list[dict[str, float]]]
) -> dict[tuple[float, float, str, str], Measured]:
    """Of each SNR, reverberation time, case and method."""
    sessions: dict[tuple[float, float, str, int], list[Row]] = defaultdict(list)
    for row in rows:
        sessions[row["snr_db"], row["rt60_s"], row["case"], row["position"]].append(row)
    lines: dict[tuple[float, float, str, str], list[list[dict[str, float]]]] = defaultdict(list)
    for (snr_db, rt60_s, case, _), session in sorted(sessions.items()):
        truths = [row for row in session if row["kind"] == "truth"]
        for method in METHODS:
            lines[snr_db, rt60_s, case, method].append(
                measure(truths, [row for row in session if row["method"] == method])
            )
    return {
        key: {name: np.array([[item[name] for item in line] for line in each]) for name in each[0][0]}
        for key, each in lines.items()
    }


def _of_sounds(truths: Sequence[Row], told: Sequence[Row]) -> list[dict[str, float]]:
    """Of each sound, one after the other: the surest of what was located."""
    items = []
    for truth in truths:
        events = [row for row in told if row["kind"] == "event" and row["moment"] == truth["moment"]]
        placed = [row for row in events if row["status"] == Status.LOCATED]
        surest = max(placed, key=lambda row: float(row["confidence"]), default=None)
        item = {"events": float(len(events)), "one": float(len(events) == 1), "located": float(surest is not None)}
        item |= dict.fromkeys(("error_m", "over", "inside", "said"), np.nan) | {"confidence": 0.0, "right": 0.0}
        if surest is not None:
            error = _place(surest) - _place(truth)
            error_m, confidence = float(np.linalg.norm(error)), float(surest["confidence"])
            right, inside = error_m <= NEAR_M, error @ np.linalg.solve(_covariance_m2(surest), error) <= NINETY_PERCENT
            item |= {"error_m": error_m, "over": float(not right), "inside": float(inside), "said": confidence}
            item |= {"confidence": confidence, "right": float(right)}
        items.append(item | {"lost": 1.0 - item["right"]})
    return items


def _of_pairs(truths: Sequence[Row], told: Sequence[Row]) -> list[dict[str, float]]:
    """Of each moment with its one or two sources: what was located, each for one source at most."""
    items = []
    for moment in sorted({truth["moment"] for truth in truths}):
        truth_m = np.array([_place(row) for row in truths if row["moment"] == moment])
        events = [row for row in told if row["kind"] == "event" and row["moment"] == moment]
        found_m = np.array([_place(row) for row in events if row["status"] == Status.LOCATED]).reshape(-1, 3)
        errors_m = assigned(truth_m, found_m)
        near = errors_m <= NEAR_M
        items.append(
            {
                "all": float(near.all()),
                "any": float(near.any()),
                "false": float(len(found_m) - near.sum()),
                "error_m": float(np.mean(errors_m[near])) if near.any() else np.nan,
                "ospa_m": ospa_m(truth_m, found_m),
            }
        )
    return items


def _of_walks(truths: Sequence[Row], told: Sequence[Row]) -> list[dict[str, float]]:
    """Of a talker."""
    times_s = np.array([row["time_s"] for row in truths])
    scored = score(times_s, np.array([_place(row) for row in truths]), _tracks(told))
    return [{name: float(value) for name, value in asdict(scored).items()} | {"one": float(scored.ids == 1)}]


_Statistic = Callable[..., Any]

_MEASURES: Final[Mapping[str, tuple[Callable[..., list[dict[str, float]]], Mapping[str, tuple[str, _Statistic]]]]] = {
    "clocks": (
        _of_sounds,
        {
            "one_event": ("one", np.nanmean),
            "located": ("located", np.nanmean),
            "median_m": ("error_m", np.nanmedian),
            "over_0.5_m": ("over", np.nanmean),
            "inside_90": ("inside", np.nanmean),
            "confidence": ("said", np.nanmean),
            "lost": ("lost", np.nanmean),
        },
    ),
    "two-sources": (
        _of_pairs,
        {
            "all_found": ("all", np.nanmean),
            "any_found": ("any", np.nanmean),
            "false": ("false", np.nanmean),
            "median_m": ("error_m", np.nanmedian),
            "ospa_m": ("ospa_m", np.nanmean),
        },
    ),
    "walking": (
        _of_walks,
        {
            "rmse_m": ("rmse_m", np.nanmedian),
            "one_id": ("one", np.nanmean),
            "ids": ("ids", np.nanmean),
            "detected": ("detected", np.nanmean),
            "false_per_s": ("false_per_s", np.nanmean),
            "latency_s": ("latency_s", np.nanmedian),
            "breaks": ("breaks", np.nanmean),
            "swaps": ("swaps", np.nanmean),
            "ospa_m": ("ospa_m", np.nanmean),
        },
    ),
}
"""Of each scenario: how a session is measured, and what is told of it: name -> (measure, statistic over all)."""

_TOLD: Final[Mapping[str, tuple[str, str]]] = {
    "one_event": ("one event a sound", "%"),
    "located": ("located", "%"),
    "median_m": ("median", "m"),
    "over_0.5_m": ("over 0.5 m", "%"),
    "inside_90": ("in the 90 % ellipsoid", "%"),
    "confidence": ("confidence", ""),
    "lost": ("lost", "%"),
    "more_lost": ("more lost than the standard", "%"),
    "grown": ("median over that of the first case", ""),
    "all_found": ("all found within 0.5 m", "%"),
    "any_found": ("one or more", "%"),
    "false": ("false ones", ""),
    "ospa_m": ("OSPA", "m"),
    "rmse_m": ("RMSE, median", "m"),
    "one_id": ("one id", "%"),
    "ids": ("ids", ""),
    "detected": ("time with a track", "%"),
    "false_per_s": ("false tracks", ""),
    "latency_s": ("latency, median", "s"),
    "breaks": ("lost and found again", ""),
    "swaps": ("swaps", ""),
}
"""Title and unit of what a report tells."""

_ABOUT: Final[Mapping[str, str]] = {
    "clocks": "Median, over 0.5 m, ellipsoid and mean confidence are of what was located; where a sound made several "
    "events, of the surest. Lost: more than 0.5 m off, or not located.",
    "two-sources": "Found: located within 0.5 m; each event counts for one source at most. False: located, and of no "
    f"source. OSPA: order 1, cut-off {CUT_OFF_M:g} m.",
    "walking": "Only while someone speaks. A track is with the talker within "
    f"{CUT_OFF_M:g} m. RMSE is of the track that is with the talker; false tracks are those that are not, on average "
    "over time; ids, lost and found again, and swaps are counted a walk. OSPA: order 1, cut-off "
    f"{CUT_OFF_M:g} m.",
}


def _blocks(rows: Sequence[SummaryRow], settings: Mapping[str, Any], *, drawn: bool) -> list[Block]:
    name = settings["scenario"]
    scenario = SESSIONS[name]
    listed = {"rt": settings["rt60s_s"], "snr": settings["snrs_db"]}
    conditions = " ".join(
        f"--{option} {','.join(f'{value:g}' for value in values)}" for option, values in listed.items()
    )
    told = [measure for measure in _TOLD if measure in rows[0]]
    cells = [
        (
            row["case"],
            f"{row['rt60_s']:g} s",
            f"{row['snr_db']:g} dB",
            row["method"],
            *(_cell(row, each) for each in told),
        )
        for row in rows
    ]
    blocks: list[Block] = [
        Heading(1, scenario.title),
        f"{scenario.about} {settings['positions']} sessions in the paper's room with two tetrahedra of 0.5 m, 5 m "
        f"apart, through the whole fusion as it is shipped, block by block; sounds of the {settings['half']} half, "
        f"seed {settings['seed']}. {_ABOUT[name]} Intervals are 99 % ones (bootstrap over sessions).",
        f"Command: `livessl evaluate localizer --scenario {name} --events DIR --positions {settings['positions']} "
        f"{conditions} --seed {settings['seed']} --half {settings['half']} --out DIR`, with the sounds of DCASE 2016 "
        "task 2.",
        Table(("case", "RT60", "SNR", "method", *(_TOLD[each][0] for each in told)), cells),
    ]
    if drawn:
        blocks.append(
            Picture("walks", "The first walks from above. Grey: the way; coloured: tracks of onset, one colour an id")
        )
    return blocks


def _cell(row: SummaryRow, name: str) -> str:
    value, low, high = (row[name + end] for end in ("", "_low", "_high"))
    if not np.isfinite(value) or (name == "more_lost" and row["method"] == STANDARD):
        return ""
    unit = _TOLD[name][1]
    scale, digits = (100.0, 1) if unit == "%" else (1.0, 3 if unit == "m" else 2)
    return f"{scale * value:.{digits}f} ({scale * low:.{digits}f} to {scale * high:.{digits}f}) {unit}".rstrip()


def _resampled(values: FloatArray, statistic: _Statistic = np.nanmean) -> FloatArray:
    """A statistic of all values (sessions, items), followed by those of resamples of the sessions: (1 + B,)."""
    drawn = np.random.default_rng(0).integers(len(values), size=(RESAMPLES, len(values)))
    flat = np.concatenate([values.reshape(1, -1), values[drawn].reshape(RESAMPLES, -1)])
    known = np.isfinite(flat).any(axis=1)
    result = np.full(len(flat), np.nan)
    result[known] = statistic(flat[known], axis=1)
    return result


def _with_interval(name: str, resampled: FloatArray) -> dict[str, float]:
    known = resampled[1:][np.isfinite(resampled[1:])]
    low, high = np.percentile(known, INTERVAL) if len(known) else (np.nan, np.nan)
    return {name: float(resampled[0]), f"{name}_low": float(low), f"{name}_high": float(high)}


def _place(row: Row) -> FloatArray:
    return np.array([row["x_m"], row["y_m"], row["z_m"]], dtype=np.float64)


def _covariance_m2(row: Row) -> FloatArray:
    xx, yy, zz, xy, xz, yz = (float(row[f"c{axes}_m2"]) for axes in COVARIANCE)
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def _tracks(told: Sequence[Row]) -> dict[int, tuple[FloatArray, FloatArray]]:
    """Times and places of each track's states, ascending in time; of two at a time the later told."""
    states: dict[int, dict[float, FloatArray]] = defaultdict(dict)
    for row in told:
        if row["kind"] == "track":
            states[row["number"]][row["time_s"]] = _place(row)
    return {
        number: (np.array(sorted(each)), np.array([each[time_s] for time_s in sorted(each)]))
        for number, each in states.items()
    }


def _walks(rows: Sequence[Row]) -> list[Walk]:
    """The first walks of the last case, with the tracks of the default."""
    tracked = [row for row in rows if row["kind"] == "track" and row["method"] == OURS]
    if not tracked:
        return []
    case = tracked[-1]["case"]
    first = next((row["rt60_s"], row["snr_db"]) for row in tracked)
    mine = [row for row in rows if row["case"] == case and (row["rt60_s"], row["snr_db"]) == first]
    walks = []
    for number in sorted({row["position"] for row in mine})[:DRAWN]:
        session = [row for row in mine if row["position"] == number]
        way_m = np.array([_place(row) for row in session if row["kind"] == "truth"])
        tracks = _tracks([row for row in session if row["method"] == OURS])
        walks.append(Walk(way_m, [places_m for _, places_m in tracks.values()]))
    return walks
