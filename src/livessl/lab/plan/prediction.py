"""Predicts the error at each place of a room from geometry and reverberation alone, and finds better places.

A plan rests on four facts. A pair measures a delay, so the gradient of the delay decides how well it resolves a place.
Reverberation is noise to that delay, as strong as the direct sound at the critical distance. Microphones are never
exactly at their stated positions. The errors of several arrays are independent, so their information adds up.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import sici

from livessl.core.geometry import microphone_pairs, pair_weight
from livessl.core.steering import delay_gradients_s_m
from livessl.core.types import ArraySpec, FloatArray, IntArray

CLEARANCE_M: Final = 0.5
"""Least distance, in metres, from a microphone to a wall or another array: nearer reflections blur the direct peak."""

DECAY_60_DB: Final = 3.0 * np.log(10.0)
"""Time constants in a decay by 60 dB: the amplitude falls as exp(-6.9 t / RT60), the energy as exp(-13.8 t / RT60)."""

_NEAREST_M: Final = 1e-9


def angle_error_deg(
    angle_deg: ArrayLike, spacing_m: ArrayLike, sample_rate_hz: float, c_m_s: float = 343.0
) -> FloatArray:
    """Return the error of a direction from a lag in whole samples: arcsin(sin theta + c/(fs d sqrt 12)) - theta.

    Parameters
    ----------
    angle_deg : float or array
        theta from **broadside** (the plane half-way between the microphones), in degrees. The paper's text measures it
        from the line that joins them, but its equation holds for this angle.
    spacing_m : float or array
        d, distance between the two microphones; broadcasts against `angle_deg`.
    sample_rate_hz : float
        fs. A lag rounded to 1/fs errs by 1/(fs sqrt 12).
    c_m_s : float
        Speed of sound.

    Returns
    -------
    float64
        Degrees; NaN where the lag belongs to no direction.

    Raises
    ------
    ValueError
        If a spacing or a rate is not above 0.
    """
    sine = np.sin(np.radians(angle_deg)) + _lag_error(spacing_m, sample_rate_hz, c_m_s)
    direction = np.arcsin(sine, out=np.full(sine.shape, np.nan), where=np.abs(sine) <= 1.0)
    return np.asarray(np.degrees(direction) - np.asarray(angle_deg, dtype=np.float64))


def _lag_error(spacing_m: ArrayLike, sample_rate_hz: float, c_m_s: float) -> FloatArray:
    spacing = np.asarray(spacing_m, dtype=np.float64)
    if not (spacing > 0).all():
        raise ValueError(f"spacing: expected metres above 0, got {spacing.min():g}")
    if not sample_rate_hz > 0:
        raise ValueError(f"sample rate: expected Hz above 0, got {sample_rate_hz}")
    return np.asarray(c_m_s / (sample_rate_hz * spacing * np.sqrt(12.0)))


def diffuse_correlation(frequency_hz: ArrayLike, spacing_m: ArrayLike, c_m_s: float = 343.0) -> FloatArray:
    """Return the correlation of a diffuse sound field at two microphones: rho = sin(kd)/(kd), k = 2 pi f / c."""
    return np.asarray(np.sinc(2.0 * np.asarray(frequency_hz) * np.asarray(spacing_m) / c_m_s))


def band_diffuse_correlation(band_hz: tuple[float, float], spacing_m: float, c_m_s: float = 343.0) -> float:
    """Return the mean of `diffuse_correlation` over a band: (Si(k2 d) - Si(k1 d)) / (k2 d - k1 d)."""
    low, high = (2.0 * np.pi * frequency * spacing_m / c_m_s for frequency in band_hz)
    return float((sici(high)[0] - sici(low)[0]) / (high - low))


def critical_distance_m(absorption: float, room_size_m: ArrayLike) -> float:
    """Return the distance, in metres, at which an omnidirectional source's direct and reverberant sound are equal.

    r_c = sqrt(S alpha / (16 pi (1 - alpha))), with the room's surface S; infinite if the walls absorb everything.

    Raises
    ------
    ValueError
        If alpha is not above 0 and at most 1.
    """
    if not 0.0 < absorption <= 1.0:
        raise ValueError(f"absorption: expected above 0 and at most 1, got {absorption}")
    x, y, z = np.asarray(room_size_m, dtype=np.float64)
    surface = 2.0 * (x * y + y * z + z * x)
    if absorption == 1.0:
        return float("inf")
    return float(np.sqrt(surface * absorption / (16.0 * np.pi * (1.0 - absorption))))


def direct_to_reverberant(distance_m: ArrayLike, critical_m: float) -> FloatArray:
    """Return the ratio of powers (r_c / r)^2 at a distance r; infinite without reverberation."""
    distance = np.asarray(distance_m, dtype=np.float64)
    return np.asarray((critical_m / np.maximum(distance, _NEAREST_M)) ** 2)


def coherence_squared(
    points_m: FloatArray, microphones_m: FloatArray, pairs: IntArray, critical_m: float
) -> FloatArray:
    """Return the squared coherence of each pair for a sound at each point: D_i/(1 + D_i) D_k/(1 + D_k), (P, N).

    D is the direct-to-reverberant ratio at each microphone. The reverberant parts are taken as uncorrelated: averaged
    over 100 to 6000 Hz their correlation is 0.013 at 0.5 m.
    """
    distance = np.sqrt(((points_m - microphones_m[:, None]) ** 2).sum(axis=2))
    if np.isinf(critical_m):
        return np.ones((len(pairs), len(points_m)))
    ratio = direct_to_reverberant(distance, critical_m)
    share = ratio / (1.0 + ratio)
    return np.asarray(share[pairs[:, 0]] * share[pairs[:, 1]])


def observation_s(sound_s: float, rt60_s: float) -> float:
    """Return the time, in seconds, that averages the error of a delay: the sound's length, but at most RT60 / 6.9.

    The reverberant part is the same sound again through a random response. Over frequency that response is correlated
    as 1/(1 + j 2 pi f T / 13.8), so a band B holds B T / 6.9 independent values of it, however long the sound is: a
    longer sound averages noise out, but not reverberation.
    """
    return min(sound_s, rt60_s / DECAY_60_DB) if rt60_s > 0 else sound_s


def delay_std_s(coherence2: ArrayLike, band_hz: tuple[float, float], time_s: float) -> FloatArray:
    """Return the Cramér-Rao bound of a delay: sigma = sqrt(3 (1 - g2) / (8 pi^2 T g2 (f2^3 - f1^3))), seconds.

    Parameters
    ----------
    coherence2 : float or array
        g2, the squared coherence, in (0, 1]; the same all over the band.
    band_hz : (float, float)
        f1 and f2.
    time_s : float
        T, the length of sound that is averaged.

    Raises
    ------
    ValueError
        If an argument is out of its range.
    """
    g2 = np.asarray(coherence2, dtype=np.float64)
    low, high = band_hz
    if not ((g2 > 0) & (g2 <= 1)).all():
        raise ValueError("squared coherence: expected above 0 and at most 1")
    if not (time_s > 0 and 0 <= low < high):
        raise ValueError(f"delay bound: expected time above 0 and a band low < high, got {time_s} s and {band_hz} Hz")
    return np.asarray(np.sqrt(3.0 * (1.0 - g2) / (8.0 * np.pi**2 * time_s * g2 * (high**3 - low**3))))


@dataclass(frozen=True, slots=True)
class Conditions:
    """The conditions that affect all arrays in the same way.

    Parameters
    ----------
    critical_m : float
        Critical distance; infinite without reverberation.
    time_s : float
        Time that averages the error of a delay: see `observation_s`.
    calibration_m : float
        Standard deviation of a microphone's position along any direction. It is the floor under all other errors, so
        it must be above 0.
    c_m_s : float
        Speed of sound.
    """

    critical_m: float
    time_s: float
    calibration_m: float
    c_m_s: float = 343.0

    def __post_init__(self) -> None:
        for name, value in (("critical distance", self.critical_m), ("time", self.time_s), ("c", self.c_m_s)):
            if not value > 0:
                raise ValueError(f"{name}: expected above 0, got {value}")
        if not (np.isfinite(self.calibration_m) and self.calibration_m > 0):
            raise ValueError(
                f"calibration error: expected metres above 0 (no position is exact), got {self.calibration_m}"
            )

    @property
    def floor_s(self) -> float:
        """Delay error that misplaced microphones cause: sqrt 2 times their error, over c."""
        return float(np.sqrt(2.0) * self.calibration_m / self.c_m_s)


def delay_information_1_m2(
    points_m: FloatArray, microphones_m: FloatArray, sigma_s: ArrayLike, c_m_s: float
) -> FloatArray:
    """Return the Fisher information about a position from all pairs of an array: 2/K sum grad tau grad tau^T / sigma^2.

    Of K(K-1)/2 pairs only K-1 delays are independent. The factor 2/K counts each once; it is exact if every microphone
    has an independent error of sigma / sqrt 2.

    Parameters
    ----------
    points_m : (N, 3) float64
    microphones_m : (K, 3) float64
    sigma_s : float or (P, N)
        Standard deviation of each pair's delay.
    c_m_s : float

    Returns
    -------
    (N, 3, 3) float64
        1/m^2.
    """
    pairs = microphone_pairs(len(microphones_m))
    gradient = delay_gradients_s_m(points_m, microphones_m, pairs, c_m_s)
    scaled = gradient / np.broadcast_to(np.asarray(sigma_s, dtype=np.float64), gradient.shape[:2])[..., None]
    by_point = scaled.transpose(1, 2, 0)
    return np.asarray(pair_weight(len(microphones_m)) * by_point @ by_point.transpose(0, 2, 1))


def information_1_m2(spec: ArraySpec, points_m: FloatArray, conditions: Conditions) -> FloatArray:
    """Return the Fisher information (N, 3, 3) of one array about a sound at each point, in 1/m^2; several add up.

    A pair's variance is the Cramér-Rao bound for its coherence plus the floor of the calibration.
    """
    pairs = microphone_pairs(len(spec.microphones_m))
    coherence2 = coherence_squared(points_m, spec.microphones_m, pairs, conditions.critical_m)
    sigma = np.hypot(delay_std_s(coherence2, spec.band_hz, conditions.time_s), conditions.floor_s)
    return delay_information_1_m2(points_m, spec.microphones_m, sigma, conditions.c_m_s)


def covariance_m2(information: FloatArray, extent_m: FloatArray | None = None) -> FloatArray:
    """Return the covariance (N, 3, 3) of a position from its information, in m^2.

    Parameters
    ----------
    information : (N, 3, 3) float64
    extent_m : (3,) float64 or None
        Size of the search volume. Along axes that the arrays do not resolve, the variance is that of the volume,
        L^2/12; an axis without extent is known, and its rows are 0. None uses the information alone, which must then
        have an inverse.
    """
    if extent_m is None:
        return np.asarray(np.linalg.inv(information))
    free = np.flatnonzero(extent_m > 0)
    inside = np.ix_(np.arange(len(information)), free, free)
    covariance = np.zeros_like(information)
    covariance[inside] = np.linalg.inv(information[inside] + np.diag(12.0 / extent_m[free] ** 2))
    return covariance


def position_error_m(covariance: FloatArray) -> FloatArray:
    """Return the root of the expected squared distance to the truth: sqrt(trace C), (N,)."""
    return np.asarray(np.sqrt(np.trace(covariance, axis1=1, axis2=2)))


def radial_tangential_m(
    covariance: FloatArray, points_m: FloatArray, origin_m: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return standard deviations (N,) along the line from an origin, and across it (RMS over two directions)."""
    towards = points_m - origin_m
    unit = towards / np.maximum(np.sqrt((towards**2).sum(axis=1, keepdims=True)), _NEAREST_M)
    along = np.einsum("na,nab,nb->n", unit, covariance, unit)
    across = np.maximum(np.trace(covariance, axis1=1, axis2=2) - along, 0.0) / 2.0
    return np.sqrt(np.maximum(along, 0.0)), np.sqrt(across)


