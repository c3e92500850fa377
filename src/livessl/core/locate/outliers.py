"""Finds the position that most arrays agree on (consensus), and excludes arrays that disagree as outliers.

It words "arrays disagree"; `core/stream/outlier_votes.py` decides from past events which arrays are suspect.

The map of each array has its own highest place. At the common position, an array that agrees loses almost nothing of
its peak-to-RMS ratio. An array that is turned or moved, or records something else, loses nearly all of its ratio there,
or makes the others lose theirs. Errors that every set-up has are no disagreement: delays may be off by as much as
`livessl.core.types.Uncertainty` allows.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Final

import numpy as np

from livessl.core.geometry import Grid, angle_deg, pair_weight
from livessl.core.locate.confidence import AGREED, LEAST_CONFIDENCE, NEAR_M, Judgement, array_power, peak_to_rms
from livessl.core.locate.peak_search import PeakSearch
from livessl.core.locate.place import Place
from livessl.core.locate.srp import PairTerms
from livessl.core.types import ArraySpec, Evidence, FloatArray, IntArray, Uncertainty

MAX_LOSS: Final = 0.8
"""Summed loss of peak-to-RMS ratio above which arrays count as disagreeing. An array is an outlier if the loss without
it is smaller by more than this value."""

MAX_UNRESOLVED_LOSS: Final = 1.5
"""Summed loss of peak-to-RMS ratio above which a position is refused if no outlier can be named. It is higher than
`MAX_LOSS`, because good arrays can also lose that much in noise and long reverberation."""

MAX_SUSPECT_LOSS: Final = 0.6
"""Further loss of peak-to-RMS ratio up to which a suspect array is used again."""

MIN_LEAD: Final = 0.05
"""Difference in loss of peak-to-RMS ratio by which one outlier must explain the disagreement better than another one
that would lead to a different position. With a smaller difference both explanations are equally good, because two
directions can also meet at a wrong position."""

DEVIATIONS: Final = 2.0
"""Number of standard deviations of a delay up to which arrays do not disagree."""

MAX_SHARE: Final = 0.15
"""Largest error of a delay that is allowed, as a share of the array's largest delay: 9 degrees broadside. An array with
less exact delays would agree with any position."""

KELVIN: Final = 293.0
"""Usual temperature, in kelvin; the relative change of the speed of sound is half that of the temperature."""

MAX_CANDIDATES: Final = 3
"""Largest number of arrays that are tried as outliers in one round, those with the largest loss first; each takes one
search."""


@dataclass(frozen=True, slots=True)
class Consensus:
    """A place, and the arrays that do not agree on it.

    Parameters
    ----------
    place : Place
    outliers : mapping of str to float
        Excluded arrays; for each, the angle in degrees between the direction it measured and the direction to the
        place.
    refused : str or None
        Reason, in words, not to rely on the place; None if it can be relied on.
    disagreement : float
        Greater one of the peak-to-RMS ratios that two arrays lose at the place; 0 for any other number.
    """

    place: Place
    outliers: Mapping[str, float] = field(default_factory=dict)
    refused: str | None = None
    disagreement: float = 0.0

    def judgement(self, grid: Grid, *, whole: bool = False) -> Judgement:
        """Judge the place, and lower its confidence as far as two arrays disagree about it."""
        judgement = self.place.judgement(grid, whole=whole)
        features = replace(judgement.features, disagreement=self.disagreement)
        confidence = features.confidence_of_candidates if judgement.candidates else features.confidence
        refused = judgement.refused
        if refused is None and confidence < LEAST_CONFIDENCE:
            refused = _refusal(self.place.evidence)
        return replace(judgement, features=features, refused=refused)


def consensus(
    evidence: Sequence[Evidence],
    suspect: Collection[str],
    search: PeakSearch,
    grid: Grid,
    c_m_s: float,
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
    c_m_s : float
        Speed of sound, m/s.
    locate : callable
        Returns the place of the evidence of some arrays.
    """
    own = _OwnPeaks(search, grid, c_m_s)
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
            losses = [sum(own.loss(without, exact=True).values()) for without in places]
            best = int(np.argmin(losses))  # by exact delays: with some latitude several may explain it as well
            if sum(loss.values()) - sum(own.loss(places[best]).values()) <= MAX_LOSS:
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
    off_deg = {part.spec.name: own.angle_deg(part, place.position_m) for part in outliers}
    return Consensus(place, off_deg, disagreement=own.disagreement(place))


def _by_trust(evidence: Sequence[Evidence], suspect: Collection[str]) -> tuple[list[Evidence], list[Evidence]]:
    """Split off the evidence of suspect arrays, unless half of the arrays or more are suspect."""
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
    """Return whether excluding another candidate is about as good as excluding the best one, but changes the place."""
    return any(
        place.apart_m(places[best]) > NEAR_M
        for place, loss in zip(places, losses, strict=True)
        if loss - losses[best] < MIN_LEAD
    )


