"""API models of the clips of events, and of requests to keep or delete them."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from livessl.core.states import Status
from livessl.schema.clips import ClipFile, MissingReason
from livessl.schema.values import PositionM, Version


class EventClips(BaseModel):
    """The recordings of one event."""

    v: Version
    event_id: str = Field(description="Id of the event.", examples=["lab-35340000000"])
    state: Literal["none", "waiting", "stored", "unreadable"] = Field(
        description="`waiting`: the recordings are being made. `none`: there are none and there will be none. "
        "`unreadable`: there are some, and what the server has stored about them is damaged, of another release, or "
        "cannot be read from the disk."
    )
    problem: str | None = Field(
        default=None,
        description="Why the recordings are `unreadable`, and what to do, or why there are none as far as that is "
        "known; null otherwise, and from older servers.",
        examples=[None],
    )
    missing: MissingReason | None = Field(
        default=None, description="Why there are no recordings, if that is known.", examples=[None]
    )
    keep: bool = Field(description="Whether the recordings are kept for ever.")
    position_m: PositionM | None = Field(
        description="Place, or a place in the direction, at which the enhanced signal is beamed; null if none."
    )
    files: list[ClipFile] = Field(description="The recordings, the enhanced one first.")
    no_enhanced: str | None = Field(
        default=None, description="Why there is no enhanced signal; null if there is one, or if that is not known."
    )
    methods: list[str] = Field(
        description="Methods by which `POST events/{id}/relocate` can locate the event again; empty if it cannot.",
        examples=[["onset", "srp-phat"]],
    )


class ClipsState(BaseModel):
    """Figures of the clips; the counts are since the server started."""

    v: Version
    enabled: bool = Field(description="Whether the site file has `server.clips`.")
    clips: int = Field(ge=0, description="Events with recordings.")
    bytes: int = Field(ge=0, description="Size of all recordings.")
    max_bytes: int | None = Field(description="Size beyond which the oldest are deleted; null if not enabled.")
    of: list[Status] = Field(description="Statuses of the events that get recordings; empty if not enabled.")
    max_age_days: float | None = Field(description="Age at which recordings are deleted; null for none.")
    kept: int = Field(ge=0, description="Events whose recordings are kept for ever.")
    unreadable: int = Field(
        ge=0, description="Events with recordings that could not be read when they were last needed."
    )
    waiting: int = Field(ge=0, description="Events whose recordings are being made.")
    frames_dropped: int = Field(ge=0, description="Frames that no recording can contain because memory was full.")
    written: int = Field(ge=0, description="Events whose recordings were stored.")
    incomplete: int = Field(ge=0, description="Of those, events of which frames of an array are missing.")
    without_sound: int = Field(ge=0, description="Events of which no frame was left.")
    with_speech: int = Field(
        ge=0, description="Events without recordings because speech was detected in them (`privacy: no-speech`)."
    )
    shed: int = Field(ge=0, description="Events without recordings because too many waited, or because of overload.")
    failed: int = Field(ge=0, description="Events without recordings because of an error.")
    deleted: int = Field(ge=0, description="Events whose recordings were deleted because of age or lack of space.")


class KeepSwitch(BaseModel):
    """Request to keep an event's recordings for ever, or no longer."""

    model_config = ConfigDict(extra="forbid", strict=True)

    keep: bool = Field(description="`true` keeps them until they are deleted by request.", examples=[True])


class Kept(BaseModel):
    """Confirmation that an event's recordings are kept for ever, or no longer."""

    v: Version
    event_id: str = Field(description="Id of the event.")
    keep: bool = Field(description="Whether they are kept for ever from now on.")


class ClipsDeleted(BaseModel):
    """Confirmation that an event's recordings were deleted."""

    v: Version
    event_id: str = Field(description="Id of the event.")
