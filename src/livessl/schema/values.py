"""API models of the values in messages: the JSON fields of an event, a track and an array, with their descriptions.

`messages.py` has the WebSocket messages and `answers.py` the REST answers that are made of them. The models describe
and are never run on the hot path: `encode.py` writes the messages, the OpenAPI and AsyncAPI descriptions are generated
from here, and the tests hold every message that a server sends against them.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Literal

from pydantic import AwareDatetime, Field, PlainSerializer, WithJsonSchema

from livessl.clock import instant_ns, utc_text
from livessl.core.states import ClockState, Status, TrackState
from livessl.schema.base import Model
from livessl.schema.reports import Channel, DriftState, Host

Version = Annotated[
    Literal[1],
    Field(description="Version of the object; it changes only when a field is renamed or narrowed.", examples=[1]),
]
Seq = Annotated[
    int,
    Field(
        ge=0,
        description="Number of the message among all that the server has published; it grows across restarts.",
        examples=[1767225600123],
    ),
]
UtcTime = Annotated[
    AwareDatetime,
    PlainSerializer(
        lambda instant: utc_text(instant_ns(instant)),
        return_type=Annotated[str, WithJsonSchema({"type": "string", "format": "date-time"})],
        when_used="json",
    ),
    Field(description="RFC 3339 time in UTC, with microseconds.", examples=["2026-01-31T12:00:00.050000Z"]),
]
PositionM = Annotated[
    list[float],
    Field(
        min_length=3,
        max_length=3,
        description="Position [x, y, z] in metres from the room's corner; z points up.",
        examples=[[2.1, 3.4, 1.2]],
    ),
]
CovarianceM2 = Annotated[
    list[Annotated[list[float], Field(min_length=3, max_length=3)]],
    Field(
        min_length=3,
        max_length=3,
        description="Covariance of the position, 3 x 3, in square metres.",
        examples=[[[0.01, 0.0, 0.0], [0.0, 0.01, 0.0], [0.0, 0.0, 0.04]]],
    ),
]
Confidence = Annotated[
    float,
    Field(
        ge=0,
        le=1,
        description="With the method `onset`, the probability that the position is right to within 0.5 m. With other "
        "methods, how far the map's peak stands out from the next best position: no probability. 0 if refused.",
        examples=[0.93],
    ),
]
Zones = Annotated[
    list[str], Field(description="Names of the site's zones that contain the position.", examples=[["door"]])
]
ArrayNames = Annotated[list[str], Field(examples=[["north", "south"]])]
LevelDbfs = Annotated[float, Field(description="In-band level in dB relative to full scale squared.", examples=[-32.5])]
StartS = Annotated[
    float,
    Field(
        description="The same time in seconds since the live run or the recording began; negative for sound that was "
        "buffered before the server started.",
        examples=[12.35],
    ),
]
LatencyS = Annotated[float, Field(description="Seconds from the end of the sound to this answer.", examples=[0.41])]


class Versioned(Model):
    """The base of all answers: they say of which version they are."""

    v: Version


class Mode(StrEnum):
    """Source of the server's sound: nodes that capture it now, or a recorded session."""

    LIVE = "live"
    REPLAY = "replay"


class RoleName(StrEnum):
    """Rights of a client: read; also enable and disable arrays; also see clients, nodes and refusals."""

    VIEWER = "viewer"
    OPERATOR = "operator"
    ADMIN = "admin"


class ArrayCondition(StrEnum):
    """Condition of an array.

    `starting`: nothing received yet. `healthy`: it works. `quiet`: its node is connected, but its device delivers no
    sound. `degraded`: it works with a fault that `reason` names. `lost`: nothing received for 1.5 s, or its node has
    ended. `disabled`: an operator has disabled it.
    """

    STARTING = "starting"
    HEALTHY = "healthy"
    QUIET = "quiet"
    DEGRADED = "degraded"
    LOST = "lost"
    DISABLED = "disabled"


class Contribution(Model):
    """The part that one array has in an event or update."""

    array: str = Field(description="Name of the array.", examples=["north"])
    active_s: float = Field(ge=0, description="Length in seconds of its sound that was used.", examples=[0.4])
    level_dbfs: LevelDbfs | None = Field(description="Its mean level over that time; null for digital silence.")
    azimuth_deg: float = Field(
        ge=-180,
        le=180,
        description="Direction from the array's centre to the position, counter-clockwise from +x, in degrees.",
        examples=[42.5],
    )
    elevation_deg: float = Field(
        ge=-90, le=90, description="Elevation of that direction above the horizontal, in degrees.", examples=[-3.1]
    )
    distance_m: float = Field(
        ge=0, description="Distance from the array's centre to the position, in metres.", examples=[2.6]
    )
    agrees: bool | None = Field(
        default=None,
        description="Whether the array agrees with the others. One that does not is an outlier and has no part in the "
        "position. Null where this cannot be decided.",
        examples=[True],
    )
    off_deg: float | None = Field(
        default=None,
        ge=0,
        le=180,
        description="Angle in degrees between its own direction and the position, for an outlier; otherwise null.",
        examples=[None],
    )
    asked: bool = Field(
        default=False,
        description="Whether it did not detect the sound and its frames were requested from its node.",
        examples=[False],
    )


