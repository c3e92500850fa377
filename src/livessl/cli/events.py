"""`livessl events`: prints a running server's messages on the terminal, and connects again after a loss."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from livessl.cli import argument
from livessl.cli.exits import OK
from livessl.cli.options import add_json
from livessl.cli.output import print_event, xyz
from livessl.cli.server_answers import add_token_file, read_token

if TYPE_CHECKING:
    from livessl.client import Received

URL: Final = "http://127.0.0.1:8000"
"""Address of a server whose site file does not say otherwise."""

KINDS: Final = ("event", "update", "track", "arrays", "alert", "zone", "zones", "poses")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    add = parser.add_argument
    add("--url", default=URL, help=f"address of the server (default: {URL})")
    add_token_file(parser)
    add("--ca-file", type=Path, metavar="FILE", help="PEM file of the authority that signed the server's certificate")
    add(
        "--kinds",
        type=_kinds,
        default=("event",),
        metavar="KIND,KIND,…",
        help=f"messages to print: {', '.join(KINDS)}; arrays: a state has changed; zone: a track has entered or "
        "left a zone or loiters there; zones: a zone was added, changed or removed; poses: arrays have "
        "new poses (default: event)",
    )
    add(
        "--zone",
        metavar="NAME",
        help="print only events, updates, tracks, changes of tracks (kind zone) and alerts inside this zone; other "
        "kinds are not affected",
    )
    add(
        "--min-confidence",
        type=argument.probability,
        metavar="C",
        help="print only events and updates of at least this confidence, 0 to 1",
    )
    add(
        "--track",
        type=argument.count,
        metavar="N",
        help="print tracks and zone changes of track N only; other kinds are not affected",
    )
    add(
        "--max-rate",
        type=argument.above_zero,
        metavar="HZ",
        help="print at most HZ updates a second for each sound; the same limit holds for each track and for the "
        "arrays. Events, alerts, changes in zones, and the first and last state of a track are always printed",
    )
    add("--since", type=_time, metavar="TIME", help="begin with the stored events from this time on (RFC 3339)")
    add("--limit", type=argument.positive, metavar="N", help="end after N messages")
    add_json(parser, "print one JSON object per message")


def run(arguments: argparse.Namespace) -> int:
    """Print messages until Ctrl-C; connect again when the connection is lost."""
    from livessl.client import Options, connect

    given: dict[str, Any] = {
        "kinds": arguments.kinds,
        "zone": arguments.zone,
        "min_confidence": arguments.min_confidence,
        "track": arguments.track,
        "max_rate_hz": arguments.max_rate,
        "since": arguments.since,
        "ca_file": arguments.ca_file,
    }
    options = Options(**{name: value for name, value in given.items() if value is not None})  # type: ignore[typeddict-item]
    token = None if arguments.token_file is None else read_token(arguments.token_file)
    try:
        with connect(arguments.url, token, **options) as live:
            for printed, message in enumerate(live, start=1):
                _print(message, as_json=arguments.json)
                if printed == arguments.limit:
                    break
    except KeyboardInterrupt:
        return OK
    return OK


def _print(message: Received, *, as_json: bool) -> None:
    if as_json:
        print(message.model_dump_json(), flush=True)
        return
    found: dict[str, Any] = message.model_dump(mode="json")
    if message.kind == "event":
        print(found["time_utc"] or "", end="  ")
        print_event(found, as_json=False)
    else:
        print(_line(found), flush=True)


def _line(found: dict[str, Any]) -> str:
    """Return a message as a line of text."""
    when = found.get("time_utc") or found.get("now_utc") or found.get("raised_utc") or ""
    match found["kind"]:
        case "update":
            what = f"{found['event_id']}  {xyz(found['position_m'])}  confidence {found['confidence']:.2f}"
        case "track":
            what = f"{found['id']} {found['state']}  {xyz(found['position_m'])}"
        case "arrays":
            what = ", ".join(f"{one['name']} {one['state']}" for one in found["arrays"])
        case "alert":
            what = f"{found['rule']}: {found['text']}"
        case "zone":
            what = f"track {found['track_id']} {found['change']} {found['zone']}  {xyz(found['position_m'])}"
        case "poses":
            what = ", ".join(found["changed"])
        case "zones":
            what = ", ".join(found["by_name"]) or "none"
        case _:
            what = found.get("reason", "")
    return f"{when:<27}  {found['kind']:<6}  {what}"


def _kinds(text: str) -> tuple[str, ...]:
    kinds = tuple(kind.strip() for kind in text.split(","))
    wrong = [kind for kind in kinds if kind not in KINDS]
    if wrong:
        raise argparse.ArgumentTypeError(f"expected some of {', '.join(KINDS)}, got {wrong[0]!r}")
    return kinds


def _time(text: str) -> str:
    argument.time(text)
    return text
