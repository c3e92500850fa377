"""`livessl capture`: runs a capture node, on its audio device, or on files, a session or a simulated scene instead."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from livessl.cli import argument, progress
from livessl.cli.exits import OK, stop_on_signal
from livessl.cli.options import add_joint, add_site, add_wav, read_site
from livessl.cli.service import service_manager
from livessl.clock import SystemClock
from livessl.garbage import collect_as_usual, collect_seldom
from livessl.traces import traced


def add_arguments(parser: Any) -> None:
    """Describe the command's arguments."""
    add_site(parser)
    parser.add_argument("--node", required=True, help="name of the node in the site file")
    add_joint(parser)
    add_wav(
        parser,
        "use the sound of FILE, in real time, instead of the device; repeat the option for each array of the node",
    )
    parser.add_argument(
        "--session",
        type=Path,
        metavar="DIR",
        help="use a session that `livessl record` or `livessl simulate` has made, in real time, instead of the device; "
        "the site file may give the inputs of an array in another order than when it was recorded",
    )
    parser.add_argument("--loop", action="store_true", help="with --wav or --session: repeat the files until Ctrl-C")
    parser.add_argument(
        "--start-at",
        type=argument.time,
        metavar="TIME",
        help="with --wav or --session: time stamp of the files' first sample, RFC 3339 (default: now, or the next "
        "multiple of 5 s if the site has several nodes, so that all start together)",
    )


def run(arguments: argparse.Namespace) -> int:
    """Run the command."""
    collect_seldom()
    service = service_manager()
    from livessl.capture.node import capture_device, capture_recordings
    from livessl.cli.node_input import audio_device, check_files, node_config, recordings, run_id
    from livessl.recordings.assign import span_ns

    site = read_site(arguments)
    config = node_config(site, arguments.node, arguments.site)
    check_files(arguments, config)
    clock = SystemClock()
    name = run_id(arguments.node, clock)
    device = audio_device(arguments, config, clock)
    collect_as_usual()
    if device is not None:
        with stop_on_signal() as stop, traced("livessl-node", arguments.node):
            capture_device(site, arguments.node, device, clock, name, stop.is_set, service)
        return OK
    parts = recordings(arguments, site, clock.now_ns())
    traces = traced("livessl-node", arguments.node)
    with stop_on_signal() as stop, traces, progress.timed("playing", *span_ns(parts)) as bar:
        capture_recordings(site, arguments.node, parts, clock, name, stop.is_set, bar, service)
    return OK
