"""Hubs under the load of many sites, simulated at the broker by the messages that their servers would send.

    python benchmarks/hub_load.py --sites 1 10 100 1000 --out results/hub
    python benchmarks/hub_load.py --history 10000 100000 1000000 --out results/hub
    python benchmarks/hub_load.py --out results/hub --into docs/scaling.md

A real NATS server, a real hub as a process, and PostgreSQL (`--sqlite`: an SQLite file instead). The sites publish an
hour of messages (`--minutes`) as fast as the stream takes them: how fast the hub takes them in. Then they go on at the
pace of real time: how long a message takes to the history, and after that how long answers of the API take meanwhile.
All the time, each site reports on itself every 5 s, as real ones do. `--history` fills the database of a hub instead,
and measures the answers. `--into` writes the tables of all that lies in `--out` into a page.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import sys
import time
from collections.abc import Callable, Coroutine, Iterator, Sequence
from contextlib import ExitStack, asynccontextmanager
from dataclasses import asdict, dataclass, field
from functools import partial
from itertools import chain, islice
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Final

import nats

sys.path[:0] = [str(Path(__file__).parents[1] / "tests"), str(Path(__file__).parents[1] / "tests" / "faults")]

import machine
from history import Times
from history_rows import Rows, fill
from hub_processes import World, measure_answers, running_hub_process
from hub_report import document, written_into
from hub_sites import MESSAGES_PER_HOUR, MIN_PACE, SimulatedSite, hub_rows
from livessl.clock import SystemClock
from livessl.federation.archive import Archive
from livessl.federation.storing import Delivery
from livessl.server.api.encode import JsonObject
from livessl.server.forwarding.link import REPORT_S, WINDOW
from livessl.server.forwarding.stream import CONSUMER, HEALTH, MESSAGE_ID, STREAM, message_id, subject
from postgresql import SETTINGS, running_postgresql
from processor_time import memory_mb

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from nats.aio.client import Client
    from nats.js import JetStreamContext

CONNECTIONS: Final = 4
"""Connections that all simulated sites share; real ones have one each."""

LOOK_S: Final = 0.2
"""Interval, in seconds, at which the stream is asked how far the hub is."""


@dataclass(frozen=True)
class Demand:
    """Sites, minutes that they publish at once, seconds at the pace of real time, and seconds to wait for the hub."""

    sites: int
    minutes: int
    paced_s: float
    patience_s: float


# --- sites


@dataclass
class Progress:
    """What the sites have published, and how far the hub is."""

    stream: JetStreamContext
    sent: dict[int, float] = field(default_factory=dict)
    """When each message was handed to NATS, by its number in the stream."""
    events: int = 0
    lags_s: list[float] = field(default_factory=list)
    """Ages of the oldest message that the hub has not taken in, at each look."""
    most_waiting: int = 0
    taken: int = 0
    """Number of the last message in the stream before which the hub has taken in all."""

    async def look(self) -> int:
        """Ask the stream how many messages wait for the hub; return that."""
        info = await self.stream.consumer_info(STREAM, CONSUMER)
        waiting = int(info.num_pending or 0) + int(info.num_ack_pending or 0)
        self.taken = int(info.ack_floor.stream_seq) if info.ack_floor else 0
        oldest = self.sent.get(self.taken + 1) if waiting else None
        self.lags_s.append(0.0 if oldest is None else time.perf_counter() - oldest)
        self.most_waiting = max(self.most_waiting, waiting)
        return waiting

    async def watch(self, end: asyncio.Event) -> None:
        """Look until the end."""
        while not end.is_set():
            await self.look()
            await asyncio.sleep(LOOK_S)

    async def drain(self, patience_s: float) -> bool:
        """Return whether the hub has taken everything in within some seconds."""
        until = time.perf_counter() + patience_s
        while await self.look():
            if time.perf_counter() > until:
                return False
            await asyncio.sleep(LOOK_S)
        return True


async def publish(progress: Progress, stream: JetStreamContext, window: Sequence[Delivery]) -> None:
    """Publish some messages as a site's server does, and wait until the stream has acknowledged all."""
    waiting, times = [], []
    for site, kind, place, body in window:
        times.append(time.perf_counter())
        headers = {MESSAGE_ID: message_id(place), "Nats-Expected-Stream": STREAM}
        waiting.append(await stream.publish_async(subject(site, kind), body, headers=headers))
        progress.events += kind == "event"
    for each, sent in zip(await asyncio.gather(*waiting), times, strict=True):
        progress.sent[each.seq] = sent


