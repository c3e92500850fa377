"""Hubs under faults, and under the load of many sites.

    python benchmarks/hub.py --events 1000
    python benchmarks/hub.py --sites 1000 --rate 1500 --seconds 60

Without `--sites`: three sites, a cluster of three NATS servers and two hubs on PostgreSQL, all as they run in service.
Links are cut, a NATS server and the hub at work are killed. It prints how long after the return of the links, or after
the death, the last event is shown by every hub, and whether each event is there once and in order. The exit status is 1
if one is not, or if the return takes longer than a second.

With `--sites`: so many sites are simulated at the broker, one NATS server and one hub. It prints the rate that the
stream and the hub take, how far the hub lags behind, what an event takes on the disks, and how long the API's answers
take with so many events.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import random
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import httpx
import nats
import orjson

sys.path[:0] = [str(Path(__file__).parents[1] / "tests"), str(Path(__file__).parents[1] / "tests" / "faults")]

from history import Times
from history_rows import START_NS, random_event
from hub_desk import newest_at
from hub_world import HubProcess, HubWorld, running_world
from livessl.clock import SystemClock, utc_text
from livessl.lab.processes import end, wait_until_ready
from livessl.server.api.encode import JsonObject
from livessl.server.forwarding.stream import MESSAGE_ID, Place, message_id, subject
from nats_servers import NatsServer, running_nats
from postgresql import SETTINGS, PostgreSQL, running_postgresql
from small_site import wait_until

MAX_RETURN_S: Final = 1.0
"""Longest time, in seconds, from the return of a link to the last event that waited for it."""

IN_FLIGHT: Final = 500
"""Messages that each simulated publisher sends before the first one is acknowledged, as a site's server does."""

ARRAYS: Final = 8


# --- faults


