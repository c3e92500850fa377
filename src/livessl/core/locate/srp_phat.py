"""The paper's methods: `srp-phat`, and the variants `cepstral` and `averaged` with another front end."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from livessl.core.correlate.band import uses_envelope
from livessl.core.correlate.gcc_phat import GCCPhat
from livessl.core.correlate.spectra import FrontEnd, averaged, cepstral
from livessl.core.geometry import Grid, microphone_pairs
from livessl.core.locate import ambiguity, refine
from livessl.core.locate.estimator import Localization, Sound
from livessl.core.locate.map_estimator import MapEstimator, third_octaves_below_hz
from livessl.core.locate.peak_search import PeakSearch
from livessl.core.locate.srp import SRPFunctional
from livessl.core.methods import AVERAGED, CEPSTRAL, SRP_PHAT
from livessl.core.steering import alias_free_hz
from livessl.core.types import ArraySpec, Evidence

_SAMPLED_POINTS: Final = 4096
"""Approximate number of grid points at which the effect of a band limit is checked."""


class SrpPhat(MapEstimator):
    """The paper's standard method: GCC-PHAT of whole segments, mapped and summed over the arrays.

    Parameters
    ----------
    arrays : sequence of ArraySpec
    grid : Grid
        Search grid.
    c_m_s : float
        Speed of sound, m/s.
    band_limit : bool or None
        Whether the band is limited for each pair and grid point to prevent spatial aliasing. None limits it for arrays
        for which more than half of all pairs and points of the map would lose part of the band. This is the case for an
        array of 0.5 m on a grid of 0.5 m, but not on a grid of 0.1 m, on which the result would hardly change. If the
        band of any array of a sound is limited, the peak is read from the map. Otherwise the peak is searched for on
        the grid, which may be finer.
    """

    name = SRP_PHAT

    def __init__(
        self, arrays: Sequence[ArraySpec], grid: Grid, c_m_s: float, *, band_limit: bool | None = None
    ) -> None:
        super().__init__(arrays, grid, c_m_s)
        self._limited = {spec.name: self._limits_band(spec, band_limit) for spec in arrays}
        self._search = PeakSearch(arrays, grid, c_m_s)

    def locate(self, sounds: Mapping[str, Sound]) -> Localization:
        """Find the highest grid points of the summed maps, refine them between grid points, and return the best."""
        evidence = self.evidence(sounds)
        in_map = any(self._limited[name] for name in sounds)
        grid = self._map_grid if in_map else self.grid
        find = refine.in_map(self.power_maps(evidence, ()).fused, grid) if in_map else self._search.among(evidence)
        found = find(refine.CANDIDATES)
        functional = SRPFunctional(evidence, self.c_m_s)
        position, power = refine.refine_peaks(functional, found, grid)
        rivals = ambiguity.rivals(functional, [part.spec for part in evidence], position, power, grid)
        return Localization(
            position,
            refine.laplace_covariance_m2(functional, evidence, position, grid),
            refine.confidence(find, found[0], grid, position),
            evidence,
            candidates=rivals.candidates if rivals.is_ambiguous else (),
            ambiguity=rivals.reason if rivals.is_ambiguous else None,
        )

    def evidence(self, sounds: Mapping[str, Sound]) -> tuple[Evidence, ...]:
        """Correlate each array's sound, also over its limited bands if its band is limited."""
        if any(self._limited[name] for name in sounds):
            return tuple(self._limited_evidence(name, sounds[name]) for name in sorted(sounds))
        return super().evidence(sounds)

    def _limited_evidence(self, array: str, sound: Sound) -> Evidence:
        spec = self.arrays[array]
        gcc, *below = self._correlator(array, sound.sample_rate_hz).below(sound.segments, self._cut_offs_hz(array))
        return Evidence(spec, sound.without_dead_channels(gcc), tuple(map(sound.without_dead_channels, below)))

    def _new_correlator(self, array: str, sample_rate_hz: float) -> GCCPhat:
        correlate = super()._new_correlator(array, sample_rate_hz)
        if not self._cut_offs_hz(array):
            self._search.prepare(array, correlate.lags_s)
        return correlate

    def _cut_offs_hz(self, array: str) -> tuple[float, ...]:
        return third_octaves_below_hz(self.arrays[array].band_hz) if self._limited[array] else ()

    def _limits_band(self, spec: ArraySpec, band_limit: bool | None) -> bool:
        if uses_envelope(spec.band_hz):
            return False
        if band_limit is not None:
            return band_limit
        grid = self._map_grid
        some = grid.points_m(slice(None, None, max(1, grid.size // _SAMPLED_POINTS)))
        pairs = microphone_pairs(len(spec.microphones_m))
        limit_hz = alias_free_hz(some, spec.microphones_m, pairs, grid.spacing_m, self.c_m_s)
        return bool(np.median(limit_hz) < spec.band_hz[1])


class Cepstral(SrpPhat):
    """SRP-PHAT without the minimum-phase part of the channels (`livessl.core.correlate.spectra.cepstral`)."""

    name = CEPSTRAL
    front_end: FrontEnd = staticmethod(cepstral)


class Averaged(SrpPhat):
    """SRP-PHAT of GCCs averaged over frames of 25 ms (`livessl.core.correlate.spectra.averaged`)."""

    name = AVERAGED
    front_end: FrontEnd = staticmethod(averaged)
