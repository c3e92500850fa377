"""`livessl replay`: plays a recorded session, at some speed, to a running server or to one in this process."""

from __future__ import annotations

import argparse
import logging
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from livessl.capture.node import send_session
from livessl.cli import argument, progress
from livessl.cli.exits import OK, stop_on_signal
from livessl.cli.node_input import run_id
from livessl.cli.options import add_joint, add_json, add_method, import_from_here, joints, refuse_unused
from livessl.cli.output import print_event
from livessl.cli.serve import run_until_stopped
from livessl.clock import PacedClock, SystemClock, UnpacedClock
from livessl.recordings.assign import AssignedRecording, assign_sessions, span_ns
from livessl.recordings.session import read_session
from livessl.server.app import Server
from livessl.site.alert_models import AlertsConfig
from livessl.site.load import load_site
from livessl.site.models import Site
from livessl.site.server_models import HttpConfig, StoreConfig


def add_arguments(parser: Any) -> None:
    """Describe the command's arguments."""
    parser.add_argument(
        "directories",
        type=Path,
        metavar="DIR",
        nargs="+",
        help="folder of a session, made by record or simulate; give one folder for each node",
    )
    parser.add_argument("--site", type=Path, help="site file (default: that of the first session)")
    parser.add_argument(
        "--speed", type=argument.speed, default=1.0, help="speed as a multiple of real time, or 'max' (default: 1)"
    )
    parser.add_argument(
        "--server",
        type=argument.endpoint,
        metavar="ENDPOINT",
        help="send the session to a running server; ENDPOINT is the address at which it receives nodes (server.bind), "
        "such as tcp://127.0.0.1:5570 (default: run a server in this process)",
    )
    parser.add_argument(
        "--once", action="store_true", help="exit at the end of the session instead of keeping the dashboard running"
    )
    add_json(parser, "print one JSON object per event (not with --server)")
    add_method(parser, "the site's; not with --server")
    add_joint(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run the command."""
    if arguments.server is not None:
        given = {"--json": arguments.json, "--method": arguments.method}
        refuse_unused("replay", given, "with --server, because that server locates and publishes the events")
    import_from_here()
    sessions = [read_session(directory) for directory in arguments.directories]
    joint = joints(arguments)
    site = load_site(arguments.site, joint) if arguments.site else sessions[0].site(joint)
    parts = assign_sessions(site, sessions)
    if arguments.server is not None:
        with stop_on_signal() as stop:
            _send(site, arguments.server, parts, arguments.speed, stop)
    else:
        _serve_here(arguments, site, parts)
    return OK


def _serve_here(arguments: argparse.Namespace, site: Site, parts: Sequence[AssignedRecording]) -> None:
    """Run a server with a dashboard in this process, and play the session to it."""
    server = Server(
        _private(site, own_http=arguments.site is not None),
        SystemClock(),
        method=arguments.method,
        on_event=lambda event: print_event(event, as_json=arguments.json),
    )
    logging.info("dashboard on %s", server.url)
    stop = threading.Event()
    failures: list[Exception] = []

    def send() -> None:
        try:
            _send(site, server.endpoint, parts, arguments.speed, stop)
            server.wait_idle()
        except Exception as error:  # noqa: BLE001 - raised again below
            failures.append(error)
        if arguments.once or failures:
            server.stop()
        else:
            logging.info("the session has ended; the dashboard runs until Ctrl-C")

    sender = threading.Thread(target=send, daemon=True)
    sender.start()
    run_until_stopped(server)
    stop.set()
    sender.join(timeout=4.0)
    if failures:
        raise failures[0]


def _private(site: Site, *, own_http: bool) -> Site:
    """Return the site for a server that binds to this machine only, without keys, stores nothing, and raises no alerts.

    Keys and history belong to the site's real server. Unless the user named the site file (`own_http`), the HTTP
    settings of the session's own copy are dropped, too, because they were meant for another machine.
    """
    http = site.server.http if own_http else HttpConfig(port=site.server.http.port)
    here = site.server.model_copy(update={"bind": "tcp://127.0.0.1:*", "http": http, "events_db": None, "sinks": ()})
    return site.model_copy(update={"server": here, "keys": None, "store": StoreConfig(), "alerts": AlertsConfig()})


def _send(site: Site, endpoint: str, parts: Sequence[AssignedRecording], speed: float, stop: threading.Event) -> None:
    clock = SystemClock()
    begin_ns, end_ns = span_ns(parts)
    pace = UnpacedClock(begin_ns) if speed == float("inf") else PacedClock(begin_ns, speed)
    with progress.timed("playing", begin_ns, end_ns) as bar:
        send_session(site, endpoint, parts, pace, clock, run_id("replay", clock), stop.is_set, bar)
