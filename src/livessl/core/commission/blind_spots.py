"""Finds blind spots: which shifts and turns of arrays, or a mirrored room, the sounds so far could not have shown.

Two arrays whose lines of sight to a sound still meet after one of them was moved receive nothing that contradicts the
site file: the place of the sound is unknown and explains it. How much of a fault remains visible follows from the
slopes of the delays, with the places of the sounds eliminated and every array as free as it is in a careful set-up.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from livessl.core.commission.blind_spot import BlindSpot
from livessl.core.commission.diagnosis import most_telling, of_sounds
from livessl.core.commission.finding import LEAST_SOUNDS
from livessl.core.commission.judge import COSTS, least_gain
from livessl.core.commission.mirror import mirrored
from livessl.core.commission.places import Delays, Microphones, PlaceSearch
from livessl.core.commission.set_up import Known, SetUp
from livessl.core.commission.tolerance import Fit
from livessl.core.types import FloatArray

MOST_HIDDEN_M: Final = 0.3
MOST_HIDDEN_DEG: Final = 10.0
"""Shift, in metres, and rotation, in degrees, up to which hidden faults are not reported. With three arrays and sounds
in all parts of a room, larger faults become visible."""

SURELY: Final = 1.3
"""Number of standard deviations by which a fault must exceed the least reported size, so that it is reported nine times
out of ten."""

_SAME_DEG: Final = 15.0
_SAME_RATIO: Final = 1.1
"""Angle between two directions, in degrees, and ratio of two sizes, below which both count as equal."""

_LEAST_SEEN: Final = 1e-12
"""Least growth of the deviance per square metre or degree, so that a fault without any effect gets a finite size."""


def blind_spots(
    microphones: Microphones, delays: Delays, bounds_m: FloatArray, c_m_s: float, known: Known
) -> tuple[BlindSpot, ...]:
    """Return the faults that sounds at unknown places hide: a reflection of the room, and shifts and rotations.

    Parameters
    ----------
    microphones : mapping of array to (K, 3) float64
        Positions of the microphones as filed, metres.
    delays : mapping of array to (S, K) float64
        Delays of the same S sounds at each array, seconds; NaN if an array did not receive a sound.
    bounds_m : (3, 2) float64
        Search volume, metres.
    c_m_s : float
        Speed of sound as filed, m/s.
    known : Known
        Uncertainty of the set-up and of the delays.

    Returns
    -------
    tuple of BlindSpot
        The reflection (`livessl.core.commission.mirror`), then the shifts larger than `MOST_HIDDEN_M` and the rotations
        larger than `MOST_HIDDEN_DEG`. Empty with fewer than two arrays or three sounds, from which poses cannot be
        judged.
    """
    if len(delays) < 2 or len(next(iter(delays.values()))) < LEAST_SOUNDS:
        return ()
    rows, microphones = most_telling(delays), {name: microphones[name] for name in delays}
    delays, known = of_sounds(delays, rows), known.of_sounds(rows)
    places_m = PlaceSearch(bounds_m, c_m_s).fit(microphones, delays).positions_m
    set_up = SetUp(microphones, delays, c_m_s, known.freedom, stds_s=known.stds_s)
    fit = Fit([set_up], places_m[None], bounds_m)
    fit.run()
    [seen] = fit.seen()
    found: dict[str, list[BlindSpot]] = {"moved": [], "turned": []}
    for name in microphones:
        own, pose = known.freedom[name], fit.pose_of(name)
        for fault, columns, std in (
            ("moved", pose[:3], np.full(3, own.position_m)),
            ("turned", pose[3:], own.orientation_deg),
        ):
            found[fault].append(_weakest(fault, name, seen[np.ix_(columns, columns)] / np.outer(std, std), len(delays)))
    most = {"moved": MOST_HIDDEN_M, "turned": MOST_HIDDEN_DEG}
    hidden = {fault: [one for one in spots if one.least > most[fault]] for fault, spots in found.items()}
    reflection = mirrored(microphones, places_m, bounds_m)
    of_poses = [spot for spots in hidden.values() for spot in _joined(spots)]
    return (*(() if reflection is None else (reflection,)), *of_poses)


def _weakest(fault: str, array: str, seen: FloatArray, arrays: int) -> BlindSpot:
    """Return the direction in which a fault has the least effect, and the size from which it is reported there.

    `seen` (3, 3) is the growth of the deviance per square metre or square degree.
    """
    needed = np.sqrt(COSTS[fault] + least_gain(arrays)) + SURELY
    values, vectors = np.linalg.eigh(seen)
    weakest = vectors[:, 0]
    along = weakest * np.sign(weakest[np.abs(weakest).argmax()])
    least = float(needed / np.sqrt(max(values[0], _LEAST_SEEN)))
    return BlindSpot(fault, (array,), least, tuple(float(one) for one in along))


def _joined(spots: Sequence[BlindSpot]) -> Iterator[BlindSpot]:
    """Yield the blind spots of one fault; arrays with the same direction and size share one."""
    rest = list(spots)
    while rest:
        first = rest[0]
        same = [one for one in rest if _is_same(one, first)]
        yield replace(first, arrays=tuple(name for one in same for name in one.arrays))
        rest = [one for one in rest if one not in same]


def _is_same(one: BlindSpot, other: BlindSpot) -> bool:
    angle_deg = np.degrees(np.arccos(min(1.0, abs(float(np.dot(one.along, other.along))))))
    return bool(angle_deg < _SAME_DEG and max(one.least, other.least) < _SAME_RATIO * min(one.least, other.least))
