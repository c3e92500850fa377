"""The time that the zones cost for each event: none, one, and 21 polygons that overlap, for sure and unsure positions.

The output is one JSON object, in milliseconds of processor time; the exit status is 1 if 21 zones exceed the limit.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from typing import Final

import numpy as np

from livessl.core.types import FloatArray
from livessl.server.zones.membership import PreparedZones, Prism

VOLUME_M: Final = np.array([[0.0, 8.0], [0.0, 10.0], [0.0, 4.0]])
CENTRE_M: Final = np.array([4.0, 5.0, 1.6])
STDS_M: Final = (0.05, 0.2, 0.5)
"""Largest standard deviation of a position; the others are 0.7 and 0.3 of it."""

CORNERS: Final = 6
MOST_MS: Final = 0.5
"""Longest time for 21 zones that overlap."""


def zones(count: int) -> list[Prism]:
    """Return polygons around the middle of the room, every second one with a range of heights."""
    rng = np.random.default_rng(1)
    angles = np.arange(CORNERS) * 2.0 * np.pi / CORNERS
    found = []
    for number in range(count):
        radii_m, centre_m = rng.uniform(0.4, 2.0, CORNERS), CENTRE_M[:2] + rng.uniform(-1.0, 1.0, 2)
        corners_m = centre_m + radii_m[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        found.append(Prism(corners_m, *((0.5, 2.2) if number % 2 else (-np.inf, np.inf))))
    return found


def covariance_m2(std_m: float, seed: int) -> FloatArray:
    """Return the covariance of an ellipsoid in any direction."""
    axes, _ = np.linalg.qr(np.random.default_rng(seed).standard_normal((3, 3)))
    return np.asarray(axes @ np.diag(np.square([0.3 * std_m, 0.7 * std_m, std_m])) @ axes.T)


def cost_ms(prepared: PreparedZones, std_m: float, rounds: int) -> float:
    """Return the median processor time of an event, each at another place in the middle of the room."""
    rng, taken = np.random.default_rng(2), []
    for seed in range(rounds):
        position_m, spread_m2 = CENTRE_M + rng.uniform(-0.5, 0.5, 3), covariance_m2(std_m, seed)
        begun = time.thread_time()
        prepared.probabilities(position_m, spread_m2)
        taken.append(time.thread_time() - begun)
    return round(1000.0 * float(np.median(taken)), 3)


def main() -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=300, help="events of each kind (default: 300)")
    rounds = parser.parse_args().rounds
    found = {
        f"{count} zones": {
            f"{std_m} m": cost_ms(PreparedZones(zones(count), VOLUME_M), std_m, rounds) for std_m in STDS_M
        }
        for count in (0, 1, 21)
    }
    print(json.dumps(found, indent=1))
    worst_ms = max(found["21 zones"].values())
    if worst_ms > MOST_MS:
        print(f"21 zones take {worst_ms} ms, expected at most {MOST_MS}", file=sys.stderr)
    return 1 if worst_ms > MOST_MS else 0


if __name__ == "__main__":
    sys.exit(main())