class _OwnPeaks:
    """The highest place of each array alone, which is searched for when it is first needed."""

    def __init__(self, search: PeakSearch, grid: Grid, c_m_s: float) -> None:
        self._search = search
        self._grid = grid
        self._c_m_s = c_m_s
        self._highest: dict[str, tuple[float, FloatArray]] = {}

    def loss(self, place: Place, *, exact: bool = False) -> dict[str, float]:
        """Return the peak-to-RMS ratio that each array loses at `place`, compared with its own highest place.

        Delays may be off by what the set-up allows, unless they are `exact`.

        If the sum may exceed `MAX_LOSS`, the larger losses are exact. All others are upper bounds, which require no
        search.
        """
        terms = place.functional.pair_terms(place.position_m)
        here = {
            part.spec.name: peak_to_rms(part, array_power(part, term) if exact else self._power(part, term, place))
            for part, term in zip(place.evidence, terms, strict=True)
        }
        loss = {part.spec.name: max(0.0, _upper_bound(part) - here[part.spec.name]) for part in place.evidence}
        if sum(sorted(loss.values())[-MAX_CANDIDATES:]) > MAX_LOSS:
            for part in place.evidence:
                name = part.spec.name
                if loss[name] > MAX_LOSS / MAX_CANDIDATES:
                    loss[name] = max(0.0, peak_to_rms(part, self._at(part)[0]) - here[name])
        return loss

    def disagreement(self, place: Place) -> float:
        """Greater one of the peak-to-RMS ratios that two arrays lose at `place`; 0 for any other number of arrays.

        Delays count as exact unless an array's set-up is described as less certain than usual. Up to `AGREED` it may be
        an upper bound, which needs no search.
        """
        if len(place.evidence) != 2:
            return 0.0
        greatest = 0.0
        terms = place.functional.pair_terms(place.position_m)
        for part, term in zip(place.evidence, terms, strict=True):
            power = array_power(part, term) if _is_usual(part.spec.uncertainty) else self._power(part, term, place)
            here = peak_to_rms(part, power)
            lost = _upper_bound(part) - here
            greatest = max(greatest, lost if lost <= AGREED else peak_to_rms(part, self._at(part)[0]) - here)
        return greatest

    def _power(self, evidence: Evidence, term: PairTerms, place: Place) -> float:
        """Return the greatest SRP of an array at a place if each delay may have the error that the set-up allows."""
        values, lags_s = evidence.gcc.values, evidence.gcc.lags_s
        distance_m = float(np.linalg.norm(place.position_m - evidence.spec.centre_m))
        off_s = allowed_s(evidence.spec, evidence.gcc.pairs, term.lags_s, distance_m, self._c_m_s)
        first = np.searchsorted(lags_s, term.lags_s - off_s)
        last = np.maximum(np.searchsorted(lags_s, term.lags_s + off_s, side="right"), first + 1)
        highest = sum(float(row[a:b].max(initial=0.0)) for row, a, b in zip(values, first, last, strict=True))
        return max(array_power(evidence, term), pair_weight(len(evidence.spec.microphones_m)) * highest)

    def angle_deg(self, evidence: Evidence, position_m: FloatArray) -> float:
        """Return the angle, in degrees, at an array between its own highest place and a position."""
        centre_m = evidence.spec.centre_m
        return angle_deg(self._at(evidence)[1] - centre_m, position_m - centre_m)

    def _at(self, evidence: Evidence) -> tuple[float, FloatArray]:
        name = evidence.spec.name
        if name not in self._highest:
            (peak,) = self._search.among([evidence])(1)
            self._highest[name] = (peak.power, self._grid.point_m(peak.point))
        return self._highest[name]


def allowed_s(spec: ArraySpec, pairs: IntArray, delays_s: FloatArray, distance_m: float, c_m_s: float) -> FloatArray:
    """Return the greatest error (P,), in seconds, that delays (P,) may have if the set-up is right.

    Parameters
    ----------
    spec : ArraySpec
    pairs : (P, 2) int64
    delays_s : (P,) float64
        Delays of a source, seconds.
    distance_m : float
        Distance of the source from the array, metres.
    c_m_s : float
        Speed of sound, m/s.
    """
    known = spec.uncertainty
    apart = spec.microphones_m[pairs]
    apart_s = np.linalg.norm(apart[:, 1] - apart[:, 0], axis=1) / c_m_s
    turned = np.hypot(np.radians(known.orientation_deg), known.position_m / max(distance_m, spec.aperture_m))
    warmer = 0.5 * known.temperature_c / KELVIN
    deviation_s = np.sqrt(known.clock_s**2 + (apart_s * turned) ** 2 + (delays_s * warmer) ** 2)
    return np.asarray(np.minimum(DEVIATIONS * deviation_s, MAX_SHARE * spec.aperture_m / c_m_s))


def _is_usual(known: Uncertainty) -> bool:
    """Return whether a set-up is known at least as well as usual."""
    usual = Uncertainty()
    return all(getattr(known, each.name) <= getattr(usual, each.name) for each in fields(usual))


def _upper_bound(evidence: Evidence) -> float:
    """Return the highest possible peak-to-RMS ratio: that of all of an array's pairs at their highest lag."""
    highest = evidence.gcc.values.max(axis=1).sum(dtype=np.float64)
    return peak_to_rms(evidence, pair_weight(len(evidence.spec.microphones_m)) * float(highest))


def _refusal(evidence: Sequence[Evidence]) -> str:
    names = " and ".join(repr(part.spec.name) for part in evidence) if len(evidence) == 2 else "the arrays"
    return (
        f"{names} point to different places, and it is unknown which is wrong; check their poses in the site file "
        "(arrays.NAME.position_m and orientation_deg), and the order and polarity of their channels"
    )
