"""When a second source is reported: sounds with one and with two sources, and the decision that is fitted to them.

`python benchmarks/second_source.py simulate --events DIR --half development|test --out FILE` plays, in rooms and to
arrays of the half's own, two sounds at once, two less than a metre apart, one sound alone, one beside a steady fan, and
one beside a talker in the background. `claps --arrays recorders|frames --half first|second --out FILE` takes real
claps instead (`benchmarks/claps.py`). Both write a line of JSON for each sound: what was reported, and the features by
which a second source was judged. `fit FILE...` prints the constants of `livessl.core.locate.second_source`, and `report
FILE...` how many sounds had which outcome, with 95 % intervals by Wilson. All sounds go through the whole pipeline.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

import numpy as np

import claps
from livessl.core.geometry import Grid
from livessl.core.locate.confidence import NEAR_M
from livessl.core.locate.estimator import register
from livessl.core.locate.frame_gccs import FrameGCCs
from livessl.core.locate.onset import Onset
from livessl.core.locate.place import Place
from livessl.core.locate.second_source import SecondSourceFeatures, SecondSourceSearch, TwoSources
from livessl.core.types import ArraySpec, Event, FloatArray, Status
from livessl.lab.evaluate.job import read_clips
from livessl.lab.evaluate.localizer import half_of
from livessl.lab.evaluate.paper import CLASSES
from livessl.lab.evaluate.scenarios import HALVES
from livessl.lab.evaluate.statistics import wilson
from livessl.recordings.assign import AssignedRecording
from livessl.recordings.recording import MemoryRecording
from mixtures import RATE_HZ, Case, apart_m, simulated
from recordings import events_in

FITTED: Final = ("two", "four", "frames")
"""Layouts to which the decision is fitted. Two microphones as an array have one delay, which hardly shows whether
a place is a source: with `pairs` hardly any second source is found, and they would hide what shows one."""

RIDGE: Final = 1e-3
"""Penalty of the squared weights of the standardized features in the fit."""


class Recorder(SecondSourceSearch):
    """Keeps every pair of places that was judged, also those that were not reported."""

    judged: Final[list[TwoSources]] = []

    def most_likely(self, first: Place, frames: Sequence[FrameGCCs]) -> TwoSources:
        """Find the most likely pair, and keep it."""
        found = super().most_likely(first, frames)
        self.judged.append(found)
        return found


class Observed(Onset):
    """The default localizer with a `Recorder`."""

    def __init__(self, arrays: Sequence[ArraySpec], grid: Grid, c_m_s: float) -> None:
        super().__init__(arrays, grid, c_m_s)
        self._second_source = Recorder(self._search, self.grid, c_m_s)


def clapped(arrays: str, half: str) -> Iterator[tuple[dict[str, Any], Case]]:
    """Return the real claps of one half of each session, in the order of time."""
    site = claps.site(arrays)
    truth_m = claps.placed_m(json.loads((claps.FOLDER / "truth.json").read_text())["source_m"])
    for name in names_of(half):
        samples, rate_hz = claps.samples_of(name)
        parts = np.split(samples, np.cumsum([len(spec.microphones_m) for spec in site.specs])[:-1])
        by_array = dict(zip((spec.name for spec in site.specs), parts, strict=True))
        yield {"number": name, "kind": "clap", "layout": arrays}, Case(site, by_array, truth_m[None], rate_hz)


def names_of(half: str) -> list[str]:
    """Return the claps of the first or the second half of each session, by time."""
    sessions: dict[str, list[str]] = {}
    for name in claps.names():
        sessions.setdefault(name.split("_")[0], []).append(name)
    chosen = []
    for session in sessions.values():
        ordered = sorted(session, key=lambda name: float(name.split("_")[1]))
        chosen += ordered[: len(ordered) // 2] if half == "first" else ordered[len(ordered) // 2 :]
    return chosen


def outcome(case: Case) -> dict[str, Any]:
    """Locate one case: what was reported, and the features of the pair of places that was judged last."""
    parts = []
    for spec in case.site.specs:
        samples = case.samples[spec.name]
        recording = MemoryRecording("case", case.sample_rate_hz, samples)
        parts.append(AssignedRecording(spec.name, recording, 0, tuple(range(1, len(samples) + 1))))
    Recorder.judged.clear()
    events = events_in(case.site, parts, "observed")
    located = [event for event in events if event.status is Status.LOCATED]
    first = max((event for event in events if event.source == 1), key=lambda event: event.power or 0.0, default=None)
    found_m = [event.estimate.position_m for event in located if event.estimate is not None]
    errors_m = [[apart_m(place_m, truth_m) for truth_m in case.truths_m] for place_m in found_m]
    pairs = [_judged(pair, case.truths_m) for pair in Recorder.judged]
    return {
        "status": None if first is None else str(first.status),
        "error_m": None if first is None or first.estimate is None else min(_errors_m(first, case.truths_m)),
        "found": _found(errors_m, len(case.truths_m)),
        "false": sum(min(each) > NEAR_M for each in errors_m),
        "ghosts": sum(event.source == 2 and min(_errors_m(event, case.truths_m)) > NEAR_M for event in located),
        "pairs": pairs,
    }


def _found(errors_m: Sequence[Sequence[float]], count: int) -> int:
    """Return how many of the true places some located event is near."""
    return sum(any(each[k] <= NEAR_M for each in errors_m) for k in range(count))


def _errors_m(event: Event, truths_m: FloatArray) -> list[float]:
    if event.estimate is None:
        return [float("inf")]
    return [apart_m(event.estimate.position_m, truth_m) for truth_m in truths_m]


def _judged(pair: TwoSources, truths_m: FloatArray) -> dict[str, Any]:
    """Describe a pair of places: its features, and whether the second is a true source that the first is not."""
    first = [apart_m(pair.first.position_m, truth_m) for truth_m in truths_m]
    second = [apart_m(pair.second.position_m, truth_m) for truth_m in truths_m]
    nearest = int(np.argmin(second))
    right = second[nearest] <= NEAR_M and first[nearest] > NEAR_M
    return {"features": asdict(pair.features), "right": right, "first_m": min(first), "second_m": second[nearest]}


def fit(rows: Sequence[Mapping[str, Any]]) -> FloatArray:
    """Fit the log-odds that the second place is a true source: intercept, and the weights of its terms (1 + T,).

    Right and wrong places have the same weight together: how often two sounds begin at once depends on the site.
    """
    fitted = [row for row in rows if row["layout"] in FITTED and row["kind"] != "near"]  # those are neither one nor two
    pairs = [pair for row in fitted for pair in row["pairs"]]
    values = np.array([SecondSourceFeatures(**pair["features"]).terms for pair in pairs])
    right = np.array([pair["right"] for pair in pairs], dtype=np.float64)
    counts = np.where(right > 0.0, 0.5 / right.mean(), 0.5 / (1.0 - right.mean()))
    mean, deviation = values.mean(axis=0), values.std(axis=0)
    design = np.column_stack([np.ones(len(values)), (values - mean) / deviation])
    penalty = RIDGE * len(values) * np.diag([0.0, *np.ones(values.shape[1])])
    weights = np.zeros(design.shape[1])
    for _ in range(100):
        probability = 1.0 / (1.0 + np.exp(-design @ weights))
        slope = design.T @ (counts * (right - probability)) - penalty @ weights
        curvature = (design.T * (counts * probability * (1.0 - probability))) @ design + penalty
        step = np.linalg.solve(curvature, slope)
        weights += step
        if np.abs(step).max() < 1e-9:
            break
    scaled = weights[1:] / deviation
    return np.array([weights[0] - scaled @ mean, *scaled])


def report(rows: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Yield a line for each kind of sound, and for each layout of it."""
    yield "| sounds | number | all found within 0.5 m | with a false second source | first wrong | first not located |"
    yield "|---|---|---|---|---|---|"
    keys = sorted({(row["kind"], layout) for row in rows for layout in ("", row["layout"])})
    for kind, name in keys:
        chosen = [row for row in rows if row["kind"] == kind and name in ("", row["layout"])]
        wanted = 2 if kind in ("two", "near") else 1
        counts = (
            sum(row["found"] == wanted for row in chosen),
            sum(row["ghosts"] > 0 for row in chosen),
            sum(row["status"] == str(Status.LOCATED) and row["error_m"] > NEAR_M for row in chosen),
            sum(row["status"] != str(Status.LOCATED) for row in chosen),
        )
        shares = " | ".join(_share(count, len(chosen)) for count in counts)
        yield f"| {kind}{', ' if name else ''}{name} | {len(chosen)} | {shares} |"


