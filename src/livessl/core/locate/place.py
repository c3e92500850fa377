"""Finds the highest place of some arrays' summed maps: a search on the grid, then a refinement below it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from livessl.core.geometry import Grid
from livessl.core.locate import ambiguity, refine
from livessl.core.locate.confidence import Judgement, array_power, judge, peak_to_rms
from livessl.core.locate.peak_search import PeakSearch
from livessl.core.locate.srp import SRPFunctional
from livessl.core.types import Evidence, FloatArray

_STARTS: Final = 3
"""Grid points that are refined: of two tops between grid points, the one with the lower grid point may be higher."""


@dataclass(frozen=True, slots=True)
class Place:
    """The highest place of some arrays' summed maps.

    Parameters
    ----------
    evidence : tuple of Evidence
        Evidence of these arrays, in the order of their names.
    functional : SRPFunctional
        SRP of the evidence.
    position_m : (3,) float64
        Metres.
    power, rival_power : float
        The functional there, and the highest power outside its `refine.neighbourhood`.
    """

    evidence: tuple[Evidence, ...]
    functional: SRPFunctional
    position_m: FloatArray
    power: float
    rival_power: float

    @property
    def peak_to_rms(self) -> list[float]:
        """Peak-to-RMS ratio of each array there."""
        terms = self.functional.pair_terms(self.position_m)
        return [peak_to_rms(part, array_power(part, term)) for part, term in zip(self.evidence, terms, strict=True)]

    @property
    def stands_out_everywhere(self) -> bool:
        """True if every array's peak-to-RMS ratio there is at least 1, that of noise."""
        return min(self.peak_to_rms) >= 1.0

    def judgement(self, grid: Grid, *, whole: bool = False) -> Judgement:
        """Judge the place; `whole` if the evidence includes whole segments."""
        specs = [part.spec for part in self.evidence]
        rivals = ambiguity.rivals(self.functional, specs, self.position_m, self.power, grid)
        return judge(
            self.functional, self.evidence, self.position_m, self.power, self.rival_power, grid, whole=whole,
            rivals=rivals,
        )  # fmt: skip

    def apart_m(self, other: Place) -> float:
        """Distance from another place, in metres."""
        return float(np.linalg.norm(self.position_m - other.position_m))


def highest_place(evidence: Sequence[Evidence], search: PeakSearch, grid: Grid, c_m_s: float) -> Place:
    """Search the grid for the highest place of some evidence, and refine it below the grid.

    Parameters
    ----------
    evidence : sequence of Evidence
        Evidence of one or more arrays, in any order: it is sorted by their names, because sums depend on the order.
    search : PeakSearch
    grid : Grid
        Grid of the search.
    c_m_s : float
        Speed of sound, m/s.
    """
    evidence = tuple(sorted(evidence, key=lambda part: part.spec.name))
    find = search.among(evidence)
    found = find(_STARTS)
    functional = SRPFunctional(evidence, c_m_s)
    position_m, power = refine.refine_peaks(functional, found, grid)
    rival_power = refine.rival_power(find, grid, position_m)
    return Place(evidence, functional, position_m, power, rival_power)
