"""Arrays whose halves are sampled by two devices: how many sounds are located wrongly.

    python benchmarks/inner_clocks.py --events FOLDER --half development --sounds 200

Rooms, frames, sounds and errors of the set-up are those of `benchmarks/mixtures.py`, one source each. In half of the
cases the set-up is exact. In the others everything is off by the default `Uncertainty`: poses, temperature, and the two
devices of each frame. Each sound is located as `livessl locate` does.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from contextlib import nullcontext
from itertools import count, islice
from pathlib import Path
from typing import Any, Final
from unittest.mock import patch

import numpy as np

from livessl.core.locate import tolerant
from livessl.core.types import Event, Status
from livessl.lab.evaluate.job import read_clips
from livessl.lab.evaluate.localizer import half_of
from livessl.lab.evaluate.paper import CLASSES
from livessl.lab.evaluate.scenarios import HALVES
from livessl.lab.evaluate.unit import Clips
from livessl.recordings.assign import AssignedRecording
from livessl.recordings.recording import MemoryRecording
from mixtures import RATE_HZ, Case, simulated, turn
from recordings import events_in

FAR_M: Final = 0.5


def told(case: Case) -> tuple[str, float]:
    """Locate a case's sound: the status and the error, in metres, of its loudest first source."""
    parts = [
        AssignedRecording(name, MemoryRecording("sound", case.sample_rate_hz, samples), 0, (1, 2, 3, 4))
        for name, samples in case.samples.items()
    ]
    events: list[Event] = [event for event in events_in(case.site, parts) if event.source == 1]
    if not events:
        return "missed", np.inf
    first = max(events, key=lambda event: event.power or 0.0)
    if first.estimate is None:
        return str(first.status), np.inf
    return str(first.status), float(np.linalg.norm(first.estimate.position_m - case.truths_m[0]))


def rows(clips: Clips, half: str, seed: int, sounds: int) -> Iterator[dict[str, Any]]:
    """Yield the outcome of each sound."""
    numbers = islice((number for number in count() if turn(number) == ("one", "frames")), sounds)
    for head, case in simulated(clips, half, seed, numbers):
        status, error_m = told(case)
        yield head | {"status": status, "error_m": error_m}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--events", type=Path, required=True, help="folder of DCASE 2016 task 2 clips")
    parser.add_argument("--half", choices=HALVES, default=HALVES[0])
    parser.add_argument("--sounds", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--sharp", action="store_true", help="as if the clocks inside an array were known to agree")
    parser.add_argument("--json", action="store_true", help="also print each sound")
    given = parser.parse_args()
    clips = half_of(read_clips(given.events, CLASSES, RATE_HZ), given.half)
    kept = []
    with patch.object(tolerant, "SHARE", 0.0) if given.sharp else nullcontext():
        for row in rows(clips, given.half, given.seed, given.sounds):
            kept.append(row)
            if given.json:
                print(json.dumps(row), flush=True)
    print("| set-up | sounds | located | wrong | median |")
    print("|---|---|---|---|---|")
    for exact in (True, False):
        chosen = [row for row in kept if row["exact"] is exact]
        errors_m = np.array([row["error_m"] for row in chosen if row["status"] == Status.LOCATED])
        what = "exact" if exact else "clocks, poses and temperature off"
        wrong, median_m = (errors_m > FAR_M).sum(), np.median(errors_m)
        print(f"| {what} | {len(chosen)} | {len(errors_m)} | {wrong} | {median_m:.3f} m |")


if __name__ == "__main__":
    main()
