"""Computes a plan: error maps, aliasing, direct-to-reverberant ratios, advised moves. It draws and prints nothing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from livessl.core.geometry import Grid, microphone_pairs
from livessl.core.steering import alias_free_hz
from livessl.core.types import ArraySpec, FloatArray
from livessl.lab.plan import prediction
from livessl.lab.plan.defaults import CALIBRATION_M
from livessl.simulation.room import absorption
from livessl.site.build.grid import search_grid
from livessl.site.models import Site

ANGLES_DEG: Final = (0.0, 30.0, 60.0, 80.0)
"""Directions from broadside, in degrees, at which the angular error is reported."""

DISTANCES_M: Final = (1.0, 2.0, 3.0, 4.0)
"""Distances, in metres, at which the direct-to-reverberant ratio is reported."""

SHARES: Final = (5, 25, 50, 75, 95)
"""Percentiles that are reported."""

HEIGHT_M: Final = 1.5
"""Default height, in metres, of the expected sounds: about that of a mouth, a table or a door handle."""

SOUND_S: Final = 0.5
"""Length, in seconds, of the expected sound; it hardly matters with reverberation, see `prediction.observation_s`."""

RATE_HZ: Final = 44100.0
"""Sample rate, in hertz, that is assumed for an array that no node captures."""

MAP_POINTS: Final = 600
"""Most points of the floor map: a third of a metre apart in a room of 8 x 10 m."""

BAND_POINTS: Final = 4000
"""Most points of the search volume at which the bands of the pairs are examined."""

LATTICE: Final = 150
"""Approximate number of positions that are tried for an array."""

WORTH_WHILE: Final = 0.95
"""Largest ratio of the median errors with and without a move for which the move is advised."""

MOST_MOVES: Final = 3
"""Most moves that are advised."""


@dataclass(frozen=True, slots=True)
class Errors:
    """The predicted error (ny, nx) over the floor map, in metres, and its radial and tangential components."""

    total_m: FloatArray
    radial_m: FloatArray
    tangential_m: FloatArray

    def percentile_m(self, share: float) -> float:
        """Return a percentile of the total error over the map, in metres."""
        return float(np.percentile(self.total_m, share))


@dataclass(frozen=True, slots=True)
class Prediction:
    """The predicted errors of each array alone and of all together, on a floor map at one height.

    `absorption` is the share of sound that the walls absorb.
    """

    absorption: float
    conditions: prediction.Conditions
    floor: Grid
    alone: tuple[Errors, ...]
    fused: Errors

    @property
    def height_m(self) -> float:
        """Height of the map, in metres."""
        return self.floor.bounds_m[2][0]


@dataclass(frozen=True, slots=True)
class PairPlan:
    """Two microphones: channels from 1, their distance, and percentiles over the room of the alias-free frequency."""

    channels: tuple[int, int]
    spacing_m: float
    alias_free_hz: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class ArrayPlan:
    """The plan of one array.

    Parameters
    ----------
    spec : ArraySpec
    sample_rate_hz : float
        Sample rate of the node that captures the array.
    sample_rate_known : bool
        False if no node captures the array and `RATE_HZ` is assumed.
    angle_error_deg : tuple of float
        Angular error of the widest pair at `ANGLES_DEG`; NaN where the lag belongs to no direction.
    diffuse_correlation : float
        Correlation of a diffuse field at the widest pair, averaged over the band.
    pairs : tuple of PairPlan
    alias_free_hz : tuple of float
        Percentiles `SHARES`, over (point, pair) combinations, of the frequency up to which there is no aliasing.
    beyond_grid : float
        Share of (point, pair) combinations with spatial aliasing inside the band on this grid.
    alone : Errors
        Errors predicted for this array without the others.
    """

    spec: ArraySpec
    sample_rate_hz: float
    sample_rate_known: bool
    angle_error_deg: tuple[float, ...]
    diffuse_correlation: float
    pairs: tuple[PairPlan, ...]
    alias_free_hz: tuple[float, ...]
    beyond_grid: float
    alone: Errors


@dataclass(frozen=True, slots=True)
class Plan:
    """The plan of a site; the columns of the map are at `x_m`, its rows at `y_m`, all of it at `height_m`.

    For a site with one array, `addition` is the best position of a second one like it.
    """

    site: Site
    rt60_s: float
    absorption: float
    conditions: prediction.Conditions
    height_m: float
    x_m: FloatArray
    y_m: FloatArray
    arrays: tuple[ArrayPlan, ...]
    fused: Errors
    moves: tuple[prediction.Move, ...]
    addition: prediction.Move | None


def make_plan(
    site: Site,
    rt60_s: float,
    height_m: float | None = None,
    calibration_m: float = CALIBRATION_M,
    progress: Callable[[int, int], None] | None = None,
) -> Plan:
    """Compute the plan of a site.

    Parameters
    ----------
    site : Site
    rt60_s : float
        Reverberation time; 0 is anechoic.
    height_m : float or None
        Height of the map. None takes that of the search plane, or `HEIGHT_M`, or the middle of a lower search volume.
    calibration_m : float
        Standard deviation of a microphone's position along any direction, above 0.
    progress : callable or None
        Called with the number of arrays whose other positions were tried, and the number of all arrays.

    Raises
    ------
    ValueError
        If the room cannot have the reverberation time, or the height lies outside the search volume.
    """
    expected = predict(site, rt60_s, height_m, calibration_m)
    conditions, points = expected.conditions, expected.floor.points_m()
    volume = _volume(site)
    extent = volume.upper_m - volume.lower_m
    arrays = tuple(_array_plan(site, spec, volume, own) for spec, own in zip(site.specs, expected.alone, strict=True))
    room, step = site.room.size_m, _step_m(site.room.size_m)
    moves = prediction.best_moves(site.specs, points, conditions, room, extent, step, progress)
    addition = None
    if len(site.specs) == 1:
        addition = prediction.best_addition(site.specs[0], points, conditions, room, extent, step)
    return Plan(
        site=site,
        rt60_s=rt60_s,
        absorption=expected.absorption,
        conditions=conditions,
        height_m=expected.height_m,
        x_m=expected.floor.axis_m(0),
        y_m=expected.floor.axis_m(1),
        arrays=arrays,
        fused=expected.fused,
        moves=tuple(move for move in moves if move.after_m <= WORTH_WHILE * move.before_m)[:MOST_MOVES],
        addition=addition,
    )


def predict(
    site: Site, rt60_s: float, height_m: float | None = None, calibration_m: float = CALIBRATION_M
) -> Prediction:
    """Predict the errors of a site's arrays at their present places; parameters and errors are those of `make_plan`."""
    alpha = absorption(rt60_s, site.room.size_m, site.c_m_s)
    conditions = prediction.Conditions(
        prediction.critical_distance_m(alpha, site.room.size_m),
        prediction.observation_s(SOUND_S, rt60_s),
        calibration_m,
        site.c_m_s,
    )
    volume = _volume(site)
    floor = _floor(volume, height_m)
    points = floor.points_m()
    extent = volume.upper_m - volume.lower_m
    information = [prediction.information_1_m2(spec, points, conditions) for spec in site.specs]
    middle = np.mean([spec.centre_m for spec in site.specs], axis=0)
    return Prediction(
        absorption=alpha,
        conditions=conditions,
        floor=floor,
        alone=tuple(
            _errors(own, floor, extent, spec.centre_m) for spec, own in zip(site.specs, information, strict=True)
        ),
        fused=_errors(np.sum(information, axis=0), floor, extent, middle),
    )


