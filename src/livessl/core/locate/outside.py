"""Decides whether a sound came from outside the search volume, and words that reason. It uses correlations only.

The search ends at the surface of the volume. A sound from beyond the surface is therefore located on the surface, or at
a place inside at which all arrays have some power. Both places have less power than the true one, which is searched for
beyond the volume, along the direction from which each array receives the sound.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from livessl.core.geometry import Grid, angle_deg, pair_weight
from livessl.core.locate import refine
from livessl.core.locate.ambiguity import SAME_POWER
from livessl.core.locate.confidence import CLEAR_PEAK_TO_RMS, NEAR_M, peak_to_rms
from livessl.core.locate.place import Place
from livessl.core.locate.srp import SRPFunctional
from livessl.core.types import Candidate, Evidence, FloatArray

GAIN: Final = 0.1
"""Least amount by which the power of a place outside must exceed that of the best place inside, as a share of the
latter. It is 0.1 to 0.3 for the middle half of sounds outside. For sounds inside, noise and reverberation reach 0.04,
even with a reverberation time of 2 s."""

SURFACE_GAIN: Final = 0.005
"""Value of `GAIN` if the best place inside lies on the surface of the volume. The power rises only a little along the
line of sight of arrays that are in line with the sound. Reflections by a wall move places by less than `NEAR_M`."""

POSE_DEG: Final = 1.5
"""Standard deviation, in degrees, of an array's orientation if it is aligned by eye and measuring tape."""

MOST_DEVIATIONS: Final = 2.5
"""Number of standard deviations of the poses, over all arrays, up to which wrong poses explain an outside place."""

NEAR_BY_POSE_M: Final = 1.25
"""Distance, in metres, between the places inside and outside up to which the place inside is kept if poses explain the
difference. If they are farther apart, the arrays do not measure the distance well enough to exclude the place
outside."""

SUFFICIENT: Final = 0.95
"""Least power of a place, as a share of the highest possible power of the evidence, at which the place explains the
evidence so well that no second source is needed."""

_DIRECTIONS: Final = 1600
"""Number of directions examined for each array, about 5 degrees apart: the width of a lobe of an array of 0.5 m."""

_CLOSER_DEG: Final = (3.0, 1.0)
"""Half widths, in degrees, of the two finer searches around the best direction."""

_CLOSER_STEPS: Final = 9
"""Number of directions along each axis of a finer search."""

_FARTHEST_DIAGONALS: Final = 3.0
"""Greatest distance of examined places from an array, in diagonals of the volume. Farther away, only the direction
matters."""

_NEAREST_M: Final = 0.3
"""Shortest distance, in metres, that is examined along each direction."""

_DISTANCES: Final = 100
"""Number of distances examined along each direction, in equal ratios of about 5 %. For two arrays some metres apart,
neighbouring distances differ by less than a lobe."""

MOST_DIRECTIONS: Final = 4
"""Largest number of arrays along whose directions places are examined: those that receive the sound most clearly."""

_PROMISING: Final = 0.9
"""Highest power along these directions, as a share of the required power, below which no place is refined."""

_REFINED_M: Final = 0.5
"""Edge, in metres, of the cells in which places outside are refined: four times the longest step of a climb."""


@dataclass(frozen=True, slots=True)
class Outside:
    """A place outside the search volume that explains the evidence better than any place inside.

    Parameters
    ----------
    place : Place
        Place outside; its `rival_power` is the power of the place inside.
    grid : Grid
        A box that contains the search volume and the place, in which the place is judged.
    surface : bool
        Whether the place inside lies on the surface, so that the sound may be there.
    """

    place: Place
    grid: Grid
    surface: bool

    @property
    def is_sufficient(self) -> bool:
        """True if the place explains the evidence so well that no second source is needed."""
        return self.place.power >= SUFFICIENT * highest_power(self.place.evidence)

    def candidates(self, inside_m: FloatArray) -> tuple[Candidate, Candidate]:
        """Return the place, and the best place inside, with their probabilities."""
        margin = refine.margin(self.place.power, self.place.rival_power)
        share = 1.0 / (1.0 + float(np.exp(-margin / SAME_POWER)))
        return Candidate(self.place.position_m, share), Candidate(inside_m, 1.0 - share)

    @property
    def reason(self) -> str:
        """The reason in words."""
        near = ", ".join(f"{x:.1f}" for x in self.place.position_m)
        where = (
            "at the surface of the search volume or outside the search volume"
            if self.surface
            else "outside the search volume"
        )
        return (
            f"{where}, near ({near}); if it was inside, check the arrays' poses in the site file, room.size_m and "
            "grid.bounds_m"
        )


