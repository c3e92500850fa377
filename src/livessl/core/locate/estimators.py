"""Estimators: from the sounds that several arrays heard to a place. Each is a name in `ESTIMATORS`."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final, Protocol

import numpy as np

from livessl.core.correlate.band import dead_channels
from livessl.core.correlate.gcc_phat import (
    GCCPhat,
    LagSampling,
    correlated,
    microphone_pairs,
    require_band,
    uses_envelope,
)
from livessl.core.correlate.onset_gcc import OnsetFrontEnd, OnsetGCC, summed
from livessl.core.correlate.spectra import FrontEnd, averaged, cepstral, whole_segment
from livessl.core.geometry import Grid
from livessl.core.locate import confidence, outliers, refine, second_source
from livessl.core.locate.confidence import ConfidenceFeatures
from livessl.core.locate.peak_search import PeakSearch
from livessl.core.locate.srp import SRPFunctional, SRPMapper
from livessl.core.steering import alias_free_hz
from livessl.core.types import GCC, ArraySpec, Evidence, Float32Array, FloatArray


@dataclass(frozen=True, slots=True)
class Sound:
    """What one array heard: segments, each (K, n) samples without gaps, at its sampling rate."""

    segments: Sequence[Float32Array]
    sample_rate_hz: float
    onsets: Sequence[OnsetGCC] = ()
    """What the estimator's listener made of its frames and those around them, frame by frame, where there is one."""
    suspect: bool = False
    """Whether the array has disagreed with the others lately."""
    sources: int = 1
    """How many sources are to be looked for."""
    ended: bool = True
    """Whether this is all of it; what goes on will be heard again, and is not worth a second look."""

    @property
    def clarity(self) -> float:
        """How much there is in it of onsets."""
        return float(np.mean([onset.levels for onset in self.onsets])) * len(self.onsets) if self.onsets else 0.0

    def live(self, gcc: GCC) -> GCC:
        """Its GCC with nothing in the pairs of dead microphones (`livessl.core.stream.activity.dead_channels`).

        Where none of its samples was kept nothing tells which these are.
        """
        if not self.segments:
            return gcc
        dead = dead_channels(self.segments)
        if not dead.any():
            return gcc
        values = np.where(np.any(dead[gcc.pairs], axis=1)[:, None], np.float32(0.0), gcc.values)
        return GCC(gcc.pairs, gcc.lags_s, values)


@dataclass(frozen=True, slots=True)
class Localization:
    """A place, how sure, and what it was read from: the arrays' evidence, in the order of their names.

    `proven` says that no node of the grid is higher; else the search was given up, for nothing stood out.
    """

    position_m: FloatArray
    covariance_m2: FloatArray
    confidence: float
    evidence: tuple[Evidence, ...]
    proven: bool = True
    features: ConfidenceFeatures | None = None
    """What the confidence was worked out from, where it is a probability."""
    refused: str | None = None
    """Why it should not be relied on, where it should not."""
    outliers: Mapping[str, float] | None = None
    """Arrays that it was found without, for they disagree with the others, and by what angle in degrees; None where
    nobody asked."""
    unneeded: Collection[str] = ()
    """Arrays that it was found without, for enough others heard the sound more clearly."""
    others: tuple[Localization, ...] = ()
    """Other sources that sounded at the same time."""


@dataclass(frozen=True, slots=True)
class PowerMaps:
    """Power at every node of a grid.

    Parameters
    ----------
    grid : Grid
        Which nodes; it may be coarser than the grid that is searched.
    fused : (G,) float32
        Sum over the arrays, in the grid's order.
    arrays : mapping of name to (G,) float32
        One map each.
    """

    grid: Grid
    fused: Float32Array
    arrays: Mapping[str, Float32Array]


