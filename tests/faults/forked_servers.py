"""Whole servers, one after the other: `python forked_servers.py SITE_FILE` starts one for each line that it reads.

Each is forked from a process that has loaded everything, so that it begins at once. The process prints the number of
each server's process, and its exit status when it has ended.
"""

from __future__ import annotations

import logging
import os
import sys
from pathlib import Path

from livessl.clock import SystemClock
from livessl.server.app import Server
from livessl.site.load import load_site


def main() -> None:
    """Begin a life for each line."""
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(message)s")
    for _ in sys.stdin:
        process = os.fork()
        if process == 0:
            Server(load_site(Path(sys.argv[1])), SystemClock()).run()
            os._exit(0)
        print(process, flush=True)
        _, status = os.waitpid(process, 0)
        print(os.waitstatus_to_exitcode(status), flush=True)


if __name__ == "__main__":
    main()
