"""How often the reported ellipsoid contains the truth where the arrays are not quite where the site file says.

    python benchmarks/set_up_error.py --rooms 30

Rooms, arrays and sounds are those of `benchmarks/careful_set_up.py`. Each array is shifted along each axis and turned
about each axis at random, by as much as the site file says that it may be. Each room has ten sounds, which share its
errors.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from typing import Final

import numpy as np

import careful_set_up as rooms
import livessl
from livessl.clock import UnpacedClock
from livessl.core.types import Event, FloatArray, Status
from livessl.offline import assigned, run
from livessl.site.models import Site

KNOWN: Final = ((0.0, 0.0), (0.01, 0.5), (0.02, 0.7), (0.02, 1.5), (0.02, 2.0))
"""Standard deviations of the arrays' places, metres, and orientations, degrees."""

NINETY_PERCENT: Final = 6.251
"""90 % of a chi-square distribution with three degrees of freedom."""

FAR_M: Final = 0.5


def site_of(arrays: int, seed: int, position_m: float, orientation_deg: float) -> Site:
    """A site of `benchmarks/careful_set_up.py` whose set-up is known so well."""
    known = {"position_m": position_m, "orientation_deg": orientation_deg, "temperature_c": 0.0}
    return rooms.site_of(arrays, seed, uncertainty=known)


def errors(arrays: int, seed: int, position_m: float, orientation_deg: float) -> Iterator[tuple[float, float, float]]:
    """Yield the error of each sound in metres, and squared in units of the covariance, whole and of the sound alone."""
    site = site_of(arrays, seed, position_m, orientation_deg)
    placed = rooms.built(site, seed, position_m, orientation_deg, 0.0)
    specs = tuple(replace(spec, microphones_m=placed[spec.name]) for spec in site.specs)
    rt60_s = rooms.RT60_S[seed % len(rooms.RT60_S)]
    scene = livessl.simulate(site, rt60_s=rt60_s, count=rooms.SOUNDS, sample_rate_hz=rooms.RATE_HZ, seed=seed).scene
    loaded, parts = assigned(site, rooms.recorded(site, specs, seed), rooms.RATE_HZ)
    for output in run(loaded, parts, UnpacedClock()):
        if not isinstance(output, Event) or output.status is not Status.LOCATED or output.estimate is None:
            continue
        start_s = output.start_ns / 1e9
        source = min(scene.sources, key=lambda one: abs(one.start_s - start_s))
        off_m = output.estimate.position_m - source.position_m
        yield (
            float(np.linalg.norm(off_m)),
            _squared(off_m, output.estimate.covariance_m2),
            _squared(off_m, output.estimate.sound_covariance_m2),
        )


def _squared(off_m: FloatArray, covariance_m2: FloatArray) -> float:
    return float(off_m @ np.linalg.solve(covariance_m2, off_m))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rooms", type=int, default=30)
    parser.add_argument("--arrays", type=int, nargs="+", default=[2, 3])
    given = parser.parse_args()
    columns = "| arrays | place, orientation | located within 0.5 m | median"
    print(columns + " | in the ellipsoid | in that of the sound alone |")
    print("|---|---|---|---|---|---|")
    for arrays in given.arrays:
        for position_m, orientation_deg in KNOWN:
            rows = [row for seed in range(given.rooms) for row in errors(arrays, seed, position_m, orientation_deg)]
            error_m, whole, sound = np.array(rows).T
            near = error_m < FAR_M
            inside, alone = (100.0 * np.mean(each[near] <= NINETY_PERCENT) for each in (whole, sound))
            print(
                f"| {arrays} | {100 * position_m:.0f} cm, {orientation_deg:g}° | {near.sum()} of "
                f"{given.rooms * rooms.SOUNDS} | {np.median(error_m[near]):.3f} m | {inside:.0f} % | {alone:.0f} % |",
                flush=True,
            )


if __name__ == "__main__":
    main()
