"""Decides whether a second source sounds at the same time and where, after the first one's part is removed.

The remainder (`livessl.core.locate.frame_gccs`) comes from a second source, from reverberation of the first source, or
from noise that was there before. A second source is the highest place of the remainder, and stands out from
reverberation and noise in some frame at more than half of the arrays.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from livessl.core.correlate.band import uses_envelope
from livessl.core.geometry import Grid
from livessl.core.locate import refine
from livessl.core.locate.confidence import AGREED, LEAST_CONFIDENCE, NEAR_M, Judgement, array_power
from livessl.core.locate.estimator import Localization, Sound, strongest_onsets
from livessl.core.locate.frame_gccs import FrameGCCs, Remainder
from livessl.core.locate.outliers import Consensus
from livessl.core.locate.outside import highest_power
from livessl.core.locate.peak_search import PeakSearch
from livessl.core.locate.place import Place
from livessl.core.locate.srp import SRPFunctional
from livessl.core.types import Evidence, FloatArray

APART_M: Final = 1.0
"""Distance, in metres, below which two places count as one source."""

MOST_ARRAYS_SEPARATED: Final = 8
"""Largest number of arrays used to separate two sources; the time is proportional to their number."""

CANDIDATES: Final = 6
"""Number of places examined for each source; the right one is hardly ever lower in the order."""

CANDIDATES_APART_M: Final = 0.5
"""Least distance between candidates along one of the axes, in metres."""

LEAST_PROSPECT: Final = 0.1
"""Confidence of the first estimate below which a second source is not examined further."""

CLEAR: Final = 1.0
"""Prominence of the second source in a frame from which the power of the frame is divided between both sources. Below
it, the remainder may be reflections."""

LEAST_EXPLAINED: Final = 0.55
"""Share of the height of its pairs' GCCs that a second source explains at an array that clearly receives it."""

RECEIVED: Final = 0.4
"""The same, below which an array does not receive the second source. Arrays that disagree must all receive it: with two
channels of one exchanged, each array alone receives one of two places."""

AS_WELL: Final = 0.85
"""Power of an array near the first source, as a share of that at the second, from which on the array alone cannot tell
which of both places it receives."""

UNEXPLAINED: Final = 0.05
"""Share of the height of the pairs' GCCs that a source may leave unexplained, because the lag axis is sampled."""

_FIT: Final = (-10.16, 4.06, 1.91, 6.71, 0.97)
"""Log-odds of a second source at a place: intercept and the weights of `SecondSourceFeatures.terms`. Fitted by
`benchmarks/second_source.py` to sounds of the development half in simulated rooms."""


@dataclass(frozen=True, slots=True)
class SecondSourceFeatures:
    """The measurements from which the confidence of a second source is computed.

    Parameters
    ----------
    above_all, above_noise : float
        Greatest prominence in a frame, above reflections and noise and above noise alone
        (`livessl.core.locate.frame_gccs.Remainder.prominences`); mean over the arrays. In the frames of a real second
        source the first source is weak, and both values are nearly equal. Reflections occur together with the first
        source.
    margin : float
        1 - (power at the best other place) / (power at the place), in the evidence of the second source.
    explained : float
        Height of the pairs' GCCs at the place, relative to the highest value that each of them has anywhere; mean over
        the arrays. All pairs of all arrays receive a source; only some receive reflections that meet at a place.
    """

    above_all: float
    above_noise: float
    margin: float
    explained: float

    @property
    def terms(self) -> FloatArray:
        """Terms of the log-odds without the intercept, (4,). Each halving of the unexplained share adds the same."""
        unexplained = max(0.0, 1.0 - self.explained) + UNEXPLAINED
        return np.array([self.above_all, self.above_noise, self.margin, -np.log(unexplained)])

    @property
    def confidence(self) -> float:
        """Probability that there is a second source at the place."""
        log_odds = _FIT[0] + float(self.terms @ np.array(_FIT[1:]))
        return float(1.0 / (1.0 + np.exp(-log_odds)))