class Estimator(Protocol):
    """Finds where the sounds came from."""

    name: str

    def prepare(self, array: str, sample_rate_hz: float) -> None:
        """Work out what an array at a sampling rate needs; `locate` does it otherwise."""
        ...

    def listener(self, array: str, sample_rate_hz: float) -> OnsetFrontEnd | None:
        """Make what is to hear every frame of an array, in order; None where segments are all that is asked for."""
        ...

    def locate(self, sounds: Mapping[str, Sound]) -> Localization:
        """Localize one sound heard by the arrays named in `sounds`; at least one."""
        ...

    def power_maps(self, evidence: Sequence[Evidence], separately: Collection[str] | None = None) -> PowerMaps:
        """Maps of what `locate` went by, for people: the fused one, and those of the arrays named (None for all).

        It may be called from another thread than `locate`.
        """
        ...


class SrpPhat:
    """The paper's standard: GCC-PHAT over whole segments, mapped and summed over the arrays.

    Parameters
    ----------
    arrays : sequence of ArraySpec
    grid : Grid
    c_m_s : float
    band_limit : bool or None
        Whether the band is limited per pair and node against spatial aliasing. None is "where it matters": for arrays
        of which more than half of all pairs and nodes of the map would lose part of the band. On a 0.1 m grid an array
        of 0.5 m is not among them, and its answer would hardly change; on a 0.5 m grid it is. Where an array's band is
        limited the peak is read from the map, else it is searched for on the grid, which may be finer.
    """

    name = "srp-phat"
    front_end: FrontEnd = staticmethod(whole_segment)

    def __init__(
        self, arrays: Sequence[ArraySpec], grid: Grid, c_m_s: float, *, band_limit: bool | None = None
    ) -> None:
        self._arrays = {spec.name: spec for spec in arrays}
        self._grid = grid
        self._map_grid = map_grid(arrays, grid)
        self._c_m_s = c_m_s
        self._limited = {spec.name: self._limits_band(spec, band_limit) for spec in arrays}
        self._search = PeakSearch(arrays, grid, c_m_s)
        self._correlators: dict[str, tuple[float, GCCPhat, Sequence[float]]] = {}
        self._mappers: dict[str, tuple[FloatArray, SRPMapper]] = {}

    def prepare(self, array: str, sample_rate_hz: float) -> None:
        """Work out an array's tables for a sampling rate."""
        self._correlator(array, sample_rate_hz)

    def listener(self, array: str, sample_rate_hz: float) -> OnsetFrontEnd | None:  # noqa: ARG002 - an Estimator
        """None: segments are all it needs."""
        return None

    def locate(self, sounds: Mapping[str, Sound]) -> Localization:
        """Find the highest places of the arrays' summed maps, refine them below the grid, take the best."""
        # float sums depend on the order: the answer must not
        evidence = self._evidence({name: sounds[name] for name in sorted(sounds)})
        in_map = any(self._limited[name] for name in sounds)
        grid = self._map_grid if in_map else self._grid
        find = refine.in_map(self.power_maps(evidence, ()).fused, grid) if in_map else self._search.among(evidence)
        found = find(refine.CANDIDATES)
        functional = SRPFunctional(evidence, self._c_m_s)
        position, _ = refine.refine(functional, np.stack([grid.node_m(peak.node) for peak in found]), grid)
        return Localization(
            position,
            refine.laplace_covariance_m2(functional, evidence, position, grid),
            refine.confidence(find, found[0], grid, position),
            evidence,
            found[0].proven,
        )

    def power_maps(self, evidence: Sequence[Evidence], separately: Collection[str] | None = None) -> PowerMaps:
        """Map each array's evidence onto the grid, and sum."""
        fused = np.zeros(self._map_grid.size, dtype=np.float32)
        arrays: dict[str, Float32Array] = {}
        for heard in evidence:
            mapper = self._mapper(heard)
            if separately is None or heard.spec.name in separately:
                arrays[heard.spec.name] = mapper(heard.gcc, *heard.below)
                fused += arrays[heard.spec.name]
            else:
                mapper.add(fused, heard.gcc, *heard.below)
        return PowerMaps(self._map_grid, fused, arrays)

    def _evidence(self, sounds: Mapping[str, Sound]) -> tuple[Evidence, ...]:
        if any(self._limited[name] for name in sounds):
            return tuple(self._heard(name, sound) for name, sound in sounds.items())
        correlators = [self._correlator(name, sound.sample_rate_hz)[0] for name, sound in sounds.items()]
        segments = [sound.segments for sound in sounds.values()]
        gccs = correlated(list(zip(correlators, segments, strict=True)))
        return tuple(
            Evidence(self._arrays[name], sound.live(gcc))
            for (name, sound), gcc in zip(sounds.items(), gccs, strict=True)
        )

    def _heard(self, array: str, sound: Sound) -> Evidence:
        correlate, cut_offs_hz = self._correlator(array, sound.sample_rate_hz)
        gcc, *below = correlate.below(sound.segments, cut_offs_hz)
        return Evidence(self._arrays[array], sound.live(gcc), tuple(map(sound.live, below)))

    def _correlator(self, array: str, sample_rate_hz: float) -> tuple[GCCPhat, Sequence[float]]:
        known = self._correlators.get(array)
        if known is not None and known[0] == sample_rate_hz:
            return known[1:]
        spec = self._arrays[array]
        correlate = GCCPhat(spec, sample_rate_hz, self._c_m_s, self.front_end)
        cut_offs_hz = third_octaves_below_hz(spec.band_hz) if self._limited[array] else ()
        if not cut_offs_hz:
            self._search.prepare(array, correlate.lags_s)
        self._correlators[array] = (sample_rate_hz, correlate, cut_offs_hz)
        return correlate, cut_offs_hz

    def _mapper(self, heard: Evidence) -> SRPMapper:
        """The mapper of an array's lags; made anew when its sampling rate, and with it the lags, have changed."""
        spec, gcc = heard.spec, heard.gcc
        known = self._mappers.get(spec.name)
        if known is not None and np.array_equal(known[0], gcc.lags_s):
            return known[1]
        cut_offs_hz = third_octaves_below_hz(spec.band_hz)[: len(heard.below)]
        mapper = SRPMapper(spec, self._map_grid, gcc.pairs, gcc.lags_s, self._c_m_s, cut_offs_hz)
        self._mappers[spec.name] = (gcc.lags_s, mapper)
        return mapper

    def _limits_band(self, spec: ArraySpec, band_limit: bool | None) -> bool:
        if uses_envelope(spec.band_hz):
            return False
        if band_limit is not None:
            return band_limit
        grid = self._map_grid
        some = grid.nodes_m(slice(None, None, max(1, grid.size // _NODES_ASKED)))
        pairs = microphone_pairs(len(spec.microphones_m))
        limit_hz = alias_free_hz(some, spec.microphones_m, pairs, grid.spacing_m, self._c_m_s)
        return bool(np.median(limit_hz) < spec.band_hz[1])


def map_grid(arrays: Sequence[ArraySpec], grid: Grid) -> Grid:
    """The grid that maps are drawn on: the one that is searched, or a coarser one where that is too fine for people.

    Its tables take at most `MAP_BYTES`.
    """
    pairs = sum(len(microphone_pairs(len(spec.microphones_m))) for spec in arrays)
    drawn = grid if grid.spacing_m >= MAP_SPACING_M else Grid(grid.bounds_m, MAP_SPACING_M)
    while 2 * pairs * drawn.size > MAP_BYTES:
        drawn = Grid(grid.bounds_m, 1.1 * drawn.spacing_m)
    return drawn


class Cepstral(SrpPhat):
    """SRP-PHAT after the channels' minimum-phase part has been taken out: see `spectra.cepstral`."""

    name = "cepstral"
    front_end: FrontEnd = staticmethod(cepstral)


class Averaged(SrpPhat):
    """SRP-PHAT of GCCs averaged over frames of 25 ms: see `livessl.core.correlate.spectra.averaged`."""

    name = "averaged"
    front_end: FrontEnd = staticmethod(averaged)


class Onset(SrpPhat):
    """The default: the directions of onsets, noise and reverberation taken for what they are (see `onset_gcc`).

    It is SRP-PHAT of another correlation. An array that the others outvote has no part in the answer
    (`livessl.core.locate.outliers`). Places are searched for on nodes `SEARCH_SPACING_M` apart or nearer, whatever
    the grid of the maps, and refined below that, so that the answer does not depend on the grid. It tells how
    sure it is by probability, and refuses what is too unsure (`livessl.core.locate.confidence`).

    Parameters
    ----------
    arrays : sequence of ArraySpec
    grid : Grid
    c_m_s : float
    """

    name = "onset"

    def __init__(self, arrays: Sequence[ArraySpec], grid: Grid, c_m_s: float) -> None:
        super().__init__(arrays, Grid(grid.bounds_m, min(grid.spacing_m, SEARCH_SPACING_M)), c_m_s, band_limit=False)
        self._map_grid = map_grid(arrays, grid)
        self._samplings: dict[str, tuple[float, LagSampling]] = {}

    def prepare(self, array: str, sample_rate_hz: float) -> None:
        """Work out an array's tables for a sampling rate."""
        self._sampling(array, sample_rate_hz)

    def listener(self, array: str, sample_rate_hz: float) -> OnsetFrontEnd:
        """The onset front end of an array."""
        return OnsetFrontEnd(self._arrays[array], sample_rate_hz, self._sampling(array, sample_rate_hz))

    def locate(self, sounds: Mapping[str, Sound]) -> Localization:
        """Find the highest place of the summed maps, outvote who does not agree on it, and judge what is left."""
        clearest = _clearest(sounds, MOST_ARRAYS)
        evidence = tuple(self._heard(name, sound) for name, sound in clearest.items())
        suspect = [name for name, sound in clearest.items() if sound.suspect]
        found = self._answer(evidence, suspect)
        second = self._second(found.agreed, evidence, clearest)
        others = () if second is None else (second[1],)
        if second is not None:
            place, other = second
            judged = _judged(place, self._grid)
            found = _Answer(evidence, outliers.Agreed(place, other.outliers or {}), judged, judged.refused)
        elif not found.is_sure and all(sound.ended for sound in clearest.values()):
            again = self._answer(self._with_whole(evidence, clearest), suspect, whole=True)
            found = max(found, again, key=lambda answer: (answer.refused is None, answer.judged.features.confidence))
        place = found.agreed.place
        return Localization(
            place.position_m,
            found.judged.covariance_m2,
            found.judged.features.confidence,
            found.evidence,
            place.proven,
            found.judged.features,
            found.refused if place.proven else "nothing stands out: the search for the place was given up",
            found.agreed.outliers,
            sounds.keys() - clearest.keys(),
            tuple(replace(other, unneeded=sounds.keys() - {h.spec.name for h in other.evidence}) for other in others),
        )

    def _answer(self, evidence: tuple[Evidence, ...], suspect: Collection[str], *, whole: bool = False) -> _Answer:
        agreed = outliers.agreed(evidence, suspect, self._search, self._grid, self._place)
        judged = _judged(agreed.place, self._grid, whole=whole)
        return _Answer(evidence, agreed, judged, agreed.refused or judged.refused)

    def _with_whole(self, evidence: tuple[Evidence, ...], sounds: Mapping[str, Sound]) -> tuple[Evidence, ...]:
        """The evidence and that of whole segments: what goes on steadily counts as much as what begins."""
        telling = _clearest(sounds, MOST_TELLING_APART)
        return tuple(
            self._plus_whole(heard, telling[heard.spec.name]) if heard.spec.name in telling else heard
            for heard in evidence
        )

    def _plus_whole(self, heard: Evidence, sound: Sound) -> Evidence:
        whole = super()._heard(heard.spec.name, sound).gcc
        return Evidence(heard.spec, replace(heard.gcc, values=heard.gcc.values + whole.values))

    def _second(
        self, agreed: outliers.Agreed, everyone: tuple[Evidence, ...], sounds: Mapping[str, Sound]
    ) -> tuple[outliers.Place, Localization] | None:
        """The first place, and the second; None where there is none.

        What the first explains is taken out, and the second looked for; without that the first is looked for again, and
        then the second once more. Arrays may disagree because one hears another source best: where each of them hears
        something at both places, none is outvoted.
        """
        for all_of_them in (everyone, agreed.place.evidence) if agreed.outliers else (everyone,):
            divided = agreed.refused is not None or len(all_of_them) > len(agreed.place.evidence)
            telling = _clearest({heard.spec.name: sounds[heard.spec.name] for heard in all_of_them}, MOST_TELLING_APART)
            evidence = tuple(heard for heard in all_of_them if heard.spec.name in telling)
            specs = [heard.spec for heard in evidence]
            if len(specs) < 2 or not all(sound.onsets and sound.sources > 1 for sound in telling.values()):
                return None
            if any(uses_envelope(spec.band_hz) for spec in specs):
                return None  # magnitudes do not add up
            moments = [self._moments(heard, sounds[heard.spec.name]) for heard in evidence]
            first = replace(agreed.place, evidence=evidence, functional=SRPFunctional(evidence, self._c_m_s))
            second, prospect = self._beside(first, moments)
            if prospect < second_source.LEAST_PROSPECT:
                continue
            again, _ = self._beside(second, moments)
            second, confidence = self._beside(again, moments)
            if (
                confidence < second_source.LEAST_CONFIDENCE
                or not second.proven
                or again.apart_m(second) < second_source.APART_M
            ):
                continue
            if divided and not (again.is_heard_by_all and second.is_heard_by_all):
                continue
            judged = _judged(second, self._grid)
            outliers = {name: off for name, off in agreed.outliers.items() if name not in {s.name for s in specs}}
            # a short sound hardly counts where another's moments were evened out, and may be surer as it was
            firsts = [again] if divided or first.apart_m(second) < second_source.APART_M else [again, agreed.place]
            return max(firsts, key=lambda place: _judged(place, self._grid).features.confidence), Localization(
                second.position_m,
                judged.covariance_m2,
                confidence,
                second.evidence,
                features=judged.features,
                outliers=outliers,
            )
        return None

    def _beside(self, place: outliers.Place, moments: Sequence[second_source.Moments]) -> tuple[outliers.Place, float]:
        """The likeliest other place when one is taken out, and how likely it is that a source is there, too.

        Of a few that stand high together, the one that is clear in a moment as well: by the product of the two.
        """
        delays_s = [term.lags_s for term in place.functional.pair_terms(place.position_m)]
        evidence = tuple(each.without(taken_s) for each, taken_s in zip(moments, delays_s, strict=True))
        find, functional = self._search.among(evidence), SRPFunctional(evidence, self._c_m_s)
        known = [refine.neighbourhood(place.position_m, self._grid)]
        apart_nodes = round(second_source.CANDIDATES_APART_M / self._grid.spacing_m)
        best, chosen = 0.0, (place, 0.0)
        for _ in range(second_source.CANDIDATES):
            found = find(1, without=known)
            if not found:
                break
            position_m, power = refine.refine(functional, self._grid.node_m(found[0].node), self._grid)
            terms = functional.pair_terms(position_m)
            clearness = second_source.clearness(
                [
                    one.clearness(term.lags_s, taken_s)
                    for one, term, taken_s in zip(moments, terms, delays_s, strict=True)
                ]
            )
            if power * clearness > best:
                candidate = outliers.Place(evidence, functional, position_m, power, power, found[0].proven)
                best, chosen = power * clearness, (candidate, second_source.confidence(clearness))
            known.append(refine.box_around(self._grid, found[0].node, apart_nodes))
        other, confidence = chosen
        return replace(other, rival_power=refine.rival_power(find, self._grid, other.position_m)), confidence

    def _moments(self, heard: Evidence, sound: Sound) -> second_source.Moments:
        sampling = self._sampling(heard.spec.name, sound.sample_rate_hz)
        return second_source.Moments.of(heard.spec, sampling, sound.onsets, np.any(heard.gcc.values, axis=1))

    def _place(self, evidence: Sequence[Evidence]) -> outliers.Place:
        evidence = tuple(sorted(evidence, key=lambda heard: heard.spec.name))  # sums depend on the order
        find = self._search.among(evidence)
        found = find(_STARTS)
        functional = SRPFunctional(evidence, self._c_m_s)
        starts_m = np.stack([self._grid.node_m(peak.node) for peak in found])
        position, power = refine.refine(functional, starts_m, self._grid)
        rival_power = refine.rival_power(find, self._grid, position)
        return outliers.Place(evidence, functional, position, power, rival_power, found[0].proven)

    def _heard(self, array: str, sound: Sound) -> Evidence:
        if sound.onsets:
            onsets = summed(sound.onsets)
        else:
            onsets = self.listener(array, sound.sample_rate_hz).listen(sound.segments)
        sampling = self._sampling(array, sound.sample_rate_hz)
        spec = self._arrays[array]
        pairs = microphone_pairs(len(spec.microphones_m))
        gcc = GCC(pairs, sampling.fine_lags_s, sampling.fine(onsets.lags / onsets.heights(pairs)))
        return Evidence(spec, sound.live(gcc))

    def _sampling(self, array: str, sample_rate_hz: float) -> LagSampling:
        known = self._samplings.get(array)
        if known is not None and known[0] == sample_rate_hz:
            return known[1]
        spec = self._arrays[array]
        require_band(spec, sample_rate_hz)
        sampling = LagSampling.shared(spec.band_hz, sample_rate_hz, spec.aperture_m / self._c_m_s)
        self._samplings[array] = (sample_rate_hz, sampling)
        self._search.prepare(array, sampling.fine_lags_s)
        return sampling


def _clearest(sounds: Mapping[str, Sound], most: int) -> dict[str, Sound]:
    """Of many arrays those that heard the clearest onsets, in the order of their names."""
    in_order = {name: sounds[name] for name in sorted(sounds)}
    if len(in_order) <= most:
        return in_order
    clearest = sorted(in_order, key=lambda name: -in_order[name].clarity)[:most]
    return {name: sound for name, sound in in_order.items() if name in clearest}


@dataclass(frozen=True, slots=True)
class _Answer:
    """Of what evidence, who agrees on which place, what it is worth, and why it should not be relied on if so."""

    evidence: tuple[Evidence, ...]
    agreed: outliers.Agreed
    judged: confidence.Judgement
    refused: str | None

    @property
    def is_sure(self) -> bool:
        """Whether a second look is not worth its time."""
        return self.refused is None and self.judged.features.is_sure


def _judged(place: outliers.Place, grid: Grid, *, whole: bool = False) -> confidence.Judgement:
    return confidence.judge(
        place.functional, place.evidence, place.position_m, place.power, place.rival_power, grid, whole=whole
    )


def third_octaves_below_hz(band_hz: tuple[float, float]) -> tuple[float, ...]:
    """Cut-offs in steps of a third of an octave from a band's upper edge down, as far as some band is left."""
    low, high = band_hz
    steps = np.arange(1, int(3.0 * np.log2(high / max(low, _LEAST_CUT_OFF_HZ))) + 1)
    return tuple(float(cut_off) for cut_off in high * 2.0 ** (-steps / 3.0))


SEARCH_SPACING_M: Final = 0.1
"""6 kHz turns a 0.5 m array's phases by less than half a period over so far, nearly everywhere: no peak is missed."""

_STARTS: Final = 3
"""Places looked at more closely: between two nodes a lower one may be the higher one in truth."""

MOST_ARRAYS: Final = 16
"""Arrays that a place is told by: of more, those that heard it most clearly. The others hardly move it, and what an
answer costs, and how soon it is there, no longer depends on how many there are."""

MOST_TELLING_APART: Final = 8
"""Arrays that two sources at once are told apart by, and that are listened to twice where an answer is not sure: their
number is what it costs, and so many say it clearly."""

MAP_SPACING_M: Final = 0.1
"""Maps are not drawn finer than this: a screen shows no more of a room."""

MAP_BYTES: Final = 128_000_000
"""What the tables of all arrays' maps may take."""

_NODES_ASKED: Final = 4096
"""Nodes looked at to see whether a band limit matters."""

_LEAST_CUT_OFF_HZ: Final = 100.0

ESTIMATORS: Final[dict[str, Callable[[Sequence[ArraySpec], Grid, float], Estimator]]] = {
    each.name: each for each in (Onset, SrpPhat, Cepstral, Averaged)
}
"""Name in the site file and on the command line, and what makes it."""
