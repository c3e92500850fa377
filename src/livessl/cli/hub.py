"""`livessl hub`: runs the hub of many sites, its API and its page."""

from __future__ import annotations

import argparse
import logging
from pathlib import Path
from typing import Any

from livessl.cli.exits import OK
from livessl.cli.service import service_manager
from livessl.clock import SystemClock
from livessl.garbage import collect_seldom


def add_arguments(parser: Any) -> None:
    """Describe the command's arguments."""
    parser.add_argument(
        "--config",
        type=Path,
        required=True,
        metavar="FILE",
        help="the hub's settings (YAML). `nats` and `database` are required, such as: "
        '{nats: {servers: ["nats://127.0.0.1:4222"]}, database: hub.sqlite}. Further keys are `http` (as '
        "`server.http` of a site file), `stream`, `retention_days` and `hub`, the hub's name",
    )


def run(arguments: argparse.Namespace) -> int:
    """Run the command."""
    collect_seldom()
    service = service_manager()
    from livessl.federation.app import HubServer
    from livessl.federation.config import load_hub

    server = HubServer(load_hub(arguments.config), SystemClock(), service)
    logging.info("hub on %s", server.url)
    try:
        server.run()
    except KeyboardInterrupt:
        logging.info("stopped")
    return OK
