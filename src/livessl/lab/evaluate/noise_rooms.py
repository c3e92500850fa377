"""The rooms of the scenario `noise`, as plain values: eight for development and eight others for tests."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from livessl.core.geometry import circle, line, posed, tetrahedron
from livessl.core.types import ArraySpec, FloatArray
from livessl.lab.evaluate.paper import BAND_HZ, SMALL_M
from livessl.lab.evaluate.scenarios import HALVES

_SQUARE_M: Final = 0.2
_SMALL_SQUARE_M: Final = 0.064
"""Edges of squares of four microphones, in metres."""

_LINE_M: Final = 0.1
"""Distance of neighbours in a line of four, in metres."""

_Place = tuple[float, float, float]

_EQUAL: Final = ((1.0, 1.0), (1.0, 1.0), (1.0, 1.0))
_CARPET: Final = ((0.6, 1.2), (0.7, 1.0), (1.9, 0.8))
"""A carpet on the floor, and walls that differ."""

_CURTAIN: Final = ((3.0, 0.6), (0.7, 0.7), (0.8, 1.0))
"""A curtain at one end."""

_CEILING: Final = ((0.5, 0.9), (0.6, 0.6), (0.4, 2.6))
"""A ceiling of absorbers over a hard floor."""

_WINDOWS: Final = ((0.4, 1.1), (1.6, 0.5), (1.4, 0.9))
"""Hard windows opposite to shelves."""

_SOFT: Final = (0.6, 1.0, 1.3)
"""Factors on the absorption below 500 Hz, between, and above 2 kHz: soft surfaces absorb high frequencies."""

_HARD: Final = (1.2, 1.0, 0.9)
"""The same where panels and windows absorb low frequencies."""


@dataclass(frozen=True, slots=True)
class NoiseRoom:
    """A room with its arrays.

    Parameters
    ----------
    name : str
        Name in the results.
    size_m : (float, float, float)
    rt60_s : float
        Nominal reverberation time; with the size it gives the mean absorption of the walls.
    arrays : tuple of ArraySpec
    shares : three of (float, float)
        How much each wall absorbs relative to the others: at 0 and at the far end of x, y and z.
    bands : tuple of float
        Factor on the absorption in each band, as `livessl.simulation.walls` has them.
    """

    name: str
    size_m: tuple[float, float, float]
    rt60_s: float
    arrays: tuple[ArraySpec, ...]
    shares: tuple[tuple[float, float], ...] = _EQUAL
    bands: tuple[float, ...] = (1.0,)

    @property
    def microphones_m(self) -> FloatArray:
        """Positions of all microphones (K, 3), array by array, in metres."""
        return np.vstack([spec.microphones_m for spec in self.arrays])

    @property
    def has_equal_walls(self) -> bool:
        """True if all walls have the same absorption at all frequencies."""
        return self.shares == _EQUAL and self.bands == (1.0,)


def _array(name: str, shape_m: FloatArray, place_m: _Place, yaw_deg: float, pitch_deg: float = 0.0) -> ArraySpec:
    return ArraySpec(name, posed(shape_m, place_m, yaw_deg, pitch_deg), BAND_HZ)


def _alike(shape_m: FloatArray, *places: tuple[_Place, float]) -> tuple[ArraySpec, ...]:
    """Return an array of one shape at each place, turned about the vertical by an angle in degrees."""
    return tuple(_array(name, shape_m, *place) for name, place in zip("abcd", places, strict=False))


def _tetrahedra(*places: tuple[_Place, float]) -> tuple[ArraySpec, ...]:
    return _alike(tetrahedron(SMALL_M), *places)


def _squares(*places: tuple[_Place, float], edge_m: float = _SQUARE_M) -> tuple[ArraySpec, ...]:
    """Return a horizontal square at each place."""
    return _alike(circle(edge_m / np.sqrt(2.0), 4), *places)


def _lines(*places: tuple[_Place, float, float]) -> tuple[ArraySpec, ...]:
    """Return a line of four at each place, turned by yaw and pitch in degrees."""
    return tuple(_array(name, line(_LINE_M, 4), *place) for name, place in zip("abcd", places, strict=False))


def _mixed(
    tetrahedral: tuple[_Place, float], square: tuple[_Place, float], lined: tuple[_Place, float]
) -> tuple[ArraySpec, ...]:
    """Return a tetrahedron, a square and an upright line."""
    return (
        _array("a", tetrahedron(SMALL_M), *tetrahedral),
        _array("b", circle(_SQUARE_M / np.sqrt(2.0), 4), *square),
        _array("c", line(_LINE_M, 4), *lined, 90.0),
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
        NoiseRoom(
            "entrance hall, tetrahedra at one wall",
            (8.6, 6.8, 3.9),
            1.5,
            _tetrahedra(((0.6, 0.7, 1.6), 20.0), ((6.0, 0.8, 2.4), 65.0)),
            _WINDOWS,
            _HARD,
        ),
        NoiseRoom(
            "lounge, squares of 64 mm near walls",
            (6.1, 5.2, 2.6),
            0.45,
            _squares(((0.4, 2.7, 0.9), 10.0), ((5.6, 1.9, 1.1), 55.0), ((2.8, 4.8, 1.4), 35.0), edge_m=_SMALL_SQUARE_M),
            _CARPET,
            _SOFT,
        ),
        NoiseRoom(
            "seminar room, lines on walls",
            (7.6, 5.9, 3.0),
            0.7,
            _lines(((3.7, 0.15, 1.5), 0.0, 0.0), ((0.15, 2.8, 1.7), 90.0, 0.0), ((7.4, 3.3, 1.6), 0.0, 90.0)),
            _CEILING,
            _SOFT,
        ),
        NoiseRoom(
            "kitchen, mixed arrays",
            (4.9, 4.4, 2.6),
            0.6,
            _mixed(((0.6, 0.7, 1.5), 30.0), ((3.4, 2.9, 2.5), 20.0), ((4.6, 0.4, 1.2), 0.0)),
            _CURTAIN,
            _HARD,
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
        NoiseRoom(
            "chapel, tetrahedra at one wall",
            (10.3, 7.7, 5.2),
            1.5,
            _tetrahedra(((0.7, 7.0, 1.7), 45.0), ((6.5, 6.9, 2.1), 15.0)),
            _CURTAIN,
            _HARD,
        ),
        NoiseRoom(
            "living room, squares of 64 mm near walls",
            (5.7, 4.9, 2.5),
            0.45,
            _squares(((0.4, 2.1, 1.0), 25.0), ((5.3, 2.9, 0.8), 70.0), ((3.1, 0.4, 1.3), 5.0), edge_m=_SMALL_SQUARE_M),
            _CEILING,
            _SOFT,
        ),
        NoiseRoom(
            "lecture room, lines on walls",
            (8.9, 6.6, 3.2),
            0.7,
            _lines(((4.6, 6.45, 1.6), 0.0, 0.0), ((8.75, 3.1, 1.4), 90.0, 0.0), ((0.2, 3.6, 1.8), 0.0, 90.0)),
            _CARPET,
            _SOFT,
        ),
        NoiseRoom(
            "shop, mixed arrays",
            (6.7, 5.3, 3.1),
            0.6,
            _mixed(((6.0, 0.7, 1.6), 60.0), ((2.4, 2.2, 3.0), 40.0), ((0.3, 4.9, 1.3), 0.0)),
            _WINDOWS,
            _HARD,
        ),
    ),
}
"""The rooms of each half, which the positions take in turn. The search volume of the squares ends at the ceiling, above
which their mirror images lie; squares and lines have mirror images inside the room where they are not."""
