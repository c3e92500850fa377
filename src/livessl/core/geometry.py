"""Shapes and poses of arrays (roll, pitch, yaw), azimuth and elevation, the grid, speed of sound by temperature.

Coordinates are in metres, right-handed, with z up and a corner of the room at the origin.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from livessl.core.types import FloatArray, IntArray

SPEED_OF_SOUND_0C_M_S: Final = 331.3
"""Speed of sound in dry air at 0 degrees Celsius, m/s."""


def speed_of_sound_m_s(temperature_c: float) -> float:
    """Return the speed of sound in dry air, m/s, at a temperature in degrees Celsius: 331.3 sqrt(1 + T/273.15)."""
    return SPEED_OF_SOUND_0C_M_S * float(np.sqrt(1.0 + temperature_c / 273.15))


def as_positions_m(positions: ArrayLike) -> FloatArray:
    """Return positions (n, 3), in metres, as a float64 array.

    Raises
    ------
    ValueError
        If the shape is another or a coordinate is not finite.
    """
    array = np.array(positions, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != 3:
        raise ValueError(f"positions: expected shape (n, 3), got {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError("positions: expected finite coordinates in metres, got NaN or infinity")
    return array


def tetrahedron(edge_m: float) -> FloatArray:
    """Regular tetrahedron of four microphones around the origin, with its base down.

    Channel 1 is the apex (+z); channels 2 to 4 are the base, counter-clockwise seen from above, channel 2 towards +x.

    Returns
    -------
    (4, 3) float64
        Metres.
    """
    circumradius = edge_m / np.sqrt(3.0)  # of the base triangle
    height = edge_m * np.sqrt(2.0 / 3.0)
    azimuth = np.array([0.0, 2.0, 4.0]) * np.pi / 3.0
    base = np.column_stack([circumradius * np.cos(azimuth), circumradius * np.sin(azimuth), np.full(3, -height / 4.0)])
    return np.vstack([[0.0, 0.0, 0.75 * height], base])


def circle(radius_m: float, count: int, clockwise: bool = False) -> FloatArray:
    """Horizontal circle of `count` microphones around the origin, channel 1 towards +x, counter-clockwise.

    Returns
    -------
    (count, 3) float64
        Metres.
    """
    azimuth = 2.0 * np.pi * np.arange(count) / count * (-1.0 if clockwise else 1.0)
    return np.column_stack([radius_m * np.cos(azimuth), radius_m * np.sin(azimuth), np.zeros(count)])


def line(spacing_m: float, count: int) -> FloatArray:
    """Line of `count` microphones along x around the origin, channel 1 at the smallest x.

    Returns
    -------
    (count, 3) float64
        Metres.
    """
    x = (np.arange(count) - (count - 1) / 2.0) * spacing_m
    return np.column_stack([x, np.zeros(count), np.zeros(count)])


def posed(
    shape_m: FloatArray,
    position_m: ArrayLike,
    yaw_deg: float = 0.0,
    pitch_deg: float = 0.0,
    roll_deg: float = 0.0,
) -> FloatArray:
    """Rotate and move a shape: roll about x, then pitch about y, then yaw about z (right-hand rule), then a shift.

    Parameters
    ----------
    shape_m : (K, 3) float64
        Positions relative to the array's own origin, metres.
    position_m : (3,)
        Position of that origin in the room, metres.
    yaw_deg, pitch_deg, roll_deg : float
        Degrees. Yaw is counter-clockwise seen from above; a positive pitch lowers the +x end.
    """
    turned_m = shape_m @ rotation(yaw_deg, pitch_deg, roll_deg).T
    return np.asarray(turned_m + np.asarray(position_m, dtype=np.float64))


def rotation(yaw_deg: float, pitch_deg: float, roll_deg: float) -> FloatArray:
    """Matrix (3, 3) that turns column vectors: roll about x, then pitch about y, then yaw about z (right-hand rule)."""
    cos_y, cos_p, cos_r = np.cos(np.radians([yaw_deg, pitch_deg, roll_deg]))
    sin_y, sin_p, sin_r = np.sin(np.radians([yaw_deg, pitch_deg, roll_deg]))
    yaw = np.array([[cos_y, -sin_y, 0.0], [sin_y, cos_y, 0.0], [0.0, 0.0, 1.0]])
    pitch = np.array([[cos_p, 0.0, sin_p], [0.0, 1.0, 0.0], [-sin_p, 0.0, cos_p]])
    roll = np.array([[1.0, 0.0, 0.0], [0.0, cos_r, -sin_r], [0.0, sin_r, cos_r]])
    return np.asarray(yaw @ pitch @ roll)


def angle_deg(one: FloatArray, other: FloatArray) -> float:
    """Angle between two vectors (3,), 0 to 180 degrees."""
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(one, other)), one @ other)))


def direction_deg(origin_m: FloatArray, target_m: FloatArray) -> tuple[float, float, float]:
    """Azimuth (counter-clockwise from +x) and elevation in degrees, and distance in metres, of target from origin."""
    x, y, z = np.asarray(target_m, dtype=np.float64) - origin_m
    horizontal = float(np.hypot(x, y))
    return (
        float(np.degrees(np.arctan2(y, x))),
        float(np.degrees(np.arctan2(z, horizontal))),
        float(np.hypot(horizontal, z)),
    )


def pan_tilt_deg(
    target_m: ArrayLike, position_m: ArrayLike, yaw_deg: float = 0.0, pitch_deg: float = 0.0, roll_deg: float = 0.0
) -> tuple[float, float, float]:
    """Pan and tilt, in degrees, that turn a camera from its rest towards a place, and the distance in metres.

    Pan is the rotation to the right about the camera's own upright axis, -180 to 180; tilt, which follows it, is
    upwards, -90 to 90. At rest the camera looks along its +x axis, with +z up.

    Parameters
    ----------
    target_m, position_m : (3,)
        The place and the camera's, metres.
    yaw_deg, pitch_deg, roll_deg : float
        How the camera is mounted: see `posed`.
    """
    away_m = np.asarray(target_m, dtype=np.float64) - np.asarray(position_m, dtype=np.float64)
    seen_m = np.asarray(away_m @ rotation(yaw_deg, pitch_deg, roll_deg))
    azimuth_deg, elevation_deg, distance_m = direction_deg(np.zeros(3), seen_m)
    return -azimuth_deg, elevation_deg, distance_m


@dataclass(frozen=True, slots=True)
class Grid:
    """Grid points at the centres of the cells that fill a box.

    The cells divide the box evenly, with edges as near to `spacing_m` as possible, so no part of it lies more than half
    a cell from a grid point. An axis whose bounds are equal has one point: the search is then in a plane.

    Parameters
    ----------
    bounds_m : ((x0, x1), (y0, y1), (z0, z1))
        The search volume, metres.
    spacing_m : float
        Wanted distance between neighbouring points, metres.

    Raises
    ------
    ValueError
        If a lower bound lies above its upper one, or the spacing is not positive.
    """

    bounds_m: tuple[tuple[float, float], tuple[float, float], tuple[float, float]]
    spacing_m: float

    def __post_init__(self) -> None:
        if not self.spacing_m > 0:
            raise ValueError(f"grid: expected spacing_m > 0, got {self.spacing_m}")
        for axis, (low, high) in zip("xyz", self.bounds_m, strict=True):
            if not low <= high:
                raise ValueError(f"grid: expected lower <= upper bound on {axis}, got [{low}, {high}]")

    @property
    def lower_m(self) -> FloatArray:
        """Lower corner (3,), metres."""
        return np.array([low for low, _ in self.bounds_m], dtype=np.float64)

    @property
    def upper_m(self) -> FloatArray:
        """Upper corner (3,), metres."""
        return np.array([high for _, high in self.bounds_m], dtype=np.float64)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of points along x, y and z."""
        x, y, z = (max(1, round(float(extent) / self.spacing_m)) for extent in self.upper_m - self.lower_m)
        return x, y, z

    @property
    def size(self) -> int:
        """Number of points."""
        x, y, z = self.shape
        return x * y * z

    @property
    def cell_m(self) -> FloatArray:
        """Edges of a cell (3,), metres; 0 on an axis whose bounds are equal."""
        return np.asarray((self.upper_m - self.lower_m) / np.array(self.shape))

    @property
    def free_axes(self) -> tuple[int, ...]:
        """Axes whose bounds are not equal."""
        return tuple(axis for axis, (low, high) in enumerate(self.bounds_m) if high > low)

    def axis_m(self, axis: int) -> FloatArray:
        """Coordinates of the points along one axis, metres."""
        return np.asarray(self.lower_m[axis] + (np.arange(self.shape[axis]) + 0.5) * self.cell_m[axis])

    def points_m(self, which: slice = slice(None)) -> FloatArray:
        """Points (G, 3), metres, all or some, z fastest: point g is at `numpy.unravel_index(g, shape)`."""
        cells = np.unravel_index(np.arange(*which.indices(self.size)), self.shape)
        return np.stack([self.axis_m(axis)[cell] for axis, cell in enumerate(cells)], axis=1)

    def point_m(self, index: int) -> FloatArray:
        """Position (3,) of one point, metres."""
        cell = np.array(np.unravel_index(index, self.shape), dtype=np.float64)
        return np.asarray(self.lower_m + (cell + 0.5) * self.cell_m)


def pair_weight(microphones: int) -> float:
    """Weight of a pair of an array of K microphones, 2/K: see `livessl.core.locate.srp`."""
    return 2.0 / microphones


@cache
def microphone_pairs(count: int) -> IntArray:
    """All pairs (i, k), i < k, of `count` microphones: (P, 2)."""
    pairs = np.stack(np.triu_indices(count, k=1), axis=1).astype(np.int64)
    pairs.flags.writeable = False
    return pairs
