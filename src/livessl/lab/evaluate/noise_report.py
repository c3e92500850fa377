"""The report on the scenario `noise`: what is right, what is wrong, and what is claimed, in each kind of noise."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from livessl.core.locate.confidence import NEAR_M
from livessl.core.types import BoolArray
from livessl.lab.evaluate.localizer import METHODS
from livessl.lab.evaluate.localizer_report import Columns, SummaryRow, read_columns
from livessl.lab.evaluate.markdown import Block, Heading, Table, as_markdown
from livessl.lab.evaluate.noise import KINDS, LEAD_S, SENSOR_DB, TALKERS
from livessl.lab.evaluate.noise_rooms import NOISE_ROOMS
from livessl.lab.evaluate.scenarios import NOISE
from livessl.lab.evaluate.statistics import NINETY_PERCENT, wilson, write_csv

ALL: Final = "all"
"""Value of a column over which a row of the summary is taken."""


def write_noise_report(out: Path) -> list[Path]:
    """Write `summary.csv` and `report.md` into the folder of a campaign; return their paths."""
    settings = json.loads((out / "campaign.json").read_text(encoding="utf-8"))["settings"]
    rows = summary(read_columns(out / "results.parquet"))
    write_csv(out / "summary.csv", rows)
    (out / "report.md").write_text(as_markdown(_blocks(rows, settings)), encoding="utf-8")
    return [out / name for name in ("summary.csv", "report.md")]


def summary(columns: Columns) -> list[SummaryRow]:
    """Summarize each kind and level of noise by each method, over all rooms and sounds; then each room and each sound.

    `right` is the share of all sounds that are located within `NEAR_M`; `wrong` is the share of the located ones that
    are further off, and `at_noise` the share of those within `NEAR_M` of a noise source. Intervals are 95 % intervals
    by Wilson, as if sounds were independent.
    """
    levels_db = sorted(set(columns["snr_db"].tolist()), reverse=True)
    parts: list[dict[str, Any]] = [{"noise": kind, "snr_db": snr_db} for kind in KINDS for snr_db in levels_db]
    for name in ("room", "sound"):
        parts += [{name: value} for value in dict.fromkeys(columns[name].tolist())]
    rows = []
    for part in parts:
        here = np.ones(len(columns["method"]), dtype=np.bool_)
        for name, value in part.items():
            here &= columns[name] == value
        head = {"noise": ALL, "snr_db": ALL, "room": ALL, "sound": ALL} | part
        rows += [
            head | {"method": method} | _measured(columns, here & (columns["method"] == method)) for method in METHODS
        ]
    return rows


def _measured(columns: Columns, chosen: BoolArray) -> SummaryRow:
    located, error_m = columns["located"][chosen], columns["error_m"][chosen]
    near = error_m <= NEAR_M
    right, wrong, count = int((located & near).sum()), int((located & ~near).sum()), len(error_m)
    to_noise_m = columns["to_noise_m"][chosen][located & ~near].astype(np.float64)
    to_noise_m = to_noise_m[np.isfinite(to_noise_m)]  # white and diffuse noise have no place
    inside = columns["mahalanobis2"][chosen][located] <= NINETY_PERCENT
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
        "at_noise": float((to_noise_m <= NEAR_M).mean()) if len(to_noise_m) else np.nan,
        "confidence": float(columns["confidence"][chosen][located].mean()) if located.any() else np.nan,
        "inside_90": float(inside.mean()) if located.any() else np.nan,
    }
    return {"sounds": count} | {name: round(value, 4) for name, value in row.items()}


def _blocks(rows: Sequence[SummaryRow], settings: Mapping[str, Any]) -> list[Block]:
    levels = ",".join(f"{snr_db:g}" for snr_db in settings["snrs_db"])
    rooms = [
        (room.name, " x ".join(f"{edge:g}" for edge in room.size_m) + " m", f"{room.rt60_s:g} s", str(len(room.arrays)))
        for room in NOISE_ROOMS[settings["half"]]
    ]
    return [
        Heading(1, "Localization in the noise that rooms have"),
        f"{settings['positions']} positions in the rooms of the {settings['half']} half, one clip of each class at "
        f"each position, seed {settings['seed']}. All kinds and levels of noise get the same sounds. A sound is "
        f"*right* if it is located within {NEAR_M:g} m, of all sounds; *wrong* is the share of the located ones that "
        f"are further off, and *at the noise* the share of those that are within {NEAR_M:g} m of a noise source; it is "
        "empty where noise has no place. The *median* and "
        "*in the 90 % ellipsoid* are over the located sounds. *Within 0.5 m* counts sounds that are not located, too. "
        "Brackets hold 95 % intervals by Wilson, as if all sounds were independent.",
        f"Command: `livessl evaluate localizer --scenario {NOISE} --events DIR --positions {settings['positions']} "
        f"--snr {levels} --seed {settings['seed']} --half {settings['half']} --out DIR`, with the sounds of DCASE 2016 "
        "task 2.",
        Heading(2, "By kind and level of noise"),
        Table(("noise", "SNR", *_TITLES), [_cells(row, "noise", "snr_db") for row in rows if row["noise"] != ALL]),
        Heading(2, "By room, over all noise"),
        Table(("room", *_TITLES), [_cells(row, "room") for row in rows if row["room"] != ALL]),
        Heading(2, "By sound, over all noise"),
        Table(("sound", *_TITLES), [_cells(row, "sound") for row in rows if row["sound"] != ALL]),
        Heading(2, "Rooms and noise"),
        Table(("room", "size", "RT60", "arrays"), rooms),
        (
            "*White*: independent at each microphone.",
            "*Fan*: pink noise and the harmonics of the blades, with equal power, from one place in the room.",
            f"*Talkers*: clips of speech, one after another, from {TALKERS} places in the room.",
            "*Diffuse*: pink noise that arrives from all directions with equal power.",
        ),
        "Arrays are tetrahedra of 0.5 m, or horizontal squares of 0.2 m where the name says so. Walls are equal and "
        "rooms are boxes; all sources radiate alike in all directions. The level of the noise is relative to the mean "
        "power of the sound over its whole recording, from 100 Hz up. Sensor noise "
        f"{SENSOR_DB:g} dB below the sound is always added. The recording begins {LEAD_S:g} s before the sound, and "
        "the beginning of the sound is known: detection is not part of this measurement.",
    ]


_TITLES: Final = ("method", "sounds", "right", "wrong among located", "median", "at the noise", "within 0.5 m",
                  "mean confidence", "in the 90 % ellipsoid")  # fmt: skip


def _cells(row: SummaryRow, *names: str) -> tuple[str, ...]:
    head = [f"{row[name]:g} dB" if name == "snr_db" else str(row[name]) for name in names]
    return (
        *head,
        row["method"],
        str(row["sounds"]),
        _share(row, "right"),
        _share(row, "wrong") if row["located"] else "",
        f"{row['median_m']:.3f} m" if row["located"] else "",
        "" if np.isnan(row["at_noise"]) else f"{100 * row['at_noise']:.0f} %",
        f"{100 * row['near']:.1f} %",
        "" if np.isnan(row["confidence"]) else f"{row['confidence']:.2f}",
        f"{100 * row['inside_90']:.0f} %" if row["located"] else "",
    )


def _share(row: SummaryRow, name: str) -> str:
    return f"{100 * row[name]:.1f} % ({100 * row[f'{name}_low']:.1f} to {100 * row[f'{name}_high']:.1f})"
