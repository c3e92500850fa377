"""The report: what was run, what the claims came to, medians and figures. Markdown, HTML and CSV of one content."""

from __future__ import annotations

import html
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from livessl.lab.evaluate.campaign import read_costs
from livessl.lab.evaluate.claims import Claim, claims
from livessl.lab.evaluate.figures import draw_all
from livessl.lab.evaluate.paper import EXPERIMENTS
from livessl.lab.evaluate.statistics import Interval, Results, read_results, summary, write_csv

READINGS: Final = (
    "Sounds come at 16 kHz, enough for a band of 100 to 6000 Hz, high-passed at 100 Hz; recordings are rounded to 16 "
    "bits, their largest sample at -6 dBFS. No sensor noise unless --snr.",
    "Activity: 50 ms frames of the mean power of the system's microphones, active from a tenth of the maximum; one "
    "mask for all channels; the longest segment is localized (--segment).",
    "srp-phat: GCC-PHAT of the whole segment, band-limited per pair and node to 1/(2 D |grad tau|), not normalised, "
    "summed over pairs and arrays (--no-band-limit). On grids of more than 8192 nodes cut-offs are third octaves.",
    "cepstral: rectangular frames of 0.6 s or half the segment, the channel's cepstrum starts as the first frame's and "
    "takes 0.06 of each further one. averaged: 25 ms Hann frames, half overlapping.",
    "Grids are cell-centred; the estimate is the highest node, not refined below the grid, as in the paper.",
    "Rooms by the image method, walls by Sabine with 24 ln 10 / c; each response ends at its nominal reverberation "
    "time. T30 is what the responses then measure.",
    "Intervals are 99 % bootstrap intervals; positions are resampled, all conditions alike, so differences are paired.",
)
"""How the paper's open points are read; each is a switch or a line here."""

PAPERS_LAYOUT: Final = (
    "Tetrahedra are every other vertex of a cube, the second of a pair mirrored along the length, so that two at 0 m "
    "are a cube's eight vertices; the 8-microphone array is these eight.",
    "The office is simulated with sources anywhere in 4 x 4 m at two heights 2 m apart; the paper's was real.",
)
OTHER_LAYOUT: Final = (
    "Room, search volume, speed of sound, bands and arrays are the site file's.",
    "Sources are anywhere in the search volume.",
)
"""What is read so of rooms and arrays."""


@dataclass(frozen=True, slots=True)
class Heading:
    """A title of a level from 1 on."""

    level: int
    text: str


@dataclass(frozen=True, slots=True)
class Table:
    """Column titles and rows of text."""

    titles: Sequence[str]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True, slots=True)
class Picture:
    """A figure by its name, and what it shows."""

    name: str
    text: str


Block = Heading | Table | Picture | str | tuple[str, ...]
"""A part of the report; text is a paragraph, a tuple of text a list."""


def write_report(out: Path, folders: Sequence[Path]) -> list[Path]:
    """Write summary, claims, figures and report of the campaigns in `folders` into `out`.

    Raises
    ------
    ValueError
        Where a folder holds no finished campaign, or two hold the same experiment.
    """
    campaigns: dict[str, Results] = {}
    about: dict[str, dict[str, Any]] = {}
    for folder in folders:
        require_campaign(folder)
        settings = json.loads((folder / "campaign.json").read_text(encoding="utf-8"))["settings"]
        experiment = settings["experiment"]
        if "layout" in settings:
            experiment += f"-{settings['layout']['site']}"
        if experiment in campaigns:
            raise ValueError(f"{folder}: expected each experiment once, got {experiment} again")
        campaigns[experiment] = read_results(folder / "results.parquet", experiment)
        about[experiment] = settings | {"costs": read_costs(folder)}
    out.mkdir(parents=True, exist_ok=True)
    rows = [row for results in campaigns.values() for row in summary(results)]
    found = claims(campaigns) if EXPERIMENTS.keys() & campaigns.keys() else []
    figures = draw_all(out / "figures", campaigns)
    blocks = _blocks(campaigns, about, rows, found, figures)
    write_csv(out / "summary.csv", rows)
    written = {"report.md": as_markdown(blocks), "report.html": as_html(_title(found), blocks)}
    tables = ["summary.csv"]
    if found:
        write_csv(out / "claims.csv", [dict(zip(_CLAIM_TITLES, row, strict=True)) for row in _claim_rows(found)])
        tables.append("claims.csv")
        table = Table(_CLAIM_TITLES, _claim_rows(found))
        written = {"claims.md": as_markdown([Heading(1, "What the paper says"), table])} | written
    for name, text in written.items():
        (out / name).write_text(text, encoding="utf-8")
    return [out / name for name in (*tables, *written)]