def find_outside(
    inside: Place, evidence: Sequence[Evidence], grid: Grid, c_m_s: float, *, refused: bool
) -> Outside | None:
    """Find a place outside the search volume that explains the evidence better than the best place inside.

    Parameters
    ----------
    inside : Place
        The best place inside.
    evidence : sequence of Evidence
        Evidence of all arrays, including outliers with respect to the place inside.
    grid : Grid
        Search grid.
    c_m_s : float
        Speed of sound, m/s.
    refused : bool
        Whether the place inside is refused; its position on the surface then has no meaning.
    """
    if len(grid.free_axes) < 3 or len(evidence) < 2:
        return None  # sounds off a plane that is searched look far away in it; one array measures no distance
    evidence = tuple(sorted(evidence, key=lambda part: part.spec.name))
    functional = SRPFunctional(evidence, c_m_s)
    power = float(functional.value(inside.position_m[None])[0])
    surface = not refused and _on_surface(inside.position_m, grid)
    least = (1.0 + (SURFACE_GAIN if surface else GAIN)) * power
    if power <= 0.0 or highest_power(evidence) < least:
        return None
    clearest = sorted(evidence, key=lambda part: -peak_to_rms(part, highest_power([part])))[:MOST_DIRECTIONS]
    starts_m = np.concatenate([_along_m(part, grid, c_m_s) for part in clearest])
    values = functional.value(starts_m)
    if not len(values) or values.max() < _PROMISING * least:
        return None
    wide = _widened(grid)
    position_m, beyond = refine.refine(functional, starts_m[values.argmax()], wide)
    is_outside = bool(((position_m < grid.lower_m) | (position_m > grid.upper_m)).any())
    if beyond < least or not is_outside or _is_near(position_m, inside.position_m, evidence):
        return None
    place = Place(evidence, functional, position_m, beyond, power)
    if sorted(place.peak_to_rms)[-2] < CLEAR_PEAK_TO_RMS:
        return None  # one array's noise has a peak somewhere along the other's line of sight
    return Outside(place, wide, surface=surface and beyond < (1.0 + GAIN) * power)


def highest_power(evidence: Sequence[Evidence]) -> float:
    """Return the highest possible power: that of all pairs at their highest lag."""
    return sum(
        pair_weight(len(part.spec.microphones_m)) * float(part.gcc.values.max(axis=1).sum(dtype=np.float64))
        for part in evidence
    )


def _is_near(place_m: FloatArray, inside_m: FloatArray, evidence: Sequence[Evidence]) -> bool:
    """Return whether a place outside and one inside are the same answer, given the uncertainty of the arrays' poses."""
    turns_deg = [angle_deg(place_m - part.spec.centre_m, inside_m - part.spec.centre_m) for part in evidence]
    by_pose = float(np.linalg.norm(turns_deg)) <= MOST_DEVIATIONS * POSE_DEG
    return float(np.linalg.norm(place_m - inside_m)) <= (NEAR_BY_POSE_M if by_pose else NEAR_M)


def _on_surface(position_m: FloatArray, grid: Grid) -> bool:
    from_surface_m = np.minimum(position_m - grid.lower_m, grid.upper_m - position_m)
    return bool((from_surface_m <= grid.cell_m).any())


def _widened(grid: Grid) -> Grid:
    reach_m = _FARTHEST_DIAGONALS * float(np.linalg.norm(grid.upper_m - grid.lower_m))
    x, y, z = ((low - reach_m, high + reach_m) for low, high in grid.bounds_m)
    return Grid((x, y, z), _REFINED_M)


def _along_m(part: Evidence, grid: Grid, c_m_s: float) -> FloatArray:
    """Return places (N, 3) outside the volume along the direction from which an array receives a far sound."""
    functional, centre_m = SRPFunctional([part], c_m_s), part.spec.centre_m
    far_m = _FARTHEST_DIAGONALS * float(np.linalg.norm(grid.upper_m - grid.lower_m))

    def highest(directions: FloatArray) -> FloatArray:
        return np.asarray(directions[functional.value(centre_m + far_m * directions).argmax()])

    direction = highest(_SPHERE)
    for half_deg in _CLOSER_DEG:
        direction = highest(_around(direction, np.radians(half_deg)))
    places_m = centre_m + np.geomspace(_NEAREST_M, far_m, _DISTANCES)[:, None] * direction
    return places_m[((places_m < grid.lower_m) | (places_m > grid.upper_m)).any(axis=1)]


def _around(direction: FloatArray, half: float) -> FloatArray:
    """Return unit vectors (N, 3) on a square around a direction, `half` radians to each side."""
    across = np.linalg.svd(direction[None])[2][1:]
    steps = np.linspace(-half, half, _CLOSER_STEPS)
    one, other = np.meshgrid(steps, steps)
    vectors = direction + one.reshape(-1, 1) * across[0] + other.reshape(-1, 1) * across[1]
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def _sphere() -> FloatArray:
    """Return unit vectors (N, 3) that cover the sphere evenly: a Fibonacci lattice."""
    index = np.arange(_DIRECTIONS) + 0.5
    height = 1.0 - 2.0 * index / _DIRECTIONS
    azimuth = np.pi * (1.0 + np.sqrt(5.0)) * index
    ring = np.sqrt(1.0 - height**2)
    return np.stack([np.cos(azimuth) * ring, np.sin(azimuth) * ring, height], axis=1)


_SPHERE: Final = _sphere()
