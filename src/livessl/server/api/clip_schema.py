"""The contract of the API, continued: models of the clips of events."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from livessl.schema.values import PositionM, UtcTime, Version


class ClipBeam(BaseModel):
    """The part of one array in an enhanced clip."""

    array: str = Field(description="Name of the array.", examples=["north"])
    share: float = Field(ge=0, le=1, description="Share of the signal; 0 for an array that was left out.")
    lag_s: float = Field(
        description="Seconds by which its beam was later than the first one's after known offsets of the clocks and "
        "travel times were subtracted; it is corrected."
    )
    snr_db: float | None = Field(
        description="Signal-to-noise ratio of its beam in dB; null if there was no quiet before the sound."
    )


class ClipFile(BaseModel):
    """One recording of a clip."""

    name: str = Field(description="Name in the address of the recording.", examples=["array-north.flac"])
    kind: Literal["array", "enhanced"] = Field(
        description="`array`: what the microphones of one array recorded. `enhanced`: one signal, beamed at the place."
    )
    array: str | None = Field(description="Name of the array; null for `enhanced`.", examples=["north"])
    channels: int = Field(ge=1, description="Number of channels, in the order of the array's microphones.")
    sample_rate_hz: int = Field(gt=0, description="Sampling rate in hertz.", examples=[44100])
    duration_s: float = Field(ge=0, description="Length in seconds.")
    bytes: int = Field(ge=0, description="Size of the stored file.")
    time_utc: UtcTime = Field(
        description="Time of the first sample: at the array, or for `enhanced` at the source, which is earlier."
    )
    pre_roll_s: float = Field(description="Length of the recording before the event's start, in seconds.")
    post_roll_s: float = Field(description="Length of the recording after the event's end, in seconds.")
    gaps_s: list[list[float]] = Field(
        description="Begin and end of each gap, in seconds after the first sample; samples there are zero.",
        examples=[[[0.4, 0.55]]],
    )
    gain_db: float = Field(description="Gain by which the signal was made louder for listening.", examples=[18.5])
    beams: list[ClipBeam] = Field(description="Arrays of an enhanced signal, the best first; empty for `array`.")


class EventClips(BaseModel):
    """The recordings of one event."""

    v: Version
    event_id: str = Field(description="Id of the event.", examples=["lab-35340000000"])
    state: Literal["none", "waiting", "stored"] = Field(
        description="`waiting`: the recordings are being made. `none`: there are none and there will be none."
    )
    keep: bool = Field(description="Whether the recordings are kept for ever.")
    position_m: PositionM | None = Field(description="Place at which the enhanced signal is beamed; null if none.")
    files: list[ClipFile] = Field(description="The recordings, the enhanced one first.")
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
    max_age_days: float | None = Field(description="Age at which recordings are deleted; null for none.")
    kept: int = Field(ge=0, description="Events whose recordings are kept for ever.")
    waiting: int = Field(ge=0, description="Events whose recordings are being made.")
    frames_dropped: int = Field(ge=0, description="Frames that no recording can have, for want of memory.")
    written: int = Field(ge=0, description="Events whose recordings were stored.")
    incomplete: int = Field(ge=0, description="Of those, events of which frames of an array are missing.")
    without_sound: int = Field(ge=0, description="Events of which no frame was left.")
    shed: int = Field(ge=0, description="Events without recordings because too many waited, or for the load.")
    failed: int = Field(ge=0, description="Events without recordings because of an error.")
    deleted: int = Field(ge=0, description="Events whose recordings were deleted for their age or for room.")


class KeepSwitch(BaseModel):
    """Request to keep an event's recordings for ever, or no longer."""

    model_config = ConfigDict(extra="forbid", strict=True)

    keep: bool = Field(description="`true` keeps them until somebody deletes them.", examples=[True])


class Kept(BaseModel):
    """Confirmation that an event's recordings are kept for ever, or no longer."""

    v: Version
    event_id: str = Field(description="Id of the event.")
    keep: bool = Field(description="Whether they are kept for ever from now on.")


class ClipsDeleted(BaseModel):
    """Confirmation that an event's recordings were deleted."""

    v: Version
    event_id: str = Field(description="Id of the event.")
