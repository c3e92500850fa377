"""Set-ups of arrays, and the delays of sounds in them."""

from __future__ import annotations

import numpy as np

from livessl.core.geometry import posed, tetrahedron
from livessl.core.types import FloatArray

C_M_S = 343.0
BOUNDS_M = np.array([[0.0, 8.0], [0.0, 10.0], [0.0, 4.0]])
PLACES_M = {"north": (4.0, 2.5, 2.0), "south": (4.0, 7.5, 2.0), "west": (1.2, 5.0, 2.2)}

Arrays = dict[str, FloatArray]


def set_up(rng: np.random.Generator, count: int = 2) -> Arrays:
    """Tetrahedra that are turned at random, (4, 3) metres each."""
    return {
        name: posed(tetrahedron(0.5), PLACES_M[name], yaw_deg=float(rng.uniform(-180.0, 180.0)))
        for name in list(PLACES_M)[:count]
    }


def sources(rng: np.random.Generator, count: int = 10) -> FloatArray:
    """Places all over the room, (count, 3) metres."""
    return rng.uniform([0.5, 0.5, 0.5], [7.5, 9.5, 2.5], (count, 3))


def delays_of(microphones_m: Arrays, sources_m: FloatArray, rng: np.random.Generator, std_s: float = 5e-6) -> Arrays:
    """What each array measures, (sounds, channels) seconds, with some error."""
    delays = {}
    for name, at_m in microphones_m.items():
        away_m = np.linalg.norm(sources_m[:, None] - at_m, axis=2)
        delays[name] = away_m / C_M_S + rng.normal(0.0, std_s, away_m.shape)
    return delays


def turned(microphones_m: FloatArray, angle_deg: float) -> FloatArray:
    """An array turned counter-clockwise about its centre."""
    centre_m = microphones_m.mean(axis=0)
    return posed(microphones_m - centre_m, centre_m, yaw_deg=angle_deg)
