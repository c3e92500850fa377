"""A NATS server, a database and a hub as processes, and how long the hub's answers take."""

from __future__ import annotations

import random
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

import httpx
import psycopg

from history import ZONES, Times
from history_rows import START_NS, STEP_NS
from hub_sites import site_name
from hub_world import HubProcess
from livessl.clock import SystemClock, utc_text
from livessl.lab.processes import end, wait_until_ready
from livessl.server.api.encode import JsonObject
from nats_servers import NatsServer, running_nats
from postgresql import SETTINGS, PostgreSQL, running_postgresql
from processor_time import processor_s, running_ns
from small_site import wait_until

REQUEST_S: Final = 0.05
"""Interval, in seconds, at which the API is asked."""

Requests = dict[str, Callable[[], str]]
"""What is asked for, by its name: each call returns the path of a request."""


@dataclass
class World:
    """The processes of a run."""

    server: NatsServer
    hub: HubProcess
    postgresql: PostgreSQL | None
    folder: Path

    def processor_s(self) -> dict[str, float]:
        """Return the processor time so far of each part, in seconds."""
        database = self.postgresql and self.postgresql.pid
        pids = {"hub": self.hub.process.pid, "nats": self.server.pid, "database": database}
        return {name: processor_s(pid) for name, pid in pids.items() if pid}

    def running_ns(self) -> dict[int, int]:
        """Return the processor time so far, in nanoseconds, of each process of hub and database (`running_ns`)."""
        return running_ns(self.hub.process.pid) | (running_ns(self.postgresql.pid) if self.postgresql else {})

    def stored_bytes(self) -> int:
        """Return the size of the database."""
        if self.postgresql is None:
            return sum(path.stat().st_size for path in self.folder.glob("hub.sqlite*"))
        with psycopg.connect(self.postgresql.address, autocommit=True) as connection:
            connection.execute("CHECKPOINT")
            row = connection.execute("SELECT pg_database_size(current_database())").fetchone()
        assert row is not None
        return int(row[0])


@contextmanager
def running_hub_process(folder: Path, sqlite: bool, filled: tuple[PostgreSQL, str] | None = None) -> Iterator[World]:
    """Run one NATS server and one hub, and PostgreSQL unless a filled one is given by its URL or SQLite is wanted."""
    with ExitStack() as stack:
        (folder / "nats").mkdir(exist_ok=True)
        server = stack.enter_context(running_nats(folder / "nats"))
        postgresql, database = (None, str(folder / "hub.sqlite")) if filled is None else filled
        if filled is None and not sqlite:
            settings = {**SETTINGS, "fsync": "on", "full_page_writes": "on", "shared_buffers": "128MB"}
            postgresql = stack.enter_context(running_postgresql(settings))
            database = postgresql.url()
        hub = HubProcess(folder, 0, database, [server.url], replicas=1)
        stack.callback(lambda: end([hub.process]))
        wait_until_ready(hub.url, [hub.process], SystemClock())
        wait_until(hub.takes_in, "a hub that takes messages in")
        yield World(server, hub, postgresql, folder)


def measure_answers(world: World, sites: int, seconds: float, stored: int | None = None) -> JsonObject:
    """Return how long answers of the API take, asked for some seconds in turns.

    The processor time of hub and database during each is measured as well. It hardly depends on what else the machine
    does, but it includes what both do besides.

    Parameters
    ----------
    world : World
    sites : int
    seconds : float
    stored : int or None
        Number of events of a filled history, in which events are searched by further filters. None for any other one:
        then all sites and metrics are asked for as well, which do not depend on it.
    """
    rng = random.Random(6)
    further = _state_requests() if stored is None else _search_requests(rng, sites, stored)
    requests = {**_site_requests(rng, sites), **further}
    times: dict[str, tuple[list[float], list[float]]] = {kind: ([], []) for kind in requests}
    until, rounds = time.perf_counter() + seconds, 0
    with httpx.Client(base_url=world.hub.url, timeout=120) as client:
        while time.perf_counter() < until or rounds < 2:
            rounds += 1
            for kind, request in requests.items():
                asked, before, begun = request(), world.running_ns(), time.perf_counter()
                client.get(asked).raise_for_status()
                passed_s, after = time.perf_counter() - begun, world.running_ns()
                times[kind][0].append(passed_s)
                times[kind][1].append(sum(ns - before.get(pid, 0) for pid, ns in after.items()) / 1e9)
                time.sleep(REQUEST_S)
    return {kind: asdict(Times.of(*each)) for kind, each in times.items()}


def _state_requests() -> Requests:
    return {"all sites": lambda: "/api/v1/sites", "metrics": lambda: "/metrics"}


def _site_requests(rng: random.Random, sites: int) -> Requests:
    return {
        "newest of all": lambda: "/api/v1/events",
        "newest of a site": lambda: f"/api/v1/events?site={site_name(rng.randrange(sites))}",
        "of a site, by time and confidence": lambda: (
            f"/api/v1/events?site={site_name(rng.randrange(sites))}&min_confidence=0.9&since={utc_text(START_NS)}"
        ),
    }


def _search_requests(rng: random.Random, sites: int, stored: int) -> Requests:
    """Return searches by the further filters of `GET events`, over all times that a filled history has."""

    def until() -> str:
        return utc_text(START_NS + rng.randrange(stored) * STEP_NS)

    return {
        "of a site, before a time": lambda: f"/api/v1/events?site={site_name(rng.randrange(sites))}&until={until()}",
        "of a site and zone": lambda: (
            f"/api/v1/events?site={site_name(rng.randrange(sites))}&zone=zone-{rng.randrange(ZONES)}"
        ),
        "of a site and array, refused": lambda: (
            f"/api/v1/events?site={site_name(rng.randrange(sites))}&array=south&status=refused"
        ),
        "of all, before a time": lambda: f"/api/v1/events?until={until()}",
        "of all, by zone and confidence": lambda: (
            f"/api/v1/events?zone=zone-{rng.randrange(ZONES)}&min_confidence=0.99&until={until()}"
        ),
    }
