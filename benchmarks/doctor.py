"""Faults of a set-up, made on purpose, and what the doctor says about them.

    python benchmarks/doctor.py --seeds 30 --out results/doctor --cache results/doctor/cache
    python benchmarks/doctor.py --seeds 5 --live --out results/doctor-live
    python benchmarks/doctor.py --table --out results/doctor --into docs/doctor.md

The rooms and the faults are those of `doctor_rooms.py`; seeds from 1000 on are for development, and those below it for
the report. A fault counts as named if a finding has its code, its array and, where it has one, its channel. With
`--live` the events go one by one to the examination of a running server, which is looked at after each.

The examinations of two arrays use what they observed beside the third one (clocks, too), and those of plugs in other
inputs what is observed with the plugs where they belong. A test shows that it differs by less than the delays' errors,
and `--live` does localize them. Rows are appended to `rows.jsonl` as they come, and those that are there are not
made again, so that a campaign can be interrupted. Observations are kept in `--cache`, if given: then only conclusions
are drawn again.
"""

from __future__ import annotations

import argparse
import json
import pickle
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from doctor_rooms import ARRAYS, FAULTS, RATE_HZ, Fault, Room, Routes, Target
from livessl import offline
from livessl.clock import SystemClock, UnpacedClock
from livessl.core.commission.finding import Finding, Severity
from livessl.core.types import Event, Observation
from livessl.examination import Gathered, conclude, gather
from livessl.lab.evaluate.markdown import Table, as_markdown
from livessl.lab.evaluate.statistics import wilson
from livessl.server.overload import Overload
from livessl.server.set_up_watch import SetUpWatch
from livessl.site.models import Site

DOUBT: Final = 0.5
"""Confidence at which a finding leaves open which array it is about."""

HARMFUL_M: Final = 0.2
"""Increase of the median error, in metres, from which a fault may not leave all arrays healthy."""

Row = dict[str, Any]


class Rooms:
    """The last room that was asked for, and what was observed in all, kept on the disk.

    Parameters
    ----------
    cache : Path or None
        Folder for observations.
    """

    def __init__(self, cache: Path | None) -> None:
        self._cache = cache
        self._room: Room | None = None
        self._gathered: dict[str, Gathered] = {}  # of the last room

    def room(self, seed: int) -> Room:
        """A room."""
        if self._room is None or self._room.seed != seed:
            self._room, self._gathered = Room(seed), {}
        return self._room

    def gathered(self, seed: int, fault: Fault, arrays: int) -> tuple[Site, Gathered]:
        """The site file, and what its examination rests on; what fewer arrays observed is that beside all others."""
        room = self.room(seed)
        made = fault if fault.recorded is not None else FAULTS[0]
        if made.name not in self._gathered:
            self._gathered[made.name] = self._of_all(room, made)
        gathered = self._gathered[made.name]
        if fault.routed is not None:
            gathered = _routed(gathered, fault.routed(room.target))
        return room.site_with(fault, arrays), _of_arrays(gathered, set(ARRAYS[:arrays]))

    def _of_all(self, room: Room, fault: Fault) -> Gathered:
        path = None if self._cache is None else self._cache / f"{room.seed}-{fault.name.replace(' ', '_')}.pickle"
        if path is not None and path.exists():
            found: Gathered = pickle.loads(path.read_bytes())  # noqa: S301 - written below
            return found
        site, recordings = room.site_with(fault, len(ARRAYS)), room.recordings_with(fault, len(ARRAYS))
        gathered = gather(*offline.assigned(site, recordings, RATE_HZ))
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(pickle.dumps(gathered))
        return gathered


def _routed(gathered: Gathered, routes: Routes) -> Gathered:
    """Return what is observed with the plugs in other inputs: the same, under other names and in another order."""
    inputs = {array: (array, np.arange(4)) for array in ARRAYS} | routes
    if any(one.array is not None for one in gathered.findings):
        raise ValueError("expected a set-up without faults of channels; their numbers would be others")

    def routed(sound: Sequence[Observation]) -> tuple[Observation, ...]:
        own = {one.array: one for one in sound}
        return tuple(
            replace(
                own[source],
                array=array,
                delays_s=own[source].delays_s[order],
                inverted=own[source].inverted[order],
                coherence=own[source].coherence[order],
                powers=own[source].powers[order],
            )
            for array, (source, order) in inputs.items()
            if source in own
        )

    return replace(gathered, sounds=tuple(routed(sound) for sound in gathered.sounds))


def _of_arrays(gathered: Gathered, arrays: set[str]) -> Gathered:
    """Return what some arrays observed."""
    sounds = (tuple(one for one in sound if one.array in arrays) for sound in gathered.sounds)
    findings = tuple(one for one in gathered.findings if one.array is None or one.array in arrays)
    return replace(gathered, sounds=tuple(sound for sound in sounds if sound), findings=findings)


