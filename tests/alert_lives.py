"""A process that alerts until it is killed: `python alert_lives.py SITE_FILE COUNT`, one life for each line it reads.

Each life continues with the sounds that are not final yet, and ends by itself once every alert is delivered. It is
forked from a process that has loaded everything, so that a life begins at once.
"""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

from alert_desk import ELSEWHERE, Desk, refused, sound
from livessl.core.types import Event
from livessl.server.alerts.outbox import DeliveryState
from livessl.site.load import load_site


def event(number: int) -> Event:
    """Each third sound is refused, each third is elsewhere, and the others are in the zone."""
    return (sound(number), refused(number), sound(number, ELSEWHERE))[number % 3]


def live(site_file: str, count: int) -> None:
    """Let the sounds become final that are not, and deliver all alerts."""
    desk = Desk(load_site(Path(site_file)))
    desk.alerts.start()
    stored = desk.store.count()
    assert stored is not None
    for number in range(stored, count):
        desk.finish(event(number))
        time.sleep(0.003)
    wanted = len(range(0, count, 3))
    while desk.alerts.counts() != {("guard", DeliveryState.DELIVERED): wanted}:
        time.sleep(0.01)
    desk.close()


def main() -> None:
    """Begin a life for each line; print its process, and its exit status when it has ended."""
    for _ in sys.stdin:
        process = os.fork()
        if process == 0:
            live(sys.argv[1], int(sys.argv[2]))
            os._exit(0)
        print(process, flush=True)
        _, status = os.waitpid(process, 0)
        print(os.waitstatus_to_exitcode(status), flush=True)


if __name__ == "__main__":
    main()
