"""The effect of clocks that disagree: one scene, replayed with one array's clock off and drifting.

`python benchmarks/clocks.py --cache FOLDER` simulates a scene in the demo's room once, and localizes it with each
offset and drift of the south array's clock. The results are in docs/accuracy/arrays.md.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import soundfile

from livessl.clock import UnpacedClock
from livessl.core.stream.clock_offsets import ClockOffset
from livessl.core.types import Block, Event, Output, Status
from livessl.lab.demo import SITE_FILE
from livessl.recordings.assign import AssignedRecording, make_pipelines
from livessl.recordings.play import paced_messages
from livessl.recordings.recording import FileRecording
from livessl.simulation.scene import Scene, make_scene, read_sounds, render
from livessl.site.build.fusion import make_fusion
from livessl.site.load import load_site
from livessl.site.models import Site
from recordings import CLASSES, DATA

RATE_HZ: Final = 16000.0
START_NS: Final = 1_767_225_600_000_000_000
OFFSETS_S: Final = (0.0, 0.03, 0.075, 0.15, -0.15)
DRIFTS_PPM: Final = (0.0, 100.0)
NEAR_M: Final = 0.5


@dataclass(frozen=True)
class Drifting:
    """A recording whose blocks are stamped by a clock that runs fast."""

    once: FileRecording
    drift_ppm: float

    def __getattr__(self, name: str) -> Any:
        """Return any other attribute of the recording."""
        return getattr(self.once, name)

    def blocks(self, start_ns: int) -> Iterator[Block]:
        """Yield the blocks of the recording with the stamps of that clock."""
        for block in self.once.blocks(start_ns):
            gained_ns = round((block.stamp_ns - start_ns) * self.drift_ppm * 1e-6)
            yield Block(block.first_index, block.samples, block.stamp_ns + gained_ns)


def scene_of(site: Site, sounds: int, rt60_s: float, gap_s: float, seed: int) -> Scene:
    """Make a scene of development sounds of every class, anywhere in the room."""
    chosen = [sound for name in CLASSES for sound in read_sounds(DATA / "dcase2016_task2", RATE_HZ) if name in sound[0]]
    return make_scene(
        site.room.size_m,
        rt60_s=rt60_s,
        sounds=chosen[::2],
        count=sounds,
        sample_rate_hz=RATE_HZ,
        c_m_s=site.c_m_s,
        keep_away_m=[spec.centre_m for spec in site.specs],
        seed=seed,
        gap_s=gap_s,
    )


def recorded(site: Site, scene: Scene, cache: Path, name: str) -> dict[str, Path]:
    """Simulate each array's recording of a scene, unless the cache has it; return the files."""
    cache.mkdir(parents=True, exist_ok=True)
    paths = {}
    for number, spec in enumerate(site.specs):
        path = paths[spec.name] = cache / f"{name}-{spec.name}.wav"
        if not path.exists():
            samples = render(scene, spec.microphones_m, seed=number + 1)
            soundfile.write(path, samples.T, round(RATE_HZ), subtype="PCM_16")
    return paths


def located_with(
    site: Site, paths: dict[str, Path], offset_s: float, drift_ppm: float, *, corrected: bool
) -> tuple[list[Event], ClockOffset | None]:
    """Localize with the last array's clock off; return the events and the offset that was estimated at the end."""
    late = list(paths)[-1]
    parts = []
    for array, path in paths.items():
        recording = FileRecording(path)
        start_ns = START_NS
        if array == late:
            start_ns += round(offset_s * 1e9)
        drifting = Drifting(recording, drift_ppm if array == late else 0.0)
        parts.append(AssignedRecording(array, drifting, start_ns, tuple(range(1, 5))))
    fusion = make_fusion(site, updates=False, corrects_clocks=corrected)
    outputs: list[Output] = []
    now_ns = 0
    for now_ns, batch in paced_messages(*make_pipelines(site, parts), UnpacedClock()):
        outputs += fusion.step(batch, now_ns)
    outputs += fusion.flush(now_ns)
    known = {status.name: status.clock_offset for status in fusion.status(now_ns)}
    return [output for output in outputs if isinstance(output, Event)], known[late]


def by_sound(scene: Scene, events: list[Event]) -> list[list[Event]]:
    """Return for each sound the events that ended after its beginning and before that of the next sound."""
    starts_s = np.array([source.start_s for source in scene.sources])
    found: list[list[Event]] = [[] for _ in scene.sources]
    for event in events:
        end_s = (event.end_ns - START_NS) / 1e9
        found[max(0, int(np.searchsorted(starts_s, end_s)) - 1)].append(event)
    return found


def figures(scene: Scene, events: list[Event]) -> dict[str, Any]:
    """Count the sounds with one event, with both arrays and near the truth, and summarize the errors."""
    errors_m, both, one = [], 0, 0
    for source, found in zip(scene.sources, by_sound(scene, events), strict=True):
        one += len(found) == 1
        both += any(len(event.heard_by) == 2 for event in found)
        placed = [event.estimate for event in found if event.status is Status.LOCATED and event.estimate is not None]
        if placed:
            errors_m.append(min(float(np.linalg.norm(e.position_m - source.position_m)) for e in placed))
    near = sum(error_m <= NEAR_M for error_m in errors_m)
    return {
        "sounds": len(scene.sources),
        "events": len(events),
        "one_event": one,
        "both": both,
        "located": len(errors_m),
        "near": near,
        "median_m": round(float(np.median(errors_m)), 4) if errors_m else None,
        "p90_m": round(float(np.quantile(errors_m, 0.9)), 3) if errors_m else None,
    }


def main() -> None:
    """Simulate, localize, and print a line for each offset and drift."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sounds", type=int, default=36)
    parser.add_argument("--rt60", type=float, default=0.7)
    parser.add_argument("--gap", type=float, default=0.8)
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--noise-dbfs", type=float, default=-75.0)
    parser.add_argument("--uncorrected", action="store_true", help="do not estimate and correct clock offsets")
    parser.add_argument("--offsets", type=float, nargs="+", default=OFFSETS_S)
    parser.add_argument("--cache", type=Path, required=True)
    arguments = parser.parse_args()
    site = load_site(SITE_FILE)
    a = arguments
    scene = replace(scene_of(site, a.sounds, a.rt60, a.gap, a.seed), noise_dbfs=a.noise_dbfs)
    name = f"{a.sounds}-{a.rt60:g}-{a.gap:g}-{a.seed}{a.noise_dbfs:g}"
    paths = recorded(site, scene, arguments.cache, name)
    for drift_ppm in DRIFTS_PPM:
        for offset_s in arguments.offsets:
            events, clock = located_with(site, paths, offset_s, drift_ppm, corrected=not arguments.uncorrected)
            found = figures(scene, events)
            if clock is not None:
                last_s = (events[-1].end_ns - START_NS) / 1e9
                wrong_s = clock.offset_s - offset_s - drift_ppm * 1e-6 * last_s
                found |= {"offset_wrong_ms": round(1e3 * wrong_s, 2), "offset_std_ms": round(1e3 * clock.std_s, 2)}
            print(json.dumps({"offset_s": offset_s, "drift_ppm": drift_ppm, **found}), flush=True)


if __name__ == "__main__":
    main()
