"""Breaks things on purpose and counts what is lost.

`python benchmarks/faults.py replayed --seeds 1000` in simulated time, `soak` for a day of it, `processes --out FOLDER`
with real processes, and `wire` with damaged messages. The results are in docs/reliability.md.
"""

from __future__ import annotations

import argparse
import json
import logging
import math
import random
import resource
import shutil
import sys
import tempfile
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from itertools import pairwise
from pathlib import Path
from typing import Any

sys.path[:0] = [str(Path(__file__).parents[1] / "tests"), str(Path(__file__).parents[1] / "tests" / "faults")]

from deaths import DEATHS, make_death_recordings, play_death
from fuzz import fuzz, lines_missed
from killed_alerts import play_killed
from mutation import campaign
from processes import NODES, Playing, make_recordings, play
from scenarios import HARMLESS, difference, nodes_killed, undisturbed
from soak import GROWTH, REFERENCE_HOURS, Sample, soak

DEATH_SOUNDS = 30
FUZZED_AT_A_TIME = 100_000


def replayed(seed: int) -> list[str]:
    """Run a seed under every fault; return the failures."""
    logging.disable(logging.CRITICAL)
    expected = undisturbed(seed)
    wrong = {name: difference(seed, fault, expected) for name, fault in HARMLESS.items()}
    with tempfile.TemporaryDirectory() as spools:
        wrong["nodes killed"] = nodes_killed(seed, Path(spools), expected)
    return [f"seed {seed}, {name}: {what}" for name, what in wrong.items() if what is not None]


def undisturbed_processes(site: Playing, rng: random.Random, end_s: float) -> None:
    """Cause no fault."""
    site.sleep_until(end_s)


def server_killed(site: Playing, rng: random.Random, end_s: float) -> None:
    """Kill the server 50 times, at random moments of the scene."""
    for moment_s in sorted(rng.uniform(0.0, end_s - 5.0) for _ in range(50)):
        site.sleep_until(moment_s)
        site.kill("server")
        site.start_server()


def nodes_killed_9(site: Playing, rng: random.Random, end_s: float) -> None:
    """Kill one of the nodes 20 times; it restarts at once."""
    for moment_s in sorted(rng.uniform(0.0, end_s - 10.0) for _ in range(20)):
        site.sleep_until(moment_s)
        name = rng.choice(list(NODES))
        site.kill(name)
        site.start_node(name)


def link_cut(site: Playing, rng: random.Random, end_s: float) -> None:
    """Cut one node's link for 60 s, then the other's, then both."""
    for k, names in enumerate((["a"], ["b"], ["a", "b"])):
        site.sleep_until(10.0 + 80.0 * k)
        for name in names:
            site.proxies[name].weather.cut = True
        site.sleep_until(70.0 + 80.0 * k)
        for name in names:
            site.proxies[name].weather.cut = False


def loss_and_jitter(site: Playing, rng: random.Random, end_s: float) -> None:
    """Lose 5 % of the pieces, with 200 ms of jitter."""
    for proxy in site.proxies.values():
        proxy.weather.loss, proxy.weather.jitter_s = 0.05, 0.2
    site.sleep_until(end_s)


def cables_pulled(site: Playing, rng: random.Random, end_s: float) -> None:
    """Loosen the contact at one node for 60 s, then unplug the other's cable for 60 s."""
    site.sleep_until(10.0)
    site.cables["a"].loosen(rng, 60.0)
    site.sleep_until(90.0)
    site.cables["b"].pull()
    site.sleep_until(150.0)
    site.cables["b"].plug()


def links_narrow(site: Playing, rng: random.Random, end_s: float) -> None:
    """Limit links to a tenth of the bandwidth that sound needs, for half of the time."""
    site.sleep_until(10.0)
    for cable in site.cables.values():
        cable.narrow(200)
    site.sleep_until(10.0 + end_s / 2)
    for cable in site.cables.values():
        cable.narrow(100_000)


def cable_pulled_then_narrow(site: Playing, rng: random.Random, end_s: float) -> None:
    """Unplug a cable for up to 30 s, then limit it to a third of the bandwidth that sound needs; four times."""
    for k in range(4):
        cable = site.cables[rng.choice(list(NODES))]
        site.sleep_until(10.0 + k * end_s / 4)
        cable.narrow(100_000)
        cable.pull()
        site.sleep_until(10.0 + k * end_s / 4 + rng.uniform(1.0, 30.0))
        cable.narrow(700)
        cable.plug()
    site.sleep_until(end_s)


def stopped(site: Playing, rng: random.Random, end_s: float) -> None:
    """Stop server or nodes by SIGSTOP for up to 5 s, or tear a connection, 30 times."""
    for moment_s in sorted(rng.uniform(0.0, end_s - 10.0) for _ in range(30)):
        site.sleep_until(moment_s)
        if rng.random() < 0.3:
            site.proxies[rng.choice(list(NODES))].tear()
        else:
            site.stop(rng.choice(["server", *NODES]), rng.uniform(0.1, 5.0))