def measure_faults(world: HubWorld, events: int, cuts: int) -> JsonObject:
    """Cut, kill, and measure until everything is shown again."""
    each = -(-events // ((cuts + 2) * len(world.links)))  # a part for each cut and each death
    world.finish(10)
    world.wait_until_shown()
    returns, processor_s = [], []
    for _ in range(cuts):
        for link in world.links.values():
            link.cut()
        world.finish(each)
        wait_until(lambda: not any(desk.store.backlog.unsaved for desk in world.desks.values()), "stored events")
        for link in world.links.values():
            link.mend()
        before_s = _processor_s()
        returns.append(_until_shown(world))
        processor_s.append(_processor_s() - before_s)
    world.cluster[-1].kill()
    world.finish(each)
    nats_killed_s = _until_shown(world)
    world.cluster[-1].start()
    wait_until(world.cluster[-1].is_healthy, "the NATS server that was killed")
    world.finish(each)
    world.kill_the_hub_at_work()
    hub_killed_s = _until_shown(world)
    stored, wanted = world.stored(), world.wanted()
    return {
        "events": sum(world.sent.values()),
        "waiting_at_each_return": each * len(world.links),
        "shown_after_return_s": [round(seconds, 3) for seconds in returns],
        "processor_time_of_each_return_s": [round(seconds, 3) for seconds in processor_s],
        "shown_after_a_nats_server_died_s": round(nats_killed_s, 3),
        "shown_after_the_hub_at_work_died_s": round(hub_killed_s, 3),
        "each_once": {name: sorted(ids) for name, ids in stored.items()}
        == {name: sorted(ids) for name, ids in wanted.items()},
        "in_order": stored == wanted,
    }


def _processor_s() -> float:
    """Return the processor time so far, in seconds, of this process and all that it has started and that still run."""
    parents, times = {}, {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            fields = (folder / "stat").read_text(encoding="utf-8").rpartition(")")[2].split()
        except OSError:  # it has just ended
            continue
        parents[int(folder.name)] = int(fields[1])
        times[int(folder.name)] = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    ours, more = set(), {os.getpid()}
    while more:
        ours |= more
        more = {process for process, parent in parents.items() if parent in more} - ours
    return sum(times[process] for process in ours)


def _until_shown(world: HubWorld) -> float:
    """Look at one hub and site after the other; a look at all of them all the time would slow the hubs down."""
    begun = time.perf_counter()
    for hub in world.hubs:
        for name, count in world.sent.items():
            while newest_at(hub.url, name) != f"{name}-{count - 1}":
                time.sleep(0.02)
    return time.perf_counter() - begun


# --- load


@dataclass(frozen=True)
class Load:
    """A load of simulated sites: their number, events a second of all of them (0: as fast as it goes), and seconds."""

    sites: int
    rate: float
    seconds: float


class Publisher:
    """Publishes for many sites, on a thread of its own, as their servers do: in order, and with a limit in flight."""

    def __init__(self, url: str, load: Load) -> None:
        self._url = url
        self._load = load
        self.published = 0
        """Events that the stream has acknowledged."""
        self.seconds = 0.0
        """Time that it took."""
        self.sent_ns: dict[str, int] = {}
        """When each event was handed to NATS, by its id."""

    def run(self) -> None:
        """Publish until the time is over."""
        asyncio.run(self._run())

    async def _run(self) -> None:
        client = await nats.connect(self._url)
        stream, rng, clock = client.jetstream(), random.Random(5), SystemClock()
        numbers = dict.fromkeys((f"site-{number:04d}" for number in range(self._load.sites)), 0)
        names, begun = list(numbers), time.perf_counter()
        waiting: list[asyncio.Future[Any]] = []
        count = 0
        while (passed := time.perf_counter() - begun) < self._load.seconds:
            due = count + IN_FLIGHT if self._load.rate <= 0 else round(passed * self._load.rate)
            for _ in range(min(due - count, IN_FLIGHT)):
                name = names[count % len(names)]
                numbers[name] += 1
                event = {**random_event(rng, count, clock.now_ns()), "id": f"{name}-{numbers[name]}"}
                headers = {MESSAGE_ID: message_id(Place("simulated", numbers[name]))}
                self.sent_ns[event["id"]] = clock.now_ns()
                waiting.append(await stream.publish_async(subject(name, "event"), orjson.dumps(event), headers=headers))
                count += 1
            if waiting:
                await asyncio.gather(*waiting)
                self.published, waiting = count, []
            else:
                await asyncio.sleep(0.005)
        self.seconds = time.perf_counter() - begun
        await client.close()


def measure_load(
    hub: HubProcess, server: NatsServer, postgresql: PostgreSQL | None, folder: Path, load: Load
) -> JsonObject:
    """Publish, and watch the hub until it has taken everything in."""
    publisher = Publisher(server.url, load)
    thread = threading.Thread(target=publisher.run)
    begun = time.perf_counter()
    thread.start()
    lags, memory = [], []
    with httpx.Client(base_url=hub.url, timeout=120) as client:
        while thread.is_alive():
            lags.append(publisher.published - _taken(client))
            memory.append(_memory_mb(hub.process.pid))
            time.sleep(0.25)
        wait_until(lambda: _taken(client) >= publisher.published, "the hub", seconds=600)
        taken_s = time.perf_counter() - begun
        answers = {kind: asdict(times) for kind, times in measure_answers(client, load.sites).items()}
    stored = _size(folder / "hub.sqlite*") if postgresql is None else _size_of_database(postgresql)
    events = publisher.published
    return {
        "sites": load.sites,
        "arrays": load.sites * ARRAYS,
        "events": events,
        "published_per_s": round(events / publisher.seconds),
        "taken_in_per_s": round(events / taken_s),
        "most_behind": max(lags, default=0),
        "hub_memory_mb": max(memory, default=0),
        "bytes_per_event_in_the_stream": round(_size(folder / "nats" / "**" / "*.blk") / max(1, events)),
        "bytes_per_event_in_the_database": round(stored / max(1, events)),
        "answers": answers,
    }


def measure_answers(client: httpx.Client, sites: int, searches: int = 100) -> dict[str, Times]:
    """Return how long answers of the API take."""
    rng = random.Random(6)
    requests: dict[str, Callable[[], str]] = {
        "newest of all": lambda: "/api/v1/events",
        "newest of a site": lambda: f"/api/v1/events?site=site-{rng.randrange(sites):04d}",
        "of a site, by time and confidence": lambda: (
            f"/api/v1/events?site=site-{rng.randrange(sites):04d}&min_confidence=0.9&since={utc_text(START_NS)}"
        ),
        "all sites": lambda: "/api/v1/sites",
    }
    found = {}
    for kind, request in requests.items():
        seconds = []
        for _ in range(searches):
            asked, begun = request(), time.perf_counter()
            client.get(asked).raise_for_status()
            seconds.append(time.perf_counter() - begun)
        found[kind] = Times.of(seconds)
    return found


def _taken(client: httpx.Client) -> int:
    return int(client.get("/api/v1/health").json()["taken"])


def _memory_mb(process: int) -> int:
    status = Path(f"/proc/{process}/status").read_text(encoding="utf-8")
    return next(int(line.split()[1]) // 1000 for line in status.splitlines() if line.startswith("VmRSS"))


def _size(pattern: Path) -> int:
    return sum(path.stat().st_size for path in Path(pattern.anchor).glob(str(pattern.relative_to(pattern.anchor))))


def _size_of_database(postgresql: PostgreSQL) -> int:
    import psycopg

    with psycopg.connect(f"postgresql://livessl@127.0.0.1:{postgresql.port}/postgres") as connection:
        row = connection.execute("SELECT pg_database_size(current_database())").fetchone()
    assert row is not None
    return int(row[0])


@contextmanager
def loaded_hub(folder: Path, postgresql: PostgreSQL | None) -> Iterator[tuple[NatsServer, HubProcess]]:
    """One NATS server and one hub."""
    (folder / "nats").mkdir()
    with running_nats(folder / "nats") as server:
        database = str(folder / "hub.sqlite") if postgresql is None else postgresql.url()
        hub = HubProcess(folder, 0, database, [server.url], replicas=1)
        try:
            wait_until_ready(hub.url, [hub.process], SystemClock())
            wait_until(hub.takes_in, "the hub")
            yield server, hub
        finally:
            end([hub.process])


def main() -> int:
    """Run one of the two benchmarks."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--events", type=int, default=1000, help="events in all (default: 1000)")
    parser.add_argument("--cuts", type=int, default=3, help="how often the links are cut (default: 3)")
    parser.add_argument("--sites", type=int, default=0, help="simulate the load of so many sites instead")
    parser.add_argument("--rate", type=float, default=0.0, help="events a second of all sites (default: all that goes)")
    parser.add_argument("--seconds", type=float, default=60.0, help="how long they are published (default: 60)")
    parser.add_argument("--sqlite", action="store_true", help="with --sites: SQLite instead of PostgreSQL")
    arguments = parser.parse_args()
    with TemporaryDirectory(prefix="livessl-hub-") as name:
        folder = Path(name)
        if arguments.sites and arguments.sqlite:
            load = Load(arguments.sites, arguments.rate, arguments.seconds)
            with loaded_hub(folder, None) as (server, hub):
                found = measure_load(hub, server, None, folder, load)
        else:
            with running_postgresql({**SETTINGS, "fsync": "on"}) as postgresql:
                if arguments.sites:
                    load = Load(arguments.sites, arguments.rate, arguments.seconds)
                    with loaded_hub(folder, postgresql) as (server, hub):
                        found = measure_load(hub, server, postgresql, folder, load)
                else:
                    with running_world(folder, postgresql.url()) as world:
                        found = measure_faults(world, arguments.events, arguments.cuts)
    print(json.dumps(found, indent=1))
    if arguments.sites:
        return 0
    late = max(found["shown_after_return_s"]) > MAX_RETURN_S
    return 0 if found["each_once"] and found["in_order"] and not late else 1


if __name__ == "__main__":
    sys.exit(main())
