"""API models of every REST answer and error body (site, arrays, health, events, access). See `values.py`."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from typing import Annotated, Any, Final

from pydantic import BaseModel, ConfigDict, Field

from livessl.schema.base import Model
from livessl.schema.values import Array, ArrayCondition, Event, Mode, PositionM, RoleName, Track, UtcTime, Versioned
from livessl.schema.zones import BoundsM, IntervalM, ZoneShape

BandHz = Annotated[
    list[float],
    Field(
        min_length=2, max_length=2, description="Lowest and highest frequency used, in hertz.", examples=[[100, 6000]]
    ),
]


class HealthState(StrEnum):
    """Condition of the server.

    `ok`: every enabled array is healthy. `starting`: an enabled array has not sent anything yet, and the others are
    healthy. `degraded`: `reasons` says why; a server whose arrays are all disabled is degraded.
    `overloaded`: sound arrives faster than the machine can locate it, and `load` says what is shed. `failed`: the
    server stops.
    """

    OK = "ok"
    STARTING = "starting"
    DEGRADED = "degraded"
    OVERLOADED = "overloaded"
    FAILED = "failed"


class PrivacyMode(StrEnum):
    """Privacy mode.

    `recording` permits recordings of sound, `no-speech` only clips in which no speech was detected, and
    `positions-only` none.
    """

    RECORDING = "recording"
    NO_SPEECH = "no-speech"
    POSITIONS_ONLY = "positions-only"


class Door(StrEnum):
    """The entrance at which a caller was refused: the port of the nodes, or HTTP, which serves API and WebSockets."""

    NODES = "nodes"
    HTTP = "http"


class RoomSize(Model):
    """The room: a box whose lowest corner is the origin."""

    size_m: PositionM = Field(description="Size in x, y and z, in metres.", examples=[[8.0, 10.0, 4.0]])


class SearchGrid(Model):
    """Grid of the points that are searched."""

    bounds_m: BoundsM
    spacing_m: float = Field(gt=0, description="Distance between neighbouring grid points in metres.", examples=[0.05])
    shape: list[int] = Field(
        min_length=3, max_length=3, description="Number of grid points in x, y and z.", examples=[[160, 200, 80]]
    )


class ActivitySettings(Model):
    """Settings of the activity detection."""

    threshold: float = Field(gt=0, le=1, description="Threshold relative to the recent maximum.", examples=[0.1])
    floor_factor: float = Field(ge=1, description="Threshold relative to the noise floor's power.", examples=[4.0])


class ArrayGeometry(Model):
    """Position of an array and of its microphones."""

    position_m: PositionM = Field(description="Mean position of the microphones [x, y, z] in metres.")
    microphones_m: list[PositionM] = Field(
        min_length=2, description="Position of each microphone in channel order, in metres."
    )
    band_hz: BandHz


class FloorPlanPlace(Model):
    """Place of the floor plan's picture, which `GET floor-plan` returns."""

    bounds_m: list[IntervalM] = Field(
        min_length=2, max_length=2, description="Intervals in x and y.", examples=[[[0, 8], [0, 10]]]
    )


class Privacy(Model):
    """Rules for keeping sound and events."""

    mode: PrivacyMode
    retention_days: float | None = Field(
        gt=0, description="Days after which events are deleted; null if events are never deleted.", examples=[30.0]
    )


class Site(Versioned):
    """Geometry and settings of the site."""

    site: str = Field(description="Name of the site.", examples=["lab"])
    version: str = Field(description="Version of livessl that the server runs.", examples=["0.1.0"])
    mode: Mode
    room: RoomSize
    grid: SearchGrid
    speed_of_sound_m_s: float = Field(gt=0, description="Speed of sound in metres a second.", examples=[343.0])
    band_hz: BandHz
    method: str = Field(description="Name of the estimator.", examples=["onset"])
    frame_s: float = Field(gt=0, description="Length of a frame in seconds.", examples=[0.05])
    activity: ActivitySettings
    arrays: dict[str, ArrayGeometry] = Field(description="Arrays by name; a joint array replaces those that it joins.")
    joint: dict[str, list[str]] = Field(description="Names of the arrays that each joint array joins.", examples=[{}])
    zones: dict[str, ZoneShape] = Field(description="Zones by name.")
    can_draw: bool = Field(description="Whether operators can draw zones.", examples=[True])
    floor_plan: FloorPlanPlace | None = Field(description="The picture under the plan; null if there is none.")
    privacy: Privacy