class LatencyStages(Model):
    """Stages between the end of the sound and the answer, in seconds; their sum is `latency_s`."""

    waited: float = Field(description="Wait for the quiet that ends an event; 0 for an update.", examples=[0.3])
    sent: float = Field(
        description="Until the node had sent the last message that the answer needs, by the node's clock.",
        examples=[0.03],
    )
    received: float = Field(
        description="Until the server had received it. Between two machines the clocks' difference is included, which "
        "can make it negative.",
        examples=[0.002],
    )
    located: float = Field(description="Until the answer was computed, by the server's clock.", examples=[0.02])


StagesOrNull = Annotated[
    LatencyStages | None,
    Field(description="Stages of the latency; null in a replay, whose sound is from another time."),
]


class Candidate(Model):
    """One of several places that explain a sound about equally well, such as mirror images."""

    position_m: PositionM
    probability: float = Field(ge=0, le=1, description="Its probability among all candidates.", examples=[0.5])


Candidates = Annotated[
    list[Candidate],
    Field(
        description="Where places cannot be told apart: `position_m`, and then those that explain the sound about as "
        "well, most probable first; `status` is then at most `direction-only`. Empty otherwise.",
    ),
]


class Membership(Model):
    """A zone, and the probability that the sound came from it."""

    name: str = Field(description="Name of the zone.", examples=["door"])
    probability: float = Field(
        ge=0,
        le=1,
        description="Probability by the event's covariance, given that the sound came from the search volume.",
        examples=[0.97],
    )


class Event(Model):
    """A finished sound: the accurate answer.

    Every live event has all fields. A stored one may lack those with a default if an older release has stored it.
    """

    kind: Literal["event"]
    id: str = Field(description="Name of the event; it never changes.", examples=["small-1767225600000-1"])
    time_utc: UtcTime | None = Field(
        description="Start of the sound's first active frame; null where a recording does not say when it was made."
    )
    start_s: StartS
    duration_s: float = Field(ge=0, description="Length of the sound in seconds.", examples=[0.85])
    position_m: PositionM | None = Field(description="Position of the source; null when refused.")
    covariance_m2: CovarianceM2 | None = Field(description="Covariance of the position; null when refused.")
    confidence: Confidence
    arrays: ArrayNames = Field(description="Arrays that contributed to the position.")
    method: str = Field(description="Name of the estimator.", examples=["onset", "srp-phat"])
    status: Status = Field(
        description="`located`; `direction-only` where the distance cannot be determined, where `candidates` cannot be "
        "told apart, or where the sound came from outside the search volume; `refused` where too few "
        "arrays detected the sound, the position is too uncertain, or arrays disagree and none can be excluded."
    )
    reason: str | None = Field(
        description="Why the event is not simply located, or which array was an outlier; null if there is nothing to "
        "explain.",
        examples=[None],
    )
    heard_by: ArrayNames = Field(description="Arrays that detected the sound by themselves.")
    level_dbfs: LevelDbfs | None = Field(
        description="Level of the loudest 50 ms; null for digital silence, and for a second source of unknown share."
    )
    contributions: list[Contribution] = Field(description="One entry for each array that was used.")
    zones: Zones
    membership: list[Membership] = Field(
        default=[], description="Zones from which it came with a probability of at least 0.05."
    )
    excluded: bool = Field(
        default=False,
        description="Whether its position lies in an excluded zone, or does with a probability of at least 0.5. It "
        "raises no alert.",
        examples=[False],
    )
    excluded_by: list[str] = Field(default=[], description="Names of these zones.", examples=[[]])
    late_frames: int = Field(ge=0, description="Frames that missed their window's deadline.", examples=[0])
    latency_s: LatencyS
    latency_stages_s: StagesOrNull
    late: bool = Field(description="Whether it was published again because sound arrived late.", examples=[False])
    replaces: list[str] = Field(description="Ids of events published before that this one replaces.", examples=[[]])
    source: int = Field(
        default=1,
        ge=1,
        le=2,
        description="1, or 2 for the second of two simultaneous sources, each of which has an event of its own.",
        examples=[1],
    )
    candidates: Candidates = Field(default=[])


class OtherSource(Model):
    """A further source that sounds at the same time."""

    position_m: PositionM
    covariance_m2: CovarianceM2
    confidence: Confidence
    zones: Zones


class Track(Model):
    """A source that is followed over several estimates."""

    kind: Literal["track"]
    id: int = Field(ge=0, description="Number of the track; it stays the same while the track lives.", examples=[7])
    state: TrackState
    time_utc: UtcTime | None = Field(description="Time of the state below; null where it is not known in UTC.")
    start_s: StartS
    position_m: PositionM
    velocity_m_s: Annotated[list[float], Field(min_length=3, max_length=3)] = Field(
        description="Velocity [x, y, z] in metres a second.", examples=[[0.4, 0.0, 0.0]]
    )
    covariance_m2: CovarianceM2
    zones: Zones


