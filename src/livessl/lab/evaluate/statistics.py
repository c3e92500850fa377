"""A campaign's results as numbers: errors by condition, medians with bootstrap intervals. It gives no verdicts."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow.parquet as pq

from livessl.core.types import BoolArray, FloatArray

RESAMPLES: Final = 1000
"""Number of bootstrap resamples: the ends of a 99 % interval are then the 5th from either side."""

INTERVAL: Final = (0.5, 99.5)
"""Percentiles of a 99 % interval."""

NINETY_PERCENT: Final = 6.251
"""Quantile of chi-square with three degrees of freedom: the squared Mahalanobis radius of the 90 % ellipsoid."""

ERRORS: Final = ("error_m", "radial_m", "azimuth_deg", "elevation_deg")
"""Columns of the error and of its components."""

Condition = tuple[str, str, float]
"""System, method, nominal reverberation time in seconds."""


@dataclass(frozen=True, slots=True)
class Interval:
    """A number and the 99 % bootstrap interval around it."""

    value: float
    low: float
    high: float

    @classmethod
    def of(cls, resampled: FloatArray) -> Interval:
        """Make an interval of a value that is followed by its resamples: (1 + B,)."""
        low, high = np.percentile(resampled[1:], INTERVAL)
        return cls(float(resampled[0]), float(low), float(high))


@dataclass
class Results:
    """Errors of every condition of one campaign.

    Parameters
    ----------
    experiment : str
    values : mapping of Condition to error name to (positions, classes) float64
    classes : tuple of str
        Classes of sound.
    t30_s : mapping of nominal reverberation time to (positions,) float64
        Measured reverberation time, in seconds.
    """

    experiment: str
    values: dict[Condition, dict[str, FloatArray]]
    classes: tuple[str, ...]
    t30_s: dict[float, FloatArray]
    _medians: dict[tuple[Condition, str | None], FloatArray] = field(default_factory=dict)

    @property
    def positions(self) -> int:
        """Number of positions of the source."""
        return len(next(iter(self.t30_s.values())))

    @property
    def rt60s_s(self) -> tuple[float, ...]:
        """Nominal reverberation times, in seconds, in ascending order."""
        return tuple(sorted(self.t30_s))

    def has(self, system: str, method: str = "srp-phat") -> bool:
        """Return whether there are results of a system by a method."""
        return any(known[:2] == (system, method) for known in self.values)

    def medians(self, system: str, method: str, rt60_s: float, sound: str | None = None) -> FloatArray:
        """Return the median error, in metres, followed by the medians of resamples: (1 + B,).

        Positions are resampled, not events, because the four events of a position share its place. Every condition gets
        the same resamples, so that differences are paired.
        """
        condition = (system, method, rt60_s)
        key = (condition, sound)
        if key not in self._medians:
            errors = self.values[condition]["error_m"]
            if sound is not None:
                errors = errors[:, [self.classes.index(sound)]]
            rng = np.random.default_rng(0)
            chosen = rng.integers(len(errors), size=(RESAMPLES, len(errors)))
            resampled = np.median(errors[chosen].reshape(RESAMPLES, -1), axis=1)
            self._medians[key] = np.concatenate([[np.median(errors)], resampled])
        return self._medians[key]


def read_results(path: Path, experiment: str) -> Results:
    """Read the `results.parquet` of one of the paper's campaigns.

    Raises
    ------
    ValueError
        If its positions do not all have the same rows.
    """
    table = pq.read_table(path)
    text = {name: _codes(table, name) for name in ("system", "method", "sound")}
    numbers = {name: table.column(name).to_numpy() for name in ("position", "rt60_s", "t30_s", *ERRORS)}
    rt60_s = np.round(numbers["rt60_s"].astype(np.float64), 4)
    classes = tuple(text["sound"][1])
    order = np.lexsort((text["sound"][0], numbers["position"], rt60_s, text["method"][0], text["system"][0]))
    positions = len(np.unique(numbers["position"]))
    size = positions * len(classes)
    if len(order) == 0 or len(order) % size:
        raise ValueError(f"{path}: expected the same rows for each of {positions} positions, got {len(order)} in all")
    values: dict[Condition, dict[str, FloatArray]] = {}
    t30_s: dict[float, FloatArray] = {}
    for first in range(0, len(order), size):
        rows = order[first : first + size]
        head = rows[0]
        system = text["system"][1][text["system"][0][head]]
        method = text["method"][1][text["method"][0][head]]
        shape = (positions, len(classes))
        errors = {name: numbers[name][rows].astype(np.float64).reshape(shape) for name in ERRORS}
        values[system, method, float(rt60_s[head])] = errors
        t30_s[float(rt60_s[head])] = numbers["t30_s"][rows].astype(np.float64).reshape(shape)[:, 0]
    return Results(experiment, values, classes, t30_s)


def summary(results: Results) -> list[dict[str, Any]]:
    """Summarize each condition, for all sounds and for each class: one row each."""
    rows = []
    for (system, method, rt60_s), errors in results.values.items():
        for sound in (None, *results.classes):
            column = slice(None) if sound is None else [results.classes.index(sound)]
            error = errors["error_m"][:, column].ravel()
            interval = Interval.of(results.medians(system, method, rt60_s, sound))
            q25, q75, p95 = np.percentile(error, [25, 75, 95])
            rows.append(
                {
                    "experiment": results.experiment,
                    "system": system,
                    "method": method,
                    "rt60_s": rt60_s,
                    "t30_s": round(float(np.median(results.t30_s[rt60_s])), 3),
                    "sound": sound or "all",
                    "events": len(error),
                    "median_m": round(interval.value, 4),
                    "low_m": round(interval.low, 4),
                    "high_m": round(interval.high, 4),
                    "q25_m": round(float(q25), 4),
                    "q75_m": round(float(q75), 4),
                    "p95_m": round(float(p95), 4),
                    "over_0.5_m": round(float((error > 0.5).mean()), 4),
                    "over_1_m": round(float((error > 1.0).mean()), 4),
                    **{
                        f"median_abs_{name}": round(float(np.median(np.abs(errors[name][:, column]))), 4)
                        for name in ERRORS[1:]
                    },
                }
            )
    return rows


def write_csv(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    """Write rows that have the same keys."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def with_interval(name: str, resampled: FloatArray) -> dict[str, float]:
    """Return a value, (1 + B,) with its resamples, and its 99 % interval as columns `NAME`, `NAME_low`, `NAME_high`."""
    known = resampled[1:][np.isfinite(resampled[1:])]
    low, high = np.percentile(known, INTERVAL) if len(known) else (np.nan, np.nan)
    return {name: float(resampled[0]), f"{name}_low": float(low), f"{name}_high": float(high)}