def require_campaign(folder: Path) -> None:
    """Refuse a folder that holds no finished campaign.

    Raises
    ------
    ValueError
        Then.
    """
    if not all((folder / name).exists() for name in ("campaign.json", "results.parquet")):
        raise ValueError(f"{folder}: expected a finished campaign (campaign.json, results.parquet), got none")


def as_markdown(blocks: Sequence[Block]) -> str:
    """Blocks as GitHub's Markdown."""
    parts = []
    for block in blocks:
        match block:
            case Heading(level, text):
                parts.append(f"{'#' * level} {text}")
            case Table(titles, rows):
                escaped = [[cell.replace("|", "\\|") for cell in cells] for cells in rows]
                lines = [" | ".join(cells) for cells in (titles, ["---"] * len(titles), *escaped)]
                parts.append("\n".join(f"| {line} |" for line in lines))
            case Picture(name, text):
                parts.append(f"![{text}](figures/{name}.png)\n\n*{text}.*")
            case str():
                parts.append(block)
            case _:
                parts.append("\n".join(f"- {item}" for item in block))
    return "\n\n".join(parts) + "\n"


def as_html(title: str, blocks: Sequence[Block]) -> str:
    """Blocks as a page that needs only the figures beside it."""
    parts = []
    for block in blocks:
        match block:
            case Heading(level, text):
                parts.append(f"<h{level}>{html.escape(text)}</h{level}>")
            case Table(titles, rows):
                head = "".join(f"<th>{html.escape(cell)}</th>" for cell in titles)
                body = "\n".join(
                    "<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in cells) + "</tr>" for cells in rows
                )
                parts.append(f"<table><thead><tr>{head}</tr></thead><tbody>\n{body}\n</tbody></table>")
            case Picture(name, text):
                caption = html.escape(text)
                image = f'<img src="figures/{name}.svg" alt="{caption}">'
                parts.append(f"<figure>{image}<figcaption>{caption}.</figcaption></figure>")
            case str():
                parts.append(f"<p>{html.escape(block)}</p>")
            case _:
                parts.append("<ul>" + "".join(f"<li>{html.escape(item)}</li>" for item in block) + "</ul>")
    body = "\n".join(parts)
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{html.escape(title)}</title>\n'
        f"<style>{_STYLE}</style></head>\n<body>\n{body}\n</body></html>\n"
    )


_STYLE: Final = (
    "body{font:15px/1.5 system-ui,sans-serif;max-width:70em;margin:2em auto;padding:0 1em}"
    "table{border-collapse:collapse;margin:1em 0}td,th{border:1px solid #ccc;padding:.2em .5em;text-align:left}"
    "figure{margin:1.5em 0}img{max-width:100%}"
)

_CLAIM_TITLES: Final = ("claim", "the paper", "decided by", "holds within", "ours", "99 % interval", "verdict", "note")


def _claim_rows(found: Sequence[Claim]) -> list[list[str]]:
    rows = []
    for claim in found:
        ours, interval = "-", "-"
        if claim.ours is not None:
            digits = 3 if claim.name in {"kd", "coherence"} else 2
            ours = f"{claim.ours.value:.{digits}f}"
            interval = f"{claim.ours.low:.{digits}f} to {claim.ours.high:.{digits}f}"
        rows.append(
            [
                claim.name,
                claim.paper,
                claim.measure,
                _region(claim.region),
                ours,
                interval,
                str(claim.verdict),
                claim.note,
            ]
        )
    return rows


def _region(region: tuple[float, float]) -> str:
    low, high = region
    if high == np.inf:
        return "above 0" if low < 1e-3 else f"{low:g} and above"
    return f"{high:g} and below" if low == -np.inf else f"{low:g} to {high:g}"


