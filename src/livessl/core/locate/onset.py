"""The default method: SRP of onset GCCs, with outliers, a second source, and a confidence that is a probability."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from livessl.core.correlate.band import uses_envelope
from livessl.core.correlate.gcc_phat import LagSampling, require_band
from livessl.core.correlate.onset_gcc import OnsetFrontEnd, summed
from livessl.core.geometry import Grid, microphone_pairs
from livessl.core.locate import confidence, outliers
from livessl.core.locate.estimator import Localization, Sound
from livessl.core.locate.map_estimator import MapEstimator, map_grid
from livessl.core.locate.outliers import Consensus
from livessl.core.locate.peak_search import PeakSearch
from livessl.core.locate.place import Place, highest_place
from livessl.core.locate.second_source import APART_M, FrameGCCs, SecondSourceSearch
from livessl.core.locate.srp import SRPFunctional
from livessl.core.methods import ONSET
from livessl.core.types import GCC, ArraySpec, Evidence

SEARCH_SPACING_M: Final = 0.1
"""Coarsest spacing of the search grid, in metres: over so far the phases of a 0.5 m array turn by less than half a
period at 6 kHz nearly everywhere, and no peak is missed."""

MOST_ARRAYS: Final = 16
"""Most arrays from which a sound is located, those with the strongest onsets. Further ones hardly move the position,
and without them the cost and the delay of an answer do not grow with the number of arrays."""

MOST_ARRAYS_REEXAMINED: Final = 8
"""Most arrays used to separate two sources, and to correlate whole segments where onsets are not sure: both cost time
in proportion to the number of arrays."""


class Onset(MapEstimator):
    """SRP of onset GCCs, in which noise and reverberation have little weight (`livessl.core.correlate.onset_gcc`).

    Arrays that are outliers have no part in the position (`livessl.core.locate.outliers`). The search grid is never
    coarser than `SEARCH_SPACING_M`, and positions are refined below it, so that they do not depend on the grid of the
    maps. The confidence is a probability, and too uncertain positions are refused (`livessl.core.locate.confidence`).

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
        self._samplings: dict[str, tuple[float, LagSampling]] = {}

    def prepare(self, array: str, sample_rate_hz: float) -> None:
        """Compute an array's tables for a sampling rate.

        Raises
        ------
        ValueError
            If the rate is too low for the array's band.
        """
        self._sampling(array, sample_rate_hz)

    def onset_front_end(self, array: str, sample_rate_hz: float) -> OnsetFrontEnd:
        """Return a new front end for an array's frames."""
        return OnsetFrontEnd(self.arrays[array], sample_rate_hz, self._sampling(array, sample_rate_hz))

    def locate(self, sounds: Mapping[str, Sound]) -> Localization:
        """Find the place that most arrays agree on, then a second source, and judge both."""
        strongest = _with_strongest_onsets(sounds, MOST_ARRAYS)
        evidence = self.evidence(strongest)
        suspect = [name for name, sound in strongest.items() if sound.suspect]
        answer = self._answer(evidence, suspect)
        pair = self._two_sources(answer.consensus, evidence, strongest)
        others = () if pair is None else (pair[1],)
        if pair is not None:
            first, second = pair
            judgement = self._judged(first)
            answer = _Answer(evidence, Consensus(first, second.outliers or {}), judgement, judgement.refused)
        elif not answer.is_sure and all(sound.ended for sound in strongest.values()):
            again = self._answer(self._with_whole_segments(evidence, strongest), suspect, whole=True)
            answer = max(answer, again, key=lambda one: (one.refused is None, one.judgement.features.confidence))
        place = answer.consensus.place
        return Localization(
            place.position_m,
            answer.judgement.covariance_m2,
            answer.judgement.features.confidence,
            answer.evidence,
            place.proven,
            answer.judgement.features,
            answer.refused if place.proven else "no place stands out: the search was stopped before it was complete",
            answer.consensus.outliers,
            sounds.keys() - strongest.keys(),
            tuple(replace(other, unneeded=sounds.keys() - {h.spec.name for h in other.evidence}) for other in others),
        )

    def evidence(self, sounds: Mapping[str, Sound]) -> tuple[Evidence, ...]:
        """Sum each array's onset GCCs; the evidence is in the order of the arrays' names."""
        return tuple(self._onset_evidence(name, sounds[name]) for name in sorted(sounds))

    def _answer(self, evidence: tuple[Evidence, ...], suspect: Collection[str], *, whole: bool = False) -> _Answer:
        consensus = outliers.consensus(evidence, suspect, self._search, self.grid, self._place)
        judgement = self._judged(consensus.place, whole=whole)
        return _Answer(evidence, consensus, judgement, consensus.refused or judgement.refused)

    def _judged(self, place: Place, *, whole: bool = False) -> confidence.Judgement:
        return confidence.judge(
            place.functional, place.evidence, place.position_m, place.power, place.rival_power, self.grid, whole=whole
        )

    def _place(self, evidence: Sequence[Evidence]) -> Place:
        return highest_place(evidence, self._search, self.grid, self.c_m_s)

    def _with_whole_segments(self, evidence: tuple[Evidence, ...], sounds: Mapping[str, Sound]) -> tuple[Evidence, ...]:
        """Add the GCCs of whole segments, in which a steady sound counts as much as its onset."""
        reexamined = _with_strongest_onsets(sounds, MOST_ARRAYS_REEXAMINED)
        whole = {
            name: sound.without_dead_channels(self._correlator(name, sound.sample_rate_hz)(sound.segments)).values
            for name, sound in reexamined.items()
        }
        return tuple(
            replace(part, gcc=replace(part.gcc, values=part.gcc.values + whole[part.spec.name]))
            if part.spec.name in whole
            else part
            for part in evidence
        )

    def _two_sources(
        self, consensus: Consensus, evidence: tuple[Evidence, ...], sounds: Mapping[str, Sound]
    ) -> tuple[Place, Localization] | None:
        """Find two sources: the place of the first, and the second; None if there is no second.

        Arrays may disagree because one of them receives the other source best. Where every array has a peak at both
        places, none of them is an outlier.
        """
        for tried in (evidence, consensus.place.evidence) if consensus.outliers else (evidence,):
            divided = consensus.refused is not None or len(tried) > len(consensus.place.evidence)
            reexamined = _with_strongest_onsets(
                {part.spec.name: sounds[part.spec.name] for part in tried}, MOST_ARRAYS_REEXAMINED
            )
            some = tuple(part for part in tried if part.spec.name in reexamined)
            if not _separable(some, reexamined):
                return None
            first = replace(consensus.place, evidence=some, functional=SRPFunctional(some, self.c_m_s))
            found = self._second_source.find(first, [self._frames(part, sounds[part.spec.name]) for part in some])
            if found is None:
                continue
            if divided and not (found.first.stands_out_everywhere and found.second.stands_out_everywhere):
                continue
            judgement = self._judged(found.second)
            used = {part.spec.name for part in some}
            # a short sound hardly counts once the frames of another are evened out, and may be surer as it was
            keep = not divided and first.apart_m(found.second) >= APART_M
            firsts = [found.first, consensus.place] if keep else [found.first]
            return max(firsts, key=lambda place: self._judged(place).features.confidence), Localization(
                found.second.position_m,
                judgement.covariance_m2,
                found.confidence,
                found.second.evidence,
                features=judgement.features,
                outliers={name: off_deg for name, off_deg in consensus.outliers.items() if name not in used},
            )
        return None

    def _frames(self, evidence: Evidence, sound: Sound) -> FrameGCCs:
        sampling = self._sampling(evidence.spec.name, sound.sample_rate_hz)
        return FrameGCCs.of(evidence.spec, sampling, sound.onsets, np.any(evidence.gcc.values, axis=1))

    def _onset_evidence(self, array: str, sound: Sound) -> Evidence:
        if sound.onsets:
            onsets = summed(sound.onsets)
        else:
            onsets = self.onset_front_end(array, sound.sample_rate_hz).push_segments(sound.segments)
        sampling = self._sampling(array, sound.sample_rate_hz)
        spec = self.arrays[array]
        pairs = microphone_pairs(len(spec.microphones_m))
        gcc = GCC(pairs, sampling.fine_lags_s, sampling.fine(onsets.lags / onsets.heights(pairs)))
        return Evidence(spec, sound.without_dead_channels(gcc))

    def _sampling(self, array: str, sample_rate_hz: float) -> LagSampling:
        known = self._samplings.get(array)
        if known is not None and known[0] == sample_rate_hz:
            return known[1]
        spec = self.arrays[array]
        require_band(spec, sample_rate_hz)
        sampling = LagSampling.shared(spec.band_hz, sample_rate_hz, spec.aperture_m / self.c_m_s)
        self._samplings[array] = (sample_rate_hz, sampling)
        self._search.prepare(array, sampling.fine_lags_s)
        return sampling


