"""Counts of the scenario `noise`: right and wrong sounds in each part of the results, and how right confidence is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any, Final

import numpy as np

from livessl.core.locate.confidence import NEAR_M
from livessl.core.types import BoolArray, Status
from livessl.lab.evaluate.localizer import METHODS
from livessl.lab.evaluate.localizer_report import EDGES, Columns, SummaryRow
from livessl.lab.evaluate.noise_kinds import KINDS
from livessl.lab.evaluate.noise_sounds import OTHER_SOUNDS
from livessl.lab.evaluate.statistics import NINETY_PERCENT, wilson

ALL: Final = "all"
"""Value of a column over which a row of the summary is taken."""

PARTS: Final = ("room", "where", "facing", "sound")
"""Columns by which the results are summarized over all noise."""

MOST_WRONG: Final = 0.05
"""Largest share of wrong positions among the located ones that is aimed at."""

STANDARD, OURS = METHODS


def summary(columns: Columns) -> list[SummaryRow]:
    """Summarize each kind and level of noise by each method, over all rooms and sounds; then each of `PARTS`.

    `right` is the share of all sounds that are located within `NEAR_M`. `wrong` is the share of the located ones that
    are further off, and `at_noise` the share of those within `NEAR_M` of a noise source. `withheld` is the share of all
    sounds whose best place is within `NEAR_M` but not reported as a position. Each room has a row at each level, too.
    Intervals are 95 % intervals by Wilson, as if sounds were independent. The sounds of `OTHER_SOUNDS` have rows of
    their own alone.
    """
    levels_db = sorted(set(columns["snr_db"].tolist()), reverse=True)
    kinds = [kind for kind in KINDS if (columns["noise"] == kind).any()]
    parts: list[dict[str, Any]] = [{"noise": kind, "snr_db": snr_db} for kind in kinds for snr_db in levels_db]
    for name in PARTS:
        parts += [{name: value} for value in dict.fromkeys(columns[name].tolist())]
    rooms = dict.fromkeys(columns["room"].tolist())
    parts += [{"room": room, "snr_db": snr_db} for room in rooms for snr_db in levels_db]
    is_other = np.isin(columns["sound"], list(OTHER_SOUNDS))
    rows = []
    for part in parts:
        here = is_other if part.get("sound") in OTHER_SOUNDS else ~is_other
        for name, value in part.items():
            here = here & (columns[name] == value)
        head = dict.fromkeys(("noise", "snr_db", *PARTS), ALL) | part
        for method in METHODS:
            chosen = here & (columns["method"] == method)
            if chosen.any():
                rows.append(head | {"method": method} | _measured(columns, chosen))
    return rows


def _measured(columns: Columns, chosen: BoolArray) -> SummaryRow:
    located, error_m = columns["located"][chosen], columns["error_m"][chosen]
    near = error_m <= NEAR_M
    right, wrong, count = int((located & near).sum()), int((located & ~near).sum()), len(error_m)
    to_noise_m = columns["to_noise_m"][chosen][located & ~near].astype(np.float64)
    to_noise_m = to_noise_m[np.isfinite(to_noise_m)]  # white and diffuse noise have no place
    inside = columns["mahalanobis2"][chosen][located] <= NINETY_PERCENT
    directions = columns["status"][chosen] == Status.DIRECTION_ONLY.value
    fits = directions & (columns["bearing_deg"][chosen] <= NEAR_DEG)
    right_low, right_high = wilson(right, count)
    wrong_low, wrong_high = wilson(wrong, right + wrong)
    row: dict[str, float] = {
        "right": right / count,
        "right_low": right_low,
        "right_high": right_high,
        "wrong": wrong / max(1, right + wrong),
        "wrong_low": wrong_low,
        "wrong_high": wrong_high,
        "median_m": float(np.median(error_m[located])) if located.any() else np.nan,
        "located": (right + wrong) / count,
        "near": float(near.mean()),
        "withheld": float((near & ~located).mean()),
        "direction": float(directions.mean()),
        "right_direction": float(fits.mean()),
        "at_noise": float((to_noise_m <= NEAR_M).mean()) if len(to_noise_m) else np.nan,
        "confidence": float(columns["confidence"][chosen][located].mean()) if located.any() else np.nan,
        "inside_90": float(inside.mean()) if located.any() else np.nan,
    }
    return {"sounds": count} | {name: round(value, 4) for name, value in row.items()}


NEAR_DEG: Final = 10.0
"""Largest error, in degrees at the nearest array, of a direction that counts as right."""


def too_wrong(rows: Sequence[SummaryRow]) -> list[SummaryRow]:
    """Return the cells of noise in which more than `MOST_WRONG` of the positions of `onset` are wrong."""
    return [row for row in _cells(rows, OURS) if row["wrong"] > MOST_WRONG]


def below_standard(rows: Sequence[SummaryRow]) -> list[SummaryRow]:
    """Return the cells of noise in which `onset` has fewer right sounds than the standard's interval begins with."""
    standard = {(row["noise"], row["snr_db"]): row for row in _cells(rows, STANDARD)}
    return [row for row in _cells(rows, OURS) if row["right"] < standard[row["noise"], row["snr_db"]]["right_low"]]