async def publish_at_once(
    progress: Progress, stream: JetStreamContext, sites: Sequence[SimulatedSite], minutes: int
) -> None:
    """Publish the first minutes of some sites in windows, as fast as the stream acknowledges them."""
    following = (message for _ in range(minutes) for site in sites for message in site.minute())
    messages = chain((message for site in sites for message in site.begin()), following)
    while window := list(islice(messages, WINDOW)):
        await publish(progress, stream, window)


async def publish_paced(progress: Progress, sites: Sequence[SimulatedSite], seconds: float) -> float:
    """Publish at the pace of real time, site by site; return the messages of a second."""
    rate = max(MIN_PACE, len(sites) * MESSAGES_PER_HOUR / 3600)
    begun, count = time.perf_counter(), 0
    messages = (message for number in range(10**9) for message in sites[number % len(sites)].minute())
    while (passed := time.perf_counter() - begun) < seconds:
        due = round(passed * rate) - count
        if due > 0:
            await publish(progress, progress.stream, list(islice(messages, due)))
            count += due
        await asyncio.sleep(0.01)
    return rate


async def report(client: Client, sites: Sequence[SimulatedSite], end: asyncio.Event) -> None:
    """Publish the reports of all sites on themselves, evenly spread, until the end."""
    begun, count = time.perf_counter(), 0
    while not end.is_set():
        due = int((time.perf_counter() - begun) / REPORT_S * len(sites))
        for number in range(count, due):
            site = sites[number % len(sites)]
            await client.publish(subject(site.name, HEALTH), site.report())
        count = due
        await asyncio.sleep(0.02)


@asynccontextmanager
async def meanwhile(work: Callable[[asyncio.Event], Coroutine[None, None, None]]) -> AsyncIterator[None]:
    """Do something while the context lasts; what fails in it fails here.

    The event tells it to end: Python 3.11 may lose a cancellation of what waits for an answer of NATS.
    """
    end = asyncio.Event()
    task = asyncio.create_task(work(end))
    try:
        yield
    finally:
        end.set()
        await task


async def measure_load(world: World, demand: Demand) -> JsonObject:
    """Publish some minutes as fast as it goes, then go on at the pace of real time."""
    sites = [SimulatedSite(number) for number in range(demand.sites)]
    empty, clients = world.stored_bytes(), [await nats.connect(world.server.url) for _ in range(CONNECTIONS)]
    streams = [client.jetstream(timeout=60.0) for client in clients]
    progress = Progress(streams[0])
    before, begun = world.processor_s(), time.perf_counter()
    async with meanwhile(partial(report, clients[0], sites)):
        async with meanwhile(progress.watch):
            parts = [sites[number::CONNECTIONS] for number in range(CONNECTIONS)]
            floods = (
                publish_at_once(progress, stream, part, demand.minutes)
                for stream, part in zip(streams, parts, strict=True)
                if part
            )
            await asyncio.gather(*floods)
        published_s, published = time.perf_counter() - begun, len(progress.sent)
        is_drained = await progress.drain(demand.patience_s)
        flood_s, flood = time.perf_counter() - begun, world.processor_s()
        state = (await streams[0].stream_info(STREAM)).state
        found: JsonObject = {
            "sites": demand.sites,
            "messages": published,
            "events": progress.events,
            "minutes": demand.minutes,
            "is_drained": is_drained,
            "published_per_s": published / published_s,
            "taken_in_per_s": progress.taken / flood_s,
            "most_waiting": progress.most_waiting,
            "processor_ms_per_message": {
                name: 1000 * (flood[name] - before[name]) / max(1, progress.taken) for name in flood
            },
            "stream_bytes_per_message": state.bytes / max(1, state.messages),
            "database_bytes_per_event": (world.stored_bytes() - empty) / max(1, progress.events),
        }
        if is_drained:
            found["paced"] = await measure_paced(world, demand, progress, sites)
    found["hub_memory_mb"] = memory_mb(world.hub.process.pid, "VmHWM")
    for client in clients:
        await client.close()
    return found


