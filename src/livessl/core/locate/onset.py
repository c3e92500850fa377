"""The default method `onset`: SRP of onset GCCs, without outliers, with a second source and a probability.

`srp.py` sums the maps of the arrays, each with the weight 2/K. `contributing.py` decides which arrays contribute, and
`outliers.py` which are excluded.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from livessl.core.correlate.onset_gcc import OnsetFrontEnd
from livessl.core.geometry import Grid
from livessl.core.locate import ambiguity, outliers
from livessl.core.locate.confidence import (
    CROSSING_DEG,
    LEAST_CONFIDENCE,
    NEAR_M,
    Judgement,
)
from livessl.core.locate.contributing import NO_EVIDENCE, contributing
from livessl.core.locate.estimator import Localization, Sound, strongest_onsets
from livessl.core.locate.frame_gccs import FrameGCCs
from livessl.core.locate.map_estimator import MapEstimator, map_grid
from livessl.core.locate.onset_evidence import OnsetEvidence, without_background
from livessl.core.locate.outliers import Consensus
from livessl.core.locate.outside import Outside, find_outside
from livessl.core.locate.peak_search import PeakSearch
from livessl.core.locate.place import Place, highest_place
from livessl.core.locate.second_source import SecondSourceSearch
from livessl.core.locate.srp import SRPFunctional
from livessl.core.locate.tolerant import tolerant
from livessl.core.methods import ONSET
from livessl.core.types import ArraySpec, Evidence

SEARCH_SPACING_M: Final = 0.1
"""Coarsest spacing of the search grid, in metres. Within 0.1 m the phase of a 0.5 m array at 6 kHz changes by less than
half a period almost everywhere, so no peak is missed."""

MOST_ARRAYS: Final = 16
"""Most arrays from which a sound is located: those with the strongest onsets. Further arrays hardly move the position,
and without them the time for a result does not grow with the number of arrays."""

MOST_ARRAYS_REEXAMINED: Final = 8
"""Most arrays whose whole segments are correlated in a second look; the time grows with their number."""


BACKGROUND: Final = 0.05
"""Least share of the power at a position, beyond chance, that the background must have there to be subtracted. The
sound is then searched for in the remainder."""


BEGAN: Final = 0.8
"""Peak-to-RMS ratio of the beginning of a sound at a position, relative to that of the whole sound, below which the
place of the beginning is searched for. It is lower at 15 % of the right positions of the development half."""

LEAD: Final = 1.0
"""Difference of the beginning's peak-to-RMS ratio from which its own place is preferred to that of the whole sound."""


@dataclass(frozen=True, slots=True)
class _Answer:
    """The consensus of the contributing arrays, its judgement, and the reason for refusing it, or None.

    If no array contributes, `evidence` is that of all arrays.
    """

    evidence: tuple[Evidence, ...]
    contributing: frozenset[str]
    consensus: Consensus
    judgement: Judgement
    refused: str | None

    @property
    def is_sure(self) -> bool:
        """True if a second look would hardly improve the answer."""
        return self.refused is None and self.judgement.features.is_sure

    def rank(self) -> tuple[bool, bool, float]:
        """Return the rank of the answer: of two answers, the one with the greater rank is better."""
        return self.refused is None, len(self.contributing) > 1, self.judgement.features.confidence


