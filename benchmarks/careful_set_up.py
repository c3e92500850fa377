"""A room of 8 x 10 x 4 m, and tetrahedra of 0.5 m that stand nearly where the site file has them.

Other benchmarks measure in it: `calibrate.py` and `set_up_error.py`.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from scipy.spatial.transform import Rotation

from livessl.core.types import ArraySpec, Float32Array, FloatArray
from livessl.simulation.of_site import scene_of
from livessl.simulation.scene import Scene, render
from livessl.site.load import parse_site
from livessl.site.models import Site

RATE_HZ: Final = 16000.0
SOUNDS: Final = 10
RT60_S: Final = (0.3, 0.5, 0.8)
POSITIONS_M: Final = {"north": (4.0, 2.5, 2.0), "south": (4.0, 7.5, 2.0), "west": (1.2, 5.0, 2.2)}
POSITION_STD_M, ORIENTATION_STD_DEG, MICROPHONE_STD_M = 0.02, 1.2, 0.002

Recordings = dict[str, Float32Array]


def site_of(arrays: int, seed: int, **settings: Any) -> Site:
    """A site with so many arrays, which are turned at random, and with other settings of the site file."""
    rng = np.random.default_rng([seed, 1])
    names = list(POSITIONS_M)[:arrays]
    text: dict[str, Any] = {
        "site": "doctor",
        "room": {"size_m": [8.0, 10.0, 4.0]},
        "arrays": {
            name: {
                "geometry": {"tetrahedron": {"edge_m": 0.5}},
                "position_m": list(POSITIONS_M[name]),
                "orientation_deg": {"yaw": round(float(rng.uniform(-180.0, 180.0)), 1)},
            }
            for name in names
        },
        **settings,
    }
    return parse_site(json.dumps(text))


def built(
    site: Site,
    seed: int,
    position_std_m: float = POSITION_STD_M,
    orientation_std_deg: float = ORIENTATION_STD_DEG,
    microphone_std_m: float = MICROPHONE_STD_M,
) -> dict[str, FloatArray]:
    """The true places of the microphones, metres: not quite those of the site file."""
    rng = np.random.default_rng([seed, 2])
    placed = {}
    for spec in site.specs:
        turn = Rotation.from_rotvec(np.radians(rng.normal(0.0, orientation_std_deg, 3)))
        shift_m = rng.normal(0.0, position_std_m, 3)
        own_m = rng.normal(0.0, microphone_std_m, spec.microphones_m.shape)
        placed[spec.name] = turn.apply(spec.microphones_m - spec.centre_m) + spec.centre_m + shift_m + own_m
    return placed


def scene_in(site: Site, seed: int) -> Scene:
    """Ten sounds in a site's room."""
    return scene_of(site, rt60_s=RT60_S[seed % len(RT60_S)], count=SOUNDS, sample_rate_hz=RATE_HZ, seed=seed)


def recorded(site: Site, specs: Sequence[ArraySpec], seed: int) -> Recordings:
    """Recordings of these microphones in a site's room."""
    scene = scene_in(site, seed)
    return {spec.name: render(scene, spec.microphones_m, seed=seed + 1 + number) for number, spec in enumerate(specs)}