PROCESSES = {
    "undisturbed": undisturbed_processes,
    "server killed 50 times": server_killed,
    "nodes killed 20 times": nodes_killed_9,
    "links cut for 60 s": link_cut,
    "5 % loss, 200 ms jitter": loss_and_jitter,
    "processes stopped, connections torn": stopped,
    "cables loose and pulled": cables_pulled,
    "links narrow": links_narrow,
    "cable pulled, then narrow": cable_pulled_then_narrow,
}


CABLED = {"cables loose and pulled", "links narrow", "cable pulled, then narrow"}
"""Faults for which nodes run in network namespaces instead of behind proxies."""


def processes(folder: Path, names: list[str]) -> list[dict[str, Any]]:
    """Play the same 40 sounds under each fault, and compare the stored events with the undisturbed run."""
    recordings = folder / "recordings"
    if not recordings.exists():
        recordings.mkdir(parents=True)
        make_recordings(recordings, 40, gap_s=6.0)
    results = []
    for name in names:
        path = folder / f"{name.replace(' ', '-').replace('%', 'percent').replace(',', '')}.json"
        if not path.exists():
            directory = path.with_suffix("")  # it stays, with the output of the processes, if anything fails
            shutil.rmtree(directory, ignore_errors=True)
            events = play(recordings, directory, PROCESSES[name], len(name), cabled=name in CABLED)
            shutil.copy(directory / "said.txt", path.with_suffix(".txt"))
            shutil.rmtree(directory)
            path.write_text(json.dumps(events), encoding="utf-8")
        got = json.loads(path.read_text(encoding="utf-8"))
        results.append(compared(name, got, json.loads((folder / "undisturbed.json").read_text(encoding="utf-8"))))
        print(results[-1], flush=True)
    return results


def compared(name: str, got: list[dict[str, Any]], expected: list[dict[str, Any]]) -> dict[str, Any]:
    """Count the expected events that occur exactly once, by their starts, and compare their positions."""
    doubled = sum(1 for one, other in pairwise(got) if other["at_s"] < one["at_s"] + one["duration_s"])
    pairs = [(event, [e for e in got if abs(e["at_s"] - event["at_s"]) < 0.5]) for event in expected]
    there = [(event, found[0]) for event, found in pairs if len(found) == 1]
    whole = [(event, found) for event, found in there if found["arrays"] == event["arrays"]]
    off_m = [math.dist(event["position_m"], found["position_m"]) for event, found in whole if event["position_m"]]
    return {
        "fault": name,
        "events": len(got),
        "once": len(there),
        "doubled": doubled,
        "of_all_arrays": len(whole),
        "late": sum(event["late"] for event in got),
        "largest_difference_m": max(off_m, default=None),
    }


def alerted(folder: Path, kills: int, seed: int) -> int:
    """Kill a whole server that alerts, and print what became of the alerts and of what operators changed."""
    recordings = folder / f"recordings-{kills}"
    if not recordings.exists():
        make_recordings(recordings, 4 * kills, gap_s=1.2)
    shutil.rmtree(folder / "site", ignore_errors=True)
    outcome = play_killed(recordings, folder / "site", kills, seed)
    counts = {
        name: getattr(outcome, name) for name in ("kills", "interrupted", "sounds", "changes", "differing", "copies")
    }
    counts |= {"alerts": len(outcome.wanted), "accepted": len(outcome.accepted)}
    wrong = {name: getattr(outcome, name) for name in ("missing", "unwanted", "forgotten")}
    print(json.dumps(counts | wrong, indent=1))
    return 1 if any(wrong.values()) or outcome.differing or outcome.kills < kills else 0


