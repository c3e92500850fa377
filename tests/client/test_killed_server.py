"""Clients of a server that is killed at random moments: every event arrives, and each answer once."""

from __future__ import annotations

import asyncio
import os
import random
import signal
import socket
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from threading import Thread

import pytest

from livessl.client import Event, aconnect, connect
from server_lives import EARLY, FINAL
from small_site import HANG_S, started, wait_until, write_site

LIVES = Path(__file__).parents[1] / "server_lives.py"
KILLS = 5
COUNT = 400


@pytest.mark.processes
def test_both_clients_get_every_event_once(tmp_path: Path) -> None:
    seed = random.randrange(10**6)
    print(f"seed {seed}")
    chance = random.Random(seed)
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    site = write_site(tmp_path, {"server.events_db": "events.sqlite", "server.http.port": port})
    url = f"http://127.0.0.1:{port}"
    got: dict[str, list[tuple[str, float]]] = {"sync": [], "async": []}
    names = {f"small-{number}" for number in range(COUNT)}

    def is_complete(kind: str) -> bool:
        return {name for name, confidence in got[kind] if confidence == FINAL} == names

    def follow() -> None:
        with connect(url, kinds=["event"], since="2026-01-01T00:00:00Z", give_up_s=HANG_S) as live:
            for message in live:
                assert isinstance(message, Event)
                got["sync"].append((message.id, message.confidence))
                if is_complete("sync"):
                    return

    async def follow_too() -> None:
        async with aconnect(url, kinds=["event"], since="2026-01-01T00:00:00Z", give_up_s=HANG_S) as live:
            async for message in live:
                assert isinstance(message, Event)
                got["async"].append((message.id, message.confidence))
                if is_complete("async"):
                    return

    followers = [Thread(target=follow), Thread(target=lambda: asyncio.run(follow_too()))]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with started(sys.executable, LIVES, site, str(COUNT), **pipes) as lives:
        assert lives.stdin is not None
        assert lives.stdout is not None

        def begin() -> int:
            print("live", file=lives.stdin, flush=True)
            return int(lives.stdout.readline())  # type: ignore[union-attr]

        for follower in followers:
            follower.start()
        for _ in range(KILLS):
            process = begin()
            more = {kind: len(events) + chance.randrange(30) for kind, events in got.items()}
            wait_until(
                lambda more=more: all(len(got[kind]) >= least for kind, least in more.items()),  # type: ignore[misc]
                f"some events, got { ({kind: len(events) for kind, events in got.items()}) }",
            )
            time.sleep(chance.uniform(0.0, 0.05))
            os.kill(process, signal.SIGKILL)
        assert not is_complete("sync"), "the events do not last for so many lives"
        process = begin()
        try:
            for follower in followers:
                follower.join(timeout=HANG_S)
        finally:
            os.kill(process, signal.SIGKILL)
    for kind, events in got.items():
        assert is_complete(kind), kind
        assert {answer: times for answer, times in Counter(events).items() if times > 1} == {}
        assert dict(events) == dict.fromkeys(names, FINAL)  # the last answer of each is the final one
        assert (f"small-{COUNT - 1}", EARLY) in events or any(confidence == EARLY for _, confidence in events)
