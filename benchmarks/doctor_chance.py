"""How often chance looks like a fault of a pose, and how often any test could name one.

    python benchmarks/doctor_chance.py --seeds 100 --into docs/doctor.md

The rooms and the set-ups are those of `doctor_rooms.py`, from seed 2000 on. Nothing is rendered. The delays of ten
sounds have standard deviations that grow with the distance as those of the rendered rooms do (0.3 us at 1.8 m, 3 us at
7 m), and 20 us for 5 % of the sounds at each array, which received an echo.

Beside what the doctor says stands how often the best test would name the fault that looks for nothing else. It knows
the axis of the turn, or the line of the shift, but not the array and the sense, and names a fault in 2 % of the careful
set-ups. It follows from the slopes of the delays. A doctor that has to tell other faults, too, names fewer.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import norm

from doctor import share, verdict, written_into
from doctor_rooms import ARRAYS, FAULTS, SOUNDS, Fault, Room
from livessl.core.commission.diagnosis import diagnose
from livessl.core.commission.findings import EXACT_S, set_up_findings
from livessl.core.commission.set_up import Known, SetUp
from livessl.core.commission.tolerance import Fit
from livessl.core.types import FloatArray
from livessl.lab.evaluate.markdown import Table, as_markdown
from livessl.site.build.set_up import freedom_of

FIRST_SEED: Final = 2000
NEAR_STD_S, NEAR_M, GROWS = 0.3e-6, 1.8, 1.7
SPREAD, UNKNOWN = 0.5, 0.3
"""Spread of the logarithms of the standard deviations, and of what is known of each."""

POOR_STD_S, POOR_SHARE = 20e-6, 0.05
FALSE_SHARE: Final = 0.02
HARD: Final = ("none", "turned by 5 degrees", "moved by 0.5 m")
OF_POSES: Final = [fault for fault in FAULTS if fault.name.removesuffix(", poses measured") in HARD]
"""The faults that are not always told, and none; where poses were measured by hand and by claps."""


class Sounds:
    """Ten sounds in a careful set-up, and what its arrays measure of them.

    Parameters
    ----------
    seed, arrays : int
    """

    def __init__(self, seed: int, arrays: int) -> None:
        self.room, self._arrays = Room(seed), arrays
        site, rng = self.room.site_with(FAULTS[0], arrays), np.random.default_rng([seed, 9])
        size_m = np.array(site.room.size_m)
        self._c_m_s, self._bounds_m = site.c_m_s, np.column_stack([np.zeros(3), size_m])
        self._places_m = rng.uniform([0.5, 0.5, 0.5], [size_m[0] - 0.5, size_m[1] - 0.5, 2.2], (SOUNDS, 3))
        self._delays: dict[str, FloatArray] = {}
        self._stds_s: dict[str, FloatArray] = {}
        for name in ARRAYS[:arrays]:
            away_m = np.linalg.norm(self._places_m[:, None] - self.room.built(name), axis=2)
            std_s = NEAR_STD_S * (away_m.mean(axis=1) / NEAR_M) ** GROWS * np.exp(SPREAD * rng.standard_normal(SOUNDS))
            self._stds_s[name] = np.hypot(EXACT_S, std_s * np.exp(UNKNOWN * rng.standard_normal(SOUNDS)))
            std_s[rng.uniform(size=SOUNDS) < POOR_SHARE] = POOR_STD_S
            self._delays[name] = away_m / self._c_m_s + std_s[:, None] * rng.standard_normal(away_m.shape)

    def row(self, fault: Fault) -> dict[str, Any]:
        """Return what the doctor says of a fault, and how often the best test would tell it."""
        site = self.room.site_with(fault, self._arrays)
        filed = {spec.name: spec.microphones_m for spec in site.specs}
        known = Known(freedom_of(site), self._stds_s)
        diagnosis = diagnose(filed, self._delays, self._bounds_m, self._c_m_s, known)
        said = verdict(fault, self.room.target, list(set_up_findings(diagnosis)))
        gain = diagnosis.gained if diagnosis.rivals else 0.0
        return said | {"gain": gain, "lead": diagnosis.lead, "best": self._best_share(fault, filed, known)}

    def _best_share(self, fault: Fault, wrong: dict[str, FloatArray], known: Known) -> float:
        if fault.filed is None:
            return FALSE_SHARE
        none = next(one for one in FAULTS if not one.expected and one.measured == fault.measured)
        specs, name = self.room.site_with(none, self._arrays).specs, self.room.target.array
        right = {spec.name: spec.microphones_m for spec in specs}
        set_up = SetUp(right, self._delays, self._c_m_s, known.freedom, stds_s=known.stds_s)
        fit = Fit([set_up], self._places_m[None], self._bounds_m)
        fit.run()
        [seen] = fit.seen()
        away = np.zeros(len(seen))
        away[fit.pose_of(name)] = _pose_between(right[name], wrong[name]) / fit.pose_stds(name)
        return float(norm.cdf(np.sqrt(away @ seen @ away) - norm.isf(FALSE_SHARE / (2.0 * self._arrays))))


def _pose_between(right_m: FloatArray, wrong_m: FloatArray) -> FloatArray:
    """Shift, metres, and turn, radians, of one array from another, (6,)."""
    shift_m = wrong_m.mean(axis=0) - right_m.mean(axis=0)
    turn, _ = Rotation.align_vectors(wrong_m - wrong_m.mean(axis=0), right_m - right_m.mean(axis=0))
    return np.concatenate([shift_m, turn.as_rotvec()])


def table(rows: list[dict[str, Any]]) -> str:
    """Return the rows as a table."""
    lines = []
    for fault in OF_POSES:
        for arrays in (2, 3):
            own = [row for row in rows if row["fault"] == fault.name and row["arrays"] == arrays]
            if not own:
                continue
            named = share([row["named"] for row in own]) if fault.expected else f"- of {len(own)}"
            counts = [str(sum(row[what] for row in own)) for what in ("either", "open")]
            wrong = share([row["wrong"] for row in own])
            best = f"{100.0 * np.mean([row['best'] for row in own]):.0f} %"
            lines.append([fault.name, str(arrays), named, *counts, wrong, best])
    titles = ["fault", "arrays", "named (95 %)", "one of several", "left open", "wrong", "best test"]
    return as_markdown([Table(titles, lines)])


def main() -> None:
    """Make the set-ups and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=77)
    parser.add_argument("--fault", action="append", help="only faults of this name; repeatable")
    parser.add_argument("--into", type=Path, help="page whose table is replaced")
    arguments = parser.parse_args()
    rows = []
    for seed in range(FIRST_SEED, FIRST_SEED + arguments.seeds):
        for arrays in (2, 3):
            sounds = Sounds(seed, arrays)
            chosen = [fault for fault in OF_POSES if not arguments.fault or fault.name in arguments.fault]
            rows += [{"arrays": arrays, "fault": fault.name} | sounds.row(fault) for fault in chosen]
    text = table(rows)
    print(text)
    if arguments.into is not None:
        page = arguments.into.read_text(encoding="utf-8")
        arguments.into.write_text(written_into(page, "doctor chance", text), encoding="utf-8")


if __name__ == "__main__":
    main()
