"""API models for setting up: sounds with delays, verification, proposals for poses, calibration."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from livessl.core.commission.verification import SetUpVerdict
from livessl.core.types import Status
from livessl.schema.findings import Finding
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
    """Refuse values that are numbers in Python but not in JSON."""
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
    next_place_m: PlaceM | None = Field(description="Where another clap would show most; null if no place is free.")


class MeasureRequest(VerifyRequest):
    """Request to measure the poses of the arrays by sounds at measured places."""

    place_std_m: Annotated[float, Field(gt=0, le=1, allow_inf_nan=False)] = Field(
        default=0.03, description="How exactly the places are known along each axis: standard deviation in metres."
    )


class RefineRequest(BaseModel):
    """Request to refine the poses of the arrays by the last sounds, wherever these were made."""

    model_config = ConfigDict(extra="forbid")

    known: Annotated[
        list[str], Field(min_length=1, description="Arrays that are where the site has them.", examples=[["north"]])
    ]
    position_std_m: Annotated[float, Field(gt=0, le=10, allow_inf_nan=False)] = Field(
        default=0.1,
        description="How exactly the positions of the other arrays are known: standard deviation in metres.",
    )


class TypedPose(BaseModel):
    """Pose of an array that was typed or dragged."""

    model_config = ConfigDict(extra="forbid")

    position_m: PlaceM
    turn_deg: Annotated[list[Coordinate], Field(min_length=3, max_length=3)] = Field(
        default=[0.0, 0.0, 0.0],
        description="Turn from the present orientation about the array's centre: angles about x, then y, then z, in "
        "degrees; the one about z counts counter-clockwise, seen from above.",
        examples=[[0.0, 0.0, 15.0]],
    )


class MoveRequest(BaseModel):
    """Request to propose poses that were typed or dragged."""

    model_config = ConfigDict(extra="forbid")

    arrays: Annotated[dict[str, TypedPose], Field(min_length=1, description="Poses by the names of the arrays.")]


class AcceptRequest(BaseModel):
    """Request to bring a proposal into force."""

    model_config = ConfigDict(extra="forbid")

    id: str = Field(description="Id of the proposal.", examples=["poses-1767225600000-1"])


class PlacedMicrophones(BaseModel):
    """Position of an array and its microphones."""

    position_m: PositionM = Field(description="Mean position of the microphones [x, y, z] in metres.")
    microphones_m: list[PositionM] = Field(description="Position of each microphone in channel order, in metres.")


class ProposedPose(BaseModel):
    """The pose of an array before and after a proposal."""

    array: str = Field(description="Name of the array.", examples=["south"])
    before: PlacedMicrophones
    after: PlacedMicrophones
    shift_m: PositionM = Field(description="Shift of its centre, in metres.")
    turn_deg: PositionM = Field(
        description="Turn about its centre: a vector along the axis, whose length is the angle in degrees."
    )
    position_std_m: float | None = Field(
        ge=0,
        description="Largest standard deviation of the position along any axis, in metres; null for a typed pose.",
        examples=[0.015],
    )
    orientation_std_deg: float | None = Field(
        ge=0,
        description="Largest standard deviation of the orientation about any axis, in degrees; null for a typed pose.",
        examples=[0.4],
    )
    misfit_us: list[float] | None = Field(
        description="Root mean square of what the poses before and after leave unexplained of the delays, in "
        "microseconds; null for a typed pose.",
        examples=[[310.2, 11.8]],
    )
    determined: bool | None = Field(
        description="Whether the sounds determine the pose; null for a typed pose.", examples=[True]
    )


class MeasuredSpeed(BaseModel):
    """The speed of sound, measured by the sounds."""

    speed_of_sound_m_s: float = Field(gt=0, description="Metres a second.", examples=[344.2])
    std_m_s: float = Field(ge=0, description="Its standard deviation, in metres a second.", examples=[0.6])
    in_force_m_s: float = Field(gt=0, description="The one that positions are computed with.", examples=[343.0])


class FittedClap(BaseModel):
    """Distance between the place of a sound and where its delays alone place it."""

    number: Number
    place_m: PlaceM
    before_m: float | None = Field(
        ge=0,
        description="With the poses before, in metres; null if fewer than two arrays received it.",
        examples=[0.84],
    )
    after_m: float | None = Field(ge=0, description="With the proposed poses, in metres.", examples=[0.03])
    agrees: bool | None = Field(description="Whether it agrees with the proposed poses.", examples=[True])


class Proposal(BaseModel):
    """Poses that an operator may accept; they are not in force."""

    id: str = Field(description="Id to accept it by.", examples=["poses-1767225600000-1"])
    method: Literal["poses", "refine", "typed"] = Field(
        description="`poses`: measured by claps at known places; `refine`: from unknown sounds; `typed`: by a person."
    )
    made_utc: UtcTime
    sounds: int = Field(ge=0, description="Number of sounds that it rests on.", examples=[8])
    known: list[str] = Field(description="Arrays that were taken to be right.", examples=[[]])
    arrays: list[ProposedPose]
    speed: MeasuredSpeed | None = Field(description="Null for typed poses.")
    claps: list[FittedClap]
    next_place_m: PlaceM | None = Field(description="Where another clap would improve the poses most; null if nowhere.")
    enough: bool = Field(
        description="Whether the poses of all arrays are known as well as is useful.", examples=[False]
    )
    refusal: str | None = Field(description="Why it cannot be accepted; null if it can.", examples=[None])


class OneProposal(Proposal):
    """A proposal."""

    v: Version


class Calibration(BaseModel):
    """The calibration file of the site, and what is in it."""

    file: str = Field(description="Its name, from the folder of the site file.", examples=["calibration/lab.yaml"])
    arrays: list[str] = Field(description="Arrays whose poses it holds; the others are where the site file says.")
    method: str | None = Field(description="How the last change was measured; null if nothing is calibrated.")
    measured_utc: str | None = Field(description="When; null if nothing is calibrated.")
    sounds: int = Field(ge=0, description="Number of sounds that it rests on.")
    can_undo: bool = Field(description="Whether there is a calibration before it to go back to.")
    problem: str | None = Field(
        description="Why the file cannot be read now; the poses in force stay.", examples=[None]
    )


class Refinement(BaseModel):
    """Agreement of the sounds that were located so far with the poses in force."""

    sounds: int = Field(ge=0, description="Number of kept sounds that two arrays received.", examples=[24])
    needed: int = Field(ge=0, description="Number from which poses are refined.", examples=[20])
    agrees: bool | None = Field(description="Whether they agree with the poses; null if they leave it open.")
    proposal: Proposal | None = Field(description="The poses that they say, if these differ; null otherwise.")


class SetUp(BaseModel):
    """The set-up in force."""

    v: Version
    calibration: Calibration
    arrays: dict[str, PlacedMicrophones] = Field(description="Where each array is now, by its name.")
    next_place_m: PlaceM | None = Field(description="Where to clap first; null if no place is free.")
    refinement: Refinement


class Changed(BaseModel):
    """Result of a change of the set-up."""

    v: Version
    changed: list[str] = Field(description="Arrays whose poses are other ones now.", examples=[["south"]])
    calibration: Calibration
    arrays: dict[str, PlacedMicrophones] = Field(description="Where each array is now, by its name.")
