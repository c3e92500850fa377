"""Mirror images (front-back ambiguity) by geometry alone: which places look alike to the arrays, and the warning.

Microphones in one plane receive the same from a place and from its mirror image behind the plane; microphones on one
line receive the same from every place on a circle around it. `core.locate.ambiguity` weighs these places by what was
received.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np

from livessl.core.geometry import Grid, microphone_pairs
from livessl.core.steering import steering_delays_s
from livessl.core.types import ArraySpec, FloatArray

SAME_PERIODS: Final = 0.125
"""Difference of delays, in periods of the band's upper edge, up to which two places are the same to a pair. A GCC over
the band has lost a tenth of its height there. Microphones count as coplanar within the same share of a wavelength."""

REACH_M: Final = 0.5
"""Distance, in metres, up to which a mirror image outside the search volume counts as being on its surface. A position
may be off by that much, and its mirror image with it, so that the volume does not exclude the place."""

CURE: Final = "let grid.bounds_m end at the plane, tilt an array, or raise a microphone"
"""Advice that makes a position and its mirror image distinguishable."""

MOST_SHARE: Final = 0.05
"""Share of the search volume above which its look-alikes are worth a warning before anything is mounted."""

_SAMPLED_POINTS: Final = 250
"""Number of places at which a volume is examined: a share of a few per cent shows."""

_RECURRENCE: Final = 1.2207440846057596 ** -np.arange(1.0, 4.0)
"""Steps, as shares of the volume's edges, from one of these places to the next, so that they cover it evenly: powers of
the root of x^4 = x + 1 (Roberts' R3 sequence)."""

_ON_CIRCLE_M: Final = 0.25
"""Distance, in metres, between proposed places on a circle around a line of microphones."""

_MOST_ON_CIRCLE: Final = 96
"""Most proposed places on one circle."""


@dataclass(frozen=True, slots=True)
class Flatness:
    """A plane or a line in which microphones lie.

    Parameters
    ----------
    centre_m : (3,) float64
        A point of it, metres.
    axis : (3,) float64
        Unit vector: the normal of a plane, or the direction of a line.
    is_line : bool
    """

    centre_m: FloatArray
    axis: FloatArray
    is_line: bool

    def images_m(self, position_m: FloatArray, grid: Grid) -> FloatArray:
        """Places (N, 3) from which the microphones receive the same as from a position, without those off the grid."""
        along = float((position_m - self.centre_m) @ self.axis) * self.axis
        if not self.is_line:
            return _inside((position_m - 2.0 * along)[None], grid)
        foot_m = self.centre_m + along
        first = position_m - foot_m
        second = np.cross(self.axis, first)
        angles = self._crossings(first, second, grid)
        if angles is None:
            count = int(np.clip(2.0 * np.pi * np.linalg.norm(first) / _ON_CIRCLE_M, 12, _MOST_ON_CIRCLE))
            angles = 2.0 * np.pi * np.arange(1, count) / count
        return _inside(foot_m + np.cos(angles)[:, None] * first + np.sin(angles)[:, None] * second, grid)

    @staticmethod
    def _crossings(first: FloatArray, second: FloatArray, grid: Grid) -> FloatArray | None:
        """Angle of the other point of a circle in the plane that is searched; None if the whole circle is.

        A point at angle a is as far along the flat axis as the position if p cos a + q sin a = p: a = 2 atan2(q, p).
        """
        flat = [axis for axis in range(3) if axis not in grid.free_axes]
        swing = [axis for axis in flat if max(abs(first[axis]), abs(second[axis])) > 1e-9]
        if not swing:
            return None
        return np.array([2.0 * np.arctan2(second[swing[0]], first[swing[0]])])


def flatness(specs: Sequence[ArraySpec], c_m_s: float) -> Flatness | None:
    """Return the plane or line in which all microphones of some arrays lie; None if there is none."""
    tolerance_m = SAME_PERIODS * c_m_s / max(spec.band_hz[1] for spec in specs)
    return _flatness(tuple(spec.microphones_m.tobytes() for spec in specs), tolerance_m)


def look_alikes(position_m: FloatArray, specs: Sequence[ArraySpec], grid: Grid, c_m_s: float) -> FloatArray:
    """Places (N, 3) inside the search volume that look like a position to one of the arrays, or to all together."""
    groups = [[spec] for spec in specs] if len(specs) > 1 else []
    flats = (flatness(group, c_m_s) for group in [list(specs), *groups])
    images = [flat.images_m(position_m, grid) for flat in flats if flat is not None]
    return np.concatenate(images) if images else np.empty((0, 3))


def confused(position_m: FloatArray, places_m: FloatArray, specs: Sequence[ArraySpec], c_m_s: float) -> bool:
    """Return whether one of some places (N, 3) has the delays of a position, to within `SAME_PERIODS`, at all pairs."""
    for spec in specs:
        points_m = np.concatenate([position_m[None], places_m])
        pairs = microphone_pairs(len(spec.microphones_m))
        delays_s = steering_delays_s(points_m, spec.microphones_m, pairs, c_m_s)
        off_s = np.abs(delays_s[:, 1:] - delays_s[:, :1]).max(axis=0)
        places_m = places_m[off_s * spec.band_hz[1] <= SAME_PERIODS]
        if not len(places_m):
            return False
    return True


def ambiguous_share(specs: Sequence[ArraySpec], grid: Grid, c_m_s: float) -> float:
    """Share of the search volume in which a place looks like another one far away to all of some arrays.

    What all arrays confuse is an image of each of them, so that the images of one suffice.
    """
    flats = [flatness([spec], c_m_s) for spec in specs]
    shared = flatness(specs, c_m_s) or min(flats, key=lambda flat: flat is not None and flat.is_line)
    if shared is None or None in flats:
        return 0.0
    shares = (0.5 + np.arange(_SAMPLED_POINTS)[:, None] * _RECURRENCE) % 1.0
    points_m = grid.lower_m + shares * (grid.upper_m - grid.lower_m)
    count = 0
    for point_m in points_m:
        images_m = shared.images_m(point_m, grid)
        images_m = images_m[np.linalg.norm(images_m - point_m, axis=1) > REACH_M]
        count += bool(len(images_m)) and confused(point_m, images_m, specs, c_m_s)
    return count / len(points_m)


def warning(specs: Sequence[ArraySpec], grid: Grid, c_m_s: float) -> str | None:
    """Return a warning with its cure if many places of the search volume look alike to arrays; None otherwise."""
    share = ambiguous_share(specs, grid, c_m_s)
    if share <= MOST_SHARE:
        return None
    return (
        f"arrays: {described(specs, c_m_s)}: in {share:.0%} of the search volume a position and its mirror image "
        f"cannot be told apart, and such sounds are reported as direction-only with all candidates; {CURE}"
    )


def described(specs: Sequence[ArraySpec], c_m_s: float) -> str:
    """Return in words why places look alike to arrays, such as "all microphones lie in the plane z = 1.20 m"."""
    flat = flatness(specs, c_m_s)
    if flat is None:
        return "the microphones of each array lie in one plane or on one line"
    axis = int(np.abs(flat.axis).argmax())
    name = "xyz"[axis] if abs(flat.axis[axis]) > 1.0 - 1e-6 else None
    if flat.is_line:
        return f"all microphones lie on one line{f' along {name}' if name else ''}"
    return f"all microphones lie in {f'the plane {name} = {flat.centre_m[axis]:.2f} m' if name else 'one plane'}"


def _inside(places_m: FloatArray, grid: Grid) -> FloatArray:
    """Return the places inside the search volume; those less than `REACH_M` outside are moved to its surface."""
    within_m = np.clip(places_m, grid.lower_m, grid.upper_m)
    off_m = np.abs(within_m - places_m)
    allowed_m = np.where(grid.cell_m > 0.0, REACH_M, 1e-6)
    return within_m[(off_m <= allowed_m).all(axis=1)]


@lru_cache(maxsize=256)
def _flatness(microphones: tuple[bytes, ...], tolerance_m: float) -> Flatness | None:
    """Return the plane or line of microphones, their positions given as bytes, so that it is computed once."""
    positions_m = np.concatenate([np.frombuffer(each).reshape(-1, 3) for each in microphones])
    centre_m = positions_m.mean(axis=0)
    axes = np.linalg.svd(positions_m - centre_m, full_matrices=True)[2]
    reach_m = np.abs((positions_m - centre_m) @ axes.T).max(axis=0)
    if reach_m[2] > tolerance_m:
        return None
    is_line = bool(reach_m[1] <= tolerance_m)
    return Flatness(centre_m, axes[0] if is_line else axes[2], is_line)