def _with_strongest_onsets(sounds: Mapping[str, Sound], most: int) -> dict[str, Sound]:
    """Return at most so many sounds, those with the strongest onsets, in the order of the arrays' names."""
    in_order = {name: sounds[name] for name in sorted(sounds)}
    if len(in_order) <= most:
        return in_order
    strongest = sorted(in_order, key=lambda name: -in_order[name].onset_strength)[:most]
    return {name: sound for name, sound in in_order.items() if name in strongest}


def _separable(evidence: Sequence[Evidence], sounds: Mapping[str, Sound]) -> bool:
    """Whether two sources may be separated: they are wanted, two arrays have onsets, and none uses the envelope.

    Magnitudes of two sources do not add up.
    """
    if len(evidence) < 2 or not all(sound.onsets and sound.sources > 1 for sound in sounds.values()):
        return False
    return not any(uses_envelope(part.spec.band_hz) for part in evidence)


@dataclass(frozen=True, slots=True)
class _Answer:
    """The consensus of some evidence, its judgement, and why it should not be relied on, if so."""

    evidence: tuple[Evidence, ...]
    consensus: Consensus
    judgement: confidence.Judgement
    refused: str | None

    @property
    def is_sure(self) -> bool:
        """Whether a second look is not worth its time."""
        return self.refused is None and self.judgement.features.is_sure
