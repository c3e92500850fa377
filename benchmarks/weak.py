"""The benefit of backfill requests: one scene, ever weaker at one of two arrays.

`python benchmarks/weak.py --cache FOLDER` simulates development sounds in the demo's room, weaker at the south array by
a number of dB in the same noise, and localizes them with and without backfill requests. The results are in
docs/accuracy/arrays.md.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
import soundfile

from clocks import NEAR_M, RATE_HZ, START_NS, by_sound, scene_of
from livessl import offline
from livessl.clock import UnpacedClock
from livessl.core.types import Event, Status
from livessl.lab.demo import SITE_FILE
from livessl.recordings.assign import AssignedRecording
from livessl.recordings.recording import FileRecording
from livessl.simulation.scene import Scene, render
from livessl.site.load import load_site
from livessl.site.models import Site

LOWER_DB: Final = (0.0, 10.0, 15.0, 20.0, 25.0, 30.0)


def parts_of(site: Site, scene: Scene, cache: Path, name: str, lower_db: float) -> list[AssignedRecording]:
    """Simulate the arrays' recordings, with the sounds of the last array `lower_db` lower."""
    cache.mkdir(parents=True, exist_ok=True)
    paths = {}
    for number, spec in enumerate(site.specs):
        lower = lower_db if number == len(site.specs) - 1 else 0.0
        path = paths[spec.name] = cache / f"weak-{name}-{spec.name}-{lower:g}.wav"
        if not path.exists():
            weaker = replace(scene, level_dbfs=scene.level_dbfs - lower)
            samples = render(weaker, spec.microphones_m, seed=number + 1)
            soundfile.write(path, samples.T, round(RATE_HZ), subtype="FLOAT")
    return [
        AssignedRecording(array, FileRecording(path), START_NS, tuple(range(1, 5))) for array, path in paths.items()
    ]


def figures(scene: Scene, events: list[Event]) -> dict[str, int]:
    """Count the sounds by the outcome of their events."""
    near = wrong = alone = helped = 0
    found_by_sound = by_sound(scene, events)
    for source, found in zip(scene.sources, found_by_sound, strict=True):
        placed = [event for event in found if event.status is Status.LOCATED and event.estimate is not None]
        errors_m = [float(np.linalg.norm(e.estimate.position_m - source.position_m)) for e in placed if e.estimate]
        near += bool(errors_m) and min(errors_m) <= NEAR_M
        wrong += sum(error_m > NEAR_M for error_m in errors_m)
        alone += any(len(event.heard_by) == 1 for event in found)
        helped += any(contribution.asked for event in placed for contribution in event.contributions)
    return {
        "sounds": len(found_by_sound),
        "near": near,
        "wrong": wrong,
        "heard_by_one": alone,
        "asked_and_used": helped,
    }


def main() -> None:
    """Simulate, localize, and print two lines for each level."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sounds", type=int, default=36)
    parser.add_argument("--rt60", type=float, default=0.7)
    parser.add_argument("--noise-dbfs", type=float, default=-60.0)
    parser.add_argument("--seeds", type=int, nargs="+", default=(7, 8, 9))
    parser.add_argument("--lower-db", type=float, nargs="+", default=LOWER_DB)
    parser.add_argument("--cache", type=Path, required=True)
    a = parser.parse_args()
    site = load_site(SITE_FILE)
    for lower_db in a.lower_db:
        for ask in (False, True):
            total: Counter[str] = Counter()
            for seed in a.seeds:
                scene = replace(scene_of(site, a.sounds, a.rt60, 0.8, seed), noise_dbfs=a.noise_dbfs)
                name = f"{a.sounds}-{a.rt60:g}-{seed}{a.noise_dbfs:g}"
                parts = parts_of(site, scene, a.cache, name, lower_db)
                outputs = offline.run(site, parts, UnpacedClock(), backfill=ask)
                total += Counter(figures(scene, [output for output in outputs if isinstance(output, Event)]))
            print(json.dumps({"lower_db": lower_db, "ask": ask, **total}), flush=True)


if __name__ == "__main__":
    main()
