"""Finds the position that most arrays agree on, and the arrays that are outliers. It sees correlations and no sound.

Each array's map has a highest place of its own. At the common position an array that agrees loses next to nothing of
its peak-to-RMS ratio. An array that is turned or moved, or records something else, loses nearly all of it there, or
makes the others lose theirs.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from livessl.core.geometry import Grid, angle_deg
from livessl.core.locate.confidence import NEAR_M, array_power, peak_to_rms
from livessl.core.locate.peak_search import PeakSearch
from livessl.core.locate.place import Place
from livessl.core.locate.srp import pair_weight
from livessl.core.types import Evidence, FloatArray

MAX_LOSS: Final = 0.8
"""Summed loss of peak-to-RMS ratio above which arrays are taken to disagree. An array is an outlier if the loss without
it is smaller by more than this."""

MAX_UNRESOLVED_LOSS: Final = 1.5
"""Summed loss of peak-to-RMS ratio above which a position is refused where no outlier can be named. It lies above
`MAX_LOSS` because arrays that are all right lose that much too in noise and long reverberation."""

MAX_SUSPECT_LOSS: Final = 0.6
"""Further loss of peak-to-RMS ratio up to which a suspect array is used again."""

MIN_LEAD: Final = 0.05
"""Loss of peak-to-RMS ratio by which one outlier must explain the disagreement better than another that would lead
elsewhere. Within it both explanations are as good: two directions may meet in a false position as well as in the right
one."""

MAX_CANDIDATES: Final = 3
"""Most arrays that are tried as outliers in one round, those that lose most first: each costs a search."""


@dataclass(frozen=True, slots=True)
class Consensus:
    """A place, and the arrays that do not agree on it.

    Parameters
    ----------
    place : Place
    outliers : mapping of str to float
        Arrays that were left out of the place, and the angle in degrees between each one's own direction and the place.
    refused : str or None
        Why the place should not be relied on, in words; None if it may be.
    """

    place: Place
    outliers: Mapping[str, float] = field(default_factory=dict)
    refused: str | None = None


def consensus(
    evidence: Sequence[Evidence],
    suspect: Collection[str],
    search: PeakSearch,
    grid: Grid,
    locate: Callable[[Sequence[Evidence]], Place],
) -> Consensus:
    """Find the place that most arrays agree on.

    While arrays disagree, each candidate is left out in turn, and the one without which the others lose least becomes
    an outlier. More than half of all arrays always remain. Suspect arrays are tried last, as long as the others are
    more than half of all.

    Parameters
    ----------
    evidence : sequence of Evidence
        Evidence of all arrays.
    suspect : collection of str
        Arrays that were outliers in many of the last events.
    search : PeakSearch
    grid : Grid
        Grid of the search.
    locate : callable
        Returns the place of the evidence of some arrays.
    """
    own = _OwnPeaks(search, grid)
    trusted, last = _by_trust(evidence, suspect)
    outliers: list[Evidence] = []
    place = locate(trusted)
    while len(evidence) > 1:
        loss = own.loss(place)
        candidates = sorted(place.evidence, key=lambda part: -loss[part.spec.name])[:MAX_CANDIDATES]
        disagreement = sum(loss[part.spec.name] for part in candidates)
        if disagreement <= MAX_LOSS:
            break
        if 2 * (len(place.evidence) - 1) > len(evidence):
            places = [locate([part for part in place.evidence if part is not one]) for one in candidates]
            losses = [sum(own.loss(without).values()) for without in places]
            best = int(np.argmin(losses))
            if sum(loss.values()) - losses[best] <= MAX_LOSS:
                break
            if not _is_ambiguous(places, losses, best):
                outliers.append(candidates[best])
                place = places[best]
                continue
        if disagreement > MAX_UNRESOLVED_LOSS:
            return Consensus(place, refused=_refusal(evidence))
        break
    place, disagreeing = _with_suspects(place, last, own, locate)
    outliers += disagreeing
    return Consensus(place, {part.spec.name: own.angle_deg(part, place.position_m) for part in outliers})


def _by_trust(evidence: Sequence[Evidence], suspect: Collection[str]) -> tuple[list[Evidence], list[Evidence]]:
    """Split off the evidence of suspect arrays, unless that is half of all or more."""
    trusted = [part for part in evidence if part.spec.name not in suspect]
    if 2 * len(trusted) <= len(evidence):
        return list(evidence), []
    return trusted, [part for part in evidence if part.spec.name in suspect]


def _with_suspects(
    place: Place, suspect: Sequence[Evidence], own: _OwnPeaks, locate: Callable[[Sequence[Evidence]], Place]
) -> tuple[Place, list[Evidence]]:
    """Add the evidence of suspect arrays that agree with a place; return the new place and those that disagree."""
    disagreeing = []
    for part in suspect:
        together = locate([*place.evidence, part])
        if sum(own.loss(together).values()) - sum(own.loss(place).values()) > MAX_SUSPECT_LOSS:
            disagreeing.append(part)
        else:
            place = together
    return place, disagreeing


def _is_ambiguous(places: Sequence[Place], losses: Sequence[float], best: int) -> bool:
    """Whether leaving out another candidate is about as good as the best one and leads elsewhere."""
    return any(
        place.apart_m(places[best]) > NEAR_M
        for place, loss in zip(places, losses, strict=True)
        if loss - losses[best] < MIN_LEAD
    )


class _OwnPeaks:
    """Each array's own highest place; every one is searched for when it is first needed."""

    def __init__(self, search: PeakSearch, grid: Grid) -> None:
        self._search = search
        self._grid = grid
        self._highest: dict[str, tuple[float, FloatArray]] = {}

    def loss(self, place: Place) -> dict[str, float]:
        """Peak-to-RMS ratio that each array loses at `place` against its own highest place.

        Where the sum may exceed `MAX_LOSS` the larger losses are exact; all others are upper bounds, which need no
        search.
        """
        terms = place.functional.pair_terms(place.position_m)
        here = {
            part.spec.name: peak_to_rms(part, array_power(part, term))
            for part, term in zip(place.evidence, terms, strict=True)
        }
        loss = {part.spec.name: max(0.0, _upper_bound(part) - here[part.spec.name]) for part in place.evidence}
        if sum(sorted(loss.values())[-MAX_CANDIDATES:]) > MAX_LOSS:
            for part in place.evidence:
                name = part.spec.name
                if loss[name] > MAX_LOSS / MAX_CANDIDATES:
                    loss[name] = max(0.0, peak_to_rms(part, self._at(part)[0]) - here[name])
        return loss

    def angle_deg(self, evidence: Evidence, position_m: FloatArray) -> float:
        """Angle at an array between its own highest place and a position, in degrees."""
        centre_m = evidence.spec.centre_m
        return angle_deg(self._at(evidence)[1] - centre_m, position_m - centre_m)

    def _at(self, evidence: Evidence) -> tuple[float, FloatArray]:
        name = evidence.spec.name
        if name not in self._highest:
            (peak,) = self._search.among([evidence])(1)
            self._highest[name] = (peak.power, self._grid.point_m(peak.point))
        return self._highest[name]


def _upper_bound(evidence: Evidence) -> float:
    """Peak-to-RMS ratio that no place exceeds: that of all of an array's pairs at their highest lag."""
    highest = evidence.gcc.values.max(axis=1).sum(dtype=np.float64)
    return peak_to_rms(evidence, pair_weight(len(evidence.spec.microphones_m)) * float(highest))


def _refusal(evidence: Sequence[Evidence]) -> str:
    names = " and ".join(repr(part.spec.name) for part in evidence) if len(evidence) == 2 else "the arrays"
    return (
        f"{names} point to different places, and it is unknown which is wrong; check their poses in the site file "
        "(arrays.NAME.position_m and orientation_deg), and the order and polarity of their channels"
    )
