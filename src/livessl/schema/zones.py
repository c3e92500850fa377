"""API models of zones, and of what tracks do in them."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Literal

from pydantic import Field

from livessl.schema.base import Model
from livessl.schema.values import PositionM, StartS, UtcTime, Versioned, Zones

IntervalM = Annotated[
    list[float], Field(min_length=2, max_length=2, description="Lowest and highest coordinate in metres.")
]
BoundsM = Annotated[
    list[IntervalM],
    Field(min_length=3, max_length=3, description="Intervals in x, y and z.", examples=[[[0, 8], [0, 10], [0, 4]]]),
]
PointM = Annotated[list[float], Field(min_length=2, max_length=2, description="Corner [x, y] in metres.")]
ZoneName = Annotated[str, Field(description="Name of the zone.", examples=["door"])]


class ZoneOwner(StrEnum):
    """Owner of a zone: the site file, or the server, in which operators draw it."""

    SITE_FILE = "site-file"
    DRAWN = "drawn"


class Change(StrEnum):
    """Changes of a track: it enters a zone, leaves it, or has been there for the zone's `loiter_s`."""

    ENTER = "enter"
    LEAVE = "leave"
    LOITER = "loiter"


class ZoneShape(Model):
    """A named part of the room."""

    bounds_m: BoundsM = Field(description="The zone itself if it is a box; otherwise the smallest box around it.")
    polygon_m: list[PointM] | None = Field(
        description="Corners on the floor plan, in order; null for a box.", examples=[[[0, 0], [2, 0], [2, 1]]]
    )
    z_m: IntervalM | None = Field(description="Range of heights; null for all.", examples=[[0, 2.5]])
    exclude: bool = Field(description="Whether events there are flagged and never alert.", examples=[False])
    loiter_s: float | None = Field(
        gt=0, description="Stay in seconds after which a track loiters; null if none does.", examples=[30.0]
    )
    owner: ZoneOwner


class ZoneChange(Model):
    """A change of a track in a zone."""

    kind: Literal["zone"]
    change: Change
    zone: ZoneName
    track_id: int = Field(ge=0, description="Number of the track.", examples=[7])
    time_utc: UtcTime | None = Field(description="When; null where it is not known in UTC.")
    start_s: StartS
    since_utc: UtcTime | None = Field(description="When it entered; null where it is not known in UTC.")
    stay_s: float = Field(ge=0, description="Seconds since it entered.", examples=[12.4])
    position_m: PositionM
    probability: float = Field(
        ge=0, le=1, description="Probability that it is in the zone, by its covariance.", examples=[0.93]
    )
    zones: Zones


class ZoneList(Versioned):
    """The zones in force, by name."""

    zones: dict[str, ZoneShape] = Field(description="Zones by name.")
    can_draw: bool = Field(description="Whether the site file names a file for drawn zones.", examples=[True])


class OneZone(Versioned):
    """A zone that has been drawn or changed."""

    name: ZoneName
    zone: ZoneShape


class Deleted(Versioned):
    """Confirmation that a zone was deleted."""

    name: ZoneName


class Changes(Versioned):
    """Changes of tracks in zones, newest first."""

    changes: list[ZoneChange]