async def measure_paced(world: World, demand: Demand, progress: Progress, sites: Sequence[SimulatedSite]) -> JsonObject:
    """Publish at the pace of real time, and then ask the API as well for as long."""
    progress.lags_s.clear()
    before, begun = world.processor_s(), time.perf_counter()
    async with meanwhile(progress.watch):
        rate = await publish_paced(progress, sites, demand.paced_s)
    after, passed_s = world.processor_s(), time.perf_counter() - begun
    asking = asyncio.create_task(asyncio.to_thread(measure_answers, world.hub.url, demand.sites, demand.paced_s))
    await publish_paced(progress, sites, demand.paced_s)
    return {
        "messages_per_s": rate,
        "lag": asdict(Times.of(progress.lags_s)),
        "processor_share": {name: (after[name] - before[name]) / passed_s for name in after},
        "is_drained": await progress.drain(demand.patience_s),
        "answers": await asking,
    }


# --- history


def filled(place: str, count: int, first: int, sites: int) -> None:
    """Fill the database of a hub with so many events more, and let it know all sites."""

    def make(number: int, of: int) -> Rows:
        return hub_rows(number, of, sites)

    fill(place, count, first, make)
    archive = Archive(place if "://" in place else Path(place), SystemClock())
    try:
        simulated = [SimulatedSite(number) for number in range(sites)]
        known = [message for site in simulated for message in site.begin()]
        for batch in (known[start : start + WINDOW] for start in range(0, len(known), WINDOW)):
            taken = archive.take(batch, 0.0)
            assert len(taken.done) == len(batch)
        archive.note_reports({site.name: json.loads(site.report()) for site in simulated})
    finally:
        archive.close()


def measure_history(
    counts: Sequence[int], sites: int, seconds: float, folder: Path, sqlite: bool
) -> Iterator[JsonObject]:
    """Fill a hub's database step by step, and measure the answers of a hub at each."""
    with ExitStack() as stack:
        place = str(folder / "hub.sqlite")
        if not sqlite:
            place = stack.enter_context(running_postgresql({**SETTINGS, "shared_buffers": "128MB"})).url()
        stored = 0
        for count in sorted(counts):
            filled(place, count - stored, stored, sites)
            stored = count
            with running_hub_process(folder, sqlite=sqlite, database=place) as world:
                measure_answers(world.hub.url, sites, 0.0)  # the first look of each kind reads what no cache has
                answers = measure_answers(world.hub.url, sites, seconds)
                yield {
                    "history": count,
                    "sites": sites,
                    "answers": answers,
                    "hub_memory_mb": memory_mb(world.hub.process.pid, "VmHWM"),
                }


def main() -> int:
    """Run what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sites", type=int, nargs="+", default=[], help="numbers of sites, one run each")
    parser.add_argument("--history", type=int, nargs="+", default=[], help="numbers of stored events, one step each")
    parser.add_argument("--history-sites", type=int, default=1000, help="sites of these events (default: 1000)")
    parser.add_argument("--minutes", type=int, default=60, help="minutes that are published at once (default: 60)")
    parser.add_argument("--paced", type=float, default=20.0, help="seconds at the pace of real time (default: 20)")
    parser.add_argument("--patience", type=float, default=300.0, help="longest wait for the hub (default: 300 s)")
    parser.add_argument("--sqlite", action="store_true", help="an SQLite file instead of PostgreSQL")
    parser.add_argument("--beside", default="nothing else", help="what the machine does meanwhile, for the page")
    parser.add_argument("--out", type=Path, required=True, help="folder of the figures")
    parser.add_argument("--into", type=Path, help="page into which the tables are written")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    about = {"machine": machine.describe(), "database": "SQLite" if arguments.sqlite else "PostgreSQL"}
    about["beside"] = arguments.beside

    def keep(name: str, found: JsonObject) -> None:
        print(json.dumps(found, indent=1))
        (arguments.out / f"{name}.json").write_text(json.dumps({**about, **found}, indent=1), encoding="utf-8")

    for sites in arguments.sites:
        demand = Demand(sites, arguments.minutes, arguments.paced, arguments.patience)
        with (
            TemporaryDirectory(prefix="livessl-hub-") as name,
            running_hub_process(Path(name), arguments.sqlite) as world,
        ):
            keep(f"sites-{sites}", asyncio.run(measure_load(world, demand)))
    if arguments.history:
        with TemporaryDirectory(prefix="livessl-hub-") as name:
            steps = measure_history(
                arguments.history, arguments.history_sites, arguments.paced, Path(name), arguments.sqlite
            )
            for step in steps:
                keep(f"history-{step['history']}", step)
    if arguments.into is not None:
        page = arguments.into.read_text(encoding="utf-8")
        arguments.into.write_text(written_into(page, document(arguments.out)), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
