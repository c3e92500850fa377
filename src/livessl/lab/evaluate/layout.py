"""The room and arrays of a site file, as plain values, for the paper's experiments with other arrays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from livessl.core.correlate.gcc_phat import uses_envelope
from livessl.core.types import ArraySpec
from livessl.site.build.grid import search_grid
from livessl.site.models import Site

Interval = tuple[float, float]


@dataclass(frozen=True, slots=True)
class LaidArray:
    """An array: its name, its microphones (K, 3) in metres, and its band in Hz."""

    name: str
    microphones_m: tuple[tuple[float, ...], ...]
    band_hz: Interval

    @property
    def spec(self) -> ArraySpec:
        """The array as the core's type."""
        return ArraySpec(self.name, np.array(self.microphones_m), self.band_hz)


@dataclass(frozen=True, slots=True)
class Layout:
    """Room, grid and arrays of a site.

    Parameters
    ----------
    site : str
        Name of the site.
    room_m : (float, float, float)
    bounds_m : three (float, float)
        Search volume; sources are placed in it.
    spacing_m, c_m_s : float
        Spacing of the search grid; speed of sound.
    arrays : tuple of LaidArray
        The arrays of the site file, and then the joint ones.
    sums : tuple of (str, tuple of str)
        Name of each system whose maps are summed, and the names of its arrays.
    """

    site: str
    room_m: tuple[float, float, float]
    bounds_m: tuple[Interval, Interval, Interval]
    spacing_m: float
    c_m_s: float
    arrays: tuple[LaidArray, ...]
    sums: tuple[tuple[str, tuple[str, ...]], ...]


def layout_of(site: Site) -> Layout:
    """Return room, grid and arrays of a site, with the search volume cut to the room.

    Raises
    ------
    ValueError
        If an array's band is so high that `locate` correlates its envelope; campaigns do not.
    """
    joint = [spec for spec in site.processed if spec.name in site.joint]
    specs = [*site.specs, *joint]
    for spec in specs:
        if uses_envelope(spec.band_hz):
            low, high = spec.band_hz
            raise ValueError(
                f"--site: array {spec.name!r}: evaluate expects a band that begins low, got {low:g} to {high:g} Hz, "
                "whose envelope `locate` uses; lower its band_hz"
            )
    sums = [("all arrays", site.specs)] if len(site.specs) > 1 else []
    if joint and len(site.processed) > 1:
        sums.append(("all arrays, joint ones as one", site.processed))
    grid = search_grid(site)
    x, y, z = (
        (max(low, 0.0), min(high, size)) for (low, high), size in zip(grid.bounds_m, site.room.size_m, strict=True)
    )
    return Layout(
        site=site.site,
        room_m=site.room.size_m,
        bounds_m=(x, y, z),
        spacing_m=grid.spacing_m,
        c_m_s=site.c_m_s,
        arrays=tuple(
            LaidArray(spec.name, tuple(tuple(map(float, place)) for place in spec.microphones_m), spec.band_hz)
            for spec in specs
        ),
        sums=tuple((name, tuple(spec.name for spec in each)) for name, each in sums),
    )