@dataclass(frozen=True, slots=True)
class Move:
    """A shift of an array, or of a copy of it, and the median predicted error without and with the shift."""

    array: str
    offset_m: tuple[float, float]
    before_m: float
    after_m: float


def moved(spec: ArraySpec, offset_m: Sequence[float]) -> ArraySpec:
    """Return the array shifted by (dx, dy) metres, neither rotated nor raised."""
    return replace(spec, microphones_m=spec.microphones_m + np.array([*offset_m, 0.0]))


def best_moves(
    specs: Sequence[ArraySpec],
    points_m: FloatArray,
    conditions: Conditions,
    room_size_m: ArrayLike,
    extent_m: FloatArray,
    step_m: float = 0.5,
    progress: Callable[[int, int], None] | None = None,
) -> list[Move]:
    """Find, for each array alone, the move that lowers the median error most.

    The candidates are all shifts by whole steps along x and y that keep every microphone `CLEARANCE_M` from walls and
    from other arrays' microphones. Arrays whose moves do not lower the error are omitted.

    Parameters
    ----------
    specs : sequence of ArraySpec
    points_m : (N, 3) float64
        Positions at which sounds are expected; the median is over these.
    conditions : Conditions
    room_size_m : (3,)
    extent_m : (3,) float64
        Size of the search volume, as in `covariance_m2`.
    step_m : float
        Step of the shifts.
    progress : callable or None
        Called with (arrays tried, arrays).

    Returns
    -------
    list of Move
        The best move first.
    """
    own = [information_1_m2(spec, points_m, conditions) for spec in specs]
    everything = np.sum(own, axis=0)
    before = _median_error_m(everything, extent_m)
    moves = []
    for index, spec in enumerate(specs):
        others = [other.microphones_m for k, other in enumerate(specs) if k != index]
        shifts = shifts_m(spec, others, room_size_m, step_m)
        best = _best_of(shifts, spec, everything - own[index], before, points_m, conditions, extent_m)
        if best is not None:
            moves.append(best)
        if progress is not None:
            progress(index + 1, len(specs))
    return sorted(moves, key=lambda move: move.after_m)


