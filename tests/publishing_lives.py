"""A server that is killed again and again: `python publishing_lives.py SITE_FILE FOLLOWERS`, one life for each line.

Each life publishes the events that are not final yet, and goes on serving. It is forked from a process that has loaded
everything, so that a life begins at once.
"""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Thread

from alert_desk import after, sound
from livessl.clock import SystemClock
from livessl.core.stream.final_pass import FinalResults
from livessl.server.api.encode import JsonObject, Messages
from livessl.server.app import Server
from livessl.site.load import load_site
from small_site import started

EARLY, FINAL = 0.5, 0.9
"""Confidence of early and of final answers."""

CLOCKS: JsonObject = {"heard": {}, "frames": {}, "known": {}}
"""What is known of the nodes' clocks: nothing."""

PAUSE_S = 0.004
"""Time between two events, in seconds."""


def free_port() -> int:
    """A TCP port that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def server_lives(site: Path, followers: int) -> Iterator[Callable[[int], int]]:
    """Yield a function that begins a life of a server, once the one before was killed, and returns its process.

    It gets the number of events that are published when the life has done its work. A life waits for the followers
    after half of its events: the first half they miss, as after a real restart.
    """
    command = (sys.executable, __file__, site, str(followers))
    with started(*command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as lives:

        def begin(count: int) -> int:
            assert lives.stdin is not None
            assert lives.stdout is not None
            print(count, file=lives.stdin, flush=True)
            return int(lives.stdout.readline())

        yield begin


def live(site_file: str, followers: int, count: int) -> None:
    """Publish what is not final; each fifth event has an early answer before."""
    site = load_site(Path(site_file))
    server = Server(site, SystemClock(), stepped=True)
    parts, messages = server.parts, Messages(site, 0, utc=True)
    stored, early = parts.store.count(), parts.store.early_events()
    assert stored is not None
    parts.store.backlog.start()  # events are published before they are stored, as in a server that hears
    serving = Thread(target=server.run)
    serving.start()
    while server.loop is None:
        time.sleep(0.001)
    begin = stored - len(early)
    for number in range(begin, count):
        while number > (begin + count) / 2 and parts.fanout.clients < followers:
            time.sleep(0.005)
        if number % 5 == 4:
            parts.event_log.add_early(sound(number, confidence=EARLY), messages)
            time.sleep(PAUSE_S)
        event = sound(number, confidence=FINAL)
        parts.event_log.add_final(FinalResults((event,), after(event)), messages, CLOCKS)
        time.sleep(PAUSE_S)
    serving.join()


def main() -> None:
    """Begin a life for each line; print its process. The reader of the lines ends it."""
    for line in sys.stdin:
        process = os.fork()
        if process == 0:
            live(sys.argv[1], int(sys.argv[2]), int(line))
            return
        print(process, flush=True)
        os.waitpid(process, 0)


if __name__ == "__main__":
    main()