def damaged(count: int) -> int:
    """Decode damaged messages in ten parts, and print the memory after each."""
    logging.disable(logging.CRITICAL)
    outcomes: Counter[str] = Counter()
    began = time.monotonic()
    for part in range(10):
        outcomes += campaign(count // 10, part)
        peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1000
        print(f"{outcomes.total()} messages, {dict(outcomes)}, at most {peak_mb:.1f} MB", flush=True)
    print(f"{time.monotonic() - began:.0f} s")
    return 0


def deaths(folder: Path, names: list[str]) -> None:
    """Disable an array in each way, and print the delay of the other arrays' events."""
    recordings = folder / "recordings"
    if not recordings.exists():
        make_death_recordings(recordings, DEATH_SOUNDS)
    for name in names:
        death = play_death(recordings, folder / name.replace(" ", "-"), name)
        events = f"{len(death.delays_s)} events, p50 {1000 * death.p50_s:.0f} ms, p95 {1000 * death.p95_s:.0f} ms"
        most = f"max {1000 * death.delays_s[-1]:.0f} ms"
        print(f"{name}: {events}, {most}, shown after {death.shown_s and round(death.shown_s, 2)} s", flush=True)


def fuzzed(seconds: float) -> int:
    """Fuzz by coverage for some seconds; return 1 if a line of the decoder was not reached."""
    began_s, seed = time.monotonic(), 0
    outcomes: Counter[str] = Counter()
    found = fuzz(FUZZED_AT_A_TIME, seed)
    while time.monotonic() - began_s < seconds:
        outcomes += found.outcomes
        seed += 1
        found = fuzz(FUZZED_AT_A_TIME, seed)
    print(f"{outcomes.total()} messages, {dict(outcomes)}, {seed} seeds, {time.monotonic() - began_s:.0f} s")
    print(f"transitions between lines: {len(found.edges)}; lines of the decoder not reached: {lines_missed(found)}")
    return 1 if lines_missed(found) else 0


def soaked(hours: float, seed: int) -> int:
    """Simulate hours of four arrays; return 1 if the memory grows too much after the first, or a sound is lost."""
    logging.disable(logging.CRITICAL)

    def tell(sample: Sample) -> None:
        print(f"{sample.hours:5.2f} h {sample.resident_mb:6.1f} MB, {sample.kept} frames kept", flush=True)

    with tempfile.TemporaryDirectory() as directory:
        outcome = soak(Path(directory), hours, seed=seed, tell=tell)
    for name, value in asdict(outcome).items():
        print(f"{name:<20} {value}")
    print(f"{'growth':<20} {outcome.growth:.2%}")
    return 1 if outcome.growth > GROWTH or outcome.unheard else 0


def main() -> int:
    """Run a campaign; return 1 if anything failed."""
    parser = argparse.ArgumentParser(description=__doc__)
    campaigns = parser.add_subparsers(dest="campaign", required=True)
    sub = campaigns.add_parser("replayed", help="simulated time: every fault for each seed")
    sub.add_argument("--seeds", type=int, default=1000, help="number of simulated worlds (1000)")
    sub.add_argument("--first", type=int, default=0, help="the first seed (0)")
    sub.add_argument("--jobs", type=int, default=2, help="processes (2)")
    sub = campaigns.add_parser("processes", help="real processes and sockets: 40 sounds under each fault")
    sub.add_argument(
        "--out", type=Path, required=True, help="folder for recordings and results; existing ones are kept"
    )
    sub.add_argument("--fault", choices=list(PROCESSES), action="append", help="only this fault; may be repeated (all)")
    sub = campaigns.add_parser("wire", help="damaged messages, given to the server's ingest")
    sub.add_argument("--count", type=int, default=1_000_000, help="number of messages (1 000 000)")
    sub = campaigns.add_parser("soak", help="simulated time: a day of four arrays, and the server's memory")
    sub.add_argument("--hours", type=float, default=24.0, help="simulated time (24)")
    sub.add_argument("--seed", type=int, default=0, help="seed of the faults (0)")
    sub = campaigns.add_parser("deaths", help="real processes: the delay of events when an array fails")
    sub.add_argument("--out", type=Path, required=True, help="folder for recordings; they are kept")
    sub.add_argument("--fault", choices=list(DEATHS), action="append", help="only this fault; may be repeated (all)")
    sub = campaigns.add_parser("alerts", help="real processes: the whole server is killed while it alerts")
    sub.add_argument("--out", type=Path, required=True, help="folder for recordings; they are kept")
    sub.add_argument("--kills", type=int, default=50, help="number of kills (50)")
    sub.add_argument("--seed", type=int, default=0, help="seed of their moments (0)")
    sub = campaigns.add_parser("fuzz", help="coverage-guided fuzzing of the wire")
    sub.add_argument("--seconds", type=float, default=300.0, help="running time (300)")
    arguments = parser.parse_args()
    if arguments.campaign == "fuzz":
        return fuzzed(arguments.seconds)
    if arguments.campaign == "alerts":
        return alerted(arguments.out, arguments.kills, arguments.seed)
    if arguments.campaign == "deaths":
        deaths(arguments.out, arguments.fault or list(DEATHS))
        return 0
    if arguments.campaign == "soak":
        if arguments.hours <= REFERENCE_HOURS:
            parser.error(f"--hours: expected more than {REFERENCE_HOURS:g}, because the end is compared with that hour")
        return soaked(arguments.hours, arguments.seed)
    if arguments.campaign == "wire":
        return damaged(arguments.count)
    began = time.monotonic()
    if arguments.campaign == "processes":
        results = processes(arguments.out, arguments.fault or list(PROCESSES))
        return 0 if all(result["events"] == result["once"] == 40 for result in results) else 1
    with ProcessPoolExecutor(arguments.jobs) as pool:
        seeds = range(arguments.first, arguments.first + arguments.seeds)
        wrong: list[str] = []
        for seed, lines in zip(seeds, pool.map(replayed, seeds), strict=True):
            wrong += lines
            print(f"{seed}: {len(wrong)} wrong so far", *lines, sep="\n", flush=True)
    runs = arguments.seeds * (len(HARMLESS) + 1)
    print(f"{runs} runs of 8 sounds, {len(wrong)} went wrong, {time.monotonic() - began:.0f} s")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
