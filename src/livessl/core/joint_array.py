"""Joint arrays: several arrays on one sample clock are processed as one array of all their microphones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import astuple

import numpy as np

from livessl.core.types import MAX_MICROPHONES, ArraySpec, Uncertainty


def joined(arrays: Sequence[ArraySpec], clocks: Mapping[str, str], name: str) -> ArraySpec:
    """Join several arrays into one of all their microphones, in which pairs across arrays count too.

    Its channels are theirs, array after array.

    Parameters
    ----------
    arrays : sequence of ArraySpec
    clocks : mapping of str to str
        Name of the clock that samples each array.
    name : str
        Name of the new array.

    Raises
    ------
    ValueError
        If clocks differ or are unknown, for delays across arrays are exact only if one clock samples both; if bands
        differ, or if there are more microphones than an array may have.
    """
    require_one_clock(name, {spec.name: clocks.get(spec.name) for spec in arrays})
    bands_hz = {spec.band_hz for spec in arrays}
    if len(bands_hz) != 1:
        raise ValueError(
            f"array {name!r}: joint processing expects arrays of one band, got {sorted(bands_hz)} Hz; "
            "give them one band_hz, or let their maps be summed instead"
        )
    count = sum(len(spec.microphones_m) for spec in arrays)
    if count > MAX_MICROPHONES:
        raise ValueError(
            f"array {name!r}: joint processing expects {MAX_MICROPHONES} microphones at most, got {count}; "
            "join fewer arrays, or let their maps be summed instead"
        )
    microphones_m = np.ascontiguousarray(np.vstack([spec.microphones_m for spec in arrays]))  # sums depend on the order
    worst = Uncertainty(*np.max([astuple(spec.uncertainty) for spec in arrays], axis=0).tolist())
    parts = tuple(len(spec.microphones_m) for spec in arrays)
    return ArraySpec(name, microphones_m, bands_hz.pop(), worst, parts)


def require_one_clock(name: str, clocks: Mapping[str, str | None]) -> None:
    """Check that one clock samples all arrays that are to be joined.

    Parameters
    ----------
    name : str
        Name of the joint array.
    clocks : mapping of str to str or None
        Name of the clock that samples each array; None if it is unknown.

    Raises
    ------
    ValueError
        If the clocks differ or any is unknown.
    """
    if None in clocks.values() or len(set(clocks.values())) != 1:
        each = ", ".join(f"{array!r} by {clock or 'an unknown clock'}" for array, clock in clocks.items())
        raise ValueError(
            f"array {name!r}: joint processing expects arrays sampled by one clock, got {each}; "
            "record them through one device, or let their maps be summed instead"
        )
