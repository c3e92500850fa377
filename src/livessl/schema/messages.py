"""API models of every message of the live WebSocket (`hello`, `event`, `update`, `track`, `arrays`, `gap`, …)."""

from __future__ import annotations

from typing import Annotated, Final, Literal

from pydantic import BaseModel, Field

from livessl.core.states import Status
from livessl.schema.alerts import Alert
from livessl.schema.answers import ArrayGeometry
from livessl.schema.base import Model
from livessl.schema.values import (
    Array,
    ArrayNames,
    Candidates,
    Confidence,
    Contribution,
    CovarianceM2,
    Event,
    LatencyS,
    LevelDbfs,
    Mode,
    OtherSource,
    PositionM,
    RoleName,
    Seq,
    StagesOrNull,
    StartS,
    Track,
    UtcTime,
    Version,
    Zones,
)
from livessl.schema.zones import ZoneChange, ZoneShape

Overloaded = Annotated[
    str | None,
    Field(
        description="What an overloaded server sheds, with figures and the cure; null while it keeps up.",
        examples=[None],
    ),
]


class _Numbered(Model):
    v: Version
    seq: Seq


class Hello(_Numbered):
    """First message of every connection."""

    kind: Literal["hello"]
    now_utc: UtcTime = Field(description="Site time now; in a replay, the recording's time.")
    site: str = Field(description="Name of the site.", examples=["lab"])
    mode: Mode
    last_seq: Seq = Field(description="Number of the last message published before this connection.")
    role: RoleName = Field(description="Role of the client's token; `admin` where the site uses no tokens.")
    arrays: list[Array] = Field(description="State of every array.")
    overload: Overloaded


class EventMessage(_Numbered, Event):
    """A finished sound, published when it has ended."""


class UpdateMessage(_Numbered):
    """A preliminary position, published up to ten times a second while a sound lasts, from its last 0.2 s."""

    kind: Literal["update"]
    event_id: str = Field(description="Id that the event will have.", examples=["small-1767225600000-1"])
    time_utc: UtcTime | None = Field(description="Middle of the sound used; null where it is not known in UTC.")
    start_s: StartS
    end_utc: UtcTime | None = Field(description="End of the sound used; null where it is not known in UTC.")
    position_m: PositionM | None = Field(description="Position of the source; null when refused.")
    covariance_m2: CovarianceM2 | None = Field(description="Covariance of the position; null when refused.")
    confidence: Confidence
    arrays: ArrayNames = Field(description="Arrays that contributed to the position.")
    status: Status
    contributions: list[Contribution] = Field(description="One entry for each array that was used.")
    others: list[OtherSource] = Field(description="Further simultaneous sources, where the site enables them.")
    candidates: Candidates
    zones: Zones
    level_dbfs: LevelDbfs | None = Field(description="Level of the loudest 50 ms; null for digital silence.")
    latency_s: LatencyS | None = Field(description="Seconds from the end of the sound used; null in a replay.")
    latency_stages_s: StagesOrNull


class TrackMessage(_Numbered, Track):
    """New state of a track, published with each update."""


class ArraysMessage(_Numbered):
    """State of every array, published twice a second and as soon as one changes."""

    kind: Literal["arrays"]
    now_utc: UtcTime = Field(description="Site time now; in a replay, the recording's time.")
    mode: Mode
    arrays: list[Array] = Field(description="State of every array.")
    overload: Overloaded


class AlertMessage(_Numbered, Alert):
    """An alert of a rule; the rule's actions deliver it as well."""


class ZoneMessage(_Numbered, ZoneChange):
    """A track enters a zone, leaves it, or loiters in it."""


class ZonesMessage(_Numbered):
    """The zones in force, after an operator has drawn or deleted one."""

    kind: Literal["zones"]
    by_name: dict[str, ZoneShape] = Field(description="All zones by name.")


class PosesMessage(_Numbered):
    """Poses of the arrays, after other poses have come into force."""

    kind: Literal["poses"]
    arrays: dict[str, ArrayGeometry] = Field(description="All arrays by name.")
    changed: list[str] = Field(description="Names of the arrays that changed.", examples=[["south"]])


class Gap(Model):
    """Notice of messages that this client will not get; it has no number of its own."""

    kind: Literal["gap"]
    v: Version
    missed: int | None = Field(
        ge=1, description="How many messages are lost to this client; null where that is not known.", examples=[12]
    )
    reason: str = Field(
        description="Why they are lost, in words.",
        examples=["this client reads too slowly; 12 messages were dropped, events last"],
    )


MESSAGES: Final[tuple[type[BaseModel], ...]] = (
    Hello,
    EventMessage,
    UpdateMessage,
    TrackMessage,
    ArraysMessage,
    AlertMessage,
    ZoneMessage,
    ZonesMessage,
    PosesMessage,
    Gap,
)
"""Every message of the live WebSocket."""

Message = Annotated[
    Hello
    | EventMessage
    | UpdateMessage
    | TrackMessage
    | ArraysMessage
    | AlertMessage
    | ZoneMessage
    | ZonesMessage
    | PosesMessage
    | Gap,
    Field(discriminator="kind"),
]
"""One message of the live WebSocket; `kind` selects its model."""
