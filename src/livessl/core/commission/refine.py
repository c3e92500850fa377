"""Refines the poses of arrays and the speed of sound from sounds at unknown places.

The places of the sounds and the poses are estimated together. The delays within the arrays are enough: the arrays need
no common clock. If some arrays have one, the times between these arrays determine distances. Sounds at unknown
places do not reveal where in the room the whole set-up is, so at least one array keeps its filed pose.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import replace
from functools import partial
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from livessl.core.commission.arrivals import Arrivals
from livessl.core.commission.places import Delays, Microphones, PlaceSearch
from livessl.core.commission.poses import DELAY_STD_S, MICROPHONE_STD_M, UNKNOWN_DEG, Adjusted, Freedom, adjust
from livessl.core.commission.resection import SPEED_STD_M_S, MeasuredSetUp, described_pose, received
from livessl.core.types import FloatArray

LEAST_UNKNOWN: Final = 10
"""Fewest sounds at unknown places from which an array is refined; each sound adds three unknowns."""

POSITION_STD_M: Final = 0.5
"""Standard deviation of a filed position that is refined, metres: that of a position measured in paces."""

OUTLIER: Final = 3.5
"""Misfit of a sound, in medians of all misfits, above which the sound is not used: an array received an echo or another
sound."""

LEAST_OUTLIER_S: Final = 30e-6
"""Misfit, in seconds, below which no sound is an outlier."""

CONTRADICTION: Final = 3.0
"""Ratio of the misfit with the times between arrays to the misfit without them, above which the times contradict the
delays. The times are then not used, and positions remain as uncertain as in the site file."""

LEAST_STD_S: Final = 5e-6
"""Least standard deviation of the delays that is assumed, seconds."""

YAW_STEP_DEG: Final = 20.0
"""Step of the turns from which the adjustment begins, degrees."""


def refine(
    microphones: Microphones,
    delays: Delays,
    bounds_m: FloatArray,
    c_m_s: float,
    known: Collection[str],
    arrivals: Arrivals | None = None,
    position_std_m: float = POSITION_STD_M,
) -> MeasuredSetUp:
    """Measure the poses of arrays from sounds at unknown places, and the speed of sound.

    Parameters
    ----------
    microphones : mapping of array to (K, 3) float64
        As filed, metres. Orientations may be wrong.
    delays : mapping of array to (S, K) float64
        Delays of the same S sounds, seconds; NaN where an array did not receive a sound.
    bounds_m : (3, 2) float64
        Search volume, metres.
    c_m_s : float
        Speed of sound as filed, m/s.
    known : collection of str
        Arrays that stay as they are filed.
    arrivals : Arrivals or None
        Times at which arrays that share a clock received the same sounds.
    position_std_m : float
        Standard deviation of the filed positions along each axis, metres.

    Returns
    -------
    MeasuredSetUp
        Poses of the arrays that are not `known`. The misfits of a pose are those of all arrays together.

    Raises
    ------
    ValueError
        If no array is known or none is to be refined, or if an array received fewer than `LEAST_UNKNOWN` of the sounds
        that a known one received.
    """
    shared = np.sum([received(measured) for measured in delays.values()], axis=0) > 1
    delays = {name: measured[shared] for name, measured in delays.items()}
    free = [name for name in delays if name not in known]
    if not free or len(free) == len(delays):
        raise ValueError(f"expected one array or more to be known and one or more to be refined, got {len(free)} free")
    for name in delays:
        count = int(received(delays[name]).sum())
        if count < LEAST_UNKNOWN:
            raise ValueError(
                f"array {name!r}: expected {LEAST_UNKNOWN} sounds or more that another array received, got {count}"
            )
    microphones = {name: microphones[name] for name in delays}
    search = PlaceSearch(bounds_m, c_m_s)
    starts = [dict(microphones), _turned(microphones, delays, search, free)]
    freedom = Freedom(dict.fromkeys(free, (position_std_m, UNKNOWN_DEG)), SPEED_STD_M_S)
    tried = [(start, _adjusted(start, delays, search, freedom)) for start in starts]
    start, first = min(tried, key=lambda one: float(np.median(one[1].misfits_s)))
    used = first.misfits_s <= max(OUTLIER * float(np.median(first.misfits_s)), LEAST_OUTLIER_S)
    kept = {name: measured[used] for name, measured in delays.items()}
    std_s = _delay_std_s(first.misfits_s[used], kept, len(free))
    times = None if arrivals is None else arrivals.of_sounds(np.flatnonzero(shared)[used])
    exact = replace(freedom, microphone_std_m=MICROPHONE_STD_M)
    last = _adjusted(start, kept, search, exact, std_s)
    if times is not None:
        last = _with_times(times, last, partial(_adjusted, start, kept, search, exact, std_s))
    placed = {name: last.microphones[name] if name in free else at_m for name, at_m in start.items()}
    before_s = search.fit(microphones, kept).misfit_s
    after_s = PlaceSearch(bounds_m, last.c_m_s).fit(placed, kept).misfit_s
    poses = {
        name: described_pose(microphones[name], placed[name], last.poses[name], before_s, after_s) for name in free
    }
    places_m = np.full((len(shared), 3), np.nan)
    places_m[np.flatnonzero(shared)[used]] = last.places_m
    return MeasuredSetUp(poses, last.c_m_s, last.c_std_m_s, places_m, after_s)


def _adjusted(
    start: Microphones,
    delays: Delays,
    search: PlaceSearch,
    freedom: Freedom,
    delay_std_s: float = DELAY_STD_S,
    arrivals: Arrivals | None = None,
    begin: Adjusted | None = None,
) -> Adjusted:
    places_m = search.fit(start, delays).positions_m
    return adjust(
        start, delays, places_m, search.c_m_s, freedom, delay_std_s=delay_std_s, arrivals=arrivals, begin=begin
    )


def _with_times(times: Arrivals, without: Adjusted, adjusted: Callable[[Arrivals, Adjusted], Adjusted]) -> Adjusted:
    """Return the set-up that fits the times between arrays as well, or `without` them if they contradict it.

    Parameters
    ----------
    times : Arrivals
    without : Adjusted
        The set-up that fits the delays within the arrays.
    adjusted : callable
        Fits a set-up to the delays and to times between arrays, beginning with a set-up.
    """
    found = adjusted(times, without)
    off_s = times.contradictions_s(found.microphones, found.places_m, found.c_m_s)
    if _rms(off_s) > times.std_s:  # an array received some sounds by an echo
        found = adjusted(replace(times, std_s=_rms(off_s)), found)
    # poses that fit all times between arrays, but not the delays within them, are another lowest point far away
    return found if _rms(found.misfits_s) <= max(CONTRADICTION * _rms(without.misfits_s), LEAST_STD_S) else without


def _rms(misfits_s: FloatArray) -> float:
    return float(np.sqrt(np.mean(misfits_s**2)))


def _turned(
    microphones: Microphones, delays: Delays, search: PlaceSearch, free: Collection[str]
) -> dict[str, FloatArray]:
    """Return the microphones with each free array turned so that its delays fit those of the known arrays best.

    The adjustment begins there.
    """
    found = dict(microphones)
    known = [name for name in microphones if name not in free]
    of_known = np.sum([search.costs(search.table_s(microphones[name]), delays[name]) for name in known], axis=0)
    for name in free:
        at_m, best = microphones[name], np.inf
        centre_m = at_m.mean(axis=0)
        for upside in (0.0, 180.0):
            for yaw in np.arange(-180.0, 180.0, YAW_STEP_DEG):
                turned_m = Rotation.from_euler("ZX", [yaw, upside], degrees=True).apply(at_m - centre_m) + centre_m
                costs = of_known + search.costs(search.table_s(turned_m), delays[name])
                lowest = float(np.sqrt(costs.min(axis=1)).sum())
                if lowest < best:
                    best, found[name] = lowest, turned_m
    return found


def _delay_std_s(misfits_s: FloatArray, delays: Delays, free: int) -> float:
    """Estimate the standard deviation of the delays from the misfits (S,) of the sounds, seconds."""
    rows = np.sum([np.maximum(np.isfinite(measured).sum(axis=1) - 1, 0) for measured in delays.values()])
    unknowns = 3 * len(misfits_s) + 6 * free + 1
    count = max(int(rows) - unknowns, 1)
    return max(LEAST_STD_S, float(np.sqrt(np.mean(misfits_s**2) * rows / count)))
