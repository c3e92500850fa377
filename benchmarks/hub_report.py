"""Tables about the load of hubs, made of what `hub_load.py` has measured."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from growth import Fit
from hub_sites import ARRAYS, EVENTS_PER_HOUR, MESSAGES_PER_HOUR, MIN_PACE
from livessl.lab.evaluate.markdown import Block, Table, as_markdown
from livessl.server.forwarding.link import REPORT_S

BEGIN: Final = "<!-- begin hub load -->\n"
END: Final = "<!-- end hub load -->"

STREAM_BYTES: Final = 10_000_000_000
"""What the stream keeps by default (`stream.max_bytes`)."""

PARTS: Final = {"hub": "the hub", "database": "PostgreSQL", "nats": "NATS"}
"""Parts whose processor time is measured, by their names in the files, and as they are called on the page."""

MANY: Final = 100_000_000
"""Stored events to which the fit of the answers is extended."""

ANSWERS: Final = (
    "95th percentile of the times of the API's answers, ms (in brackets that of the processor time of hub and database "
    "meanwhile, ms)"
)

ROWS: Final = (
    "`all sites` is `GET sites`, `metrics` is `GET /metrics`, and all other rows are searches by `GET events`."
)

Json = dict[str, Any]


def written_into(page: str, text: str) -> str:
    """Return a page with a text in the place that its comments name.

    Raises
    ------
    ValueError
        If the page has no such place.
    """
    if BEGIN not in page or END not in page:
        raise ValueError(f"expected the lines {BEGIN.strip()} and {END} in the page; add them where the tables belong")
    return page[: page.index(BEGIN) + len(BEGIN)] + "\n" + text + "\n" + page[page.index(END) :]


def document(folder: Path) -> str:
    """Return the tables of all that was measured into a folder.

    Raises
    ------
    ValueError
        If there is nothing.
    """
    loads, hours, histories = _read(folder, "sites"), _read(folder, "hour"), _read(folder, "history")
    if not (loads or hours or histories):
        what = "expected files sites-N.json, hour-N.json or history-N.json; measure with --sites, --hour or --history"
        raise ValueError(f"{folder}: {what}")
    blocks: list[Block] = []
    if loads:
        blocks += [_about(loads), _flood(loads), "Processor time and disk space of these runs:", _costs(loads)]
        blocks.append(_of_a_site(loads))
        paced = [load for load in loads if "paced" in load]
        if paced:
            pace = f"At the pace of real time; at least {MIN_PACE:.0f} messages a second:"
            blocks += [pace, _paced(paced), *_limits(loads)]
            blocks += [
                f"{ANSWERS}, at the pace of real time. {ROWS}",
                _answers(paced, "sites"),
            ]
        else:
            blocks += _limits(loads)
    for hour in hours:
        blocks += _hour(hour)
    if histories:
        blocks += [
            _about(histories),
            _stored(histories),
            f"{ANSWERS}. {ROWS}",
            _answers(histories, "history"),
        ]
        blocks += _fit(histories)
    return as_markdown(blocks)


def _read(folder: Path, name: str) -> list[Json]:
    found = [json.loads(path.read_text(encoding="utf-8")) for path in folder.glob(f"{name}-*.json")]
    return sorted(found, key=lambda each: int(each[name]))


def _about(runs: Sequence[Json]) -> str:
    run = runs[-1]
    machine = run["machine"]
    loads = ", ".join(f"{each['machine']['load_before']:.1f}" for each in runs)
    return (
        f"{machine['cpu']}, {machine['cores']} cores; {run['database']}. Besides the benchmark, the machine did "
        f"{run['beside']} (load average at the start of each run: {loads})."
    )


def _flood(loads: Sequence[Json]) -> Table:
    titles = (
        "sites",
        "arrays",
        "messages",
        "published /s",
        "taken in /s",
        "speed (1 = real time)",
        "largest backlog, messages",
    )
    rows = [
        (
            *(f"{load['sites']}", f"{load['sites'] * len(ARRAYS)}", _messages(load)),
            *(f"{load['published_per_s']:.0f}", f"{load['taken_in_per_s']:.0f}"),
            f"{load['taken_in_per_s'] / real_time_per_s(load['sites']):.1f}",
            f"{load['most_waiting']}",
        )
        for load in loads
    ]
    return Table(titles, rows)


def _costs(loads: Sequence[Json]) -> Table:
    titles = ("sites", *(f"{name}, ms a message" for name in PARTS.values()), "stream, bytes a message",
              "database, bytes an event")  # fmt: skip
    rows = [
        (
            f"{load['sites']}",
            *(_number(load["processor_ms_per_message"].get(name), 2) for name in PARTS),
            f"{load['stream_bytes_per_message']:.0f}",
            f"{load['database_bytes_per_event']:.0f}",
        )
        for load in loads
    ]
    return Table(titles, rows)


def _number(value: float | None, digits: int, unit: str = "") -> str:
    """Return a number as text; a dash for an SQLite file, which is no process."""
    return "–" if value is None else f"{value:.{digits}f}{unit}"


def _messages(load: Json) -> str:
    """Return how many messages were published, of how many minutes, and whether all were taken in."""
    return f"{load['messages']} of {load['minutes']} min{'' if load['is_drained'] else ', not all taken in'}"


def _paced(loads: Sequence[Json]) -> Table:
    titles = ("sites", "messages /s", "reports /s", "age of the oldest message that waits: median, 95 %, longest",
              *PARTS.values(), "most memory of the hub")  # fmt: skip
    rows = []
    for load in loads:
        paced, lag = load["paced"], load["paced"]["lag"]
        shares = paced["processor_share"]
        rows.append(
            (
                *(f"{load['sites']}", f"{paced['messages_per_s']:.0f}", f"{load['sites'] / REPORT_S:.1f}"),
                _ages(lag),
                *(_share(shares, name) for name in PARTS),
                f"{load['hub_memory_mb']:.0f} MB",
            )
        )
    return Table(titles, rows)


def _hour(run: Json) -> list[Block]:
    """Return how it went when sites sent their hour at a multiple of its pace."""
    messages, events, sites = run["messages"], run["events"], run["hour"]
    days, size = sites * run["minutes"] / 60 / 24, run["database_bytes"] / 1e6
    grown = f"and the database by {size:.0f} MB, which is {size / days:.1f} MB a day for a site."
    if not run["is_drained"]:
        grown = f"and the database by {size:.0f} MB."
    taken = "all" if run["is_drained"] else "not all"
    text = (
        f"{run['minutes']} minutes of {sites} sites at {run['times_real']:g} times their pace: {messages} messages "
        f"with {events} events in {run['took_s']:.0f} s, {taken} taken in at the end. "
        f"The stream grew to {run['stream_bytes'] / 1e6:.0f} MB {grown}"
    )
    titles = (
        *("until minute", "messages /s", "age of the oldest message that waits: median, 95 %, longest"),
        *("largest backlog, messages", *PARTS.values(), "memory of the hub", "slowest kind of answer, 95 %"),
    )
    rows = []
    for part in run["parts"]:
        slowest = max(part["answers"], key=lambda kind: float(part["answers"][kind]["p95_ms"]))
        rows.append(
            (
                *(f"{part['until_minute']:g}", f"{part['messages_per_s']:.0f}", _ages(part["lag"])),
                f"{part['most_waiting']}",
                *(_share(part["processor_share"], name) for name in PARTS),
                f"{part['hub_memory_mb']:.0f} MB",
                f"{part['answers'][slowest]['p95_ms']:.0f} ms ({slowest})",
            )
        )
    return [_about([run]), text, Table(titles, rows)]


def _ages(lag: Json) -> str:
    return f"{lag['p50_ms'] / 1000:.2f}, {lag['p95_ms'] / 1000:.2f}, {lag['max_ms'] / 1000:.2f} s"


def _share(shares: Json, name: str) -> str:
    return _number(100 * shares[name] if name in shares else None, 1, " % of a core")


def _stored(runs: Sequence[Json]) -> str:
    """Return what the largest history takes."""
    run = runs[-1]
    size, count = run["database_bytes"], run["history"]
    return (
        f"{count} events of {run['sites']} sites take {size / 1e9:.1f} GB, {size / count:.0f} bytes an event. They "
        f"were made by the database itself; the last step took {run['filled_s']:.0f} s."
    )


def _longest(loads: Sequence[Json]) -> Json:
    """Return the run of the longest time, in which what sites send once counts least in the disk space."""
    return max(loads, key=lambda each: (each["minutes"], each["sites"]))


def _bytes_per_day(load: Json) -> float:
    return float(24 * MESSAGES_PER_HOUR * load["stream_bytes_per_message"])


def _of_a_site(loads: Sequence[Json]) -> str:
    """Return what a site sends in an hour, and what that takes."""
    load, longest = loads[-1], _longest(loads)
    stored = 24 * EVENTS_PER_HOUR * longest["database_bytes_per_event"]
    reports, real = load["sites"] / REPORT_S / load["taken_in_per_s"], 1 / REPORT_S / real_time_per_s(1)
    return (
        f"A site of {len(ARRAYS)} arrays with {EVENTS_PER_HOUR} events an hour sends {MESSAGES_PER_HOUR} messages an "
        f"hour, and {1 + len(ARRAYS)} more when it begins: its own first one and the first state of each array. These "
        f"messages take {_bytes_per_day(longest) / 1e6:.1f} MB of the stream and {stored / 1e6:.1f} MB of the "
        f"database a day (by the figures of {longest['sites']} sites). The processor times include the sites' reports "
        f"on themselves: in the run of {load['sites']} sites, {reports:.1f} reports came with each message; at the "
        f"pace of real time, {real:.1f} reports come with each message."
    )


def _limits(loads: Sequence[Json]) -> list[Block]:
    """Return by what the number of sites is limited, the first limit first.

    Processor time is that of the most sites, at the pace of real time if it was measured; disk is that of `_longest`.
    """
    load, longest = loads[-1], _longest(loads)
    sites, pace = load["sites"], real_time_per_s(load["sites"])
    which = "at full speed"
    shares = {name: ms / 1000 * pace for name, ms in load["processor_ms_per_message"].items()}
    if "paced" in load and pace >= MIN_PACE:
        shares, which = load["paced"]["processor_share"], "at the pace of real time"
    most = {f"a core for {PARTS[name]}": sites / share for name, share in shares.items() if share > 0}
    most["the rate that the hub took in here"] = load["taken_in_per_s"] / real_time_per_s(1)
    most["10 GB of stream that hold a day of messages"] = STREAM_BYTES / _bytes_per_day(longest)
    rows = [(name, f"{count:.0f}") for name, count in sorted(most.items(), key=lambda each: each[1])]
    return [f"Limits, extrapolated from {sites} sites {which}:", Table(("limit", "sites"), rows)]


def _answers(runs: Sequence[Json], key: str) -> Table:
    def answers(run: Json) -> Json:
        found: Json = run["answers"] if "answers" in run else run["paced"]["answers"]
        return found

    kinds = list(answers(runs[-1]))
    rows = [(kind, *(_answer(answers(run).get(kind)) for run in runs)) for kind in kinds]
    return Table(("answer", *(_count(run, key) for run in runs)), rows)


def _answer(times: Json | None) -> str:
    """Return the time of answers, and in brackets the processor time of hub and database meanwhile."""
    if times is None:
        return "–"
    processor = f" ({times['cpu_p95_ms']:.0f})" if times.get("cpu_p95_ms") is not None else ""
    return f"{times['p95_ms']:.0f}{processor}"


def _count(run: Json, key: str) -> str:
    noun = "stored event" if key == "history" else "site"
    return f"{run[key]} {noun}{'' if run[key] == 1 else 's'}"


def _fit(runs: Sequence[Json]) -> list[Block]:
    """Return what a power law says of more events than were stored; nothing if there are too few steps."""
    if len(runs) < 3:
        return []
    lines = []
    counts = [float(run["history"]) for run in runs]
    for kind, times in runs[-1]["answers"].items():
        measured = "p95_ms" if times.get("cpu_p95_ms") is None else "cpu_p95_ms"
        fit = Fit.power(counts, [run["answers"][kind][measured] for run in runs])
        lines.append(f"{kind}: exponent {fit.exponent:.2f}, so {fit(MANY):.0f} ms at 10⁸ events")
    what = (
        "A power law was fitted to the processor times where they were measured, otherwise to the times of answers. "
        f"Beyond {max(counts):.0f} stored events it is an extrapolation:"
    )
    return [what, tuple(lines)]


def real_time_per_s(sites: int) -> float:
    """Return the messages that so many sites send in a second."""
    return sites * MESSAGES_PER_HOUR / 3600