def verdict(fault: Fault, at: Target, findings: Sequence[Finding]) -> Row:
    """Judge what was found: the fault by name, as one of several, or as a contradiction; and anything wrong."""
    named = any(_names(fault, at, one) and one.confidence > DOUBT for one in findings)
    either = not named and any(_names(fault, at, one) and one.array is not None for one in findings)
    errors = [one for one in findings if one.severity is Severity.ERROR and not _names(fault, at, one)]
    if either:
        errors = [one for one in errors if one.fault not in fault.expected]
    left_open = [one for one in errors if one.confidence <= DOUBT]
    wrong = len(errors) > len(left_open) or (not fault.expected and bool(findings))
    return {"named": named, "either": either, "open": bool(left_open) and not named, "wrong": wrong}


def _names(fault: Fault, at: Target, finding: Finding) -> bool:
    right = finding.fault in fault.expected
    if fault.of is not None and fault.expected:
        right = right and finding.array == at.array
    return right and (fault.of != "channel" or finding.channel == at.channel + 1)


def _said(findings: Sequence[Finding]) -> list[str]:
    return [f"{one.fault} {one.array} {one.channel} {one.confidence:.2f}: {one.message}" for one in findings]


def recorded_row(rooms: Rooms, seed: int, fault: Fault, arrays: int) -> Row:
    """Examine recordings."""
    site, gathered = rooms.gathered(seed, fault, arrays)
    began_s = time.process_time()
    findings = conclude(site, gathered).findings
    spent_s = time.process_time() - began_s
    target = rooms.room(seed).target
    return verdict(fault, target, findings) | {"cpu_s": round(spent_s, 3), "said": _said(findings)}


def live_row(rooms: Rooms, seed: int, fault: Fault, arrays: int) -> Row:
    """Give the events to a server's examination one by one."""
    room = rooms.room(seed)
    site = room.site_with(fault, arrays)
    watch = SetUpWatch(site, Overload(SystemClock()))
    events, degraded_after, changes, spent_s = [], None, 0, 0.0
    loaded, parts = offline.assigned(site, room.recordings_with(fault, arrays), RATE_HZ)
    for event in offline.run(loaded, parts, UnpacedClock()):
        if isinstance(event, Event):
            before = {(one.fault, one.array, one.channel) for one in watch.state.findings}
            watch.take(event)
            began_s = time.process_time()
            watch.examine()
            spent_s = max(spent_s, time.process_time() - began_s)
            events.append(replace(event, received=()))
            changes += before != {(one.fault, one.array, one.channel) for one in watch.state.findings}
            if watch.state.errors and degraded_after is None:
                degraded_after = watch.state.sounds
    findings = watch.state.findings
    return verdict(fault, room.target, findings) | {
        "error_m": room.error_m(events),
        "degraded": sorted(watch.state.errors),
        "degraded_after": degraded_after,
        "changes": changes,
        "cpu_s": round(spent_s, 3),
        "said": _said(findings),
    }


def table(rows: Sequence[Row]) -> str:
    """Return the rows as a table: in how many rooms each fault was named, and something wrong was found."""
    counts = sorted({row["arrays"] for row in rows})
    titles = ["fault"]
    for count in counts:
        titles += [f"{count} arrays: named (95 %)", "one of several", "left open", "wrong"]
    lines = []
    for fault in FAULTS:
        cells = [fault.name]
        for count in counts:
            own = [row for row in rows if row["fault"] == fault.name and row["arrays"] == count]
            cells.append(share([row["named"] for row in own]) if fault.expected else f"- of {len(own)}")
            cells += [str(sum(row[what] for row in own)) for what in ("either", "open")]
            wrong = [row["wrong"] for row in own]
            cells.append(str(sum(wrong)) if fault.expected else share(wrong))
        if any(row["fault"] == fault.name for row in rows):
            lines.append(cells)
    return as_markdown([Table(titles, lines), _cost(rows)])


def _cost(rows: Sequence[Row]) -> str:
    """Say how much time of a processor the conclusions took."""
    of = {
        kind: [row["cpu_s"] for row in rows if row["fault"].startswith("none") == (kind == "without faults")]
        for kind in ("without faults", "with one")
    }
    parts = [f"{np.median(each):.2f} s {kind} ({np.percentile(each, 95):.2f} s)" for kind, each in of.items() if each]
    return f"The examination of ten sounds took this much time of one processor, median and 95 %: {', '.join(parts)}."


def share(flags: Sequence[bool]) -> str:
    """Return how many of some are true, with the interval of 95 % (Wilson)."""
    low, high = wilson(sum(flags), len(flags))
    return f"{sum(flags)} of {len(flags)} ({100 * low:.0f} to {100 * high:.0f} %)"


