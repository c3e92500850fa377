"""Finds a second source that sounds at the same time, after removing from the evidence what the first one explains.

All pairs of an array receive a source with one spectrum, so its share of their GCCs is one even function of lag,
shifted to each pair's delay. The mean over the pairs around their delays gives that share frame by frame. What remains
comes from other sources and from reverberation. A loud frame leaves much behind, so the remainder of a frame counts
less the louder it is: a second source often stands out best while the first is silent. A source differs from what
reverberation leaves in that it is prominent in some frame.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from livessl.core.correlate.band import uses_envelope
from livessl.core.correlate.gcc_phat import LagSampling
from livessl.core.correlate.onset_gcc import OnsetGCC, summed
from livessl.core.geometry import Grid, microphone_pairs
from livessl.core.locate import refine
from livessl.core.locate.confidence import Judgement
from livessl.core.locate.estimator import Localization, Sound, strongest_onsets
from livessl.core.locate.outliers import Consensus
from livessl.core.locate.peak_search import PeakSearch
from livessl.core.locate.place import Place
from livessl.core.locate.srp import SRPFunctional
from livessl.core.types import GCC, ArraySpec, BoolArray, Evidence, Float32Array, FloatArray, IntArray

APART_M: Final = 1.0
"""Distance, in metres, below which two places are one source."""

MOST_ARRAYS_SEPARATED: Final = 8
"""Most arrays used to separate two sources; the time it takes is in proportion to their number."""

MAX_FRAMES: Final = 40
"""Most frames that are kept apart; those of a longer sound are merged, so that memory and time do not grow with it."""

CANDIDATES: Final = 6
"""Places examined for each source; the right one is hardly ever further down."""

CANDIDATES_APART_M: Final = 0.5
"""Least distance between candidates along one of the axes, in metres."""

LITTLE: Final = 200.0
"""Onset weight of a frame below which it is mostly noise and counts less: noise at 10 dB gives some 30, a source in a
clear frame thousands."""

LEAST_SECOND_SOURCE: Final = 0.5
"""Confidence below which a second source is not reported."""

LEAST_PROSPECT: Final = 0.1
"""Confidence at first sight below which a second source is not examined further."""

_PROMINENCE_FIT: Final = (-11.6, 6.9)
"""Log-odds of a second source at a place: intercept, weight of the prominence. Fitted to the pairs of sounds and the
single sounds of the development half."""


def prominence(of_arrays: Sequence[float]) -> float:
    """Prominence of a place from each array's `FrameGCCs.prominence`: the mean of the two highest.

    Two lines of sight determine a place.
    """
    return float(np.mean(sorted(of_arrays)[-2:]))


def confidence(prominence: float) -> float:
    """Probability that there is a second source at a place of this `prominence`."""
    intercept, slope = _PROMINENCE_FIT
    return float(1.0 / (1.0 + np.exp(-(intercept + slope * prominence))))


@dataclass(frozen=True, slots=True)
class FrameGCCs:
    """One array's correlations frame by frame.

    Parameters
    ----------
    spec : ArraySpec
    lags_s : (L,) float64
        Seconds.
    values : (F, P, L) float32
        GCCs of the frames, not normalised.
    weights : (F,) float64
        Onset weight of each frame.
    """

    spec: ArraySpec
    lags_s: FloatArray
    values: Float32Array
    weights: FloatArray

    @classmethod
    def of(cls, spec: ArraySpec, sampling: LagSampling, frames: Sequence[OnsetGCC], live: BoolArray) -> FrameGCCs:
        """Interpolate an array's onset GCCs, which must not be envelopes.

        Pairs that are not `live` (P,) become zeros.
        """
        size = -(-len(frames) // MAX_FRAMES)
        together = [summed(frames[first : first + size]) for first in range(0, len(frames), size)]
        whole = summed(together)
        even = live[:, None] * np.float32(whole.weight) / whole.heights(microphone_pairs(len(spec.microphones_m)))
        coarse = np.asarray(np.stack([one.lags for one in together]).real * even, dtype=np.float32)
        fine = sampling.fine(coarse.reshape(-1, coarse.shape[2])).reshape(*coarse.shape[:2], -1)
        return cls(spec, sampling.fine_lags_s, fine, np.array([one.weight for one in together]))

    def without(self, delays_s: FloatArray) -> Evidence:
        """Evidence that remains when a source at these delays of the pairs (P,), in seconds, is removed."""
        share, starts = self._share(delays_s)
        count, live = len(self.lags_s), self._live
        scale = 1.0 / np.maximum(self.weights, LITTLE)
        scale /= max(float((self.weights * scale).sum()), 1e-9)
        values = np.einsum("f,fpl->pl", scale.astype(np.float32), self.values)
        weighed = scale.astype(np.float32) @ share
        for pair in live:
            values[pair] -= weighed[starts[pair] : starts[pair] + count]
        return Evidence(self.spec, GCC(microphone_pairs(len(self.spec.microphones_m)), self.lags_s, values))

    def prominence(self, delays_s: FloatArray, without_s: FloatArray) -> float:
        """Prominence of a source at delays (P,) after removing the one at delays `without_s`, in its clearest frame.

        It is the mean height over the pairs, over the root mean square of the frame's GCCs with both sources.
        """
        share, starts = self._share(without_s)
        at, live = self._nearest(delays_s), self._live
        if not len(live):
            return 0.0
        heights = (self.values[:, live, at[live]] - share[:, starts[live] + at[live]]).mean(axis=1)
        both = self.values[:, live]
        rms = np.sqrt(np.einsum("fpl,fpl->f", both, both) / (both.shape[1] * both.shape[2]))
        return float((heights / np.maximum(rms, 1e-9)).max())

    @property
    def _live(self) -> IntArray:
        return np.flatnonzero(self.values.any(axis=(0, 2)))

    def _nearest(self, delays_s: FloatArray) -> IntArray:
        step_s = self.lags_s[1] - self.lags_s[0]
        places = np.rint((delays_s - self.lags_s[0]) / step_s).astype(np.int64)
        return np.asarray(np.clip(places, 0, len(self.lags_s) - 1))

    def _share(self, delays_s: FloatArray) -> tuple[Float32Array, IntArray]:
        """Share of a source at delays (P,) in each frame, (F, 2 L - 1), and where in it each pair's lags begin, (P,).

        The share is r(t) = mean over pairs of [R_p(tau_p + t) + R_p(tau_p - t)] / 2, t as far as the lags reach.
        """
        frames, _, count = self.values.shape
        share = np.zeros((frames, 2 * count - 1), dtype=np.float32)
        terms = np.zeros(2 * count - 1, dtype=np.float32)
        starts = count - 1 - self._nearest(delays_s)
        for pair in self._live:
            share[:, starts[pair] : starts[pair] + count] += self.values[:, pair]
            terms[starts[pair] : starts[pair] + count] += 1.0
        return (share + share[:, ::-1]) / np.maximum(terms + terms[::-1], 1.0), starts


@dataclass(frozen=True, slots=True)
class TwoSources:
    """Two places at which sources sounded at the same time, and the confidence that the second one is a source."""

    first: Place
    second: Place
    confidence: float

    @property
    def stand_out_everywhere(self) -> bool:
        """Whether every array has a peak at both places."""
        return self.first.stands_out_everywhere and self.second.stands_out_everywhere


@dataclass(frozen=True, slots=True)
class Separation:
    """The answers for two sources that sounded at the same time: the first as a place, to be published as the main one.

    Parameters
    ----------
    first : Place
    judgement : Judgement
        Judgement of the first place.
    second : Localization
    """

    first: Place
    judgement: Judgement
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

        Arrays may disagree because they receive different sources best, so the second source is searched for in all
        evidence first, and then in that of the arrays that agree. If all arrays have a peak at both places, none is an
        outlier.

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
            first = replace(consensus.place, evidence=used, functional=SRPFunctional(used, self._c_m_s))
            found = self.find(first, [frames_of(part) for part in used])
            disputed = consensus.refused is not None or len(tried) > len(agreeing)
            if found is not None and (found.stand_out_everywhere or not disputed):
                return self._separation(consensus, found, keeps_first=not disputed)
        return None

    def _separation(self, consensus: Consensus, found: TwoSources, *, keeps_first: bool) -> Separation:
        """Judge both places. With `keeps_first` the consensus remains the first place if that is more confident.

        Equalising the frames weakens a short first source.
        """
        places = [found.first]
        if keeps_first and consensus.place.apart_m(found.second) >= APART_M:
            places.append(consensus.place)
        judged = [(place, place.judgement(self._grid)) for place in places]
        first, judgement = max(judged, key=lambda pair: pair[1].features.confidence)
        second, used = found.second.judgement(self._grid), {part.spec.name for part in found.second.evidence}
        return Separation(
            first,
            judgement,
            Localization(
                found.second.position_m,
                second.covariance_m2,
                found.confidence,
                found.second.evidence,
                features=second.features,
                outliers={name: off_deg for name, off_deg in consensus.outliers.items() if name not in used},
            ),
        )

    def find(self, first: Place, frames: Sequence[FrameGCCs]) -> TwoSources | None:
        """Find a second source; None if there is none.

        The first source is removed and the second searched for; with the second removed the first is searched for
        again, and then the second once more.

        Parameters
        ----------
        first : Place
            The place of all evidence.
        frames : sequence of FrameGCCs
            Frames of the same arrays in the same order.
        """
        second, prospect = self.beside(first, frames)
        if prospect < LEAST_PROSPECT:
            return None
        again, _ = self.beside(second, frames)
        second, confidence = self.beside(again, frames)
        if confidence < LEAST_SECOND_SOURCE or again.apart_m(second) < APART_M:
            return None
        return TwoSources(again, second, confidence)

    def beside(self, place: Place, frames: Sequence[FrameGCCs]) -> tuple[Place, float]:
        """Most likely other place once the source at `place` is removed, and the confidence that it is a source.

        Of the candidates with the highest power, the one with the highest product of power and prominence wins.
        """
        delays_s = [term.lags_s for term in place.functional.pair_terms(place.position_m)]
        evidence = tuple(each.without(taken_s) for each, taken_s in zip(frames, delays_s, strict=True))
        find, functional = self._search.among(evidence), SRPFunctional(evidence, self._c_m_s)
        known = [refine.neighbourhood(place.position_m, self._grid)]
        apart_points = round(CANDIDATES_APART_M / self._grid.spacing_m)
        best, chosen = 0.0, (place, 0.0)
        for _ in range(CANDIDATES):
            found = find(1, without=known)
            if not found:
                break
            position_m, power = refine.refine_peaks(functional, found, self._grid)
            terms = functional.pair_terms(position_m)
            each = zip(frames, terms, delays_s, strict=True)
            prominent = prominence([one.prominence(term.lags_s, taken_s) for one, term, taken_s in each])
            if power * prominent > best:
                candidate = Place(evidence, functional, position_m, power, power)
                best, chosen = power * prominent, (candidate, confidence(prominent))
            known.append(refine.box_around(self._grid, found[0].point, apart_points))
        other, other_confidence = chosen
        return replace(other, rival_power=refine.rival_power(find, self._grid, other.position_m)), other_confidence


def _separable(evidence: Sequence[Evidence], sounds: Mapping[str, Sound]) -> tuple[Evidence, ...]:
    """Return the evidence with the strongest onsets, from which two sources may be separated; empty if they may not.

    It takes two arrays, `sources` > 1 and onsets. Envelopes do not qualify: magnitudes of two sources do not add up.
    """
    strongest = strongest_onsets({part.spec.name: sounds[part.spec.name] for part in evidence}, MOST_ARRAYS_SEPARATED)
    used = tuple(part for part in evidence if part.spec.name in strongest)
    if len(used) < 2 or not all(sound.onsets and sound.sources > 1 for sound in strongest.values()):
        return ()
    return () if any(uses_envelope(part.spec.band_hz) for part in used) else used
