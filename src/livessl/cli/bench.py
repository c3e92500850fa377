"""`livessl bench`: measures how fast this machine locates, or which load a server on it carries."""

from __future__ import annotations

import argparse
import json
from typing import Any

from livessl.cli import argument, progress
from livessl.cli.exits import OK
from livessl.cli.options import add_json
from livessl.clock import SystemClock


def add_arguments(parser: Any) -> None:
    """Describe the command's arguments."""
    parser.add_argument(
        "--live", action="store_true", help="measure a server under load instead of only the computation"
    )
    only = parser.add_argument_group("with --live")
    only.add_argument(
        "--arrays",
        type=argument.positive,
        default=4,
        metavar="N",
        help="number of arrays that send sound continuously (default 4)",
    )
    only.add_argument(
        "--clients",
        type=argument.positive,
        default=4,
        metavar="N",
        help="number of clients that subscribe to events and updates (default 4)",
    )
    only.add_argument(
        "--watchers",
        type=argument.count,
        default=0,
        metavar="N",
        help="number of clients that subscribe to the power map (default 0)",
    )
    only.add_argument(
        "--seconds", type=argument.above_zero, default=20.0, help="seconds to measure, after a warm-up (default 20)"
    )
    only.add_argument(
        "--spacing", type=argument.above_zero, default=0.1, metavar="M", help="spacing of the search grid (default 0.1)"
    )
    only.add_argument(
        "--rt60",
        type=argument.rt60,
        default=0.3,
        metavar="S",
        help="reverberation time of the simulated room (default 0.3)",
    )
    only.add_argument("--spin", action="store_true", help="run a busy process on every core during the measurement")
    add_json(parser, "print one JSON object")


def run(arguments: argparse.Namespace) -> int:
    """Run the command."""
    from livessl.lab.bench import kernels, live

    if not arguments.live:
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