def _blocks(
    campaigns: Mapping[str, Results],
    about: Mapping[str, Mapping[str, Any]],
    rows: Sequence[Mapping[str, Any]],
    found: Sequence[Claim],
    figures: Mapping[str, str],
) -> list[Block]:
    blocks: list[Block] = [Heading(1, _title(found)), Heading(2, "What was run")]
    titles = [
        "experiment",
        "positions",
        "events a condition",
        "seed",
        "grid",
        "SNR",
        "CPU a position",
        "CPU in all",
        "peak memory",
    ]
    run = []
    for experiment, results in campaigns.items():
        settings, costs = about[experiment], about[experiment]["costs"]
        cpu_s = [cost["cpu_s"] for cost in costs]
        run.append(
            [
                experiment,
                str(results.positions),
                str(results.positions * len(results.classes)),
                str(settings["seed"]),
                f"{settings['spacing_m']:g} m",
                "no noise" if settings["snr_db"] is None else f"{settings['snr_db']:g} dB",
                f"{np.mean(cpu_s):.1f} s" if cpu_s else "-",
                f"{sum(cpu_s) / 3600.0:.2f} h" if cpu_s else "-",
                f"{max(cost['peak_mib'] for cost in costs):.0f} MiB" if costs else "-",
            ]
        )
    blocks.append(Table(titles, run))
    if found:
        counts: dict[str, int] = {}
        for claim in found:
            counts[claim.verdict] = counts.get(claim.verdict, 0) + 1
        blocks += [
            Heading(2, "What the paper says, and what we find"),
            ", ".join(f"{count} {verdict}" for verdict, count in sorted(counts.items()))
            + ". Nothing was tuned towards the paper: a claim that does not hold is a finding.",
            Table(_CLAIM_TITLES, _claim_rows(found)),
        ]
    blocks += [
        Heading(2, "Figures"),
        *(Picture(name, text) for name, text in figures.items()),
        Heading(2, "Medians"),
        "Metres, all sounds, with 99 % intervals; `summary.csv` has quartiles, tails and each class of sound.",
    ]
    for results in campaigns.values():
        blocks += [Heading(3, results.experiment), _medians(results)]
    blocks += [Heading(3, "By class of sound"), _by_class(rows)]
    blocks += [
        Heading(2, "How the paper's open points are read"),
        (*READINGS, *(PAPERS_LAYOUT if found else OTHER_LAYOUT)),
    ]
    return blocks


def _title(found: Sequence[Claim]) -> str:
    return "The paper, reproduced" if found else "The paper's experiments with other arrays"


def _medians(results: Results) -> Table:
    columns = list(dict.fromkeys(condition[:2] for condition in results.values))
    titles = ["RT60 (s)", "T30 (s)", *(f"{system}, {method}" for system, method in columns)]
    rows = []
    for rt60_s in results.rt60s_s:
        cells = []
        for system, method in columns:
            interval = Interval.of(results.medians(system, method, rt60_s))
            cells.append(f"{interval.value:.2f} [{interval.low:.2f}, {interval.high:.2f}]")
        rows.append([f"{rt60_s:g}", f"{np.median(results.t30_s[rt60_s]):.2f}", *cells])
    return Table(titles, rows)


def _by_class(rows: Sequence[Mapping[str, Any]]) -> Table:
    """Median and share beyond 1 m, at the ends and the middle of what was run."""
    titles = ["experiment", "system", "method", "RT60 (s)"]
    sounds = list(dict.fromkeys(row["sound"] for row in rows))
    lines: dict[tuple[str, ...], dict[str, str]] = {}
    for experiment in dict.fromkeys(row["experiment"] for row in rows):
        times = sorted({row["rt60_s"] for row in rows if row["experiment"] == experiment})
        shown = {times[0], times[len(times) // 2], times[-1]}
        for row in rows:
            if row["experiment"] == experiment and row["rt60_s"] in shown:
                key = (experiment, row["system"], row["method"], f"{row['rt60_s']:g}")
                lines.setdefault(key, {})[row["sound"]] = f"{row['median_m']:.2f} ({row['over_1_m']:.0%})"
    return Table(
        [*titles, *(f"{sound}: median (over 1 m)" for sound in sounds)],
        [[*key, *(cells.get(sound, "-") for sound in sounds)] for key, cells in lines.items()],
    )
