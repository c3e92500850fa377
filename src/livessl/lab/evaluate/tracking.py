"""Measures of localization and tracking of several sources: OSPA, and those of the LOCATA challenge.

OSPA: Schuhmacher, Vo and Vo, IEEE Trans. Signal Process. 56(8), 2008. LOCATA: Evers et al., IEEE/ACM Trans. Audio
Speech Lang. Process. 28, 2020; the challenge measures directions, this module positions.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from scipy.optimize import linear_sum_assignment

from livessl.core.types import FloatArray

CUT_OFF_M: Final = 1.0
"""Distance, in metres, from which an estimate counts as false and its source as missed."""

HOLD_S: Final = 0.5
"""Longest time, in seconds, between two states of a track over which its position is interpolated."""


def assigned(truth_m: FloatArray, found_m: FloatArray, cut_off_m: float = CUT_OFF_M) -> FloatArray:
    """Assign estimates to sources, and return each source's distance to its estimate, infinite without one.

    Each estimate belongs to one source at most. The assignment minimizes the sum of distances, each counted up to the
    cut-off.

    Parameters
    ----------
    truth_m : (N, 3) float64
    found_m : (M, 3) float64
    cut_off_m : float

    Returns
    -------
    (N,) float64
        Distances in metres.
    """
    distance_m = np.linalg.norm(truth_m[:, None] - found_m[None], axis=2)
    rows, columns = linear_sum_assignment(np.minimum(distance_m, cut_off_m))
    errors_m = np.full(len(truth_m), np.inf)
    errors_m[rows] = distance_m[rows, columns]
    return errors_m


def ospa_m(truth_m: FloatArray, found_m: FloatArray, cut_off_m: float = CUT_OFF_M) -> float:
    """Return the optimal sub-pattern assignment metric (OSPA) of order 1, in metres.

    It is the mean error over the larger set; an element without a match counts as the cut-off.

    Parameters
    ----------
    truth_m : (N, 3) float64
    found_m : (M, 3) float64
    cut_off_m : float
    """
    larger = max(len(truth_m), len(found_m))
    if larger == 0:
        return 0.0
    errors_m = np.minimum(assigned(truth_m, found_m, cut_off_m), cut_off_m)  # infinite: no match
    return float((errors_m.sum() + cut_off_m * max(0, len(found_m) - len(truth_m))) / larger)


@dataclass(frozen=True, slots=True)
class TrackScore:
    """Measures of the tracking of one source.

    Parameters
    ----------
    rmse_m : float
        Root mean square error of the source's track; NaN if it never had one.
    detected : float
        Share of the time in which the source has a track (LOCATA's probability of detection).
    ids : int
        Number of tracks that the source had at some time.
    swaps, breaks : int
        Number of times that another track took over, and that the source lost its track and got one again.
    false_per_s : float
        Mean number of tracks without a source, over time; LOCATA calls it the false alarm rate.
    latency_s : float
        Time from the beginning to the first moment with a track; NaN if there was none.
    ospa_m : float
        Mean of the OSPA over time.
    """

    rmse_m: float
    detected: float
    ids: int
    swaps: int
    breaks: int
    false_per_s: float
    latency_s: float
    ospa_m: float


def score(times_s: FloatArray, truth_m: FloatArray, tracks: Mapping[int, tuple[FloatArray, FloatArray]]) -> TrackScore:
    """Compare tracks with the true positions of a source.

    The source keeps its track while that is within the cut-off; otherwise the nearest track takes over.

    Parameters
    ----------
    times_s : (T,) float64
        Times at which the source sounded, ascending.
    truth_m : (T, 3) float64
        Its positions at these times.
    tracks : mapping of id to ((S,), (S, 3)) float64
        Times and positions of each track's states, ascending in time.
    """
    places_m = {number: _places_m(times_s, *states) for number, states in tracks.items()}
    errors_m, with_it, ospas_m = [], [], []
    false, current = 0, None
    for index, place_m in enumerate(truth_m):
        there = {number: places[index] for number, places in places_m.items() if np.isfinite(places[index, 0])}
        off_m = {number: float(np.linalg.norm(found - place_m)) for number, found in there.items()}
        if current is None or off_m.get(current, np.inf) > CUT_OFF_M:
            current = min(off_m, key=lambda number: off_m[number], default=None)
            if current is not None and off_m[current] > CUT_OFF_M:
                current = None
        with_it.append(current)
        false += len(there) - (current is not None)
        if current is not None:
            errors_m.append(off_m[current])
        found_m = np.array(list(there.values())).reshape(-1, 3)
        ospas_m.append(ospa_m(place_m[None], found_m))
    known = [number for number in with_it if number is not None]
    found_at = [index for index, number in enumerate(with_it) if number is not None]
    return TrackScore(
        rmse_m=float(np.sqrt(np.mean(np.square(errors_m)))) if errors_m else float("nan"),
        detected=len(known) / len(with_it),
        ids=len(set(known)),
        swaps=sum(one != other for one, other in pairwise(known)),
        breaks=sum(later - earlier > 1 for earlier, later in pairwise(found_at)),
        false_per_s=false / len(times_s),
        latency_s=float(times_s[found_at[0]] - times_s[0]) if found_at else float("nan"),
        ospa_m=float(np.mean(ospas_m)),
    )


def _places_m(at_s: FloatArray, times_s: FloatArray, places_m: FloatArray) -> FloatArray:
    """Interpolate a track's positions at given times: (T, 3); NaN where its states are too far apart."""
    after = np.searchsorted(times_s, at_s, side="left")
    inside = (after > 0) & (after < len(times_s))
    gap_s = np.full(len(at_s), np.inf)
    gap_s[inside] = times_s[after[inside]] - times_s[after[inside] - 1]
    at_state = (after < len(times_s)) & (times_s[np.minimum(after, len(times_s) - 1)] == at_s)
    known = at_state | (gap_s <= HOLD_S)
    interpolated = np.stack([np.interp(at_s, times_s, axis) for axis in places_m.T], axis=1)
    return np.where(known[:, None], interpolated, np.nan)
