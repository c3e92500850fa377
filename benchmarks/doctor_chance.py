"""How much an alternative explains better than a careful set-up by chance: what the doctor's least gain rests on.

    python benchmarks/doctor_chance.py --seeds 77

The rooms and the set-ups are those of `doctor_rooms.py`, from seed 2000 on. Nothing is rendered: the delays of ten
sounds have errors of 5 us (standard deviation), and 20 us for 15 % of the sounds at each array, as reverberation does.
"""

from __future__ import annotations

import argparse
from typing import Final

import numpy as np

from doctor_rooms import ARRAYS, FAULTS, SOUNDS, Room
from livessl.core.commission.diagnosis import GAIN_PER_ARRAY, MIN_GAIN
from livessl.core.commission.judge import Judge
from livessl.core.commission.places import PlaceSearch
from livessl.core.types import FloatArray

FIRST_SEED: Final = 2000
STD_S, POOR_STD_S, POOR_SHARE = 5e-6, 20e-6, 0.15


def gain(seed: int, arrays: int) -> float:
    """Gain of the best alternative that is large enough to be told; 0 if a smaller one is better."""
    room, rng = Room(seed), np.random.default_rng([seed, 9])
    site = room.site_with(FAULTS[0], arrays)
    size_m = np.array(site.room.size_m)
    places_m = rng.uniform([0.5, 0.5, 0.5], [size_m[0] - 0.5, size_m[1] - 0.5, 2.2], (SOUNDS, 3))
    delays: dict[str, FloatArray] = {}
    for name in ARRAYS[:arrays]:
        std_s = np.where(rng.uniform(size=(SOUNDS, 1)) < POOR_SHARE, POOR_STD_S, STD_S)
        away_m = np.linalg.norm(places_m[:, None] - room.built(name), axis=2)
        delays[name] = away_m / site.c_m_s + std_s * rng.standard_normal(away_m.shape)
    bounds_m = np.column_stack([np.zeros(3), size_m])
    judge = Judge({spec.name: spec.microphones_m for spec in site.specs}, delays, PlaceSearch(bounds_m, site.c_m_s))
    best = judge.judged()[0]
    return max(0.0, judge.filed - best.criterion) if best.is_large else 0.0


def main() -> None:
    """Print how often chance gains how much."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=77)
    arguments = parser.parse_args()
    print("| arrays | set-ups | median gain | 95 % | 98 % | above the least gain |\n|---|---|---|---|---|---|")
    for arrays in (2, 3):
        gains = [gain(FIRST_SEED + seed, arrays) for seed in range(arguments.seeds)]
        above = sum(one > MIN_GAIN + GAIN_PER_ARRAY * (arrays - 1) for one in gains)
        shares = " | ".join(f"{np.percentile(gains, share):.1f}" for share in (50, 95, 98))
        print(f"| {arrays} | {len(gains)} | {shares} | {above} |", flush=True)


if __name__ == "__main__":
    main()
