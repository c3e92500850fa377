"""How well several sources, and tracks of them, were found: OSPA, and the measures of the LOCATA challenge.

OSPA: Schuhmacher, Vo and Vo, IEEE Trans. Signal Process. 56(8), 2008. LOCATA: Evers et al., IEEE/ACM Trans. Audio
Speech Lang. Process. 28, 2020; there of directions, here of places.
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
"""What is further off counts as missed, and as false."""

HOLD_S: Final = 0.5
"""A track's place is known between two of its states at most so far apart."""


def assigned(truth_m: FloatArray, found_m: FloatArray, cut_off_m: float = CUT_OFF_M) -> FloatArray:
    """Distance of what was found for each source, infinite where nothing was.

    Each thing found is for one source at most; the sum of distances, none counted above the cut-off, is least.

    Parameters
    ----------
    truth_m : (N, 3) float64
    found_m : (M, 3) float64
    cut_off_m : float

    Returns
    -------
    (N,) float64
        In metres.
    """
    distance_m = np.linalg.norm(truth_m[:, None] - found_m[None], axis=2)
    rows, columns = linear_sum_assignment(np.minimum(distance_m, cut_off_m))
    errors_m = np.full(len(truth_m), np.inf)
    errors_m[rows] = distance_m[rows, columns]
    return errors_m


def ospa_m(truth_m: FloatArray, found_m: FloatArray, cut_off_m: float = CUT_OFF_M) -> float:
    """Optimal sub-pattern assignment of order 1: mean error of the larger set, what has no match counting the cut-off.

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
    """How one source was tracked.

    Parameters
    ----------
    rmse_m : float
        Of the track that is with it; NaN where none ever was.
    detected : float
        Share of the time in which one was (LOCATA's probability of detection).
    ids : int
        How many tracks were with it at some time.
    swaps, breaks : int
        How often another track took over, and how often it was lost and found again.
    false_per_s : float
        Tracks that are with no source, at a mean moment, over a second: what LOCATA calls the false alarm rate, here
        at one estimate a track and moment.
    latency_s : float
        From the beginning to the first moment with a track; NaN where there was none.
    ospa_m : float
        Mean over time.
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
    """Hold tracks against where a source was.

    A track that was with the source stays with it while it is within the cut-off; else the nearest takes over.

    Parameters
    ----------
    times_s : (T,) float64
        When the source sounded, ascending.
    truth_m : (T, 3) float64
        Where it was then.
    tracks : mapping of id to ((S,), (S, 3)) float64
        Times and places of each track's states, ascending in time.
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
    """Where a track was at some times: (T, 3); NaN where its states do not tell."""
    after = np.searchsorted(times_s, at_s, side="left")
    inside = (after > 0) & (after < len(times_s))
    gap_s = np.full(len(at_s), np.inf)
    gap_s[inside] = times_s[after[inside]] - times_s[after[inside] - 1]
    at_state = (after < len(times_s)) & (times_s[np.minimum(after, len(times_s) - 1)] == at_s)
    known = at_state | (gap_s <= HOLD_S)
    interpolated = np.stack([np.interp(at_s, times_s, axis) for axis in places_m.T], axis=1)
    return np.where(known[:, None], interpolated, np.nan)
