"""What the levels in marks cost a node: processor time of the pipeline with and without them, in turn."""

from __future__ import annotations

import argparse
import time

import numpy as np

from livessl.core.stream.pipeline import Pipeline
from livessl.core.types import Block, Float32Array
from livessl.site.build.pipeline import make_pipeline
from livessl.site.load import parse_site

RATE_HZ = 48000
BLOCK = 960
START_NS = 1_767_225_600_000_000_000
SITE = """
site: metering
room: {size_m: [8, 10, 4]}
arrays:
"""


def pipeline(arrays: int, *, reports_levels: bool) -> Pipeline:
    """Return the pipeline of some tetrahedra on one device."""
    lines = [
        f"  a{index}: {{geometry: {{tetrahedron: {{edge_m: 0.5}}}}, position_m: [{1 + index}, 5, 2]}}"
        for index in range(arrays)
    ]
    site = parse_site(SITE + "\n".join(lines) + "\n")
    channels = {f"a{index}": range(4 * index + 1, 4 * index + 5) for index in range(arrays)}
    return make_pipeline(site, channels, float(RATE_HZ), reports_levels=reports_levels)


def spent_s(made: Pipeline, samples: Float32Array, begin: int) -> float:
    """Return the processor time of one second of sound, in seconds."""
    began_s = time.process_time()
    for first in range(begin, begin + RATE_HZ, BLOCK):
        block = samples[:, first - begin : first - begin + BLOCK]
        made.push(Block(first, block.copy(), START_NS + round(first / RATE_HZ * 1e9)))
    return time.process_time() - began_s


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=int, default=30, help="seconds of sound for each row (default: 30)")
    seconds = parser.parse_args().seconds
    print("| channels | without levels | with levels | levels alone |\n|---|---|---|---|")
    for arrays in (1, 2, 4):
        noise = np.random.default_rng(0).standard_normal((4 * arrays, RATE_HZ)).astype(np.float32)
        samples = np.float32(1e-3) * noise
        made = [pipeline(arrays, reports_levels=flag) for flag in (False, True)]
        took = np.array([[spent_s(one, samples, second * RATE_HZ) for one in made] for second in range(seconds)])
        plain, metered = 100.0 * np.median(took[2:], axis=0)
        print(f"| {4 * arrays} | {plain:.2f} % | {metered:.2f} % | {metered - plain:.2f} % |")


if __name__ == "__main__":
    main()
