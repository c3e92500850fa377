"""`livessl bench`: measures how fast this machine locates, or which load a server on it carries."""

from __future__ import annotations

import argparse
import json
from typing import Any, Final

from livessl.cli import argument, progress
from livessl.cli.exits import OK
from livessl.cli.options import add_json, refuse_unused
from livessl.clock import SystemClock

LIVE_DEFAULTS: Final[dict[str, Any]] = {
    "arrays": 4,
    "clients": 4,
    "watchers": 0,
    "seconds": 20.0,
    "spacing": 0.1,
    "rt60": 0.3,
    "spin": False,
}
"""Default of each option that belongs to --live."""


def add_arguments(parser: Any) -> None:
    """Describe the command's arguments."""
    parser.add_argument(
        "--live", action="store_true", help="measure a server under load instead of only the computation"
    )
    only = parser.add_argument_group("with --live")
    only.add_argument(
        "--arrays",
        type=argument.positive,
        metavar="N",
        help="number of arrays that send sound continuously (default: 4)",
    )
    only.add_argument(
        "--clients",
        type=argument.positive,
        metavar="N",
        help="number of clients that subscribe to events and updates (default: 4)",
    )
    only.add_argument(
        "--watchers",
        type=argument.count,
        metavar="N",
        help="number of clients that subscribe to the power map (default: 0)",
    )
    only.add_argument("--seconds", type=argument.above_zero, help="seconds to measure, after a warm-up (default: 20)")
    only.add_argument(
        "--spacing",
        type=argument.above_zero,
        metavar="M",
        help="spacing of the search grid, metres (default: 0.1)",
    )
    only.add_argument(
        "--rt60",
        type=argument.rt60,
        metavar="S",
        help="reverberation time of the simulated room, seconds (default: 0.3)",
    )
    only.add_argument(
        "--spin",
        action="store_true",
        help="run one busy process on each core during the measurement, to measure a server on a busy machine",
    )
    only.set_defaults(**LIVE_DEFAULTS)
    add_json(parser, "print one JSON object")


def run(arguments: argparse.Namespace) -> int:
    """Run the command."""
    from livessl.lab.bench import kernels, live

    if not arguments.live:
        given = {f"--{option}": getattr(arguments, option) != default for option, default in LIVE_DEFAULTS.items()}
        refuse_unused("bench", given, "without --live")
        with progress.counted("measuring", "round") as show:
            report = kernels.measure(SystemClock(), progress=show)
        print(json.dumps(report.as_json()) if arguments.json else kernels.table(report))
        return OK
    demand = live.Demand(
        arrays=arguments.arrays,
        clients=arguments.clients,
        seconds=arguments.seconds,
        watchers=arguments.watchers,
        spacing_m=arguments.spacing,
        rt60_s=arguments.rt60,
        spin=arguments.spin,
    )
    with progress.counted("measuring", "s") as show:
        outcome = live.measure(demand, SystemClock(), progress=show)
    print(json.dumps(outcome.json()) if arguments.json else live.table(outcome))
    return OK
