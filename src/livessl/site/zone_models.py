"""Keys and checks of `zones` and `floor_plan` in the site file: boxes, polygons, heights."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

from pydantic import Field, field_validator, model_validator

from livessl.site import polygon
from livessl.site.fields import Bounds, Coordinate, FileName, Interval, Model, Positive, ordered


class Zone(Model):
    """A part of the room with a name: a box, or a polygon on the floor plan with a range of heights."""

    bounds_m: Bounds | None = Field(default=None, description="A box: lowest and highest x, y and z in metres.")
    polygon_m: tuple[tuple[Coordinate, Coordinate], ...] | None = Field(
        default=None, description="Instead of a box, corners [x, y] on the floor plan in metres, in order."
    )
    z_m: Interval | None = Field(default=None, description="Lowest and highest z of a polygon in metres; null for all.")
    exclude: bool = Field(default=False, description="Whether events there are flagged and never alert.")
    loiter_s: Positive | None = Field(
        default=None, description="Stay in seconds after which a track loiters; null if none does."
    )

    @field_validator("bounds_m")
    @classmethod
    def _ordered(cls, bounds: Bounds | None) -> Bounds | None:
        return None if bounds is None else ordered(bounds)

    @field_validator("polygon_m")
    @classmethod
    def _simple(cls, points: tuple[polygon.Point, ...] | None) -> tuple[polygon.Point, ...] | None:
        if points is not None and len(points) > 3 and points[0] == points[-1]:
            points = points[:-1]  # a closed ring, as other programs write it
        faults = [] if points is None else polygon.polygon_faults(points)
        if faults:
            raise ValueError(
                f"expected a polygon with {'; '.join(faults)}; correct the points, in order around the zone"
            )
        return points

    @field_validator("z_m")
    @classmethod
    def _upwards(cls, z_m: Interval | None) -> Interval | None:
        if z_m is not None and z_m[0] >= z_m[1]:
            raise ValueError(f"expected [low, high] with low < high, got [{z_m[0]:g}, {z_m[1]:g}]; swap them")
        return z_m

    @model_validator(mode="after")
    def _one_form(self) -> Zone:
        if (self.bounds_m is None) == (self.polygon_m is None):
            got = "neither" if self.bounds_m is None else "both"
            raise ValueError(f"expected either bounds_m (a box) or polygon_m (corners on the floor plan), got {got}")
        if self.bounds_m is not None and self.z_m is not None:
            raise ValueError("z_m belongs to polygon_m: a box has its heights in bounds_m; remove it")
        if self.exclude and self.loiter_s is not None:
            raise ValueError("nothing is reported of tracks in an excluded zone; remove loiter_s or exclude")
        return self

    @property
    def outline_m(self) -> tuple[polygon.Point, ...]:
        """Corners on the floor plan, in metres."""
        if self.polygon_m is not None:
            return self.polygon_m
        assert self.bounds_m is not None
        (x0, x1), (y0, y1), _ = self.bounds_m
        return (x0, y0), (x1, y0), (x1, y1), (x0, y1)

    @property
    def heights_m(self) -> Interval | None:
        """Lowest and highest z in metres; None for all heights."""
        return self.z_m if self.bounds_m is None else self.bounds_m[2]

    def box_m(self, height_m: float) -> Bounds:
        """Return the smallest box around the zone, up to the ceiling, `height_m` high, where it has no heights."""
        xs, ys = zip(*self.outline_m, strict=True)
        return (min(xs), max(xs)), (min(ys), max(ys)), self.heights_m or (0.0, height_m)

    def contains(self, position_m: Sequence[float]) -> bool:
        """Return True if a position lies inside the zone or on its surface."""
        x, y, z = position_m
        low, high = self.heights_m or (-float("inf"), float("inf"))
        if not low <= z <= high:
            return False
        if self.bounds_m is not None:
            return all(low <= value <= high for value, (low, high) in zip((x, y), self.bounds_m[:2], strict=True))
        return polygon.contains(self.outline_m, x, y)


class FloorPlan(Model):
    """A picture that lies under maps and zones: PNG or SVG."""

    image: FileName
    m_per_pixel: Annotated[Positive, Field(le=10)]
    origin_m: tuple[Coordinate, Coordinate] = (0.0, 0.0)
