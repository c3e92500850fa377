"""`livessl demo`: plays a simulated scene through real processes, and prints the error of every event."""

from __future__ import annotations

import argparse
import json
import logging
import sys
import tempfile
import threading
import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from livessl.cli import argument, progress
from livessl.cli.exits import FAILED, OK
from livessl.cli.options import add_json, add_older_name
from livessl.cli.output import xyz
from livessl.clock import SystemClock

if TYPE_CHECKING:
    from collections.abc import Callable
    from contextlib import AbstractContextManager

    from livessl.clock import Clock
    from livessl.lab import demo
    from livessl.server.api.encode import JsonObject
    from livessl.simulation.scene import Scene

WITHIN_M: Final = 0.5
"""Largest error, in metres, of a sound that counts as located; the paper uses the same limit."""

_HEAD: Final = f"{'time':>7}  {'sound':<14} {'true position':<22} {'found':<22} {'error':>7}  status"


def add_arguments(parser: Any) -> None:
    """Describe the command's arguments."""
    parser.add_argument("--once", action="store_true", help="run the scene once without opening a browser, and exit")
    add_json(parser)
    parser.add_argument("--port", type=int, default=8000, help="port of the dashboard (default: 8000)")
    count = parser.add_argument(
        "--count", type=argument.positive, default=8, metavar="N", help="number of sounds in the scene (default: 8)"
    )
    add_older_name(parser, "--events", count)
    parser.add_argument(
        "--sound-card",
        action="store_true",
        help="play the scene on a virtual audio interface, from which a node records by ALSA and PortAudio as from a "
        "real one (Linux; needs gcc, libasound2-dev and libportaudio2)",
    )
    parser.add_argument("--no-browser", action="store_true", help="do not open the dashboard in a browser")


def run(arguments: argparse.Namespace) -> int:
    """Run the command."""
    try:
        return _show(arguments)
    except KeyboardInterrupt:
        if arguments.once:
            raise
        logging.info("stopped")
        return OK


def _show(arguments: argparse.Namespace) -> int:
    from livessl.lab import demo

    clock = SystemClock()
    with (
        tempfile.TemporaryDirectory(prefix="livessl-demo-") as name,
        progress.counted("simulating the room", "source") as bar,
    ):
        directory = Path(name)
        scene, start = _prepared(arguments, directory, clock, bar)
        truth = demo.read_truth(directory)
        with start() as running:
            print(f"dashboard: {running.url}", file=sys.stderr)
            if not arguments.once and not arguments.no_browser:
                threading.Thread(target=webbrowser.open, args=(running.url,), daemon=True).start()
            if not arguments.json:
                print(_HEAD)
            events: dict[str, JsonObject] = {}

            def outcomes() -> list[demo.Outcome]:
                return demo.match(truth, list(events.values()), running.start_ns, scene.duration_s)

            def is_over() -> bool:
                silent_ns = running.silent_ns()
                return silent_ns > 0 and (all(map(_is_good, outcomes())) or silent_ns > demo.LAST_NS)

            for event in demo.events_of(running.url, is_over):
                if not demo.is_of_scene(event, running.start_ns):
                    continue
                for replaced in event["replaces"]:
                    events.pop(replaced, None)
                events[event["id"]] = event
                outcome = demo.nearest_source(truth, event, running.start_ns, scene.duration_s)
                print(_as_json(outcome) if arguments.json else _as_row(outcome), flush=True)
                if not arguments.once:
                    events.clear()
    found = outcomes()
    good = sum(map(_is_good, found))
    surplus = len(events) - len({outcome.event["id"] for outcome in found if outcome.event is not None})
    summary = f"{good} of {len(truth)} sounds located within {WITHIN_M:g} m; {surplus} events without a sound"
    print(summary, file=sys.stderr)
    return OK if good == len(truth) else FAILED


def _prepared(
    arguments: argparse.Namespace, directory: Path, clock: Clock, bar: Callable[[int, int], None]
) -> tuple[Scene, Callable[[], AbstractContextManager[demo.Running]]]:
    """Return the scene, and what starts the processes that play it."""
    from livessl.lab import demo

    port, events, loop = arguments.port, arguments.count, not arguments.once
    if not arguments.sound_card:
        site, scene = demo.prepare(directory, port, events, bar)
        return scene, lambda: demo.running(directory, site, loop=loop, clock=clock)
    from livessl.lab import demo_card

    site, scene, interfaces = demo_card.prepare(directory, port, events, bar)
    return scene, lambda: demo_card.running(directory, site, scene, interfaces, loop=loop, clock=clock)


def _is_good(outcome: demo.Outcome) -> bool:
    return outcome.located and outcome.error_m is not None and outcome.error_m <= WITHIN_M


def _as_row(outcome: demo.Outcome) -> str:
    event = outcome.event
    assert event is not None
    error = "-" if outcome.error_m is None else f"{outcome.error_m:.2f} m"
    return (
        f"{outcome.start_s:6.2f}s  {outcome.name:<14} {xyz(outcome.true_position_m):<22} "
        f"{xyz(event['position_m']):<22} {error:>7}  {event['status']}"
    )


def _as_json(outcome: demo.Outcome) -> str:
    truth = {"name": outcome.name, "start_s": outcome.start_s, "position_m": list(outcome.true_position_m)}
    return json.dumps({**(outcome.event or {}), "truth": truth, "error_m": outcome.error_m})
