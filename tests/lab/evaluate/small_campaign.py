"""A campaign that takes seconds: dry rooms, a coarse grid, synthesised sounds."""

from __future__ import annotations

from pathlib import Path

import soundfile

from livessl.lab.evaluate.job import Job, read_clips
from livessl.lab.evaluate.paper import Settings
from livessl.simulation.scene import synthesised_sounds

RATE_HZ = 16000.0
CLASSES = ("door_slam", "dropped_keys")


def write_sounds(directory: Path) -> Path:
    directory.mkdir(parents=True, exist_ok=True)
    for seed in (1, 2):
        for name, samples in synthesised_sounds(RATE_HZ, seed):
            soundfile.write(directory / f"{name}{seed:03d}.wav", samples[:6000], int(RATE_HZ))
    return directory


def small_job(directory: Path, positions: int = 2, seed: int = 5) -> Job:
    settings = Settings("one-array", positions, (0.0, 0.2), seed=seed, spacing_m=1.0)
    return Job(settings, read_clips(write_sounds(directory), CLASSES, RATE_HZ))
