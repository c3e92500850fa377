"""Breaks things on purpose: `python benchmarks/faults.py replayed --seeds 1000` in simulated time, by every fault."""

from __future__ import annotations

import argparse
import logging
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parents[1] / "tests"), str(Path(__file__).parents[1] / "tests" / "faults")]

from scenarios import HARMLESS, difference, nodes_killed, undisturbed


def replayed(seed: int) -> list[str]:
    """What went wrong with a seed, by every fault."""
    logging.disable(logging.CRITICAL)
    expected = undisturbed(seed)
    wrong = {name: difference(seed, fault, expected) for name, fault in HARMLESS.items()}
    with tempfile.TemporaryDirectory() as spools:
        wrong["nodes killed"] = nodes_killed(seed, Path(spools), expected)
    return [f"seed {seed}, {name}: {what}" for name, what in wrong.items() if what is not None]


def main() -> int:
    """Run a campaign; 1 where anything went wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("campaign", choices=["replayed"])
    parser.add_argument("--seeds", type=int, default=1000, help="how many worlds (1000)")
    parser.add_argument("--first", type=int, default=0, help="the first seed (0)")
    parser.add_argument("--jobs", type=int, default=2, help="processes (2)")
    arguments = parser.parse_args()
    began = time.monotonic()
    with ProcessPoolExecutor(arguments.jobs) as pool:
        seeds = range(arguments.first, arguments.first + arguments.seeds)
        wrong = []
        for seed, lines in zip(seeds, pool.map(replayed, seeds), strict=True):
            wrong += lines
            print(f"{seed}: {len(wrong)} wrong so far", *lines, sep="\n", flush=True)
    runs = arguments.seeds * (len(HARMLESS) + 1)
    print(f"{runs} runs of 8 sounds, {len(wrong)} went wrong, {time.monotonic() - began:.0f} s")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
