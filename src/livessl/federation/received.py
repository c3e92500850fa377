"""Checks what a hub reads in a site's message, and no more, so that sites of other releases are understood."""

from __future__ import annotations

from typing import Annotated, Any, Final

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from livessl.clock import utc_ns, utc_text

MAX_NS: Final = 2**63 - 1
"""Latest time that a database can hold, in 2262."""


def _instant(text: str) -> str:
    """Return a time as servers write it, as which the hub passes it on."""
    time_ns = utc_ns(text)
    if not 0 <= time_ns <= MAX_NS:
        raise ValueError(f"time: expected one from 1970 to 2262, got {text!r}")
    return utc_text(time_ns)


Instant = Annotated[str, AfterValidator(_instant)]
Name = Annotated[str, Field(min_length=1, max_length=200)]
Coordinate = Annotated[float, Field(ge=-1e6, le=1e6)]
Position = Annotated[list[Coordinate], Field(min_length=3, max_length=3)]
Angle = Annotated[float, Field(ge=-360, le=360)]
Row = Annotated[list[Annotated[float, Field(ge=-1e12, le=1e12)]], Field(min_length=3, max_length=3)]


class _Message(BaseModel):
    """Fields are of their own types only: no text is taken for a number; further fields are kept."""

    model_config = ConfigDict(strict=True, allow_inf_nan=False)


class _Start(_Message):
    """The beginning of a site's server."""


class _Hall(_Message):
    """The hall of an event, and whether it lies in the tile of its site."""

    name: Name
    in_tile: bool


class _Candidate(_Message):
    """A place at which the sound of an event may have been."""

    model_config = ConfigDict(strict=True, allow_inf_nan=False, extra="allow")

    position_m: Position


class _Contribution(_Message):
    """What an array contributed to an event; releases differ in which of the fields they send."""

    model_config = ConfigDict(strict=True, allow_inf_nan=False, extra="allow")

    azimuth_deg: Angle | None = None
    elevation_deg: Angle | None = None
    distance_m: Annotated[float, Field(ge=0, le=1e6)] | None = None


class _Event(_Message):
    """A final event."""

    id: Name
    time_utc: Instant
    confidence: Annotated[float, Field(ge=0, le=1)]
    position_m: Position | None = None
    status: Name
    method: str | None = None
    reason: str | None = None
    level_dbfs: float | None = None
    zones: list[Name] = []
    arrays: list[Name] = []
    heard_by: list[Name] = []
    duration_s: Annotated[float, Field(ge=0, le=1e6)] = 0.0
    covariance_m2: Annotated[list[Row], Field(min_length=3, max_length=3)] | None = None
    candidates: list[_Candidate] | None = None
    contributions: list[_Contribution] | None = None
    hall: _Hall | None = None


class _Track(_Message):
    """The beginning or the end of a track."""

    id: Annotated[int, Field(ge=0, lt=2**63)]
    state: str


class _Array(_Message):
    """A new state of an array."""

    name: Name
    state: str


class _Alert(_Message):
    """An alert."""

    key: Name
    raised_utc: Instant


class _Tile(_Message):
    """The hall of a site, and its tile there."""

    name: Name
    tile_m: list[tuple[Coordinate, Coordinate]]


class Report(_Message):
    """A site's report on itself."""

    version: str | None = None
    waiting: int = 0
    location_deg: tuple[float, float] | None = None
    hall: _Tile | None = None
    arrays: dict[str, str] = {}


RECEIVED: Final[dict[str, Any]] = {
    "start": _Start,
    "event": _Event,
    "track": _Track,
    "array": _Array,
    "alert": _Alert,
}
"""The model of each kind of message."""
