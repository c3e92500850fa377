"""Polygons in the plane: whether one holds a point, and what is wrong with its corners."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import combinations
from typing import Final

MAX_POINTS: Final = 64
"""Most corners of a polygon: drawn by hand, none has more, and each costs time for every event."""

LEAST_AREA_M2: Final = 1e-4
"""Least area of a polygon, in square metres: a square of a centimetre. A smaller one is a slip."""

MAX_NAMED: Final = 3
"""Most crossings that a message names."""

Point = tuple[float, float]


def polygon_faults(points: Sequence[Point]) -> list[str]:
    """Return everything that keeps points, in metres, from being the corners of a simple polygon; nothing if they are.

    Points are numbered from 1, as people count them.
    """
    if len(points) < 3:
        return [f"at least 3 points, got {len(points)}"]
    if len(points) > MAX_POINTS:
        return [f"at most {MAX_POINTS} points, got {len(points)}"]
    faults = [
        f"each point once, points {i + 1} and {k + 1} are both {_text(points[i])}"
        for i, k in combinations(range(len(points)), 2)
        if points[i] == points[k]
    ]
    if faults:  # edges without length cross nothing and everything
        return faults[:MAX_NAMED]
    crossings = [f"no edges that cross, {one} crosses {other}" for one, other in _crossings(points)]
    if crossings:
        return crossings[:MAX_NAMED]
    if abs(signed_area_m2(points)) < LEAST_AREA_M2:
        return ["an area, all points lie on one line"]
    return []


def signed_area_m2(points: Sequence[Point]) -> float:
    """Return the area of a polygon in square metres, positive if its corners run counter-clockwise."""
    return 0.5 * sum(x0 * y1 - x1 * y0 for (x0, y0), (x1, y1) in _edges(points))


def contains(points: Sequence[Point], x: float, y: float) -> bool:
    """Return whether a polygon holds a point; its edges belong to it."""
    inside = False
    for (x0, y0), (x1, y1) in _edges(points):
        if _turn((x0, y0), (x1, y1), (x, y)) == 0.0 and _between(x0, x, x1) and _between(y0, y, y1):
            return True
        if (y0 > y) != (y1 > y) and x < x0 + (y - y0) / (y1 - y0) * (x1 - x0):
            inside = not inside
    return inside


def distance_m(points: Sequence[Point], x: float, y: float) -> float:
    """Return how far a point lies outside a polygon, in metres; 0 for a point that the polygon holds."""
    if contains(points, x, y):
        return 0.0
    return min(_distance_to_edge_m(one, other, (x, y)) for one, other in _edges(points))


def _distance_to_edge_m(one: Point, other: Point, point: Point) -> float:
    """Return the distance, in metres, of a point from the line segment between two others."""
    length_m = math.dist(one, other)
    along = 0.0 if length_m == 0.0 else _dot(one, other, point) / length_m**2
    share = min(1.0, max(0.0, along))
    nearest = one[0] + share * (other[0] - one[0]), one[1] + share * (other[1] - one[1])
    return math.dist(nearest, point)


def _edges(points: Sequence[Point]) -> Iterator[tuple[Point, Point]]:
    yield from zip(points, (*points[1:], points[0]), strict=True)


def _crossings(points: Sequence[Point]) -> Iterator[tuple[str, str]]:
    """Yield the pairs of edges that have a point in common which is not their common corner."""
    count = len(points)
    for (i, one), (k, other) in combinations(enumerate(_edges(points)), 2):
        if k == i + 1 or (i == 0 and k == count - 1):
            corner, a, b = (other[0], one[0], other[1]) if k == i + 1 else (one[0], other[0], one[1])
            folded = _turn(corner, a, b) == 0.0 and _dot(corner, a, b) > 0.0
            meet = folded and count > 3  # a triangle on a line has no area, which says more
        else:
            meet = _meet(one, other)
        if meet:
            yield tuple(f"{m + 1}-{(m + 1) % count + 1}" for m in (i, k))  # type: ignore[misc]


def _meet(one: tuple[Point, Point], other: tuple[Point, Point]) -> bool:
    (a, b), (c, d) = one, other
    turns = _turn(a, b, c), _turn(a, b, d), _turn(c, d, a), _turn(c, d, b)
    if turns[0] * turns[1] < 0.0 and turns[2] * turns[3] < 0.0:
        return True
    touching = zip(turns, (c, d, a, b), (one, one, other, other), strict=True)
    return any(
        turn == 0.0 and _between(p[0], point[0], q[0]) and _between(p[1], point[1], q[1])
        for turn, point, (p, q) in touching
    )


def _turn(a: Point, b: Point, c: Point) -> float:
    """Return twice the area of a triangle, positive if it runs counter-clockwise; 0 for rounding alone."""
    area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
    size = max(abs(b[0] - a[0]), abs(b[1] - a[1]), abs(c[0] - a[0]), abs(c[1] - a[1]))
    return 0.0 if abs(area) <= 1e-12 * size * size else area


def _dot(corner: Point, a: Point, b: Point) -> float:
    return (a[0] - corner[0]) * (b[0] - corner[0]) + (a[1] - corner[1]) * (b[1] - corner[1])


def _between(low: float, value: float, high: float) -> bool:
    return min(low, high) <= value <= max(low, high)


def _text(point: Point) -> str:
    return f"[{point[0]:g}, {point[1]:g}]"
