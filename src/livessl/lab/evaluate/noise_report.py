"""The report on the scenario `noise`: what is right, what is wrong, and what is claimed, in each kind of noise."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np

from livessl.core.locate.confidence import NEAR_M
from livessl.lab.evaluate.figures.reliability import draw_reliability
from livessl.lab.evaluate.localizer_report import EDGES, Columns, SummaryRow, read_columns
from livessl.lab.evaluate.markdown import Block, Heading, Picture, Table, as_markdown
from livessl.lab.evaluate.noise import LEAD_S, OTHER_NOISE, SENSOR_DB, TALKERS
from livessl.lab.evaluate.noise_fit import noise_fit
from livessl.lab.evaluate.noise_rooms import NOISE_ROOMS
from livessl.lab.evaluate.noise_sounds import OTHER_SOUNDS
from livessl.lab.evaluate.noise_summary import (
    ALL,
    MOST_WRONG,
    NEAR_DEG,
    below_standard,
    reliability,
    summary,
    too_wrong,
    wrong_positions,
)
from livessl.lab.evaluate.scenarios import HALVES, NOISE
from livessl.lab.evaluate.statistics import write_csv

_PART_TITLES: Final = {"room": "room", "where": "place", "facing": "radiation", "sound": "sound"}


def write_noise_report(out: Path) -> list[Path]:
    """Write `summary.csv`, `report.md` and the figure into the folder of a campaign; return the two texts."""
    settings = json.loads((out / "campaign.json").read_text(encoding="utf-8"))["settings"]
    columns = read_columns(out / "results.parquet")
    rows = summary(columns)
    write_csv(out / "summary.csv", rows)
    draw_reliability(out / "figures", reliability(columns)[ALL])
    (out / "report.md").write_text(as_markdown(_blocks(columns, rows, settings)), encoding="utf-8")
    return [out / name for name in ("summary.csv", "report.md")]


def _blocks(columns: Columns, rows: Sequence[SummaryRow], settings: Mapping[str, Any]) -> list[Block]:
    wrong = wrong_positions(columns)
    levels = ",".join(f"{snr_db:g}" for snr_db in settings["snrs_db"])
    return [
        Heading(1, "Localization in the noise that rooms have"),
        f"{settings['positions']} positions in the rooms of the {settings['half']} half, one clip of each class at "
        f"each position, seed {settings['seed']}. All kinds and levels of noise get the same sounds. A sound is "
        f"*right* if it is located within {NEAR_M:g} m, of all sounds; *wrong* is the share of the located ones that "
        f"are further off, and *at the noise* the share of those that are within {NEAR_M:g} m of a noise source; it is "
        "empty where noise has no place. The *median* and "
        "*in the 90 % ellipsoid* are over the located sounds. *Within 0.5 m* counts sounds that are not located, too. "
        "Brackets hold 95 % intervals by Wilson, as if all sounds were independent.",
        f"Command: `livessl evaluate localizer --scenario {NOISE} --sounds DIR --positions {settings['positions']} "
        f"--snr {levels} --seed {settings['seed']} --half {settings['half']} --out DIR`, with the sounds of DCASE 2016 "
        "task 2.",
        Heading(2, "By kind and level of noise"),
        Table(("noise", "SNR", *_TITLES), [_cells(row, "noise", "snr_db") for row in rows if row["noise"] != ALL]),
        f"More than {100 * MOST_WRONG:g} % of the positions of `onset` are wrong in: {_named(too_wrong(rows))}. It has "
        f"fewer right sounds than the interval of `srp-phat` begins with in: {_named(below_standard(rows))}.",
        f"Of the {wrong['all']} wrong positions of `onset` {wrong['within_1_m']} are less than 1 m off, and "
        f"{wrong['at_noise']} within {NEAR_M:g} m of a noise source. {wrong['in_a_quarter']} of them belong to the "
        "quarter of the scenes that has most of them.",
        *(block for name in _PART_TITLES for block in _by(rows, name)),
        *_rooms_and_levels(rows),
        *_others(rows),
        *_confidence(columns),
        *_rooms(settings),
    ]


def _named(cells: Sequence[SummaryRow]) -> str:
    return ", ".join(f"{row['noise']} at {row['snr_db']:g} dB" for row in cells) or "no cell"


def _by(rows: Sequence[SummaryRow], name: str) -> list[Block]:
    here = [row for row in rows if row[name] != ALL and row["snr_db"] == ALL and row["sound"] not in OTHER_SOUNDS]
    title = _PART_TITLES[name]
    return [Heading(2, f"By {title}, over all noise"), Table((title, *_TITLES), [_cells(row, name) for row in here])]


def _rooms_and_levels(rows: Sequence[SummaryRow]) -> list[Block]:
    here = [row for row in rows if row["room"] != ALL and row["snr_db"] != ALL]
    cells = [
        (
            row["room"],
            f"{row['snr_db']:g} dB",
            row["method"],
            str(row["sounds"]),
            _share(row, "right"),
            _share(row, "wrong") if row["located"] else "",
            f"{100 * row['withheld']:.0f} %",
            f"{max(0.0, 100 * (1.0 - row['located'] - row['withheld'])):.0f} %",
        )
        for row in here
    ]
    return [
        Heading(2, "By room and level, over all kinds of noise"),
        "*Withheld* are the sounds of which no position is reported. If the best place is *near*, within "
        f"{NEAR_M:g} m, the sound is lost by its confidence or covariance alone.",
        Table(("room", "SNR", *_TITLES[:4], "withheld, near", "withheld, elsewhere"), cells),
    ]


def _others(rows: Sequence[SummaryRow]) -> list[Block]:
    here = [row for row in rows if row["sound"] in OTHER_SOUNDS]
    if not here:
        return []
    kind, snr_db = OTHER_NOISE
    cells = [
        (*_cells(row, "sound"), f"{100 * row['direction']:.0f} %, right {100 * row['right_direction']:.0f} %")
        for row in here
    ]
    return [
        Heading(2, f"Sounds of every kind, {kind} noise, {snr_db:g} dB"),
        "One synthesised sound of each kind at each position. *Direction only* is the share of all sounds; a direction "
        f"is right if it is off by at most {NEAR_DEG:g} degrees at the nearest array.",
        Table(("sound", *_TITLES, "direction only"), cells),
    ]


def _confidence(columns: Columns) -> list[Block]:
    classes = [f"{low:g} to {high:g}" for low, high in pairwise(EDGES)]
    rows = []
    for name, found in reliability(columns).items():
        cells = {each["low"]: f"{each['confidence']:.2f}: {each['near']:.2f} of {each['sounds']:g}" for each in found}
        rows.append([name, *(cells.get(low, "") for low in EDGES[:-1])])
    fit = noise_fit(columns)
    return [
        Heading(2, "Confidence"),
        "The confidence of all sounds, located or not. For each class of confidence: its mean, the share of sounds "
        f"within {NEAR_M:g} m, and the number of sounds.",
        Table(("noise", *classes), rows),
        "By the maximum likelihood of these sounds a beginning that has nothing at the position costs log-odds of "
        f"{fit.beginning:.1f}, and a second array {fit.weak:.2f} for each unit of peak-to-RMS ratio that it falls "
        "short of a clear peak. The standard deviation along the least certain axis counts "
        f"{fit.lines_spread:.1f} times where all arrays are lines. Another source begins "
        f"{100.0 * fit.elsewhere:.0f} % of the sounds. The constants in use come from the {HALVES[0]} half.",
        Picture("reliability", "Share of sounds within 0.5 m, with its 95 % interval, against the mean confidence"),
    ]


def _rooms(settings: Mapping[str, Any]) -> list[Block]:
    rooms = [
        (
            room.name,
            " x ".join(f"{edge:g}" for edge in room.size_m) + " m",
            f"{room.rt60_s:g} s",
            "equal" if room.has_equal_walls else "unequal",
            str(len(room.arrays)),
        )
        for room in NOISE_ROOMS[settings["half"]]
    ]
    return [
        Heading(2, "Rooms and noise"),
        Table(("room", "size", "RT60", "walls", "arrays"), rooms),
        (
            "*White*: independent at each microphone.",
            "*Fan*: pink noise and the harmonics of the blades, with equal power, from one place in the room.",
            "*Hum*: harmonics of twice the mains frequency, from one place.",
            f"*Talkers*: clips of speech, one after another, from {TALKERS} places in the room.",
            "*Diffuse*: pink noise that arrives from all directions with equal power.",
            "*Side*: pink noise from outside one wall or the ceiling: plane waves within 40 degrees of one direction.",
            "*Music*: synthesised music from a loudspeaker.",
            "*Intermittent*: pink noise from one place that is on for 0.3 to 1 s and off for 0.4 to 1.6 s; its level "
            "is the mean over both.",
        ),
        "Arrays are tetrahedra of 0.5 m, or what the name says: horizontal squares of 0.2 m or 64 mm, lines of four "
        "with 0.1 m between neighbours, or one of each (*mixed*). Unequal walls absorb 0.4 to 3 times the mean, and "
        "differently below 500 Hz, above 2 kHz and between. *Inside*, *edge* and *outside* are places less than 0.7 "
        "times, up to 1.2 times and more than 1.2 times as far from the middle of the arrays, in plan, as the furthest "
        "array is. Sources radiate alike *all around*, or as a talker who faces the nearest array (*towards*) or turns "
        "his back to it (*away*); noise sources radiate all around. The level of the noise is relative to the mean "
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
