"""Draws the picture of an alert as PNG: floor plan, arrays, zones, and the ellipse of the position.

It is drawn from the alert alone, with the zones and poses of now, so it can be drawn at any time.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from livessl.core.types import FloatArray
from livessl.server.api.encode import JsonObject
from livessl.server.api.png import encode_png, map_colours
from livessl.server.zones.zone_map import ZoneMap
from livessl.site.models import Site

DEFAULT_PX: Final = 640
MAX_PX: Final = 2000
"""Length of the longer side of a picture by default, and at most, in pixels."""

ROWS_AT_ONCE: Final = 64
"""Rows whose pixels are computed together, for the memory: 1 MB for each intermediate array of the largest picture."""

MARGIN_M: Final = 0.3
"""Margin around the room, in metres."""

WITHIN_95: Final = 2.4477
"""Radius, in standard deviations, that holds 95 % of a normal distribution on a plane."""

LEAST_STD_M: Final = 0.02
"""Least standard deviation, in metres, that is drawn: a smaller ellipse could not be seen."""

_GROUND: Final = (10, 8, 30)
_GRID: Final = (34, 32, 58)
_WALL: Final = (200, 200, 210)
_ZONE: Final = (90, 170, 220)
_EXCLUDED: Final = (150, 150, 150)
_ARRAY: Final = (120, 230, 140)
_SOUND: Final = (255, 255, 255)

_Colour = tuple[int, int, int]


class _Canvas:
    """A floor plan to draw on; y goes upwards."""

    def __init__(self, site: Site, size_px: int) -> None:
        size_m = np.array(site.room.size_m[:2], dtype=np.float64) + 2.0 * MARGIN_M
        self._px_per_m = size_px / float(size_m.max())
        self.shape = tuple(max(1, round(float(side))) for side in (size_m * self._px_per_m)[::-1])
        self.pixels: NDArray[np.uint8] = np.full((*self.shape, 3), _GROUND, dtype=np.uint8)

    def centres_m(self) -> tuple[FloatArray, FloatArray]:
        """Return the coordinates of the pixels: x of the columns, and y of the rows, the highest first."""
        rows, columns = self.shape
        x_m = (np.arange(columns, dtype=np.float64) + 0.5) / self._px_per_m - MARGIN_M
        y_m = (np.arange(rows, dtype=np.float64)[::-1] + 0.5) / self._px_per_m - MARGIN_M
        return x_m, y_m

    def line(self, points_m: FloatArray, colour: _Colour, width_px: int = 1, *, closed: bool = True) -> None:
        """Draw a line through points, (n, 2)."""
        ends = np.roll(points_m, -1, axis=0) if closed else points_m[1:]
        for begin, end in zip(points_m, ends, strict=False):
            steps = 2 + int(2.0 * self._px_per_m * float(np.abs(end - begin).max()))
            self._dots(begin + np.linspace(0.0, 1.0, steps)[:, None] * (end - begin), colour, width_px)

    def _dots(self, places_m: FloatArray, colour: _Colour, width_px: int) -> None:
        rows, columns = self.shape
        across = np.floor((places_m[:, 0] + MARGIN_M) * self._px_per_m).astype(np.int64)
        down = rows - 1 - np.floor((places_m[:, 1] + MARGIN_M) * self._px_per_m).astype(np.int64)
        offsets = range(-(width_px // 2), width_px - width_px // 2)
        for i in offsets:
            for k in offsets:
                self.pixels[np.clip(down + i, 0, rows - 1), np.clip(across + k, 0, columns - 1)] = colour


def picture_of(alert: JsonObject, site: Site, zones: ZoneMap, size_px: int = DEFAULT_PX) -> bytes | None:
    """Return the picture of an alert as PNG; None for one that is about no place.

    Parameters
    ----------
    alert : JsonObject
    site : Site
    zones : ZoneMap
    size_px : int
        Length of the longer side, in pixels.
    """
    position_m = _place(alert)
    if position_m is None:
        return None
    canvas = _Canvas(site, size_px)
    event = alert["event"]
    spread_m2 = None if event is None else _horizontal(event["covariance_m2"])
    if spread_m2 is not None:
        _draw_density(canvas, position_m, spread_m2)
    _draw_room(canvas, site)
    _draw_zones(canvas, zones, alert["zones"])
    for spec in site.processed:
        _draw_cross(canvas, np.asarray(spec.centre_m[:2], dtype=np.float64), _ARRAY, 0.12, diagonal=True)
    if spread_m2 is not None:
        canvas.line(_ellipse(position_m, spread_m2), _SOUND)
    _draw_cross(canvas, position_m, _SOUND, 0.2)
    return encode_png(canvas.pixels)


def _place(alert: JsonObject) -> FloatArray | None:
    """Return where an alert is, (2,) in metres."""
    about = alert["event"] or alert["change"]
    return None if about is None else np.array(about["position_m"][:2], dtype=np.float64)


def _horizontal(covariance_m2: Sequence[Sequence[float]]) -> FloatArray:
    """Return the covariance on the floor plan, (2, 2), large enough to be seen."""
    variances_m2, axes = np.linalg.eigh(np.array(covariance_m2, dtype=np.float64)[:2, :2])
    return np.asarray((axes * np.maximum(variances_m2, LEAST_STD_M**2)) @ axes.T)


def _draw_density(canvas: _Canvas, mean_m: FloatArray, covariance_m2: FloatArray) -> None:
    """Draw how probable each place is, relative to the most probable one, in the colours of maps."""
    x_m, y_m = canvas.centres_m()
    (xx, xy), (_, yy) = np.linalg.inv(covariance_m2)
    dx, dy = (x_m - mean_m[0])[None, :], (y_m - mean_m[1])[:, None]
    for first in range(0, len(dy), ROWS_AT_ONCE):
        rows = slice(first, first + ROWS_AT_ONCE)
        level = np.exp(-(xx * dx**2 + 2.0 * xy * dx * dy[rows] + yy * dy[rows] ** 2) / 2.0)
        canvas.pixels[rows] = map_colours(level)


def _draw_room(canvas: _Canvas, site: Site) -> None:
    """Draw a grid of whole metres, and the walls."""
    width_m, depth_m = site.room.size_m[:2]
    for x_m in range(1, int(np.ceil(width_m))):
        canvas.line(np.array([[x_m, 0.0], [x_m, depth_m]]), _GRID, closed=False)
    for y_m in range(1, int(np.ceil(depth_m))):
        canvas.line(np.array([[0.0, y_m], [width_m, y_m]]), _GRID, closed=False)
    canvas.line(np.array([[0.0, 0.0], [width_m, 0.0], [width_m, depth_m], [0.0, depth_m]]), _WALL, 2)


def _draw_zones(canvas: _Canvas, zones: ZoneMap, alerted: Sequence[str]) -> None:
    """Draw the outlines of the zones; those of the alert are bold."""
    for name, zone in zones.zones.items():
        outline_m = np.array(zone.outline_m, dtype=np.float64)
        canvas.line(outline_m, _EXCLUDED if zone.exclude else _ZONE, 3 if name in alerted else 1)


def _draw_cross(
    canvas: _Canvas, centre_m: FloatArray, colour: _Colour, reach_m: float, *, diagonal: bool = False
) -> None:
    arms = np.array([[1.0, 1.0], [1.0, -1.0]]) / np.sqrt(2.0) if diagonal else np.eye(2)
    for arm in arms:
        canvas.line(np.array([centre_m - reach_m * arm, centre_m + reach_m * arm]), colour, 3, closed=False)


def _ellipse(mean_m: FloatArray, covariance_m2: FloatArray) -> FloatArray:
    """Return points on the ellipse that holds the sound with a probability of 95 %, (n, 2)."""
    angles = np.linspace(0.0, 2.0 * np.pi, 90, endpoint=False)
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return np.asarray(mean_m + WITHIN_95 * circle @ np.linalg.cholesky(covariance_m2).T)
