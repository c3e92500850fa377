"""The rooms of the scenario `noise`, as plain values: four for development and four others for tests."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from livessl.core.geometry import circle, posed, tetrahedron
from livessl.core.types import ArraySpec, FloatArray
from livessl.lab.evaluate.paper import BAND_HZ, SMALL_M
from livessl.lab.evaluate.scenarios import HALVES

_SQUARE_M: Final = 0.2
"""Edge of a square of four microphones, in metres."""

_Place = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class NoiseRoom:
    """A room with its arrays.

    Parameters
    ----------
    name : str
        Name in the results.
    size_m : (float, float, float)
    rt60_s : float
        Nominal reverberation time; with the size it gives the absorption of the walls.
    arrays : tuple of ArraySpec
    """

    name: str
    size_m: tuple[float, float, float]
    rt60_s: float
    arrays: tuple[ArraySpec, ...]

    @property
    def microphones_m(self) -> FloatArray:
        """Positions of all microphones (K, 3), array by array, in metres."""
        return np.vstack([spec.microphones_m for spec in self.arrays])


def _tetrahedra(*places: tuple[_Place, float]) -> tuple[ArraySpec, ...]:
    """Return a tetrahedron at each place, turned about the vertical by an angle in degrees."""
    shape_m = tetrahedron(SMALL_M)
    return tuple(
        ArraySpec(name, posed(shape_m, place_m, yaw_deg), BAND_HZ)
        for name, (place_m, yaw_deg) in zip("abcd", places, strict=False)
    )


def _squares(*places: tuple[_Place, float]) -> tuple[ArraySpec, ...]:
    """Return a horizontal square at each place, turned about the vertical by an angle in degrees."""
    shape_m = circle(_SQUARE_M / np.sqrt(2.0), 4)
    return tuple(
        ArraySpec(name, posed(shape_m, place_m, yaw_deg), BAND_HZ)
        for name, (place_m, yaw_deg) in zip("abcd", places, strict=False)
    )


NOISE_ROOMS: Final[Mapping[str, tuple[NoiseRoom, ...]]] = {
    HALVES[0]: (
        NoiseRoom("office", (5.3, 3.9, 2.7), 0.5, _tetrahedra(((1.0, 2.1, 1.5), 10.0), ((4.2, 1.7, 1.3), 75.0))),
        NoiseRoom("class room", (9.1, 7.2, 3.2), 0.8, _tetrahedra(((2.0, 3.4, 1.6), 25.0), ((7.0, 3.9, 1.9), 100.0))),
        NoiseRoom("hall", (14.2, 9.3, 5.1), 1.2, _tetrahedra(((4.1, 4.2, 1.8), 0.0), ((10.2, 5.4, 2.1), 40.0))),
        NoiseRoom(
            "meeting room, squares under the ceiling",
            (6.4, 4.7, 2.8),
            0.4,
            _squares(((1.3, 2.5, 2.7), 15.0), ((5.2, 2.2, 2.7), 60.0), ((3.2, 4.1, 2.7), 30.0)),
        ),
    ),
    HALVES[1]: (
        NoiseRoom("studio", (4.7, 4.2, 2.5), 0.35, _tetrahedra(((0.9, 1.8, 1.4), 50.0), ((3.7, 2.5, 1.1), 5.0))),
        NoiseRoom("laboratory", (8.3, 6.1, 3.4), 0.8, _tetrahedra(((1.7, 2.8, 1.7), 80.0), ((6.6, 3.3, 1.5), 20.0))),
        NoiseRoom("workshop", (12.1, 8.4, 4.4), 1.0, _tetrahedra(((3.2, 4.6, 2.0), 35.0), ((8.9, 3.8, 1.7), 110.0))),
        NoiseRoom(
            "canteen, squares under the ceiling",
            (7.2, 5.6, 2.9),
            0.6,
            _squares(((1.6, 2.6, 2.8), 40.0), ((5.7, 3.1, 2.8), 5.0), ((3.7, 4.9, 2.8), 70.0)),
        ),
    ),
}
"""The rooms of each half, which the positions take in turn. The search volume of the squares ends at the ceiling, above
which their mirror images lie."""