class Agreement(Model):
    """Agreement of an array with the others in the last ten sounds that three or more arrays detected."""

    agreed: int = Field(ge=0, le=10, description="Sounds in which it agreed.", examples=[9])
    disagreed: int = Field(ge=0, le=10, description="Sounds in which it was an outlier.", examples=[1])


class ClockOffset(Model):
    """Offset of an array's clock from a reference clock, measured from sounds that both detected."""

    offset_s: float = Field(description="Seconds by which its clock is ahead of the reference.", examples=[0.012])
    std_s: float = Field(
        ge=0, description="Standard deviation of the offset in seconds; 0 for the reference itself.", examples=[0.002]
    )
    sounds: int = Field(ge=0, description="Number of sounds that the offset was measured from.", examples=[12])
    reference: str = Field(
        description="Name of the reference clock: a node, or an array that belongs to none.", examples=["lab-pc"]
    )
    corrected_s: float = Field(
        description="Seconds, in whole frames, by which the array's times are corrected.", examples=[0.0]
    )


class Counters(Model):
    """Counts of an array since the live run or the replay began."""

    frames: int = Field(ge=0, description="Frames received.", examples=[5210])
    marks: int = Field(ge=0, description="Marks of quiet received.", examples=[90812])
    late: int = Field(ge=0, description="Frames received after their window's deadline.", examples=[0])
    rejected: int = Field(ge=0, description="Frames and marks that were not usable.", examples=[0])
    lost_frames: int = Field(ge=0, description="Frames that the node dropped for a gap or a full spool.", examples=[0])
    overflows: int = Field(ge=0, description="Blocks of the device that followed a loss of samples.", examples=[0])
    duplicates: int = Field(ge=0, description="Frames received more than once.", examples=[0])
    sequence_gaps: int = Field(
        ge=0, description="Frames missing amid live sound; they are requested again.", examples=[0]
    )
    backfilled: int = Field(
        ge=0, description="Frames from before a connection that the node sent over it: its backlog.", examples=[0]
    )
    asked: int = Field(
        ge=0, description="Sounds that it did not detect and for which its frames were requested.", examples=[3]
    )
    helped: int = Field(ge=0, description="Of these, sounds to whose position it contributed.", examples=[2])
    too_late: int = Field(
        ge=0, description="Buffered frames of a time whose final results were published without them.", examples=[0]
    )
    shed: int = Field(
        ge=0,
        description="Frames whose sound was not used because the server was overloaded, or held too many.",
        examples=[0],
    )


class Array(Model):
    """State of an array."""

    name: str = Field(description="Name in the site file.", examples=["north"])
    state: ArrayCondition
    reason: str | None = Field(description="Why it is in that state; null while it is healthy.", examples=[None])
    node: str | None = Field(description="Node that captures it; null if no node does.", examples=["lab-pc"])
    active: bool = Field(description="Whether it detects sound now.", examples=[False])
    age_s: float | None = Field(
        ge=0,
        description="Seconds since its last message; null before the first. Marks arrive every 50 ms.",
        examples=[0.04],
    )
    level_dbfs: LevelDbfs | None = Field(description="Level now; null for digital silence or before the first message.")
    noise_floor_dbfs: LevelDbfs | None = Field(description="Level of the background; null until it is known.")
    activity_threshold_dbfs: LevelDbfs | None = Field(
        description="Level above which its node's activity detection finds sound; null until the background is known."
    )
    channel_levels_dbfs: list[LevelDbfs | None] = Field(
        description="Level of each channel in the site file's order; null for digital silence.",
        examples=[[-52.1, -51.8, -52.4, -52.0]],
    )
    sample_rate_hz: float | None = Field(
        gt=0, description="Nominal sampling rate of its device in hertz; null until it is known.", examples=[48000.0]
    )
    drift_ppm: float | None = Field(
        description="Rate of the device's clock against site time in parts per million; null until it is known.",
        examples=[-12.4],
    )
    clock: ClockState | None = Field(
        description="State of the mapping from sample index to site time; null before the first mark."
    )
    agreement: Agreement
    clock_offset: ClockOffset | None = Field(description="Null until three sounds have been measured.")
    counters: Counters
    channels: list[Channel] = Field(
        description="Level of each channel in the site file's order; empty until its node has reported them."
    )
    channels_age_s: float | None = Field(
        ge=0, description="Seconds since that report; null if there is none.", examples=[0.6]
    )
    drift: DriftState | None = Field(description="How well `drift_ppm` is known; null if its node does not report it.")
    host: Host | None = Field(description="State of its node's machine; null if it is not reported.")
    enabled: bool = Field(description="Whether its sound is used; an operator can disable an array.", examples=[True])
