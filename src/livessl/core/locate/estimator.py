"""The interface of localization methods (estimators), and their registry: `register`, or `MODULE:NAME`.

`Estimator` is the protocol, and `register` adds a method. `livessl.core.locate.map_estimator.MapEstimator` is a base
class whose subclasses have to implement only `locate`.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Protocol

import numpy as np

from livessl.core.correlate.band import dead_channels
from livessl.core.correlate.onset_gcc import OnsetFrontEnd, OnsetGCC
from livessl.core.geometry import Grid
from livessl.core.locate.confidence import ConfidenceFeatures
from livessl.core.methods import METHODS, is_method, unknown_method
from livessl.core.types import GCC, ArraySpec, Candidate, Evidence, Float32Array, FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class Course:
    """Time and power of the frames from which the onsets of an array were computed.

    Parameters
    ----------
    frame_indices : (F,) int64
        Frame indices in ascending order. All arrays of a site count from the same origin.
    powers : (F,) float64
        In-band mean power of each frame, full scale squared.
    begin : int
        First frame index at which the sound is active; earlier frames are its pre-roll.
    """

    frame_indices: IntArray
    powers: FloatArray
    begin: int


@dataclass(frozen=True, slots=True)
class Sound:
    """The part of an event, or of a window, that one array recorded.

    Parameters
    ----------
    segments : sequence of (K, n) float32
        Samples of each stretch of active sound without a gap; at least one stretch unless `onsets` are given. The
        channels are in the order of the array's microphones.
    sample_rate_hz : float
    onsets : sequence of OnsetGCC
        Results of the estimator's `onset_front_end`, one for each frame of the sound and of its pre-roll; empty if the
        estimator has no such front end.
    suspect : bool
        Whether the array was an outlier in many of the last events.
    sources : int
        Largest number of sources to look for.
    ended : bool
        Whether the sound is complete. A sound that continues will be located again anyway, so an estimator can skip
        its slower second look at it.
    detected : bool
        Whether the array detected the sound by itself. If it did not, its frames were requested.
    course : Course or None
        Time and power of the frames of `onsets`; None if they are unknown.
    second_looks : bool
        Whether there is time for a second look, which locates an unsure event again from other evidence; False while a
        server is overloaded.
    """

    segments: Sequence[Float32Array]
    sample_rate_hz: float
    onsets: Sequence[OnsetGCC] = ()
    suspect: bool = False
    sources: int = 1
    ended: bool = True
    detected: bool = True
    course: Course | None = None
    second_looks: bool = True

    @property
    def onset_strength(self) -> float:
        """Sum over the frames of the mean onset level of the microphones; 0 without `onsets`."""
        return float(np.mean([onset.levels for onset in self.onsets])) * len(self.onsets) if self.onsets else 0.0

    def without_dead_channels(self, gcc: GCC) -> GCC:
        """Return `gcc` with zeros in the pairs of dead microphones (`livessl.core.correlate.band.dead_channels`).

        Dead microphones are recognized in the segments. Without segments, `gcc` is returned unchanged.
        """
        if not self.segments:
            return gcc
        dead = dead_channels(self.segments)
        if not dead.any():
            return gcc
        values = np.where(np.any(dead[gcc.pairs], axis=1)[:, None], np.float32(0.0), gcc.values)
        return GCC(gcc.pairs, gcc.lags_s, values)


def strongest_onsets(sounds: Mapping[str, Sound], most: int) -> dict[str, Sound]:
    """Return the sounds of at most `most` arrays, those with the strongest onsets, in the order of their names."""
    in_order = {name: sounds[name] for name in sorted(sounds)}
    if len(in_order) <= most:
        return in_order
    strongest = sorted(in_order, key=lambda name: -in_order[name].onset_strength)[:most]
    return {name: sound for name, sound in in_order.items() if name in strongest}


@dataclass(frozen=True, slots=True)
class Localization:
    """The answer of an estimator: a position, its certainty, and the evidence for it.

    Parameters
    ----------
    position_m : (3,) float64
        Metres, room corner at the origin.
    covariance_m2 : (3, 3) float64
        Square metres. If it is large compared with the distance to the nearest array, fusion reports only a direction.
    confidence : float
        0 to 1.
    evidence : tuple of Evidence
        One item for each array, in the order of the arrays' names. Power maps are drawn from the evidence. May be
        empty.
    features : ConfidenceFeatures or None
        Quantities from which the confidence was computed; None if the confidence is not a probability.
    refused : str or None
        Reason, in words, not to rely on the position; None if the position can be relied on.
    outliers : mapping of str to float, or None
        Arrays that disagree with the others and were excluded from the position; for each, the angle in degrees between
        the direction it measured and the direction to the position. None if the estimator does not look for outliers.
    unneeded : collection of str
        Arrays that were not used, because their sound does not stand out from their own noise
        (`livessl.core.locate.contributing`), or because enough other arrays have stronger onsets.
    others : tuple of Localization
        Further sources that sounded at the same time.
    candidates : tuple of Candidate
        The position, and then the places that explain the sound about as well, most probable first; empty if no other
        place does. If there are candidates, fusion reports at most a direction.
    ambiguity : str or None
        Reason, in words, for the candidates; None without candidates.
    power : float or None
        Highest in-band mean frame power attributed to this source, full scale squared. None if it is the only source,
        or if the share of one of `others` is unknown.
    """

    position_m: FloatArray
    covariance_m2: FloatArray
    confidence: float
    evidence: tuple[Evidence, ...]
    features: ConfidenceFeatures | None = None
    refused: str | None = None
    outliers: Mapping[str, float] | None = None
    unneeded: Collection[str] = ()
    others: tuple[Localization, ...] = ()
    candidates: tuple[Candidate, ...] = ()
    ambiguity: str | None = None
    power: float | None = None


@dataclass(frozen=True, slots=True)
class PowerMaps:
    """Power at every point of a grid.

    Parameters
    ----------
    grid : Grid
        Grid of the maps, which may be coarser than the grid of the search.
    fused : (G,) float32
        Sum of the maps of all arrays, in the grid's order.
    arrays : mapping of str to (G,) float32
        Maps of single arrays, by name.
    """

    grid: Grid
    fused: Float32Array
    arrays: Mapping[str, Float32Array]


class Estimator(Protocol):
    """The interface of a localization method, as fusion uses it.

    Only `locate` has to be implemented. `prepare`, which is called in live operation when a node connects, may do
    nothing; `onset_front_end` may return None; and `power_maps` is called only when a client requests a map. An
    estimator may use caches, but must return the same result for the same sounds, in whatever order they come.

    Calls come from one thread, with two exceptions: `onset_front_end` may be called for several arrays at once, and
    `power_maps` from another thread.
    """

    name: str
    """Name of the method, which every event reports; `create` sets it to the name in the registry."""

    def prepare(self, array: str, sample_rate_hz: float) -> None:
        """Compute tables that depend on an array's sampling rate, so that its first sound is not delayed.

        Raises
        ------
        ValueError
            If the rate is too low for the array's band.
        """
        ...

    def onset_front_end(self, array: str, sample_rate_hz: float) -> OnsetFrontEnd | None:
        """Return a new front end that gets every frame of an array in order; None if the segments of sounds suffice.

        The results of the front end for the frames of a sound become `Sound.onsets`.
        """
        ...

    def locate(self, sounds: Mapping[str, Sound]) -> Localization:
        """Locate the source of the sounds of one or more arrays, given by array name."""
        ...

    def power_maps(self, evidence: Sequence[Evidence], separately: Collection[str] | None = None) -> PowerMaps:
        """Compute power maps from the evidence of a `Localization`; may be called from another thread.

        Parameters
        ----------
        evidence : sequence of Evidence
        separately : collection of str, or None
            Names of the arrays whose own maps are computed in addition to the fused map; None for all arrays.
        """
        ...


Factory = Callable[[Sequence[ArraySpec], Grid, float], Estimator]
"""A function that makes an estimator from the arrays, the search grid and the speed of sound in m/s. A class whose
constructor takes these parameters is itself a factory."""


def register(name: str, factory: Factory) -> None:
    """Add a localization method, which can then be chosen by its name. A method that has this name is replaced.

    Parameters
    ----------
    name : str
        Name in the site file (`fusion.method`), in `--method` and in `livessl.locate(..., method=...)`.
    factory : callable
        Called with the arrays (sequence of `ArraySpec`), the search `Grid` and the speed of sound in m/s; returns an
        `Estimator`.

    Raises
    ------
    ValueError
        If the name is empty.
    TypeError
        If `factory` cannot be called.
    """
    if not name:
        raise ValueError("method: expected a name, got an empty text")
    if not callable(factory):
        raise TypeError(f"method {name!r}: {_no_factory(factory)}")
    METHODS[name] = factory


def create(method: str, arrays: Sequence[ArraySpec], grid: Grid, c_m_s: float) -> Estimator:
    """Return a new estimator of a method.

    Parameters
    ----------
    method : str
        Registered name, or `MODULE:NAME`, the import path of a factory.
    arrays : sequence of ArraySpec
        All arrays that may take part.
    grid : Grid
        Search grid.
    c_m_s : float
        Speed of sound, m/s.

    Raises
    ------
    ValueError
        If no method has that name, or the factory of the method cannot be imported.
    """
    if not is_method(method):
        raise ValueError(unknown_method(method))
    factory = METHODS.get(method, method)
    make: Any = _imported(factory) if isinstance(factory, str) else factory
    estimator: Estimator = make(arrays, grid, c_m_s)
    estimator.name = method
    return estimator


def _imported(path: str) -> Factory:
    """Import a factory by its path `MODULE:NAME`."""
    module, _, attribute = path.partition(":")
    try:
        factory: Any = import_module(module)
    except ImportError as error:
        raise ValueError(
            f"cannot import {module!r} for {path!r} ({error}); install it, or start in the folder of the module"
        ) from error
    try:
        for name in attribute.split("."):
            factory = getattr(factory, name)
    except AttributeError as error:
        raise ValueError(f"{path!r}: {error}; correct the name after the colon") from error
    if not callable(factory):
        raise ValueError(f"{path!r}: {_no_factory(factory)}")
    made: Factory = factory
    return made


def _no_factory(given: object) -> str:
    return (
        f"expected a factory (arrays, grid, c_m_s) -> Estimator, got {type(given).__name__}; "
        "pass the class itself, not an instance"
    )
