"""The base class of estimators that sum power maps, and the resolution of the maps that are drawn."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping, Sequence
from typing import Final

import numpy as np

from livessl.core.correlate.gcc_phat import GCCPhat, correlated
from livessl.core.correlate.onset_gcc import OnsetFrontEnd
from livessl.core.correlate.spectra import FrontEnd, whole_segment
from livessl.core.geometry import Grid, microphone_pairs
from livessl.core.locate.estimator import Localization, PowerMaps, Sound
from livessl.core.locate.srp import SRPMapper
from livessl.core.types import ArraySpec, Evidence, Float32Array, FloatArray

MAP_SPACING_M: Final = 0.1
"""Finest spacing, in metres, of maps that are drawn; a screen shows no finer details of a room."""

MAP_POINTS: Final = 1_000_000
"""Largest number of points of a map that is drawn. A screen shows fewer, and ten maps of that size can be drawn per
second. A room of 8 x 10 x 4 m has a third as many at 0.1 m; a yard of 400 x 400 x 10 m is drawn at 1.2 m."""

MAP_BYTES: Final = 128_000_000
"""Largest memory, in bytes, of the look-up tables for the maps of all arrays."""

_LOWEST_CUT_OFF_HZ: Final = 100.0
"""Lowest cut-off of a limited band, in hertz, where the array's own band begins at 0 Hz."""


class MapEstimator(ABC):
    """An `Estimator` without `locate`: it computes the GCC-PHAT of whole segments, and power maps from them.

    A subclass needs one more method:

    >>> class HighestGridPoint(MapEstimator):
    ...     def locate(self, sounds):
    ...         evidence = self.evidence(sounds)
    ...         maps = self.power_maps(evidence)
    ...         position_m = maps.grid.point_m(int(maps.fused.argmax()))
    ...         return Localization(position_m, np.diag(maps.grid.cell_m**2), 0.5, evidence)
    >>> register("highest-grid-point", HighestGridPoint)  # doctest: +SKIP

    Parameters
    ----------
    arrays : sequence of ArraySpec
    grid : Grid
        Search grid. `power_maps` uses a coarser grid if this one is finer than needed or its tables would be too large.
    c_m_s : float
        Speed of sound, m/s.
    """

    name = ""
    front_end: FrontEnd = staticmethod(whole_segment)

    def __init__(self, arrays: Sequence[ArraySpec], grid: Grid, c_m_s: float) -> None:
        self.arrays = {spec.name: spec for spec in arrays}
        self.grid = grid
        self.c_m_s = c_m_s
        self._map_grid = map_grid(arrays, grid)
        self._correlators: dict[str, tuple[float, GCCPhat]] = {}
        self._mappers: dict[str, tuple[FloatArray, SRPMapper]] = {}

    @abstractmethod
    def locate(self, sounds: Mapping[str, Sound]) -> Localization:
        """Locate the source of the sounds of one or more arrays, given by array name."""

    def prepare(self, array: str, sample_rate_hz: float) -> None:
        """Compute an array's tables for a sampling rate.

        Raises
        ------
        ValueError
            If the rate is too low for the array's band.
        """
        self._correlator(array, sample_rate_hz)

    def onset_front_end(self, array: str, sample_rate_hz: float) -> OnsetFrontEnd | None:  # noqa: ARG002 - an Estimator
        """Return None, because segments suffice."""
        return None

    def evidence(self, sounds: Mapping[str, Sound]) -> tuple[Evidence, ...]:
        """Correlate each array's sound; the evidence is in the order of the arrays' names.

        Floating-point sums depend on their order, but the result must not depend on the order of `sounds`.
        """
        in_order = {name: sounds[name] for name in sorted(sounds)}
        correlators = [self._correlator(name, sound.sample_rate_hz) for name, sound in in_order.items()]
        segments = [sound.segments for sound in in_order.values()]
        gccs = correlated(list(zip(correlators, segments, strict=True)))
        return tuple(
            Evidence(self.arrays[name], sound.without_dead_channels(gcc))
            for (name, sound), gcc in zip(in_order.items(), gccs, strict=True)
        )

    def power_maps(self, evidence: Sequence[Evidence], separately: Collection[str] | None = None) -> PowerMaps:
        """Map each array's evidence onto the grid of maps, and sum."""
        fused = np.zeros(self._map_grid.size, dtype=np.float32)
        arrays: dict[str, Float32Array] = {}
        for part in evidence:
            mapper = self._mapper(part)
            if separately is None or part.spec.name in separately:
                arrays[part.spec.name] = mapper(part.gcc, *part.below)
                fused += arrays[part.spec.name]
            else:
                mapper.add(fused, part.gcc, *part.below)
        return PowerMaps(self._map_grid, fused, arrays)

    def _correlator(self, array: str, sample_rate_hz: float) -> GCCPhat:
        known = self._correlators.get(array)
        if known is not None and known[0] == sample_rate_hz:
            return known[1]
        correlate = self._new_correlator(array, sample_rate_hz)
        self._correlators[array] = (sample_rate_hz, correlate)
        return correlate

    def _new_correlator(self, array: str, sample_rate_hz: float) -> GCCPhat:
        return GCCPhat(self.arrays[array], sample_rate_hz, self.c_m_s, self.front_end)

    def _mapper(self, evidence: Evidence) -> SRPMapper:
        """Return the mapper for an array's lag axis, which changes with its sampling rate.

        Evidence from an estimator with another set-up of the arrays gets its own mapper.
        """
        spec, gcc = evidence.spec, evidence.gcc
        is_own = spec is self.arrays.get(spec.name)
        known = self._mappers.get(spec.name) if is_own else None
        if known is not None and np.array_equal(known[0], gcc.lags_s):
            return known[1]
        cut_offs_hz = third_octaves_below_hz(spec.band_hz)[: len(evidence.below)]
        mapper = SRPMapper(spec, self._map_grid, gcc.pairs, gcc.lags_s, self.c_m_s, cut_offs_hz)
        if is_own:
            self._mappers[spec.name] = (gcc.lags_s, mapper)
        return mapper


def map_grid(arrays: Sequence[ArraySpec], grid: Grid) -> Grid:
    """Return the grid on which maps are drawn: `grid`, or a coarser one if `grid` is finer than `MAP_SPACING_M`.

    The spacing grows further until there are at most `MAP_POINTS` and the look-up tables take at most `MAP_BYTES`.
    """
    pairs = sum(len(microphone_pairs(len(spec.microphones_m))) for spec in arrays)
    drawn = grid if grid.spacing_m >= MAP_SPACING_M else Grid(grid.bounds_m, MAP_SPACING_M)
    while drawn.size > MAP_POINTS or 2 * pairs * drawn.size > MAP_BYTES:
        drawn = Grid(grid.bounds_m, 1.1 * drawn.spacing_m)
    return drawn


def third_octaves_below_hz(band_hz: tuple[float, float]) -> tuple[float, ...]:
    """Return cut-offs in Hz, in steps of a third of an octave down from a band's upper edge to its lower edge."""
    low, high = band_hz
    steps = np.arange(1, int(3.0 * np.log2(high / max(low, _LOWEST_CUT_OFF_HZ))) + 1)
    return tuple(float(cut_off) for cut_off in high * 2.0 ** (-steps / 3.0))