def _share(count: int, total: int) -> str:
    low, high = wilson(count, total)
    return f"{count} = {100 * count / total:.1f} % ({100 * low:.1f} to {100 * high:.1f})"


def main() -> None:
    """Parse the command line and run what it names."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    simulate = commands.add_parser("simulate", help="simulated rooms")
    simulate.add_argument("--events", type=Path, required=True, help="folder with the clips of DCASE 2016 task 2")
    simulate.add_argument("--half", choices=HALVES, required=True)
    simulate.add_argument("--sounds", type=int, default=240)
    simulate.add_argument("--seed", type=int, default=1)
    real = commands.add_parser("claps", help="real claps")
    real.add_argument("--arrays", choices=("recorders", "frames"), required=True)
    real.add_argument("--half", choices=("first", "second"), required=True)
    for command in (simulate, real):
        command.add_argument("--out", type=Path, required=True, help="file of lines of JSON")
    for name in ("fit", "report"):
        commands.add_parser(name).add_argument("files", type=Path, nargs="+")
    given = parser.parse_args()
    if given.command in ("fit", "report"):
        rows = [json.loads(line) for file in given.files for line in file.read_text().splitlines()]
        print(fit(rows).round(2).tolist() if given.command == "fit" else "\n".join(report(rows)))
        return
    register("observed", Observed)
    if given.command == "claps":
        cases = clapped(given.arrays, given.half)
    else:
        clips = half_of(read_clips(given.events, CLASSES, RATE_HZ), given.half)
        cases = simulated(clips, given.half, given.seed, range(given.sounds))
    with given.out.open("w") as file:
        for head, case in cases:
            row = head | outcome(case)
            print(json.dumps(row), file=file, flush=True)
            print(row["number"], row["kind"], row["layout"], row["found"], row["ghosts"], flush=True)


if __name__ == "__main__":
    main()
