"""Hubs under the load of many sites, simulated at the broker by the messages that their servers would send.

    python benchmarks/hub_load.py --sites 1 10 100 1000 --out results/hub
    python benchmarks/hub_load.py --hour 1000 --out results/hub
    python benchmarks/hub_load.py --history 10000 100000 1000000 --out results/hub
    python benchmarks/hub_load.py --out results/hub --into docs/scaling.md

A real NATS server, a real hub as a process, and PostgreSQL (`--sqlite`: an SQLite file instead). The sites publish an
hour of messages (`--minutes`) as fast as the stream takes them: how fast the hub takes them in. Then they go on at the
pace of real time: how long a message takes to the history, and after that how long answers of the API take meanwhile.
All the time, each site reports on itself every 5 s, as real ones do. `--hour` has them send their hour at a multiple
of its pace instead (`--times-real`), and shows how it goes in the course of it. `--history` fills the database of a hub
and measures the answers. `--into` writes the tables of all that lies in `--out` into a page.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import nats

sys.path[:0] = [str(Path(__file__).parents[1] / "tests"), str(Path(__file__).parents[1] / "tests" / "faults")]

import machine
from history import Times
from hub_history import measure_history
from hub_hour import Hour, measure_hour
from hub_processes import World, measure_answers, running_hub_process
from hub_publishing import CONNECTIONS, Progress, meanwhile, publish_at_once, publish_paced, report
from hub_report import document, written_into
from hub_sites import SimulatedSite
from livessl.server.api.encode import JsonObject
from livessl.server.forwarding.stream import STREAM
from processor_time import memory_mb


@dataclass(frozen=True)
class Demand:
    """Sites, minutes that they publish at once, seconds at the pace of real time, and seconds to wait for the hub."""

    sites: int
    minutes: int
    paced_s: float
    patience_s: float


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
    asking = asyncio.create_task(asyncio.to_thread(measure_answers, world, demand.sites, demand.paced_s))
    await publish_paced(progress, sites, demand.paced_s)
    return {
        "messages_per_s": rate,
        "lag": asdict(Times.of(progress.lags_s)),
        "processor_share": {name: (after[name] - before[name]) / passed_s for name in after},
        "is_drained": await progress.drain(demand.patience_s),
        "answers": await asking,
    }


def main() -> int:
    """Run what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sites", type=int, nargs="+", default=[], help="numbers of sites, one run each")
    parser.add_argument("--hour", type=int, nargs="+", default=[], help="numbers of sites whose hour is followed")
    parser.add_argument("--times-real", type=float, default=10.0, help="how many times as fast (default: 10)")
    parser.add_argument("--history", type=int, nargs="+", default=[], help="numbers of stored events, one step each")
    parser.add_argument("--history-sites", type=int, default=1000, help="sites of these events (default: 1000)")
    parser.add_argument("--minutes", type=int, default=60, help="minutes that are published at once (default: 60)")
    parser.add_argument("--paced", type=float, default=20.0, help="seconds at the pace of real time (default: 20)")
    parser.add_argument("--patience", type=float, default=300.0, help="longest wait for the hub (default: 300 s)")
    parser.add_argument("--sqlite", action="store_true", help="an SQLite file instead of PostgreSQL")
    parser.add_argument("--beside", default="nothing else", help="what else the machine did (default: nothing else)")
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
    for sites in arguments.hour:
        hour = Hour(sites, arguments.minutes, arguments.times_real, arguments.patience)
        with (
            TemporaryDirectory(prefix="livessl-hub-") as name,
            running_hub_process(Path(name), arguments.sqlite) as world,
        ):
            keep(f"hour-{sites}", asyncio.run(measure_hour(world, hour)))
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
