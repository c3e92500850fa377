"""The number of arrays that are worth using: 64 arrays around one voice, located by those with the clearest onsets.

    python benchmarks/many.py --sounds 12 --rt60 1 --snr 10

prints the error and the computing time of a result for each number of arrays that may take part
(`livessl.core.locate.onset.MOST_ARRAYS`), on the same sounds. The results are in
docs/performance/experiments.md.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from typing import Final

import numpy as np

from livessl.core.locate import onset
from livessl.core.locate.estimator import create
from livessl.core.types import FRAME_S, Float32Array, FloatArray
from livessl.lab.bench import load
from livessl.lab.evaluate.localizer import sound_of
from livessl.simulation.scene import Scene, Source, render, synthesised_sounds
from livessl.site.build.grid import search_grid
from livessl.site.load import parse_site
from livessl.site.models import Site

RATE_HZ: Final = 16_000.0
QUIET_S: Final = 0.5
SOUND_S: Final = 1.0
DURATION_S: Final = 2.0
LEVEL_DBFS: Final = -15.0
MOST: Final = (4, 8, 16, 32, 64)


def recorded_at(site: Site, place_m: FloatArray, rt60_s: float, snr_db: float, seed: int) -> dict[str, Float32Array]:
    """Simulate a voice at every array, with white noise `snr_db` below its mean power over all arrays."""
    voice = dict(synthesised_sounds(RATE_HZ, seed=seed))["voice"][: round(SOUND_S * RATE_HZ)]
    source = Source("voice", QUIET_S, place_m, voice)
    scene = Scene(site.room.size_m, rt60_s, site.c_m_s, RATE_HZ, (source,), DURATION_S, level_dbfs=LEVEL_DBFS)
    clean = {spec.name: render(scene, spec.microphones_m, seed=seed) for spec in site.specs}
    begin = round(QUIET_S * RATE_HZ)
    power = np.mean([np.square(samples[:, begin:]).mean() for samples in clean.values()])
    rng = np.random.default_rng(seed)
    rms = np.sqrt(power * 10 ** (-snr_db / 10))
    return {
        name: np.asarray(samples + rms * rng.standard_normal(samples.shape), dtype=np.float32)
        for name, samples in clean.items()
    }


def compare(arrays: int, sounds: int, rt60_s: float, snr_db: float, most: Sequence[int]) -> dict[int, FloatArray]:
    """Return error (m) and computing time (s) of each sound, (sounds, 2), by the largest number of arrays."""
    site = parse_site(load.site_text(arrays, 0.1, "tcp://127.0.0.1:5570", 8000))
    estimator = create("onset", site.specs, search_grid(site), site.c_m_s)
    rng = np.random.default_rng(3)
    x, y, _ = site.room.size_m
    active = np.arange(round(DURATION_S / FRAME_S)) >= round(QUIET_S / FRAME_S)
    rows: dict[int, list[tuple[float, float]]] = {count: [] for count in most}
    shipped = onset.MOST_ARRAYS
    try:
        for number in range(sounds):
            place_m = rng.uniform((0.8, 0.8, 0.8), (x - 0.8, y - 0.8, 1.8))
            samples = recorded_at(site, place_m, rt60_s, snr_db, seed=number)
            prepared = {
                spec.name: sound_of(estimator, spec, samples[spec.name], active, RATE_HZ) for spec in site.specs
            }
            for count in most:
                onset.MOST_ARRAYS = count  # type: ignore[misc]
                estimator.locate(prepared)
                before_s = time.perf_counter()
                found = estimator.locate(prepared)
                rows[count].append((float(np.linalg.norm(found.position_m - place_m)), time.perf_counter() - before_s))
    finally:
        onset.MOST_ARRAYS = shipped  # type: ignore[misc]
    return {count: np.array(each) for count, each in rows.items()}


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arrays", type=int, default=64)
    parser.add_argument("--sounds", type=int, default=12)
    parser.add_argument("--rt60", type=float, default=1.0, metavar="S")
    parser.add_argument("--snr", type=float, default=10.0, metavar="DB")
    arguments = parser.parse_args()
    most = [count for count in MOST if count <= arguments.arrays]
    rows = compare(arguments.arrays, arguments.sounds, arguments.rt60, arguments.snr, most)
    print("| arrays that may take part | median error (mm) | largest error (mm) | median time of a result (ms) |")
    print("|---|---|---|---|")
    for count, each in rows.items():
        error_mm, time_ms = 1e3 * each.T
        print(f"| {count} | {np.median(error_mm):.1f} | {error_mm.max():.1f} | {np.median(time_ms):.1f} |")


if __name__ == "__main__":
    main()
