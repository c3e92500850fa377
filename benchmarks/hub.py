"""Hubs under faults.

    python benchmarks/hub.py --events 1000

Three sites, a cluster of three NATS servers and two hubs on PostgreSQL, all as they run in service.
Links are cut, a NATS server and the hub at work are killed. It prints how long after the return of the links, or after
the death, the last event is shown by every hub, and whether each event is there once and in order. The exit status is 1
if one is not, or if the return takes longer than a second.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

sys.path[:0] = [str(Path(__file__).parents[1] / "tests"), str(Path(__file__).parents[1] / "tests" / "faults")]

from hub_desk import newest_at
from hub_world import HubWorld, running_world
from livessl.server.api.encode import JsonObject
from postgresql import SETTINGS, running_postgresql
from processor_time import processor_s
from small_site import wait_until

MAX_RETURN_S: Final = 1.0
"""Longest time, in seconds, from the return of a link to the last event that waited for it."""


def measure_faults(world: HubWorld, events: int, cuts: int) -> JsonObject:
    """Cut, kill, and measure until everything is shown again."""
    each = -(-events // ((cuts + 2) * len(world.links)))  # a part for each cut and each death
    world.finish(10)
    world.wait_until_shown()
    returns, spent_s = [], []
    for _ in range(cuts):
        for link in world.links.values():
            link.cut()
        world.finish(each)
        wait_until(lambda: not any(desk.store.backlog.unsaved for desk in world.desks.values()), "stored events")
        for link in world.links.values():
            link.mend()
        before_s = processor_s(os.getpid())
        returns.append(_until_shown(world))
        spent_s.append(processor_s(os.getpid()) - before_s)
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
        "processor_time_of_each_return_s": [round(seconds, 3) for seconds in spent_s],
        "shown_after_a_nats_server_died_s": round(nats_killed_s, 3),
        "shown_after_the_hub_at_work_died_s": round(hub_killed_s, 3),
        "each_once": {name: sorted(ids) for name, ids in stored.items()}
        == {name: sorted(ids) for name, ids in wanted.items()},
        "in_order": stored == wanted,
    }


def _until_shown(world: HubWorld) -> float:
    """Look at one hub and site after the other; a look at all of them all the time would slow the hubs down."""
    begun = time.perf_counter()
    for hub in world.hubs:
        for name, count in world.sent.items():
            while newest_at(hub.url, name) != f"{name}-{count - 1}":
                time.sleep(0.02)
    return time.perf_counter() - begun


def main() -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--events", type=int, default=1000, help="events in all (default: 1000)")
    parser.add_argument("--cuts", type=int, default=3, help="how often the links are cut (default: 3)")
    arguments = parser.parse_args()
    with (
        TemporaryDirectory(prefix="livessl-hub-") as folder,
        running_postgresql({**SETTINGS, "fsync": "on"}) as postgresql,
        running_world(Path(folder), postgresql.url()) as world,
    ):
        found = measure_faults(world, arguments.events, arguments.cuts)
    print(json.dumps(found, indent=1))
    late = max(found["shown_after_return_s"]) > MAX_RETURN_S
    return 0 if found["each_once"] and found["in_order"] and not late else 1


if __name__ == "__main__":
    sys.exit(main())
