"""What a hub needs of a message to store it: no more, so that sites of other releases are understood."""

from __future__ import annotations

from typing import Annotated, Any, Final

from pydantic import AfterValidator, BaseModel, Field

from livessl.clock import utc_ns


def _instant(text: str) -> str:
    utc_ns(text)
    return text


Instant = Annotated[str, AfterValidator(_instant)]
Coordinate = Annotated[float, Field(ge=-1e6, le=1e6)]


class _Start(BaseModel):
    """The beginning of a site's server."""


class _Event(BaseModel):
    """A final event."""

    id: Annotated[str, Field(min_length=1, max_length=200)]
    time_utc: Instant
    confidence: float
    position_m: Annotated[list[Coordinate], Field(min_length=3, max_length=3)] | None = None
    status: str | None = None
    method: str | None = None
    reason: str | None = None
    level_dbfs: float | None = None
    zones: list[str] = []
    arrays: list[str] = []
    heard_by: list[str] = []


class _Track(BaseModel):
    """The beginning or the end of a track."""

    id: Annotated[int, Field(ge=0, lt=2**63)]
    state: str


class _Array(BaseModel):
    """A new state of an array."""

    name: str
    state: str


class _Alert(BaseModel):
    """An alert."""

    key: Annotated[str, Field(min_length=1, max_length=200)]
    raised_utc: Instant


class Report(BaseModel):
    """A site's report on itself."""

    version: str | None = None
    waiting: int = 0
    location_deg: tuple[float, float] | None = None
    arrays: dict[str, str] = {}


RECEIVED: Final[dict[str, Any]] = {
    "start": _Start,
    "event": _Event,
    "track": _Track,
    "array": _Array,
    "alert": _Alert,
}
"""The model of each kind of message."""
