"""The report on the sessions: sounds, pairs of sources and tracks, compared with the truth. It simulates nothing."""

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
from livessl.lab.evaluate.figures.localizer import Walk, draw_walks
from livessl.lab.evaluate.localizer import METHODS
from livessl.lab.evaluate.markdown import Block, Heading, Picture, Table, as_markdown
from livessl.lab.evaluate.scenarios import SESSIONS
from livessl.lab.evaluate.sessions import COVARIANCE
from livessl.lab.evaluate.statistics import NINETY_PERCENT, RESAMPLES, area_under_roc, with_interval, write_csv
from livessl.lab.evaluate.tracking import CUT_OFF_M, assigned, ospa_m, score
from livessl.lab.evaluate.unit import Row

DRAWN: Final = 6
"""Number of walks in the figure."""

STANDARD, OURS = METHODS

Measured = Mapping[str, FloatArray]
"""Measures of each session's sounds, pairs or walks: name -> (sessions, items), NaN where a measure does not exist."""

SummaryRow = dict[str, Any]


def write_sessions_report(out: Path) -> list[Path]:
    """Write `summary.csv`, `report.md` and a figure of walks into the folder of a campaign; return the two texts."""
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
    """Summarize each condition, case and method: each measure with its 99 % interval (bootstrap over sessions).

    `more_lost` is the share of lost sounds minus the standard's share in the same sessions. `grown` is the ratio of the
    median error to that of the scenario's first case.
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
                    row |= with_interval(name, _resampled(here[values], statistic))
                if scenario == "clocks":
                    standard = measured[snr_db, rt60_s, case, STANDARD]
                    row |= with_interval("more_lost", _resampled(here["lost"]) - _resampled(standard["lost"]))
                    first = measured[snr_db, rt60_s, cases[0], method]
                    medians = [_resampled(each["error_m"], np.nanmedian) for each in (here, first)]
                    row |= with_interval("grown", medians[0] / medians[1])
                    row["area_under_roc"] = area_under_roc(here["confidence"].ravel(), here["right"].ravel() > 0.0)
                summed.append(
                    {name: round(value, 4) if isinstance(value, float) else value for name, value in row.items()}
                )
    return summed


def _measured(
    rows: Sequence[Row], measure: Callable[[Sequence[Row], Sequence[Row]], list[dict[str, float]]]
) -> dict[tuple[float, float, str, str], Measured]:
    """Measure each SNR, reverberation time, case and method."""
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


def _of_sounds(truths: Sequence[Row], outputs: Sequence[Row]) -> list[dict[str, float]]:
    """Measure each sound, in order, by its most confident event among the located ones."""
    items = []
    for truth in truths:
        events = [row for row in outputs if row["kind"] == "event" and row["moment"] == truth["moment"]]
        placed = [row for row in events if row["status"] == Status.LOCATED]
        best = max(placed, key=lambda row: float(row["confidence"]), default=None)
        item = {"events": float(len(events)), "one": float(len(events) == 1), "located": float(best is not None)}
        item |= dict.fromkeys(("error_m", "over", "inside", "claimed"), np.nan) | {"confidence": 0.0, "right": 0.0}
        if best is not None:
            error = _place(best) - _place(truth)
            error_m, confidence = float(np.linalg.norm(error)), float(best["confidence"])
            right, inside = error_m <= NEAR_M, error @ np.linalg.solve(_covariance_m2(best), error) <= NINETY_PERCENT
            item |= {"error_m": error_m, "over": float(not right), "inside": float(inside), "claimed": confidence}
            item |= {"confidence": confidence, "right": float(right)}
        items.append(item | {"lost": 1.0 - item["right"]})
    return items


def _of_pairs(truths: Sequence[Row], outputs: Sequence[Row]) -> list[dict[str, float]]:
    """Measure each moment with its one or two sources; each located event counts for one source at most."""
    items = []
    for moment in sorted({truth["moment"] for truth in truths}):
        truth_m = np.array([_place(row) for row in truths if row["moment"] == moment])
        events = [row for row in outputs if row["kind"] == "event" and row["moment"] == moment]
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


def _of_walks(truths: Sequence[Row], outputs: Sequence[Row]) -> list[dict[str, float]]:
    """Measure the tracking of a talker."""
    times_s = np.array([row["time_s"] for row in truths])
    scored = score(times_s, np.array([_place(row) for row in truths]), _tracks(outputs))
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
            "confidence": ("claimed", np.nanmean),
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
"""Function that measures a session of each scenario, and the columns of its summary: name -> (measure, statistic)."""

_COLUMNS: Final[Mapping[str, tuple[str, str]]] = {
    "one_event": ("sounds with one event", "%"),
    "located": ("located", "%"),
    "median_m": ("median", "m"),
    "over_0.5_m": ("over 0.5 m", "%"),
    "inside_90": ("in the 90 % ellipsoid", "%"),
    "confidence": ("mean confidence", ""),
    "lost": ("lost", "%"),
    "more_lost": ("more lost than the standard", "%"),
    "grown": ("ratio of the median to that of the first case", ""),
    "all_found": ("all found within 0.5 m", "%"),
    "any_found": ("one or both found", "%"),
    "false": ("false events per pair", ""),
    "ospa_m": ("OSPA", "m"),
    "rmse_m": ("median RMSE", "m"),
    "one_id": ("walks with one track", "%"),
    "ids": ("tracks", ""),
    "detected": ("time with a track", "%"),
    "false_per_s": ("false tracks", ""),
    "latency_s": ("median latency", "s"),
    "breaks": ("interruptions", ""),
    "swaps": ("swaps", ""),
}
"""Title and unit of each column of a report."""

_ABOUT: Final[Mapping[str, str]] = {
    "clocks": "*Median*, *over 0.5 m*, *in the 90 % ellipsoid* and *mean confidence* are over the located sounds; a "
    "sound with several events counts by the most confident one. *Lost* sounds are not located, or located more than "
    "0.5 m off.",
    "two-sources": "A source is found if it is located within 0.5 m; each event counts for one source at most. False "
    f"events are located, but belong to no source. OSPA is of order 1, with a cut-off of {CUT_OFF_M:g} m.",
    "walking": "Only times of speech count. A track belongs to the talker while it is within "
    f"{CUT_OFF_M:g} m. The RMSE is that of the talker's track. *False tracks* is the mean number of other tracks over "
    "time. Tracks of the talker, interruptions and swaps are counted per walk. OSPA is of order 1, with a cut-off of "
    f"{CUT_OFF_M:g} m.",
}


def _blocks(rows: Sequence[SummaryRow], settings: Mapping[str, Any], *, drawn: bool) -> list[Block]:
    name = settings["scenario"]
    scenario = SESSIONS[name]
    listed = {"rt60": settings["rt60s_s"], "snr": settings["snrs_db"]}
    conditions = " ".join(
        f"--{option} {','.join(f'{value:g}' for value in values)}" for option, values in listed.items()
    )
    shown = [measure for measure in _COLUMNS if measure in rows[0]]
    cells = [
        (
            row["case"],
            f"{row['rt60_s']:g} s",
            f"{row['snr_db']:g} dB",
            row["method"],
            *(_cell(row, each) for each in shown),
        )
        for row in rows
    ]
    blocks: list[Block] = [
        Heading(1, scenario.title),
        f"{scenario.about} {settings['positions']} sessions were simulated in the paper's room with two tetrahedra of "
        "0.5 m, 5 m apart, and sent block by block through the whole fusion with its defaults; sounds of the "
        f"{settings['half']} half, seed {settings['seed']}. {_ABOUT[name]} Intervals are 99 % intervals (bootstrap "
        "over sessions).",
        f"Command: `livessl evaluate localizer --scenario {name} --sounds DIR --positions {settings['positions']} "
        f"{conditions} --seed {settings['seed']} --half {settings['half']} --out DIR`, with the sounds of DCASE 2016 "
        "task 2.",
        Table(("case", "RT60", "SNR", "method", *(_COLUMNS[each][0] for each in shown)), cells),
    ]
    if drawn:
        blocks.append(
            Picture(
                "walks", "The first walks from above. Grey: true positions; coloured: tracks by onset, a colour each"
            )
        )
    return blocks


def _cell(row: SummaryRow, name: str) -> str:
    value, low, high = (row[name + end] for end in ("", "_low", "_high"))
    if not np.isfinite(value) or (name == "more_lost" and row["method"] == STANDARD):
        return ""
    unit = _COLUMNS[name][1]
    scale, digits = (100.0, 1) if unit == "%" else (1.0, 3 if unit == "m" else 2)
    return f"{scale * value:.{digits}f} ({scale * low:.{digits}f} to {scale * high:.{digits}f}) {unit}".rstrip()


def _resampled(values: FloatArray, statistic: _Statistic = np.nanmean) -> FloatArray:
    """Return a statistic of all values (sessions, items), followed by those of resamples of sessions: (1 + B,)."""
    drawn = np.random.default_rng(0).integers(len(values), size=(RESAMPLES, len(values)))
    flat = np.concatenate([values.reshape(1, -1), values[drawn].reshape(RESAMPLES, -1)])
    known = np.isfinite(flat).any(axis=1)
    result = np.full(len(flat), np.nan)
    result[known] = statistic(flat[known], axis=1)
    return result


def _place(row: Row) -> FloatArray:
    return np.array([row["x_m"], row["y_m"], row["z_m"]], dtype=np.float64)


def _covariance_m2(row: Row) -> FloatArray:
    xx, yy, zz, xy, xz, yz = (float(row[f"c{axes}_m2"]) for axes in COVARIANCE)
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def _tracks(outputs: Sequence[Row]) -> dict[int, tuple[FloatArray, FloatArray]]:
    """Return times and positions of each track's states, ascending in time; a later state replaces one of its time."""
    states: dict[int, dict[float, FloatArray]] = defaultdict(dict)
    for row in outputs:
        if row["kind"] == "track":
            states[row["number"]][row["time_s"]] = _place(row)
    return {
        number: (np.array(sorted(each)), np.array([each[time_s] for time_s in sorted(each)]))
        for number, each in states.items()
    }


def _walks(rows: Sequence[Row]) -> list[Walk]:
    """Return the first walks of the last case, with the tracks by the default method."""
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
