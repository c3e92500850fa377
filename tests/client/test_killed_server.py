"""Clients of a server that is killed at random moments: every event arrives, and each answer once."""

from __future__ import annotations

import asyncio
import os
import random
import signal
import time
from collections import Counter
from pathlib import Path
from threading import Thread

import pytest

from livessl.client import Event, Options, Received, aconnect, connect
from publishing_lives import FINAL, free_port, server_lives
from small_site import HANG_S, wait_until, write_site

KILLS = 3
SHARE = 40
"""Events of each life."""

COUNT = SHARE * (KILLS + 1)


class Follower(Thread):
    """Follows a server by one of the clients until it has the final answer of every event."""

    def __init__(self, url: str, names: set[str]) -> None:
        super().__init__(daemon=True)
        self.url, self.names = url, names
        self.options = Options(kinds=["event"], since="2026-01-01T00:00:00Z", give_up_s=HANG_S)
        self.got: list[tuple[str, float]] = []

    @property
    def is_complete(self) -> bool:
        return {name for name, confidence in self.got if confidence == FINAL} == self.names

    def take(self, message: Received) -> None:
        assert isinstance(message, Event)
        self.got.append((message.id, message.confidence))

    def run(self) -> None:
        with connect(self.url, **self.options) as live:
            for message in live:
                self.take(message)
                if self.is_complete:
                    return


class AsyncFollower(Follower):
    """The same with the asynchronous client."""

    def run(self) -> None:
        asyncio.run(self.follow())

    async def follow(self) -> None:
        async with aconnect(self.url, **self.options) as live:
            async for message in live:
                self.take(message)
                if self.is_complete:
                    return


def kill(process: int) -> None:
    os.kill(process, signal.SIGKILL)


@pytest.mark.processes
def test_both_clients_get_every_event_once(tmp_path: Path) -> None:
    seed = random.randrange(10**6)
    print(f"seed {seed}")
    chance = random.Random(seed)
    port = free_port()
    site = write_site(tmp_path, {"server.events_db": "events.sqlite", "server.http.port": port})
    names = {f"small-{number}" for number in range(COUNT)}
    followers = [kind(f"http://127.0.0.1:{port}", names) for kind in (Follower, AsyncFollower)]
    with server_lives(site, followers=2) as begin:
        for follower in followers:
            follower.start()
        for life in range(KILLS):
            process = begin(SHARE * (life + 1))
            more = [len(follower.got) + chance.randrange(SHARE - 5) for follower in followers]
            wait_until(
                lambda more=more: all(len(f.got) >= least for f, least in zip(followers, more, strict=True)),  # type: ignore[misc]
                "some events",
            )
            time.sleep(chance.uniform(0.0, 0.05))
            kill(process)
        process = begin(COUNT)
        for follower in followers:
            follower.join(timeout=HANG_S)
        kill(process)
    for follower in followers:
        assert follower.is_complete, type(follower)
        assert {answer: times for answer, times in Counter(follower.got).items() if times > 1} == {}
        assert dict(follower.got) == dict.fromkeys(names, FINAL)  # the last answer of each is the final one
