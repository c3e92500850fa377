"""Warnings of `livessl plan`, each with the cure: arrays in a line, near a wall, too small, or aliased."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from livessl.core import mirror
from livessl.core.types import FloatArray
from livessl.lab.plan.design import SHARES, ArrayPlan, Plan
from livessl.lab.plan.prediction import CLEARANCE_M
from livessl.site.build.grid import search_grid

IN_LINE_M: Final = 0.3
"""Arrays count as collinear if their RMS distance from the best-fitting line is at most this, in metres."""

MAX_ALIASED_SHARE: Final = 0.5
"""Share of (point, pair) combinations that alias inside the band, above which the grid is reported as too coarse."""

MAX_EDGE_PER_RATE: Final = 0.45
"""Highest band edge, as a share of the sample rate, at which correlations are interpolated accurately."""

_MEDIAN: Final = SHARES.index(50)
"""Index of the median in `ArrayPlan.alias_free_hz`."""

_WALLS: Final = (("x = 0", "x = {:g} m"), ("y = 0", "y = {:g} m"), ("the floor", "the ceiling"))


def warnings(plan: Plan) -> list[str]:
    """Return everything that a user should consider before mounting the arrays."""
    found = [*_together(plan)]
    for array in plan.arrays:
        found += _near_walls(plan, array)
        found += _size(plan, array)
        found += _sampling(plan, array)
    return found


def _together(plan: Plan) -> Iterator[str]:
    if plan.site.joint:
        yield (
            f"the plan treats the joint arrays ({', '.join(plan.site.joint)}) as separate ones whose maps are summed"
        )
    if len(plan.arrays) == 1:
        yield "one array alone measures a direction, but hardly a distance; set up a second one, metres apart"
    centres = np.array([array.spec.centre_m for array in plan.arrays])
    if len(centres) >= 3 and _scatter_m(centres)[1] < IN_LINE_M:
        yield (
            "all arrays stand in one line: the distance of a sound beyond either end of that line is poorly "
            "determined; move one array metres to the side"
        )
    mirrored = mirror.warning(plan.site.specs, search_grid(plan.site), plan.site.c_m_s)
    if mirrored is not None:
        yield f"{mirrored}; the error above does not include that"


def _scatter_m(points_m: FloatArray) -> FloatArray:
    """Return the RMS spread (3,) along the points' principal axes, largest first."""
    spread = np.linalg.svd(points_m - points_m.mean(axis=0), compute_uv=False) / np.sqrt(len(points_m))
    return np.concatenate([spread, np.zeros(3)])[:3]


def _near_walls(plan: Plan, array: ArrayPlan) -> Iterator[str]:
    for axis, names in enumerate(_WALLS):
        length = plan.site.room.size_m[axis]
        across = array.spec.microphones_m[:, axis]
        for name, gap, k in (
            (names[0], float(across.min()), int(across.argmin())),
            (names[1].format(length), float(length - across.max()), int(across.argmax())),
        ):
            if gap < CLEARANCE_M - 1e-9:
                wall = name if axis == 2 else f"the wall {name}"
                yield (
                    f"array {array.spec.name!r}: microphone {k + 1} is {gap:.2f} m from {wall}, whose reflection "
                    f"arrives too soon to be separated from the direct sound; keep {CLEARANCE_M:g} m"
                )


def _size(plan: Plan, array: ArrayPlan) -> Iterator[str]:
    aperture, (_, high) = array.spec.aperture_m, array.spec.band_hz
    if aperture > plan.conditions.critical_m:
        yield (
            f"array {array.spec.name!r}: its aperture of {aperture:.2f} m is wider than the critical distance of "
            f"{plan.conditions.critical_m:.2f} m at RT60 {plan.rt60_s:g} s: reverberation covers the direct sound "
            "at some microphones, and false peaks are likely; the error above ignores them; "
            "build it smaller, and set several arrays far apart"
        )
    if aperture * high / plan.site.c_m_s < 0.5:
        needed = plan.site.c_m_s / (2.0 * high)
        yield (
            f"array {array.spec.name!r}: its aperture of {aperture:.3f} m is less than half a wavelength in its whole "
            f"band up to {high:g} Hz; build it {needed:.3f} m wide or more, or raise band_hz"
        )


def _sampling(plan: Plan, array: ArrayPlan) -> Iterator[str]:
    high, spacing = array.spec.band_hz[1], plan.site.grid.spacing_m
    if high > MAX_EDGE_PER_RATE * array.sample_rate_hz:
        yield (
            f"array {array.spec.name!r}: a band up to {high:g} Hz needs a sample rate of "
            f"{high / MAX_EDGE_PER_RATE:.0f} Hz or more, got {array.sample_rate_hz:g} Hz; raise sample_rate_hz "
            "or lower band_hz"
        )
    if array.beyond_grid > MAX_ALIASED_SHARE:
        median_hz = array.alias_free_hz[_MEDIAN]
        fits = spacing * median_hz / high
        yield (
            f"array {array.spec.name!r}: a grid of {spacing:g} m is too coarse for {high:g} Hz: "
            f"{array.beyond_grid:.0%} of all (point, pair) combinations alias below {high:g} Hz; the median alias-free "
            f"frequency is {median_hz:.0f} Hz; use grid.spacing_m {fits:.2g} m"
        )
