"""Locate the sounds in WAV files.

    python examples/locate_recordings.py [SITE NORTH_WAV SOUTH_WAV]

Without arguments it simulates a room with two sounds first, and writes the files to a temporary folder.
"""

import sys
import tempfile
from pathlib import Path

import soundfile

import livessl

SITE = Path(__file__).parents[1] / "config" / "demo.yaml"


def simulated(folder: Path) -> tuple[Path, dict[str, Path]]:
    """Write one WAV file for each array of the site, and return their paths."""
    made = livessl.simulate(SITE, rt60_s=0.5, count=2, seed=3)
    for source in made.scene.sources:
        x, y, z = source.position_m
        print(f"true    {source.start_s:6.2f} s  ({x:5.2f}, {y:5.2f}, {z:5.2f})  {source.name}")
    files = {array: folder / f"{array}.wav" for array in made.recordings}
    for array, samples in made.recordings.items():
        soundfile.write(files[array], samples.T, int(made.sample_rate_hz))
    return SITE, files


with tempfile.TemporaryDirectory() as name:
    if len(sys.argv) == 4:
        site, files = Path(sys.argv[1]), {"north": Path(sys.argv[2]), "south": Path(sys.argv[3])}
    else:
        site, files = simulated(Path(name))
    for event in livessl.locate(site, files):
        if event.estimate is None:
            print(f"refused {event.start_ns / 1e9:6.2f} s  {event.reason}")
        else:
            x, y, z = event.estimate.position_m
            print(
                f"found   {event.start_ns / 1e9:6.2f} s  ({x:5.2f}, {y:5.2f}, {z:5.2f})  "
                f"{event.status}, confidence {event.estimate.confidence:.2f}"
            )