def live_table(rows: Sequence[Row]) -> str:
    """Return the rows of `--live` as a table: which faults harm, and whether they leave all arrays healthy."""
    harmless = {(row["arrays"], row["seed"]): row["error_m"] for row in rows if row["fault"] == "none"}
    lines = []
    for count in sorted({row["arrays"] for row in rows}):
        for fault in FAULTS:
            own = [row for row in rows if row["fault"] == fault.name and row["arrays"] == count]
            if not own:
                continue
            harmed = [row for row in own if row["error_m"] - harmless.get((count, row["seed"]), 0.0) > HARMFUL_M]
            healthy = sum(not row["degraded"] for row in harmed)
            error_m = float(np.median([row["error_m"] for row in own]))
            named, changes = sum(row["named"] for row in own), max(row["changes"] for row in own)
            wrong, ever = sum(row["wrong"] for row in own), sum(row["degraded_after"] is not None for row in own)
            figures = [len(own), f"{error_m:.2f}", len(harmed), healthy, ever, named, wrong, changes]
            lines.append([fault.name, str(count), *map(str, figures)])
    titles = ["fault", "arrays", "rooms", "median error (m)", "rooms that it harms", "of these all healthy"]
    return as_markdown([Table([*titles, "degraded at any time", "named", "wrong", "most changes"], lines)])


def written_into(page: str, name: str, text: str) -> str:
    """Return a page with a text in the place that its comments name.

    Raises
    ------
    ValueError
        If the page has no such place.
    """
    begin, end = f"<!-- begin {name} -->\n", f"<!-- end {name} -->"
    if begin not in page or end not in page:
        raise ValueError(f"expected the lines {begin.strip()} and {end} in the page; add them where the table belongs")
    return page[: page.index(begin) + len(begin)] + "\n" + text + "\n" + page[page.index(end) :]


def main() -> None:
    """Run the campaign, or what is left of it, and print its table."""
    arguments = parsed()
    path = arguments.out / "rows.jsonl"
    rows = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()] if path.exists() else []
    if not arguments.table:
        arguments.out.mkdir(parents=True, exist_ok=True)
        known = {(row["arrays"], row["seed"], row["fault"]) for row in rows}
        make, rooms = live_row if arguments.live else recorded_row, Rooms(arguments.cache)
        with path.open("a", encoding="utf-8") as kept:
            for seed, fault, arrays in cases(arguments):
                if (arrays, seed, fault.name) not in known:
                    row = {"arrays": arrays, "seed": seed, "fault": fault.name} | make(rooms, seed, fault, arrays)
                    rows.append(row)
                    print(_short(row), flush=True)
                    kept.write(json.dumps(row) + "\n")
                    kept.flush()
    text = live_table(rows) if arguments.live else table(rows)
    (arguments.out / "table.md").write_text(text, encoding="utf-8")
    print(text)
    if arguments.into is not None:
        page = arguments.into.read_text(encoding="utf-8")
        name = "doctor --live" if arguments.live else "doctor"
        arguments.into.write_text(written_into(page, name, text), encoding="utf-8")


def parsed() -> argparse.Namespace:
    """Return the arguments of the command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--arrays", type=int, nargs="+", default=[2, 3])
    parser.add_argument("--fault", action="append", help="only faults of this name; repeatable")
    parser.add_argument(
        "--as-built", action="store_true", help="only faults of the site file, and none: they cost least"
    )
    parser.add_argument("--live", action="store_true", help="give the events to a server's examination, one by one")
    parser.add_argument("--out", type=Path, required=True, help="folder for rows.jsonl and table.md")
    parser.add_argument("--cache", type=Path, help="folder for observations")
    parser.add_argument("--table", action="store_true", help="only make the table of the rows so far")
    parser.add_argument("--into", type=Path, help="page whose table is replaced")
    return parser.parse_args()


def cases(arguments: argparse.Namespace) -> Iterator[tuple[int, Fault, int]]:
    """Yield seed, fault and number of arrays; all of a seed before the next one."""
    chosen = [
        fault
        for fault in FAULTS
        if (not arguments.fault or fault.name in arguments.fault)
        and (fault.live or not arguments.live)
        and (fault.recorded is None or not arguments.as_built)
    ]
    for seed in range(arguments.first, arguments.first + arguments.seeds):
        for fault in chosen:
            for arrays in arguments.arrays:
                yield seed, fault, arrays


def _short(row: Mapping[str, Any]) -> str:
    mark = next((what for what in ("named", "either", "open", "wrong") if row[what]), "-")
    wrong = " wrong" if row["wrong"] else ""
    return f"{row['arrays']} {row['seed']:3d} {row['fault']:<32} {mark + wrong:<12} {'; '.join(row['said'])}"


if __name__ == "__main__":
    main()