def _volume(site: Site) -> Grid:
    """Return the part of the search volume inside the room, with the site's spacing; the site check requires one."""
    grid = search_grid(site)
    low = np.maximum(grid.lower_m, 0.0)
    high = np.minimum(grid.upper_m, site.room.size_m)
    x, y, z = ((float(a), float(b)) for a, b in zip(low, high, strict=True))
    return Grid((x, y, z), grid.spacing_m)


def _floor(volume: Grid, height_m: float | None) -> Grid:
    low, high = volume.bounds_m[2]
    usual = max(HEIGHT_M, low) if high >= HEIGHT_M else (low + high) / 2.0
    height = usual if height_m is None else height_m
    if not low <= height <= high:
        raise ValueError(f"height: expected {low:g} to {high:g} m, where the site searches, got {height:g} m")
    x, y, _ = volume.bounds_m
    return _thinned(Grid((x, y, (height, height)), volume.spacing_m), MAP_POINTS)


def _thinned(grid: Grid, most: int) -> Grid:
    """Return a grid of the same volume with at most `most` points, and not many fewer."""
    spacing = grid.spacing_m
    while Grid(grid.bounds_m, spacing).size > most:
        spacing *= 1.05
    return Grid(grid.bounds_m, spacing)


def _step_m(room_size_m: tuple[float, float, float]) -> float:
    """Return the step of the positions that are tried: 0.5 m, more in a large room, in multiples of 0.1 m."""
    x, y, _ = room_size_m
    return max(0.5, float(np.ceil(10.0 * np.sqrt(x * y / LATTICE)) / 10.0))


def _errors(information: FloatArray, floor: Grid, extent_m: FloatArray, origin_m: FloatArray) -> Errors:
    covariance = prediction.covariance_m2(information, extent_m)
    parts = prediction.radial_tangential_m(covariance, floor.points_m(), origin_m)
    total, radial, tangential = (
        part.reshape(floor.shape[:2]).T for part in (prediction.position_error_m(covariance), *parts)
    )
    return Errors(total, radial, tangential)


def _array_plan(site: Site, spec: ArraySpec, volume: Grid, alone: Errors) -> ArrayPlan:
    node = site.node_of(spec.name)
    known_hz = site.nodes[node].device.sample_rate_hz if node is not None else None
    rate_hz = known_hz or RATE_HZ
    pairs = microphone_pairs(len(spec.microphones_m))
    points = _thinned(volume, BAND_POINTS).points_m()
    kept = alias_free_hz(points, spec.microphones_m, pairs, site.grid.spacing_m, site.c_m_s)
    apart = np.linalg.norm(spec.microphones_m[pairs[:, 0]] - spec.microphones_m[pairs[:, 1]], axis=1)
    errors = prediction.angle_error_deg(np.array(ANGLES_DEG), spec.aperture_m, rate_hz, site.c_m_s)
    return ArrayPlan(
        spec=spec,
        sample_rate_hz=rate_hz,
        sample_rate_known=known_hz is not None,
        angle_error_deg=tuple(float(error) for error in errors),
        diffuse_correlation=prediction.band_diffuse_correlation(spec.band_hz, spec.aperture_m, site.c_m_s),
        pairs=tuple(
            PairPlan((int(i) + 1, int(k) + 1), float(spacing), _shares(limits))
            for (i, k), spacing, limits in zip(pairs, apart, kept, strict=True)
        ),
        alias_free_hz=_shares(kept),
        beyond_grid=float((kept < spec.band_hz[1]).mean()),
        alone=alone,
    )


def _shares(limits_hz: FloatArray) -> tuple[float, ...]:
    """Return the percentiles `SHARES`, without interpolation, because limits may be infinite."""
    return tuple(float(value) for value in np.percentile(limits_hz, SHARES, method="lower"))