def majority(of_arrays: Sequence[float]) -> float:
    """Return the mean of the greatest prominences, those of just more than half of the arrays."""
    return float(np.mean(sorted(of_arrays)[-(len(of_arrays) // 2 + 1) :]))


@dataclass(frozen=True, slots=True)
class TwoSources:
    """Two places at which sources may have sounded at the same time, and the features of the second source."""

    first: Place
    second: Place
    features: SecondSourceFeatures

    @property
    def is_received_everywhere(self) -> bool:
        """True if every array has a peak at both places, and receives the second source."""
        return self.stand_out_everywhere and min(_explained(self.second)) >= RECEIVED

    @property
    def stand_out_everywhere(self) -> bool:
        """True if every array has a peak at both places."""
        return self.first.stands_out_everywhere and self.second.stands_out_everywhere


@dataclass(frozen=True, slots=True)
class Separation:
    """The answers for two sources that sounded at the same time. The first one is published as the main source.

    Parameters
    ----------
    first : Place
    judgement : Judgement
        Judgement of the first place.
    power : float or None
        Highest in-band frame power attributed to the first source, full scale squared; None if it is unknown.
    second : Localization
    """

    first: Place
    judgement: Judgement
    power: float | None
    second: Localization


class SecondSourceSearch:
    """Searches for a second source beside a known one.

    Parameters
    ----------
    search : PeakSearch
    grid : Grid
        Grid of the search.
    c_m_s : float
        Speed of sound, m/s.
    """

    def __init__(self, search: PeakSearch, grid: Grid, c_m_s: float) -> None:
        self._search = search
        self._grid = grid
        self._c_m_s = c_m_s

    def separate(
        self,
        consensus: Consensus,
        evidence: tuple[Evidence, ...],
        sounds: Mapping[str, Sound],
        frames_of: Callable[[Evidence], FrameGCCs],
    ) -> Separation | None:
        """Separate two sources that sound at the same time; None if there is no second one.

        Arrays may disagree because they receive different sources best. The second source is therefore searched for in
        all evidence first, and then in the evidence of the arrays that agree. If all arrays have a peak at both places,
        no array is an outlier.

        Parameters
        ----------
        consensus : Consensus
            The consensus of `evidence`.
        evidence : tuple of Evidence
        sounds : mapping of str to Sound
            The sound of each array of the evidence.
        frames_of : callable
            Returns the frames of an array's evidence.
        """
        agreeing = consensus.place.evidence
        for tried in (evidence, agreeing) if consensus.outliers else (evidence,):
            used = _separable(tried, sounds)
            if not used:
                return None
            first = self._at_the_place(consensus.place, used)
            frames = [frames_of(part) for part in used]
            found = self.find(first, frames)
            disputed = consensus.refused is not None or len(tried) > len(agreeing)
            agreed = not disputed and consensus.disagreement <= AGREED
            if found is not None and (agreed or found.is_received_everywhere):
                return self._separation(consensus, found, frames, keeps_first=not disputed)
        return None

    def _at_the_place(self, place: Place, evidence: tuple[Evidence, ...]) -> Place:
        """Return a place with its power and its rival's power in the maps of arrays that did not find it."""
        if [part.spec.name for part in evidence] == [part.spec.name for part in place.evidence]:
            return place
        functional = SRPFunctional(evidence, self._c_m_s)
        power = float(functional.value(place.position_m[None])[0])
        rival_power = refine.rival_power(self._search.among(evidence), self._grid, place.position_m)
        return Place(evidence, functional, place.position_m, power, rival_power)

    def _separation(
        self, consensus: Consensus, found: TwoSources, frames: Sequence[FrameGCCs], *, keeps_first: bool
    ) -> Separation:
        """Judge both places. With `keeps_first` the consensus remains the first place if it has the higher confidence.

        Equalising the frames makes a short first source weaker.
        """
        places = [found.first]
        if keeps_first and consensus.place.apart_m(found.second) >= APART_M:
            places.append(consensus.place)
        judged = [(place, place.judgement(self._grid)) for place in places]
        first, judgement = max(judged, key=lambda pair: pair[1].features.confidence)
        second, used = found.second.judgement(self._grid), {part.spec.name for part in found.second.evidence}
        powers = _powers(found.first, found.second, frames)
        return Separation(
            first,
            judgement,
            powers[0],
            Localization(
                found.second.position_m,
                second.covariance_m2,
                found.features.confidence,
                found.second.evidence,
                features=second.features,
                power=powers[1],
                outliers={name: off_deg for name, off_deg in consensus.outliers.items() if name not in used},
            ),
        )

    def find(self, first: Place, frames: Sequence[FrameGCCs]) -> TwoSources | None:
        """Find a second source; None if there is none.

        Parameters
        ----------
        first : Place
            The place of all evidence.
        frames : sequence of FrameGCCs
            Frames of the same arrays in the same order.
        """
        found = self.most_likely(first, frames)
        apart = found.first.apart_m(found.second) >= APART_M
        if not apart or found.features.confidence < LEAST_CONFIDENCE or self._may_be_beside(found):
            return None
        return found

    def _may_be_beside(self, found: TwoSources) -> bool:
        """Return whether what arrays receive of the second source may come from near the first one.

        That is so where half of the arrays or more hardly receive it, and the others alone as well from a place nearer
        than `APART_M` to the first: two sources near one another, which an array receives from one direction, and a
        place where its line of sight meets reflections at another array.
        """
        explained = _explained(found.second)
        if 2 * sum(share >= LEAST_EXPLAINED for share in explained) > len(explained):
            return False
        near_m = _ball_m(found.first.position_m, self._grid)
        terms = found.second.functional.pair_terms(found.second.position_m)
        return all(
            SRPFunctional([part], self._c_m_s).value(near_m).max() >= AS_WELL * array_power(part, term)
            for part, term, share in zip(found.second.evidence, terms, explained, strict=True)
            if share >= LEAST_EXPLAINED
        )

    def most_likely(self, first: Place, frames: Sequence[FrameGCCs]) -> TwoSources:
        """Return the most likely pair of places, whether or not there is a second source.

        The second source is searched for after the first is removed, then the first after the second is removed, and
        then the second again. If the first source would move to another place, both results of the first round remain.
        If the first estimate of the second source has a low confidence, it is not examined further.

        Parameters
        ----------
        first : Place
            The place of all evidence.
        frames : sequence of FrameGCCs
            Frames of the same arrays in the same order.
        """
        second, features = self.beside(first, frames)
        if features.confidence >= LEAST_PROSPECT:
            again, known = self.beside(second, frames)
            if again.apart_m(first) <= NEAR_M or known.confidence >= LEAST_CONFIDENCE:
                first = again
                second, features = self.beside(first, frames)
        return TwoSources(first, second, features)

    def beside(self, place: Place, frames: Sequence[FrameGCCs]) -> tuple[Place, SecondSourceFeatures]:
        """Return the most likely other place after the source at `place` is removed, and its features.

        Of the candidates with the highest power, the one with the highest product of power and prominence wins.
        """
        remainders = [each.without(taken_s) for each, taken_s in zip(frames, _delays_s(place), strict=True)]
        chosen = self._clearest(place, remainders)
        evidence = tuple(each.evidence_of(at_s) for each, at_s in zip(remainders, _delays_s(chosen), strict=True))
        chosen = self._highest(evidence)
        prominences = _prominences(remainders, chosen)
        above_all, above_noise = np.mean(prominences, axis=0)
        margin = refine.margin(chosen.power, chosen.rival_power)
        return chosen, SecondSourceFeatures(above_all, above_noise, margin, float(np.mean(_explained(chosen))))

    def _highest(self, evidence: tuple[Evidence, ...]) -> Place:
        """Search for the highest place of some evidence with one climb; it is not compared with other answers."""
        find, functional = self._search.among(evidence), SRPFunctional(evidence, self._c_m_s)
        position_m, power = refine.refine_peaks(functional, find(1), self._grid)
        return Place(evidence, functional, position_m, power, refine.rival_power(find, self._grid, position_m))

    def _clearest(self, place: Place, remainders: Sequence[Remainder]) -> Place:
        """Return the candidate with the highest product of power and prominence, among those with the highest power."""
        evidence = tuple(each.evidence() for each in remainders)
        find, functional = self._search.among(evidence), SRPFunctional(evidence, self._c_m_s)
        known = [refine.neighbourhood(place.position_m, self._grid)]
        apart_points = round(CANDIDATES_APART_M / self._grid.spacing_m)
        best, chosen = 0.0, place
        for _ in range(CANDIDATES):
            found = find(1, without=known)
            if not found:
                break
            position_m, power = refine.near_top(functional, found[0], self._grid)
            candidate = Place(evidence, functional, position_m, power, power)
            score = power * majority([above_all for above_all, _ in _prominences(remainders, candidate)])
            if score > best:
                best, chosen = score, candidate
            known.append(refine.box_around(self._grid, found[0].point, apart_points))
        return chosen


def _ball_m(centre_m: FloatArray, grid: Grid) -> FloatArray:
    """Return points of the search volume (N, 3), a grid's spacing apart and nearer than `APART_M` to a place."""
    steps = int(APART_M / grid.spacing_m)
    offsets_m = grid.spacing_m * np.arange(-steps, steps + 1)
    axes = [offsets_m if axis in grid.free_axes else np.zeros(1) for axis in range(3)]
    around_m = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    points_m = centre_m + around_m[np.linalg.norm(around_m, axis=1) < APART_M]
    low_m, high_m = np.array(grid.bounds_m).T
    return np.asarray(points_m[((points_m >= low_m) & (points_m <= high_m)).all(axis=1)])


def _explained(place: Place) -> list[float]:
    """Return the power of each array at a place relative to the highest possible power of its pairs."""
    terms = place.functional.pair_terms(place.position_m)
    each = zip(place.evidence, terms, strict=True)
    return [array_power(part, term) / max(highest_power([part]), 1e-9) for part, term in each]


def _prominences(remainders: Sequence[Remainder], place: Place) -> list[tuple[float, float]]:
    """Return each array's greatest prominence in a frame, above reflections and noise and above noise alone."""
    of_frames = [each.prominences(delays_s) for each, delays_s in zip(remainders, _delays_s(place), strict=True)]
    return [(float(above_all.max()), float(above_noise.max())) for above_all, above_noise in of_frames]


def _delays_s(place: Place) -> list[FloatArray]:
    """Return the delays of each array's pairs (P,) at a place, in seconds."""
    return [term.lags_s for term in place.functional.pair_terms(place.position_m)]


def _powers(first: Place, second: Place, frames: Sequence[FrameGCCs]) -> tuple[float | None, float | None]:
    """Return the highest frame power attributed to each source, full scale squared; None if it is unknown.

    In frames in which the second source is clear, the power is divided in proportion to the heights of both sources. In
    other frames all power belongs to the first source. If the second source is clear in no frame, the power of every
    frame is divided.
    """
    of_first, of_second, unclear = 0.0, 0.0, 0.0
    for each, first_s, second_s in zip(frames, _delays_s(first), _delays_s(second), strict=True):
        remainder = each.without(first_s)
        heights = np.maximum(remainder.heights(second_s)[0], 0.0)
        share = heights / np.maximum(heights + remainder.removed_heights, 1e-9)
        clear = np.where(remainder.prominences(second_s)[0] >= CLEAR, share, 0.0)
        of_sound = np.where(each.quiet, 0.0, each.powers)
        of_first = max(of_first, float((of_sound * (1.0 - clear)).max()))
        of_second = max(of_second, float((of_sound * clear).max()))
        unclear = max(unclear, float((of_sound * share).max()))
    return of_first or None, of_second or unclear or None


def _separable(evidence: Sequence[Evidence], sounds: Mapping[str, Sound]) -> tuple[Evidence, ...]:
    """Return the evidence with the strongest onsets for separating two sources; empty if they cannot be separated.

    Separation requires two arrays, `sources` > 1 and onsets. It does not work with envelopes, because the magnitudes of
    two sources do not add up.
    """
    strongest = strongest_onsets({part.spec.name: sounds[part.spec.name] for part in evidence}, MOST_ARRAYS_SEPARATED)
    used = tuple(part for part in evidence if part.spec.name in strongest)
    if len(used) < 2 or not all(sound.onsets and sound.sources > 1 for sound in strongest.values()):
        return ()
    return () if any(uses_envelope(part.spec.band_hz) for part in used) else used
