"""`livessl serve`: runs the fusion server with its API and its dashboard, until Ctrl-C or SIGTERM."""

from __future__ import annotations

import argparse
import logging
import queue
from typing import TYPE_CHECKING, Any

from livessl.cli.exits import OK, on_hang_up
from livessl.cli.options import add_joint, add_method, add_site, import_from_here, read_site
from livessl.cli.output import print_warnings
from livessl.cli.service import service_manager
from livessl.clock import SystemClock
from livessl.garbage import collect_seldom
from livessl.traces import traced

if TYPE_CHECKING:
    from livessl.server.app import Server


def add_arguments(parser: Any) -> None:
    """Describe the command's arguments."""
    add_site(parser)
    add_method(parser)
    add_joint(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run the command."""
    collect_seldom()
    service = service_manager()
    from livessl.server.app import Server

    import_from_here()
    site = read_site(arguments)
    print_warnings(site)
    requests: queue.SimpleQueue[None] = queue.SimpleQueue()  # a signal that comes too early must not end the process
    with on_hang_up(lambda: requests.put(None)), traced("livessl-server", site.site):
        server = Server(
            site, SystemClock(), method=arguments.method, read_site=lambda: read_site(arguments), service=service
        )
        logging.info("listening for nodes on %s, dashboard on %s", server.endpoint, server.url)
        with on_hang_up(server.parts.reloader.request):
            if not requests.empty():
                server.parts.reloader.request()
            run_until_stopped(server)
    return OK


def run_until_stopped(server: Server) -> None:
    """Run a server until it ends, or until Ctrl-C or SIGTERM."""
    try:
        server.run()
    except KeyboardInterrupt:
        logging.info("stopped")