class PlacedArray(Array):
    """State of an array, and where it is."""

    position_m: PositionM = Field(description="Mean position of the microphones [x, y, z] in metres.")
    microphones_m: list[PositionM] = Field(
        min_length=2, description="Position of each microphone in channel order, in metres."
    )


class Arrays(Versioned):
    """State of every array, and where it is."""

    now_utc: UtcTime = Field(description="Site time now; in a replay, the recording's time.")
    arrays: list[PlacedArray]


class Tracks(Versioned):
    """The tracks that live now."""

    tracks: list[Track]


class EventPage(Versioned):
    """A page of events, the latest start first."""

    events: list[Event]
    next_cursor: str | None = Field(
        description="Cursor of the next page: pass it unchanged as `cursor` and treat it as opaque. Null at the end.",
        examples=["1767225600050000000-17"],
    )
    previous_cursor: str | None = Field(
        description="Cursor of the first event: pass it unchanged as `after` for events that are newer, now or later. "
        "Null if no event was found.",
        examples=["1767225900050000000-42"],
    )


class EventLog(Versioned):
    """Events in the order in which they were stored."""

    position: str = Field(
        description="Pass it unchanged as `after` for the events stored from now on, and treat it as opaque.",
        examples=["0-4711"],
    )
    more: bool = Field(description="Whether more events are stored already: ask again at once.", examples=[False])
    unsaved: int = Field(ge=0, description="Events published and not stored yet: ask again soon.", examples=[0])
    complete: bool = Field(
        description="False if events may be missing: the history asked for is not this one, as after a restart of a "
        "server that keeps it in memory, or the position is too old.",
        examples=[True],
    )
    events: list[Event]


class OneEvent(Versioned, Event):
    """One event."""


class HeatMap(Versioned):
    """Number of events in each square cell of the floor plan."""

    since_utc: UtcTime | None = Field(description="Earliest start of an event; null for the beginning.")
    until_utc: UtcTime | None = Field(description="Latest start of an event; null for now.")
    bounds_m: Annotated[list[IntervalM], Field(min_length=2, max_length=2)] = Field(
        description="Intervals in x and y; the last cells may reach beyond.", examples=[[[0, 8], [0, 10]]]
    )
    spacing_m: float = Field(gt=0, description="Edge of a cell in metres.", examples=[0.25])
    shape: list[int] = Field(min_length=2, max_length=2, description="Number of cells in x and y.", examples=[[32, 40]])
    counts: list[list[int]] = Field(description="Number of events by x and y, from the lowest coordinates on.")
    events: int = Field(ge=0, description="Number of events in all cells.", examples=[123])
    elsewhere: int = Field(ge=0, description="Number of events outside the cells or without a position.", examples=[4])


class Secured(Model):
    """Connections that are protected."""

    nodes: bool = Field(description="Whether nodes need an enrolled key and are encrypted.", examples=[True])
    tokens: bool = Field(description="Whether clients need a token.", examples=[True])
    tls: bool = Field(description="Whether HTTP is encrypted.", examples=[False])


class Refused(Model):
    """Numbers of peers and requests that were refused since the start."""

    nodes: int = Field(ge=0, description="Refused at the nodes' socket.", examples=[0])
    http: int = Field(ge=0, description="Refused by the HTTP server.", examples=[0])


class LoadState(StrEnum):
    """State of the server: `normal` while it keeps up with the sound, `overloaded` while it sheds work."""

    NORMAL = "normal"
    OVERLOADED = "overloaded"


class Shed(StrEnum):
    """Work that is shed under overload, in this order.

    `updates`: only some windows of a continuing sound are located. `second_looks`: an unsure event is not located again
    from other evidence. `maps`: no power maps are drawn. `arrays`: sounds are located only from the few arrays with the
    highest power relative to their background. `quiet`: quiet frames are correlated only if sound follows.
    """

    UPDATES = "updates"
    SECOND_LOOKS = "second_looks"
    MAPS = "maps"
    ARRAYS = "arrays"
    QUIET = "quiet"