def wilson(count: int, total: int) -> tuple[float, float]:
    """Return the 95 % interval of a share by Wilson (1927); 0 to 1 if the total is 0."""
    if total == 0:
        return 0.0, 1.0
    z2 = 1.96**2
    share = count / total
    centre = (share + z2 / (2.0 * total)) / (1.0 + z2 / total)
    half = np.sqrt(z2 * (share * (1.0 - share) / total + z2 / (4.0 * total**2))) / (1.0 + z2 / total)
    return max(0.0, float(centre - half)), min(1.0, float(centre + half))


def area_under_roc(score: FloatArray, good: BoolArray) -> float:
    """Return the probability that a good event's score exceeds a bad one's; ties count half, NaN if one is missing."""
    good_scores, bad_scores = np.sort(score[good]), score[~good]
    if len(good_scores) == 0 or len(bad_scores) == 0:
        return float("nan")
    below = np.searchsorted(good_scores, bad_scores, side="left")
    not_above = np.searchsorted(good_scores, bad_scores, side="right")
    return float(1.0 - (below + not_above).mean() / (2.0 * len(good_scores)))


def _codes(table: Any, name: str) -> tuple[Any, list[str]]:
    """Return a column of names as numbers (n,), and the names in alphabetical order."""
    names, codes = np.unique(np.asarray(table.column(name).to_pylist()), return_inverse=True)
    return codes, [str(each) for each in names]
