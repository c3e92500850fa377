"""The report on the paper's campaigns as Markdown and CSV: what was run, claims and verdicts, medians and figures."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from livessl.lab.evaluate.campaign import REPORT_FILES, read_costs, require_no_others
from livessl.lab.evaluate.claims import claims
from livessl.lab.evaluate.figures.medians import draw_all
from livessl.lab.evaluate.markdown import Block, Heading, Picture, Table, as_markdown
from livessl.lab.evaluate.paper import EXPERIMENTS
from livessl.lab.evaluate.statistics import Interval, Results, read_results, summary, write_csv
from livessl.lab.evaluate.verdict import Claim

READINGS: Final = (
    "Sounds are sampled at 16 kHz, enough for a band of 100 to 6000 Hz, and high-passed at 100 Hz. Recordings are "
    "rounded to 16 bits, with their largest sample at -6 dBFS. There is no sensor noise without --snr.",
    "Activity: the mean power of the system's microphones in frames of 50 ms; a frame is active from a tenth of the "
    "largest power on. All channels share one mask; the longest segment is localized (--segment).",
    "srp-phat: GCC-PHAT of the whole segment, band-limited per pair and grid point to 1/(2 D |grad tau|), not "
    "normalised, summed over pairs and arrays (--no-band-limit). On grids of more than 8192 points the cut-offs are "
    "third octaves.",
    "cepstral: rectangular frames of 0.6 s or half the segment; the channel's cepstrum is that of the first frame, "
    "updated by 0.06 of each further one. averaged: 25 ms Hann frames that overlap by half.",
    "Grids are cell-centred. The estimate is the highest grid point, not refined below the grid, as in the paper.",
    "Rooms are simulated by the image method, with walls by Sabine's formula with 24 ln 10 / c. Each response ends at "
    "its nominal reverberation time; T30 is measured on the responses.",
    "Intervals are 99 % bootstrap intervals. Positions are resampled, in the same way for all conditions, so that "
    "differences are paired.",
)
"""Decisions on points that the paper leaves open; each is a switch or a line here."""

PAPERS_LAYOUT: Final = (
    "A tetrahedron consists of every other vertex of a cube. The second array of a pair is mirrored along the length, "
    "so that two arrays at 0 m are the eight vertices of a cube; the 8-microphone array consists of these eight.",
    "The office is simulated, with sources anywhere in 4 x 4 m at two heights 2 m apart; the paper's office was real.",
)
"""The same for rooms and arrays of the paper's campaigns."""

OTHER_LAYOUT: Final = (
    "Room, search volume, speed of sound, bands and arrays are those of the site file.",
    "Sources are anywhere in the search volume.",
)
"""The same for rooms and arrays of a site file."""

_TITLES: Final = ("The paper, reproduced", "The paper's experiments with other arrays")
"""Titles of a report, with the paper's arrays and with others."""

_RUN_TITLES: Final = (
    "experiment",
    "positions",
    "events per condition",
    "seed",
    "grid",
    "SNR",
    "CPU time per position",
    "CPU time, total",
    "peak memory",
)


def write_report(out: Path, folders: Sequence[Path]) -> list[Path]:
    """Write summary, claims, figures and report of the campaigns in `folders` into `out`.

    Returns
    -------
    list of Path
        The tables and texts that were written.

    Raises
    ------
    ValueError
        If a folder holds no finished campaign, or two hold the same experiment.
    """
    campaigns: dict[str, Results] = {}
    about: dict[str, dict[str, Any]] = {}
    _require_own(out)
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
    written = {"report.md": as_markdown(blocks)}
    tables = ["summary.csv"]
    if found:
        write_csv(out / "claims.csv", [dict(zip(_CLAIM_TITLES, row, strict=True)) for row in _claim_rows(found)])
        tables.append("claims.csv")
        table = Table(_CLAIM_TITLES, _claim_rows(found))
        written = {"claims.md": as_markdown([Heading(1, "Claims of the paper"), table])} | written
    for name, text in written.items():
        (out / name).write_text(text, encoding="utf-8")
    return [out / name for name in (*tables, *written)]


def _require_own(out: Path) -> None:
    """Raise ValueError if a folder holds files of these names, but neither a campaign nor an earlier report."""
    if (out / "campaign.json").exists():
        return
    report = out / "report.md"
    if report.is_file():
        first = report.read_bytes().partition(b"\n")[0].decode(errors="replace")
        if first in [f"# {title}" for title in _TITLES]:
            return
    require_no_others(out, REPORT_FILES)


def require_campaign(folder: Path) -> None:
    """Check that a folder holds a finished campaign.

    Raises
    ------
    ValueError
        If it does not.
    """
    if not all((folder / name).exists() for name in ("campaign.json", "results.parquet")):
        raise ValueError(f"{folder}: expected a finished campaign (campaign.json, results.parquet), got none")


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
    blocks: list[Block] = [Heading(1, _title(found)), Heading(2, "What was run"), _runs(campaigns, about)]
    if found:
        counts: dict[str, int] = {}
        for claim in found:
            counts[claim.verdict] = counts.get(claim.verdict, 0) + 1
        blocks += [
            Heading(2, "The paper's claims and our results"),
            ", ".join(f"{count} {verdict}" for verdict, count in sorted(counts.items()))
            + ". Nothing was tuned towards the paper; a claim that is not reproduced is a finding.",
            Table(_CLAIM_TITLES, _claim_rows(found)),
        ]
    blocks += [
        Heading(2, "Figures"),
        *(Picture(name, text) for name, text in figures.items()),
        Heading(2, "Medians"),
        "In metres, over all sounds, with 99 % intervals. `summary.csv` has quartiles, tails and each class of sound.",
    ]
    for results in campaigns.values():
        blocks += [Heading(3, results.experiment), _medians(results)]
    blocks += [Heading(3, "By class of sound"), _by_class(rows)]
    blocks += [
        Heading(2, "How open points of the paper are settled"),
        (*READINGS, *(PAPERS_LAYOUT if found else OTHER_LAYOUT)),
    ]
    return blocks


def _runs(campaigns: Mapping[str, Results], about: Mapping[str, Mapping[str, Any]]) -> Table:
    """Settings and cost of each campaign."""
    rows = []
    for experiment, results in campaigns.items():
        settings, costs = about[experiment], about[experiment]["costs"]
        cpu_s = [cost["cpu_s"] for cost in costs]
        rows.append(
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
    return Table(_RUN_TITLES, rows)


def _title(found: Sequence[Claim]) -> str:
    return _TITLES[0] if found else _TITLES[1]


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
    """Median and share over 1 m, at the shortest, the middle and the longest reverberation time."""
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