def best_addition(
    spec: ArraySpec,
    points_m: FloatArray,
    conditions: Conditions,
    room_size_m: ArrayLike,
    extent_m: FloatArray,
    step_m: float = 0.5,
) -> Move | None:
    """Find where a copy of the only array lowers the median error most, as a shift from it; see `best_moves`."""
    own = information_1_m2(spec, points_m, conditions)
    shifts = shifts_m(spec, [spec.microphones_m], room_size_m, step_m)
    return _best_of(shifts, spec, own, _median_error_m(own, extent_m), points_m, conditions, extent_m)


def _best_of(
    shifts: Sequence[tuple[float, float]],
    spec: ArraySpec,
    others: FloatArray,
    before_m: float,
    points_m: FloatArray,
    conditions: Conditions,
    extent_m: FloatArray,
) -> Move | None:
    """Return the shift of an array that lowers the median error most, given the others' information, or None."""
    best = None
    for shift in shifts:
        there = information_1_m2(moved(spec, shift), points_m, conditions)
        after = _median_error_m(others + there, extent_m)
        if after < (before_m if best is None else best.after_m):
            best = Move(spec.name, shift, before_m, after)
    return best


def shifts_m(
    spec: ArraySpec, others_m: Sequence[FloatArray], room_size_m: ArrayLike, step_m: float
) -> list[tuple[float, float]]:
    """Shifts (dx, dy), not (0, 0), by whole steps to where an array is clear of walls and other arrays' microphones."""
    if not step_m > 0:
        raise ValueError(f"step: expected metres above 0, got {step_m}")
    size = np.asarray(room_size_m, dtype=np.float64)[:2]
    lowest = np.ceil((CLEARANCE_M - spec.microphones_m.min(axis=0)[:2]) / step_m - 1e-9)
    highest = np.floor((size - CLEARANCE_M - spec.microphones_m.max(axis=0)[:2]) / step_m + 1e-9)
    steps_x, steps_y = (np.arange(low, high + 1) * step_m for low, high in zip(lowest, highest, strict=True))
    shifts = [(float(x), float(y)) for x in steps_x for y in steps_y if x or y]
    if not others_m:
        return shifts
    near = np.concatenate(others_m)
    between = spec.microphones_m[:, None] - near
    return [
        shift
        for shift in shifts
        if float((((between + np.array([*shift, 0.0])) ** 2).sum(axis=2)).min()) >= CLEARANCE_M**2
    ]


def _median_error_m(information: FloatArray, extent_m: FloatArray) -> float:
    return float(np.median(position_error_m(covariance_m2(information, extent_m))))