class Load(Model):
    """Load of the fusion, over the last five seconds."""

    state: LoadState
    level: int = Field(
        ge=0, description="Level of shedding: at 0 nothing is shed, and each level sheds more.", examples=[0]
    )
    since_utc: UtcTime | None = Field(description="Since when the server is overloaded; null while it keeps up.")
    delay_s: float = Field(
        ge=0, description="Longest wait of a message before it was processed, in seconds.", examples=[0.012]
    )
    busy: float = Field(ge=0, le=1, description="Share of the time in which the fusion computes.", examples=[0.31])
    messages_per_s: float = Field(ge=0, description="Messages of the nodes processed per second.", examples=[320.0])
    shed: list[Shed] = Field(description="Work that is shed now.", examples=[[]])
    updates_shed: int = Field(ge=0, description="Updates that were shed since the start.", examples=[0])
    message: str | None = Field(
        description="Figures and cure in words, while the server is overloaded; otherwise null.", examples=[None]
    )


class HealthStatus(Versioned):
    """Health as everyone may read it, without a token."""

    status: HealthState


class Health(HealthStatus):
    """Health of the server and its arrays."""

    version: str = Field(description="Version of livessl that the server runs.", examples=["0.1.0"])
    mode: Mode
    uptime_s: float = Field(ge=0, description="Seconds since the server started.", examples=[86400.0])
    arrays: dict[str, ArrayCondition] = Field(description="State of each array by name.")
    reasons: list[str] = Field(
        description="What is wrong or worth knowing, one sentence each.", examples=[["north: its node has ended"]]
    )
    load: Load
    privacy: Privacy
    secured: Secured
    refused: Refused


class KnownClient(Model):
    """A client that has a token."""

    name: str = Field(description="Name that the token was issued to.", examples=["wall"])
    role: RoleName


class RefusedCaller(Model):
    """A caller that was refused, and how often for the same reason."""

    door: Door
    who: str = Field(description="Its address, as far as it is known, or the name of the node.", examples=["192.0.2.7"])
    reason: str = Field(description="Why it was refused.", examples=["its key is not enrolled"])
    count: int = Field(ge=1, description="How often.", examples=[3])
    last_utc: UtcTime = Field(description="When it was refused last.")


class AccessList(Versioned):
    """Clients, nodes and refusals."""

    clients: list[KnownClient] = Field(description="Clients that have a token; empty where the site uses none.")
    nodes: list[str] = Field(
        description="Nodes whose keys are enrolled; empty where the site uses none.", examples=[["lab-pc"]]
    )
    refused: list[RefusedCaller] = Field(description="Callers that were refused, the latest first.")


class Switch(BaseModel):
    """Request to use an array's sound or to ignore it."""

    model_config = ConfigDict(extra="forbid", strict=True)

    enabled: bool = Field(description="`false` disables the array, `true` enables it again.", examples=[False])


class Switched(Versioned):
    """Confirmation that an array was enabled or disabled."""

    name: str = Field(description="Name of the array.", examples=["north"])
    enabled: bool = Field(description="Whether its sound is used from now on.", examples=[False])


class Error(Model):
    """Body of every error but 422."""

    detail: str = Field(
        description="What was expected and what was received.", examples=["no array 'west'; there are north, south"]
    )


class ValidationError(Model):
    """One fault of a request."""

    loc: list[str | int] = Field(description="Where the fault is.", examples=[["query", "min_confidence"]])
    msg: str = Field(
        description="What was expected and what was received.", examples=["Input should be less than or equal to 1"]
    )
    type: str = Field(description="Kind of the fault.", examples=["less_than_equal", "value_error"])
    input: Any = Field(default=None, description="The value that was received.")
    ctx: dict[str, Any] = Field(default={}, description="Limits that the value was checked against.")


class HTTPValidationError(Model):
    """Body of a 422: every fault of the request."""

    detail: list[ValidationError]


_REASONS: Final = {
    400: "The body is not text.",
    401: "The token is missing or unknown.",
    403: "The token's role is too low.",
    404: "There is nothing of that name.",
    409: "Something else owns it or needs it.",
    411: "The body's length is not declared.",
    413: "The body is too long.",
    422: "A parameter or the body is not valid, or a parameter is unknown.",
    501: "A library that it needs is not installed.",
    503: "The event database cannot be used.",
}

Responses = dict[int | str, dict[str, Any]]


def errors(*codes: int, texts: Mapping[int, str] | None = None) -> Responses:
    """OpenAPI descriptions of error answers by status; `texts` replaces the usual description of some."""
    return {
        code: {
            "model": HTTPValidationError if code == 422 else Error,
            "description": (texts or {}).get(code, _REASONS[code]),
        }
        for code in codes
    }
