"""Draws an array's frame to build it from (`livessl init --drawing`): views to scale, channels, distances."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final
from xml.sax.saxutils import escape

import numpy as np

from livessl.core.geometry import microphone_pairs
from livessl.core.types import FloatArray, IntArray

PAGE_MM: Final = (210.0, 297.0)
"""Width and height of the page, in millimetres: A4."""

VIEW_MM: Final = (150.0, 84.0)
"""Largest width and height of a view, in millimetres."""

SCALES: Final = (1, 2, 5, 10, 20, 50, 100)
"""Scales 1:N of the drawing; the first at which the views fit is taken."""

RULER_MM: Final = 100
"""Length, in millimetres, of the line that shows on paper whether the printer kept the scale."""

MOST_ROWS: Final = 16
"""Most microphones, and most distances, in a table: more would run off the page."""

_SAME_MM: Final = 4.0
"""Distance on paper, in millimetres, below which two microphones share one circle: its radius."""

_INK: Final = "#222"
_LINE: Final = "#999"


def drawing(title: str, order: str, microphones_m: FloatArray) -> str:
    """Return a page (SVG, A4, millimetres) with an array's frame from above and from the side.

    Parameters
    ----------
    title : str
    order : str
        In words, where which microphone is.
    microphones_m : (K, 3) float64
        Positions around the centre of the array, before it is turned, metres.
    """
    return "\n".join(_page(title, order, 1000.0 * microphones_m)) + "\n"


def _page(title: str, order: str, places_mm: FloatArray) -> Iterator[str]:
    width, height = PAGE_MM
    scale = next((n for n in SCALES if _fits(places_mm / n)), SCALES[-1])
    yield (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:g}mm" height="{height:g}mm" '
        f'viewBox="0 0 {width:g} {height:g}" font-family="sans-serif" font-size="4" fill="{_INK}">'
    )
    yield f'<rect width="{width:g}" height="{height:g}" fill="white"/>'
    yield _text(15, 16, title, 'font-size="6" font-weight="bold"')
    yield _text(15, 23, order, 'font-size="3.6"')
    yield _text(15, 29, f"Scale 1:{scale}. Lengths in millimetres; numbers are channels.", 'font-size="3.6"')
    yield from _ruler(15, 36)
    x, y, z = places_mm.T / scale
    yield from _view("from above", ("x", "y"), np.column_stack([x, y, z]), 92)
    yield from _view("from the side, seen along y", ("x", "z"), np.column_stack([x, z, -y]), 188)
    yield from _tables(places_mm, 238)
    yield "</svg>"


def _fits(views_mm: FloatArray) -> bool:
    spans = np.ptp(views_mm, axis=0)
    return bool(spans[0] <= VIEW_MM[0] and max(spans[1], spans[2]) <= VIEW_MM[1])


def _ruler(x: float, y: float) -> Iterator[str]:
    yield _stroke(x, y, x + RULER_MM, y)
    for end in (x, x + RULER_MM):
        yield _stroke(end, y - 1.5, end, y + 1.5)
    yield _text(x + RULER_MM + 4, y + 1.4, f"{RULER_MM} mm on paper, if printed at 100 %")


def _view(what: str, axes: tuple[str, str], seen_mm: FloatArray, middle: float) -> Iterator[str]:
    """Yield a view around a height on the page; (K, 3): right, up and towards the viewer, on paper."""
    centre = PAGE_MM[0] / 2.0
    points = np.column_stack([centre + seen_mm[:, 0], middle - seen_mm[:, 1]])
    yield _text(15, middle - VIEW_MM[1] / 2 - 4, what, 'font-weight="bold"')
    yield from _axes(15 + 4, middle + VIEW_MM[1] / 2 - 4, *axes)
    for i, k in _rods(seen_mm):
        yield _stroke(points[i, 0], points[i, 1], points[k, 0], points[k, 1], _LINE)
    yield _stroke(centre - 2, middle, centre + 2, middle, _LINE)
    yield _stroke(centre, middle - 2, centre, middle + 2, _LINE)
    drawn: list[list[int]] = []
    for index in np.argsort(seen_mm[:, 2], kind="stable"):
        near = next((group for group in drawn if np.hypot(*(points[group[0]] - points[index])) < _SAME_MM), None)
        if near is None:
            drawn.append([int(index)])
        else:
            near.append(int(index))
    for group in drawn:
        x, y = points[group[0]]
        label = ", ".join(str(number + 1) for number in sorted(group))
        half = max(4.0, 1.2 * len(label) + 1.5)
        yield (
            f'<rect x="{x - half:.2f}" y="{y - 4:.2f}" width="{2 * half:.2f}" height="8" rx="4" fill="white" '
            f'stroke="{_INK}" stroke-width="0.5"/>'
        )
        yield _text(x, y + 1.5, label, 'text-anchor="middle" font-weight="bold"')


def _rods(places: FloatArray) -> Iterator[tuple[int, int]]:
    """Yield the pairs that a rod may join: those that are hardly further apart than the nearest two."""
    pairs = microphone_pairs(len(places))
    apart = _distances(places, pairs)
    for (i, k), length in zip(pairs, apart, strict=True):
        if length <= 1.01 * apart.min():
            yield int(i), int(k)


def _axes(x: float, y: float, right: str, up: str) -> Iterator[str]:
    yield (
        f'<path d="M {x:g} {y - 12:g} v 12 h 12 m -2.5 -1.2 l 2.5 1.2 l -2.5 1.2 M {x - 1.2:g} {y - 9.5:g} '
        f'l 1.2 -2.5 l 1.2 2.5" fill="none" stroke="{_INK}" stroke-width="0.3"/>'
    )
    yield _text(x + 13.5, y + 1.4, right)
    yield _text(x - 1, y - 14, up)


def _tables(places_mm: FloatArray, y: float) -> Iterator[str]:
    yield _text(15, y, "microphone: x, y, z from the centre", 'font-weight="bold"')
    step = 4.6 if len(places_mm) <= 8 else 3.0
    for row, (number, place) in enumerate(list(enumerate(places_mm, 1))[:MOST_ROWS], 1):
        yield _text(15, y + step * row, f"{number}: " + ", ".join(f"{length:.1f}" for length in place + 0.0))
    pairs = microphone_pairs(len(places_mm))
    apart = _distances(places_mm, pairs)
    yield _text(115, y, "distances", 'font-weight="bold"')
    for row, ((i, k), length) in enumerate(list(zip(pairs, apart, strict=True))[:MOST_ROWS], 1):
        column, line = divmod(row - 1, 8)
        yield _text(115 + 40 * column, y + 4.6 * (line + 1), f"{i + 1} to {k + 1}: {length:.1f}")


def _distances(places: FloatArray, pairs: IntArray) -> FloatArray:
    return np.asarray(np.linalg.norm(places[pairs[:, 0]] - places[pairs[:, 1]], axis=1))


def _stroke(x: float, y: float, to_x: float, to_y: float, colour: str = _INK) -> str:
    return f'<line x1="{x:.2f}" y1="{y:.2f}" x2="{to_x:.2f}" y2="{to_y:.2f}" stroke="{colour}" stroke-width="0.5"/>'


def _text(x: float, y: float, text: str, style: str = "") -> str:
    return f'<text x="{x:.2f}" y="{y:.2f}"{" " if style else ""}{style}>{escape(text)}</text>'
