"""The text of `livessl check`: floor plan in characters, distances and expected errors in tables."""

from __future__ import annotations

import string
from collections.abc import Iterator
from typing import Any, Final

import numpy as np

from livessl.core.types import FloatArray
from livessl.lab.layout.measures import Layout
from livessl.site.models import Site

COLUMNS: Final = 60
"""Most characters across the floor plan: it fits into a terminal of 80 columns with its scale."""

ROWS: Final = 24
"""Most rows of the floor plan."""

TALL: Final = 2.0
"""Height of a character in widths."""

MOST_PAIRS: Final = 6
"""Most pairs of arrays whose distance is listed: those of four arrays. The table names the nearest array of each."""

LETTERS: Final = string.ascii_uppercase + string.ascii_lowercase
"""Marks of the arrays on the plan; arrays beyond the last share a mark."""


def as_text(layout: Layout, rt60_s: float) -> str:
    """Return floor plan, tables and expected errors as text."""
    return "\n".join((*floor_plan(layout.site), "", *_tables(layout, rt60_s)))


def floor_plan(site: Site) -> list[str]:
    """Return the room from above, with a letter for each array and dots around the zones."""
    x, y, _ = site.room.size_m
    cell_m = max(x / COLUMNS, y / (ROWS * TALL))
    columns, rows = max(round(x / cell_m), 1), max(round(y / (TALL * cell_m)), 1)
    cells = [[" "] * columns for _ in range(rows)]

    def put(place_m: FloatArray, mark: str) -> None:
        column, row = int(place_m[0] / x * columns), int(place_m[1] / y * rows)
        cells[min(max(row, 0), rows - 1)][min(max(column, 0), columns - 1)] = mark

    for zone in site.all_zones.values():
        corners = np.clip(np.array(zone.outline_m), 0.0, [x, y])
        for begin, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            for place_m in np.linspace(begin, end, columns + rows):
                put(place_m, "·")
    for index, spec in enumerate(site.specs):
        put(spec.centre_m, mark_of(index))
    drawn = ["".join(row) for row in reversed(cells)]
    left = len(f"{y:g}")
    return [
        f"{f'{y:g}':>{left}} ┌{'─' * columns}┐",
        *(f"{'':>{left}} │{row}│" for row in drawn),
        f"{'0':>{left}} └{'─' * columns}┘",
        f"{'':>{left}}  0{f' {x:g} m':>{columns - 1}}",
    ]


def mark_of(index: int) -> str:
    """Return the letter of an array on the plan."""
    return LETTERS[index] if index < len(LETTERS) else "*"


def _tables(layout: Layout, rt60_s: float) -> Iterator[str]:
    width = max(len("array"), *(len(array.spec.name) for array in layout.arrays))
    yield f"  {'array':<{width}}  microphones  {'centre (m)':<20}  {'size':>6}  nearest wall, nearest array"
    for index, array in enumerate(layout.arrays):
        spec, nearest = array.spec, array.nearest
        near = "" if nearest is None else f", {nearest.distance_m:.2f} m to {nearest.name}"
        centre = "(" + ", ".join(f"{length:.2f}" for length in spec.centre_m) + ")"
        yield (
            f"{mark_of(index)} {spec.name:<{width}}  {len(spec.microphones_m):>11}  {centre:<20}  "
            f"{spec.aperture_m:>4.2f} m  {array.wall.distance_m:.2f} m to {array.wall.name}{near}"
        )
    if layout.site.all_zones:
        yield f"· zones: {', '.join(layout.site.all_zones)}"
    if len(layout.arrays) > 2 and len(layout.distances_m) <= MOST_PAIRS:
        pairs = (f"{one} to {other} {apart:.2f} m" for (one, other), apart in layout.distances_m.items())
        yield f"distances: {', '.join(pairs)}"
    yield f"speed of sound: {layout.site.c_m_s:.1f} m/s, {layout.speed_source}"
    yield from _expected(layout, rt60_s)


def _expected(layout: Layout, rt60_s: float) -> Iterator[str]:
    if layout.expected is None:
        yield f"expected error: not predicted, {layout.problem}"
        return
    found = layout.expected
    each = "".join(
        f", {array.spec.name} alone {errors.percentile_m(50):.2f} m"
        for array, errors in zip(layout.arrays, found.alone, strict=True)
        if 1 < len(layout.arrays) <= 4
    )
    yield (
        f"expected error at {found.height_m:g} m height with RT60 {rt60_s:g} s: median "
        f"{found.fused.percentile_m(50):.2f} m, 95 % {found.fused.percentile_m(95):.2f} m{each}"
    )
    yield "  (a lower bound: loud sounds, microphones placed to 2 mm; `livessl plan` explains it)"


def as_json(layout: Layout, rt60_s: float) -> dict[str, Any]:
    """Return distances, speed of sound and expected errors as an object for JSON."""
    found = layout.expected
    return {
        "arrays": {
            array.spec.name: {
                "centre_m": [round(float(length), 6) for length in array.spec.centre_m],
                "microphones": len(array.spec.microphones_m),
                "size_m": round(array.spec.aperture_m, 6),
                "node": array.node,
                "nearest_wall": {"name": array.wall.name, "distance_m": round(array.wall.distance_m, 6)},
            }
            for array in layout.arrays
        },
        "distances_m": [
            {"arrays": [one, other], "distance_m": round(apart, 6)}
            for (one, other), apart in layout.distances_m.items()
        ],
        "speed_of_sound_m_s": layout.site.c_m_s,
        "expected_error": None
        if found is None
        else {
            "rt60_s": rt60_s,
            "height_m": found.height_m,
            "median_m": found.fused.percentile_m(50),
            "p95_m": found.fused.percentile_m(95),
        },
    }
