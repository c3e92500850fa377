"""API models of `clip.json`: recordings of an event, their format, and why an event has none."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Literal

from pydantic import ConfigDict, Field

from livessl.schema.base import Model
from livessl.schema.values import PositionM, UtcTime

RecordingName = Annotated[
    str,
    Field(
        pattern=r"^[A-Za-z0-9_-][A-Za-z0-9._-]{0,199}\.(flac|wav)$",
        description="Name in the address of the recording.",
        examples=["array-north.flac"],
    ),
]


class MissingReason(StrEnum):
    """Why an event has no recordings.

    `speech`: speech was detected in them, and `privacy: no-speech` stores none. `status`: `server.clips.of` does not
    name the event's status. `without_sound`: no frame of it was left. `shed`: too many events waited, or the server was
    overloaded. `failed`: an error prevented it.
    """

    SPEECH = "speech"
    STATUS = "status"
    WITHOUT_SOUND = "without_sound"
    SHED = "shed"
    FAILED = "failed"


class MissingClip(Model):
    """An event without recordings, as a line of `missing.jsonl`."""

    event_id: str = Field(description="Id of the event.")
    start_ns: int = Field(description="Begin of the event, nanoseconds since the epoch.")
    reason: MissingReason


class ClipBeam(Model):
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


class ClipFile(Model):
    """One recording of a clip."""

    name: RecordingName
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
    gaps_s: list[Annotated[list[float], Field(min_length=2, max_length=2)]] = Field(
        description="Begin and end of each gap, in seconds after the first sample; samples there are zero.",
        examples=[[[0.4, 0.55]]],
    )
    gain_db: float = Field(description="Gain by which the signal was made louder for listening.", examples=[18.5])
    beams: list[ClipBeam] = Field(description="Arrays of an enhanced signal, the best first; empty for `array`.")


class ClipHead(Model):
    """The part of `clip.json` that every reader needs; only locating the event again needs more."""

    model_config = ConfigDict(strict=True)

    start_ns: int = Field(description="Begin of the event, nanoseconds since the epoch.")
    keep: bool = Field(description="Whether the recordings are kept for ever.")
    position_m: PositionM | None = Field(
        description="Place, or a place in the direction, at which the enhanced signal is beamed; null if none."
    )
    files: list[ClipFile] = Field(description="The recordings, the enhanced one first.")
    no_enhanced: str | None = Field(
        default=None, description="Why there is no enhanced signal; null if there is one, or if that is not known."
    )