def _cells(rows: Sequence[SummaryRow], method: str) -> list[SummaryRow]:
    return [row for row in rows if row["noise"] != ALL and row["method"] == method]


def wrong_positions(columns: Columns) -> dict[str, int]:
    """Count the wrong positions of `onset`: `all`, those less than 1 m off, `at_noise`, and those `in_a_quarter`.

    `in_a_quarter` counts those of the quarter of the scenes that has most of them: sounds of one scene are not
    independent.
    """
    wrong = (columns["method"] == OURS) & ~np.isin(columns["sound"], list(OTHER_SOUNDS))
    scenes = len(set(columns["position"].tolist()))
    wrong &= columns["located"] & (columns["error_m"] > NEAR_M)
    each = np.unique(columns["position"][wrong], return_counts=True)[1]
    return {
        "all": int(wrong.sum()),
        "within_1_m": int((columns["error_m"][wrong] < 1.0).sum()),
        "at_noise": int((columns["to_noise_m"][wrong].astype(np.float64) <= NEAR_M).sum()),
        "in_a_quarter": int(np.sort(each)[::-1][: -(-scenes // 4)].sum()),
    }


def reliability(columns: Columns) -> dict[str, list[Mapping[str, float]]]:
    """Compare the confidence of `onset` with the truth: for all noise and each kind, the classes between `EDGES`.

    A class has the number of its `sounds`, located or not, their mean `confidence`, and the share that is `near`, with
    its 95 % interval `near_low` to `near_high`. Empty classes are left out.
    """
    ours = (columns["method"] == OURS) & ~np.isin(columns["sound"], list(OTHER_SOUNDS))
    groups = {ALL: ours} | {kind: ours & (columns["noise"] == kind) for kind in KINDS}
    return {name: _classes(columns, chosen) for name, chosen in groups.items() if chosen.any()}


def _classes(columns: Columns, chosen: BoolArray) -> list[Mapping[str, float]]:
    confidence, near = columns["confidence"][chosen], columns["error_m"][chosen] <= NEAR_M
    classes: list[Mapping[str, float]] = []
    for low, high in pairwise(EDGES):
        within = (confidence >= low) & ((confidence < high) | (high == EDGES[-1]))
        if within.any():
            low_share, high_share = wilson(int(near[within].sum()), int(within.sum()))
            classes.append(
                {
                    "low": low,
                    "high": high,
                    "sounds": int(within.sum()),
                    "confidence": float(confidence[within].mean()),
                    "near": float(near[within].mean()),
                    "near_low": low_share,
                    "near_high": high_share,
                }
            )
    return classes
