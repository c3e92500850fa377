"""API models of findings of the set-up and of blind spots."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from livessl.core.commission.finding import Severity
from livessl.schema.base import Model
from livessl.schema.values import Versioned


class Finding(Model):
    """One thing that is wrong with the set-up."""

    kind: Literal["finding"]
    fault: str = Field(
        description="Code of the fault: `dead`, `deaf`, `level`, `inverted`, `duplicate`, `swapped`, `mirrored`, "
        "`exchanged`, `late_channel`, `geometry`, `turned`, `moved`, `temperature`, `clipping`, `dc`, `hum`, `noisy`, "
        "`ntp` or `cpu`; others may be added.",
        examples=["swapped"],
    )
    array: str | None = Field(description="The array; null for the whole site.", examples=["south"])
    channel: int | None = Field(ge=1, description="Channel of the array, from 1; null for all.", examples=[3])
    severity: Severity
    confidence: float = Field(ge=0, le=1, description="How sure it is.", examples=[0.99])
    message: str = Field(
        description="What is wrong.",
        examples=["channels 2 and 3 of 'south' are swapped: misfit 240 -> 24 us over 5 sounds"],
    )
    cure: str = Field(description="What to do.", examples=["exchange the plugs"])
    input: int | None = Field(
        ge=1, description="Input of the device that carries the channel, if the site file names it.", examples=[7]
    )


class BlindSpot(Model):
    """A shift or turn of an array, or a reflection of the whole room, that the last sounds would not show."""

    kind: Literal["blind_spot"]
    fault: str = Field(
        description="Code of the fault that would stay hidden: `moved`, `turned` or `mirrored`; others may be added.",
        examples=["moved"],
    )
    arrays: list[str] = Field(
        min_length=1,
        description="Array; several if the same fault of each of them would stay hidden.",
        examples=[["north", "south"]],
    )
    least_m: float | None = Field(
        gt=0,
        description="Smallest shift, in metres, that these sounds would show in nine of ten cases; null for a turn.",
        examples=[0.8],
    )
    least_deg: float | None = Field(
        ge=0,
        description="Smallest turn, in degrees, that these sounds would show in nine of ten cases; of a mirrored room "
        "the turn that some array would have besides exchanged channels; null for a shift.",
        examples=[None],
    )
    along: list[float] = Field(
        min_length=3,
        max_length=3,
        description="Direction of the shift, axis of the turn, or normal of the plane of the mirror: a unit "
        "vector [x, y, z] in the axes of the room.",
        examples=[[0.96, 0.27, 0.0]],
    )
    message: str = Field(
        description="What these sounds cannot show.",
        examples=[
            "these sounds cannot show whether 'north' or 'south' is moved by less than 0.8 m along (0.96, 0.27, 0.00)"
        ],
    )
    cure: str = Field(
        description="What would show it.", examples=["clap at places that you know, and run livessl calibrate verify"]
    )


class Findings(Versioned):
    """Faults of the set-up that the last sounds show, errors first, and faults that they would not show."""

    sounds: int = Field(ge=0, description="Number of sounds that were examined.", examples=[12])
    least_sounds: int = Field(
        default=0,  # of a server that is older than the field
        ge=0,
        description="Fewest sounds from which delays are judged, so that poses and the order of channels are examined.",
        examples=[3],
    )
    findings: list[Finding]
    blind_spots: list[BlindSpot] = Field(
        default=[],  # of a server that is older than the field
        description="What these sounds cannot show about poses. Empty with fewer than `least_sounds` sounds of two "
        "arrays, and while a finding is about poses: then sizes would not hold.",
    )