class Onset(MapEstimator):
    """SRP of onset GCCs, in which noise and reverberation have little weight (`livessl.core.correlate.onset_gcc`).

    Outliers are excluded from the position (`livessl.core.locate.outliers`). The search grid is never coarser than
    `SEARCH_SPACING_M`, and positions are refined below it, so that they do not depend on the grid of the maps. The
    confidence is a probability, and positions that are too uncertain are refused (`livessl.core.locate.confidence`).

    Parameters
    ----------
    arrays : sequence of ArraySpec
    grid : Grid
    c_m_s : float
        Speed of sound, m/s.
    """

    name = ONSET

    def __init__(self, arrays: Sequence[ArraySpec], grid: Grid, c_m_s: float) -> None:
        super().__init__(arrays, Grid(grid.bounds_m, min(grid.spacing_m, SEARCH_SPACING_M)), c_m_s)
        self._map_grid = map_grid(arrays, grid)
        self._search = PeakSearch(arrays, self.grid, c_m_s)
        self._second_source = SecondSourceSearch(self._search, self.grid, c_m_s)
        self._onsets = OnsetEvidence(self.arrays, c_m_s, self._search.prepare)

    def prepare(self, array: str, sample_rate_hz: float) -> None:
        """Compute an array's tables for a sampling rate.

        Raises
        ------
        ValueError
            If the rate is too low for the array's band.
        """
        self._onsets.sampling(array, sample_rate_hz)

    def onset_front_end(self, array: str, sample_rate_hz: float) -> OnsetFrontEnd:
        """Return a new front end for an array's frames."""
        return self._onsets.front_end(array, sample_rate_hz)

    def locate(self, sounds: Mapping[str, Sound]) -> Localization:
        """Find the place that most arrays agree on, then a second source, and judge both.

        If there is no second source and the first answer is not sure, a sound that has ended gets a second look: whole
        segments are added to the onsets, and the more confident of the two answers is returned. A sound that a place
        outside the search volume explains better is reported as such (`livessl.core.locate.outside`). Neither whole
        segments nor clocks that are apart inside an array are considered unless every sound has ended, and allows
        `second_looks`.
        """
        strongest = strongest_onsets(sounds, MOST_ARRAYS)
        looks_again = all(sound.second_looks for sound in strongest.values())
        is_thorough = looks_again and all(sound.ended for sound in strongest.values())
        evidence = self.evidence(strongest)
        suspect = [name for name, sound in strongest.items() if sound.suspect]
        evidence, answer = self._beneath_background(evidence, suspect, tolerance=is_thorough)
        if looks_again and not answer.is_sure:
            loud = self._onsets.of_loud(evidence, strongest)
            if loud is not None:
                _, by_loud = self._beneath_background(loud, suspect, tolerance=is_thorough)
                answer = max(answer, by_loud, key=_Answer.rank)
        outside = self._outside(answer)
        separation = None

        def frames(part: Evidence) -> FrameGCCs:
            return self._onsets.frames(part, strongest[part.spec.name])

        if outside is None or not outside.is_sufficient:
            separation = self._second_source.separate(answer.consensus, answer.evidence, strongest, frames)
        others: tuple[Localization, ...] = ()
        if separation is not None:
            second, judgement = separation.second, separation.judgement
            consensus = Consensus(separation.first, second.outliers or {})
            answer = replace(answer, consensus=consensus, judgement=judgement, refused=judgement.refused)
            outside = None
            second = self._with_candidates(second)
            others = (replace(second, unneeded=sounds.keys() - {part.spec.name for part in second.evidence}),)
        elif outside is None and is_thorough and not answer.is_sure:
            second_look = self._answer(self._with_whole_segments(evidence, strongest), suspect, whole=True)
            answer = max(answer, second_look, key=_Answer.rank)
            outside = self._outside(answer)
        found = self._localization(answer) if outside is None else self._beyond(answer, outside)
        power = None if separation is None else separation.power
        return replace(found, unneeded=sounds.keys() - answer.contributing, others=others, power=power)

    def _beneath_background(
        self, evidence: tuple[Evidence, ...], suspect: Collection[str], *, tolerance: bool
    ) -> tuple[tuple[Evidence, ...], _Answer]:
        """Return the evidence used and the answer; if the background explains the place, the evidence without it.

        If the sound did not begin at that place, the place of its beginning is the answer.
        """
        answer = self._answer(evidence, suspect, tolerance=tolerance)
        if answer.judgement.features.background >= BACKGROUND:
            beneath = without_background(evidence, answer.consensus.place, self.c_m_s)
            other = self._answer(beneath, suspect, tolerance=tolerance)
            if other.refused is None and other.rank() > answer.rank():
                evidence, answer = beneath, other
        return evidence, self._by_beginning(answer, suspect)

    def _by_beginning(self, answer: _Answer, suspect: Collection[str]) -> _Answer:
        """Return the place at which a sound began, if it is clear and differs from the place of an answer.

        The place of the answer then emitted little or nothing when the sound began, so another source is there.
        """
        features = answer.judgement.features
        parts = tuple(part.beginning for part in answer.evidence if part.beginning is not None)
        if not parts or features.beginning is None or features.beginning >= BEGAN * features.peak_to_rms:
            return answer
        other = self._answer(parts, suspect)
        apart_m = np.linalg.norm(other.consensus.place.position_m - answer.consensus.place.position_m)
        lead = other.judgement.features.peak_to_rms - features.beginning
        return other if other.refused is None and apart_m > NEAR_M and lead > LEAD else answer

    def evidence(self, sounds: Mapping[str, Sound]) -> tuple[Evidence, ...]:
        """Sum each array's onset GCCs; the evidence is in the order of the arrays' names."""
        return self._onsets.of(sounds)

    def _answer(
        self, evidence: tuple[Evidence, ...], suspect: Collection[str], *, whole: bool = False, tolerance: bool = True
    ) -> _Answer:
        """Return the answer of sharp evidence, or that of tolerant evidence (`tolerant`) if it is more certain.

        If arrays disagree, the sharp evidence is used, because wide peaks would hide the disagreement. If the arrays do
        not determine the distance, the two places differ along the line of sight.
        """
        sharp = self._answer_by(evidence, suspect, whole=whole)
        is_agreed = sharp.refused is None and not sharp.consensus.outliers
        if not tolerance or not is_agreed or sharp.judgement.features.crossing_deg < CROSSING_DEG:
            return sharp
        place = sharp.consensus.place
        (peak,) = self._search.among([tolerant(part) for part in sharp.evidence])(1)
        if np.linalg.norm(self.grid.point_m(peak.point) - place.position_m) <= NEAR_M:
            return sharp
        wide = self._answer_by(tuple(tolerant(part) for part in evidence), suspect, whole=whole)
        return max(sharp, wide, key=_Answer.rank)

    def _answer_by(self, evidence: tuple[Evidence, ...], suspect: Collection[str], *, whole: bool) -> _Answer:
        together = self._place(evidence)
        terms = together.functional.pair_terms(together.position_m)
        kept = contributing(together.evidence, terms, self._highest_power, self.c_m_s)
        if not kept:
            judgement = together.judgement(self.grid, whole=whole)
            return _Answer(evidence, frozenset(), Consensus(together), judgement, NO_EVIDENCE)
        known = {_names(evidence): together}

        def place_of(parts: Sequence[Evidence]) -> Place:
            return known.get(_names(parts)) or self._place(parts)

        consensus = outliers.consensus(kept, suspect, self._search, self.grid, self.c_m_s, place_of)
        judgement = consensus.judgement(self.grid, whole=whole)
        return _Answer(kept, _names(kept), consensus, judgement, consensus.refused or judgement.refused)

    def _highest_power(self, evidence: Evidence) -> float:
        """Return the highest power of one array's own map."""
        (peak,) = self._search.among([evidence])(1)
        return peak.power

    def _outside(self, answer: _Answer) -> Outside | None:
        if not answer.contributing:
            return None
        place, refused = answer.consensus.place, answer.refused is not None
        return find_outside(place, answer.evidence, self.grid, self.c_m_s, refused=refused)

    def _localization(self, answer: _Answer) -> Localization:
        place, judgement = answer.consensus.place, answer.judgement
        return Localization(
            position_m=place.position_m,
            covariance_m2=judgement.covariance_m2,
            confidence=judgement.features.confidence,
            evidence=answer.evidence,
            features=judgement.features,
            refused=answer.refused,
            outliers=answer.consensus.outliers,
            candidates=judgement.candidates,
            ambiguity=judgement.ambiguity,
        )

    def _beyond(self, answer: _Answer, outside: Outside) -> Localization:
        """Return the place outside the search volume and the one inside as candidates; all arrays agree on it."""
        place, judgement = outside.place, outside.place.judgement(outside.grid, whole=answer.judgement.features.whole)
        candidates = outside.candidates(answer.consensus.place.position_m)
        features = replace(judgement.features, share=candidates[0].probability)
        known = features.confidence_at_known_distance >= LEAST_CONFIDENCE
        return Localization(
            position_m=place.position_m,
            covariance_m2=judgement.covariance_m2,
            confidence=features.confidence,
            evidence=answer.evidence,
            features=features,
            refused=None if known else outside.reason,
            outliers={},
            candidates=candidates,
            ambiguity=outside.reason,
        )

    def _with_candidates(self, second: Localization) -> Localization:
        """Add the other places that explain the remainder of the second source about as well."""
        functional, specs = SRPFunctional(second.evidence, self.c_m_s), [part.spec for part in second.evidence]
        power = float(functional.value(second.position_m[None])[0])
        rivals = ambiguity.rivals(functional, specs, second.position_m, power, self.grid)
        if not rivals.is_ambiguous:
            return second
        return replace(second, candidates=rivals.candidates, ambiguity=rivals.reason)

    def _place(self, evidence: Sequence[Evidence]) -> Place:
        return highest_place(evidence, self._search, self.grid, self.c_m_s)

    def _with_whole_segments(self, evidence: tuple[Evidence, ...], sounds: Mapping[str, Sound]) -> tuple[Evidence, ...]:
        """Add the GCCs of whole segments, in which a steady sound counts as much as its onset."""
        reexamined = strongest_onsets(sounds, MOST_ARRAYS_REEXAMINED)
        correlators = {name: self._correlator(name, sound.sample_rate_hz) for name, sound in reexamined.items()}

        def added(part: Evidence) -> Evidence:
            name = part.spec.name
            if name not in reexamined:
                return part
            sound, correlate = reexamined[name], correlators[name]
            values = part.gcc.values + sound.without_dead_channels(correlate(sound.segments)).values
            noise_rms = part.noise_rms + correlate.noise_rms(sound.segments)
            return replace(part, gcc=replace(part.gcc, values=values), noise_rms=noise_rms)

        return tuple(added(part) for part in evidence)


def _names(evidence: Sequence[Evidence]) -> frozenset[str]:
    return frozenset(part.spec.name for part in evidence)
