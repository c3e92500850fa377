"""Estimators: from the sounds that several arrays heard to a place. Each is a name in `ESTIMATORS`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np

from livessl.core import peaks
from livessl.core.gcc import GCCPhat
from livessl.core.geometry import Grid
from livessl.core.srp import HeardBy, SRPFunctional, SRPMapper
from livessl.core.types import ArraySpec, Float32Array, FloatArray


@dataclass(frozen=True, slots=True)
class Sound:
    """What one array heard: segments, each (K, n) samples without gaps, at its sampling rate."""

    segments: tuple[Float32Array, ...]
    sample_rate_hz: float


@dataclass(frozen=True, slots=True)
class Localization:
    """A place, how sure, and the maps (G,) it was read from."""

    position_m: FloatArray
    covariance_m2: FloatArray
    confidence: float
    fused: Float32Array
    maps: Mapping[str, Float32Array]


class Estimator(Protocol):
    """Finds where the sounds came from."""

    name: str

    def prepare(self, array: str, sample_rate_hz: float) -> None:
        """Work out what an array at a sampling rate needs; `locate` does it otherwise."""
        ...

    def locate(self, sounds: Mapping[str, Sound]) -> Localization:
        """Localize one sound heard by the arrays named in `sounds`; at least one."""
        ...


class SrpPhat:
    """The paper's standard: GCC-PHAT over whole segments, mapped and summed over the arrays.

    Parameters
    ----------
    arrays : sequence of ArraySpec
    grid : Grid
    c_m_s : float
    """

    name = "srp-phat"

    def __init__(self, arrays: Sequence[ArraySpec], grid: Grid, c_m_s: float) -> None:
        self._arrays = {spec.name: spec for spec in arrays}
        self._grid = grid
        self._c_m_s = c_m_s
        self._tools: dict[str, tuple[float, GCCPhat, SRPMapper]] = {}

    def prepare(self, array: str, sample_rate_hz: float) -> None:
        """Work out an array's tables for a sampling rate."""
        self._tools_for(array, sample_rate_hz)

    def locate(self, sounds: Mapping[str, Sound]) -> Localization:
        """Sum the arrays' maps, take the peak, refine it below the grid."""
        evidence: list[HeardBy] = []
        maps: dict[str, Float32Array] = {}
        for name in sorted(sounds):  # float sums depend on the order: the answer must not
            correlate, to_map = self._tools_for(name, sounds[name].sample_rate_hz)
            gcc = correlate(sounds[name].segments)
            evidence.append(HeardBy(self._arrays[name], gcc))
            maps[name] = to_map(gcc)
        fused: Float32Array = np.asarray(np.sum(list(maps.values()), axis=0, dtype=np.float32))
        functional = SRPFunctional(evidence, self._c_m_s)
        position = peaks.best_peak(functional, fused, self._grid)
        return Localization(
            position,
            peaks.laplace_covariance_m2(functional, evidence, position, self._grid),
            peaks.confidence(fused, self._grid, position),
            fused,
            maps,
        )

    def _tools_for(self, array: str, sample_rate_hz: float) -> tuple[GCCPhat, SRPMapper]:
        known = self._tools.get(array)
        if known is not None and known[0] == sample_rate_hz:
            return known[1:]
        spec = self._arrays[array]
        correlate = GCCPhat(spec, sample_rate_hz, self._c_m_s)
        mapper = SRPMapper(spec, self._grid, correlate.pairs, correlate.lags_s, self._c_m_s)
        self._tools[array] = (sample_rate_hz, correlate, mapper)
        return correlate, mapper


ESTIMATORS: Final[dict[str, Callable[[Sequence[ArraySpec], Grid, float], Estimator]]] = {SrpPhat.name: SrpPhat}
"""Name in the site file and on the command line, and what makes it."""
