"""Models of the routes for setting up: the last sounds with their delays, and the verification by known places."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from livessl.core.commission.verification import SetUpVerdict
from livessl.core.types import Status
from livessl.schema.answers import Finding
from livessl.schema.values import PositionM, UtcTime, Version

MOST_CLAPS = 64
"""Most known places of one verification."""

Number = Annotated[int, Field(ge=1, description="Number of the sound; later sounds have higher ones.", examples=[17])]
Coordinate = Annotated[float, Field(strict=True, ge=-1e4, le=1e4, allow_inf_nan=False)]
PlaceM = Annotated[
    list[Coordinate],
    Field(min_length=3, max_length=3, description="Measured place [x, y, z] in metres.", examples=[[2.0, 3.0, 1.2]]),
]


def _whole(value: object) -> object:
    """Refuse what is a number in Python, but none in JSON."""
    if isinstance(value, bool | str | bytes):
        raise ValueError("expected a whole number")
    return value


class ObservedDelays(BaseModel):
    """Delays and levels of one sound at the channels of one array, measured without any geometry."""

    array: str = Field(description="Name of the array.", examples=["north"])
    delays_us: list[float | None] = Field(
        description="Delay of each channel against the mean of those that have one, in microseconds; null for a "
        "channel without sound.",
        examples=[[-210.4, 95.1, 60.0, 55.3]],
    )
    inverted: list[bool] = Field(description="Channels of opposite polarity to most.")
    coherence: list[float] = Field(
        description="How well each channel correlates with the others: about 1 for one direct sound, 0 for another one."
    )
    powers: list[float] = Field(description="Mean power of each channel, full scale squared.")
    sharpness: float = Field(description="How far the correlations stand out; noise gives 1 to 3.", examples=[7.5])
    closure_us: float = Field(ge=0, description="Contradiction between the pairs, in microseconds.", examples=[4.1])


class HeardSound(BaseModel):
    """A finished sound: where it was located, and the delays within each array."""

    number: Number
    id: str = Field(description="Id of its event.", examples=["small-1767225600000-1"])
    time_utc: UtcTime = Field(description="Site time of its beginning; in a replay, the recording's time.")
    position_m: PositionM | None = Field(description="Where it was located; null if that was refused.")
    status: Status
    reason: str | None = Field(description="Why it was not located; otherwise null.", examples=[None])
    observations: list[ObservedDelays] = Field(description="One entry for each array that received it exactly.")


class HeardSounds(BaseModel):
    """The last sounds that were finished, the oldest first."""

    v: Version
    now_utc: UtcTime = Field(description="Site time now; in a replay, the recording's time.")
    last: int = Field(
        ge=0, description="Number of the newest sound; sounds that come later have higher ones.", examples=[17]
    )
    sounds: list[HeardSound]


class ClapRequest(BaseModel):
    """One sound and the place where it was made."""

    model_config = ConfigDict(extra="forbid")

    number: Annotated[
        int, Field(ge=1, le=2**53, description="Number of the sound.", examples=[17]), BeforeValidator(_whole)
    ]
    place_m: PlaceM


class VerifyRequest(BaseModel):
    """Request to verify the set-up by sounds at measured places."""

    model_config = ConfigDict(extra="forbid")

    claps: Annotated[list[ClapRequest], Field(min_length=1, max_length=MOST_CLAPS)]


class VerifiedClap(BaseModel):
    """One sound at a measured place, with the error of its position."""

    number: Number
    place_m: PlaceM
    position_m: PositionM | None = Field(description="Where it was located; null if that was refused.")
    error_m: float | None = Field(ge=0, description="Distance of the two, in metres.", examples=[0.06])
    status: Status
    reason: str | None = Field(description="Why it was not located; otherwise null.", examples=[None])


class Verified(BaseModel):
    """Result of the verification."""

    v: Version
    verdict: SetUpVerdict
    claps: list[VerifiedClap]
    findings: list[Finding] = Field(description="What explains the errors.")
