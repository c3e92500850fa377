"""The time that `livessl --help`, and the help of each command, takes.

    python benchmarks/help_time.py --out docs/performance

Each is started several times, and the first start, which reads files from the disk, is not counted.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
from pathlib import Path
from typing import Final

import machine
from livessl.cli.main import COMMANDS
from livessl.clock import SystemClock

STARTS: Final = 5


def measure(command: list[str], starts: int) -> dict[str, float]:
    """Return the shortest and the median elapsed time, and the median processor time, of a command's help, seconds."""
    clock, walls_s, cpus_s = SystemClock(), [], []
    for _ in range(starts + 1):
        before, began_ns = os.times(), clock.monotonic_ns()
        subprocess.run(  # noqa: S603 - ours
            [sys.executable, "-m", "livessl", *command, "--help"], check=True, capture_output=True
        )
        after = os.times()
        walls_s.append((clock.monotonic_ns() - began_ns) / 1e9)
        cpus_s.append(sum(after[2:4]) - sum(before[2:4]))
    return {
        "shortest_s": round(min(walls_s[1:]), 3),
        "median_s": round(statistics.median(walls_s[1:]), 3),
        "processor_s": round(statistics.median(cpus_s[1:]), 3),
    }


def main() -> int:
    """Measure the help of every command and write `help.json`."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    parser.add_argument("--starts", type=int, default=STARTS)
    arguments = parser.parse_args()
    about = machine.describe()
    results = {"livessl": measure([], arguments.starts)}
    results |= {f"livessl {one.name}": measure([one.name], arguments.starts) for one in COMMANDS}
    for name, took in results.items():
        print(f"{name:<20} {took['median_s']:6.3f} s, processor {took['processor_s']:6.3f} s")
    arguments.out.mkdir(parents=True, exist_ok=True)
    report = {"machine": about, "starts": arguments.starts, "help": results}
    (arguments.out / "help.json").write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
