"""The service alone under load: `livessl bench --live` with an estimator that costs nothing, and a profile.

    python benchmarks/live.py --arrays 64 --clients 20 --seconds 20 --profile server.pstats

The cost of the localization itself is measured by the core's own benchmarks. Here the estimator returns one position
after one pass over its sound. The profile is of the thread that runs the fusion, by cProfile, which makes it slower.
"""

from __future__ import annotations

import argparse
import cProfile
import json
import pstats
import subprocess
import sys
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from livessl.cli.main import main as livessl
from livessl.clock import SystemClock
from livessl.core.geometry import Grid
from livessl.core.locate.estimator import Localization, PowerMaps, Sound, register
from livessl.core.types import ArraySpec, Evidence
from livessl.lab.bench import live
from livessl.server.engine import Engine


class Nowhere:
    """Locates everything in the middle of the room, after one pass over the sound to bring it into the cache."""

    name = "onset"

    def __init__(self, arrays: Sequence[ArraySpec], grid: Grid, c_m_s: float) -> None:
        self._grid = grid
        self._middle_m = (grid.lower_m + grid.upper_m) / 2

    def prepare(self, array: str, sample_rate_hz: float) -> None:
        """Prepare nothing."""

    def onset_front_end(self, array: str, sample_rate_hz: float) -> None:
        """Nothing listens."""
        return

    def locate(self, sounds: Mapping[str, Sound]) -> Localization:
        """Return the middle of the room."""
        loudest = max(float(segment.max()) for sound in sounds.values() for segment in sound.segments)
        return Localization(self._middle_m + 0.01 * loudest, 0.01 * np.eye(3), 0.5, ())

    def power_maps(self, evidence: Sequence[Evidence], separately: Collection[str] | None = None) -> PowerMaps:
        """Return a map without power."""
        return PowerMaps(self._grid, np.zeros(self._grid.size, dtype=np.float32), {})


def serve(site_file: Path, profile: Path | None) -> None:
    """Run the server with this estimator, and profile it if a file is given."""
    register("onset", Nowhere)
    if profile is not None:
        turn = Engine.turn
        profiler = cProfile.Profile()

        def profiled(engine: Engine) -> None:
            profiler.runcall(turn, engine)

        Engine.turn = profiled  # type: ignore[assignment, method-assign]
    livessl(["serve", "--site", str(site_file)])
    if profile is not None:
        profiler.dump_stats(profile)


def main() -> None:
    """Measure and print the outcome."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--arrays", type=int, default=16)
    parser.add_argument("--clients", type=int, default=20)
    parser.add_argument("--watchers", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--profile", type=Path)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--serve", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.serve is not None:
        serve(arguments.serve, arguments.profile)
        return
    extra = [] if arguments.profile is None else ["--profile", str(arguments.profile)]

    def start(site_file: Path) -> Any:
        return subprocess.Popen([sys.executable, __file__, "--serve", str(site_file), *extra])  # noqa: S603 - this file

    demand = live.Demand(
        arguments.arrays, arguments.clients, arguments.seconds, watchers=arguments.watchers, spacing_m=0.5, rt60_s=0.0
    )
    outcome = live.measure(demand, SystemClock(), start=start)
    print(json.dumps(outcome.json()) if arguments.json else live.table(outcome))
    if arguments.profile is not None:
        pstats.Stats(str(arguments.profile)).sort_stats("tottime").print_stats(25)


if __name__ == "__main__":
    main()
