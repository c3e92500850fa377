"""API models of an event that is located again, with both answers."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from livessl.core.states import Status
from livessl.schema.base import Model
from livessl.schema.values import ArrayNames, Candidates, Confidence, CovarianceM2, PositionM, Versioned


class RelocateRequest(BaseModel):
    """Request to locate an event again from its recordings."""

    model_config = ConfigDict(extra="forbid", strict=True)

    method: str | None = Field(
        default=None,
        min_length=1,
        max_length=200,
        description="One of the `methods` of `GET events/{id}/clips`; null takes that of the event.",
        examples=["srp-phat"],
    )
    set_up: Literal["then", "now"] = Field(
        default="then",
        description="Places of the microphones, and speed of sound: `then`, those by which the event was located "
        "first, or `now`, those in force.",
        examples=["now"],
    )


Digest = Annotated[
    str | None,
    Field(
        description="Digest of the release, the wanted method, `set_up`, and all settings of the site that decide the "
        "answer. Answers with equal digests were made with equal settings. Null from a server of an older release.",
        examples=["3b9f0c6d1e2a4857"],
    ),
]


class RelocationSettings(Versioned):
    """The settings with which events are located again."""

    digest: Digest = None


class LocationAnswer(Model):
    """One answer to where an event was."""

    method: str = Field(description="Name of the method.", examples=["srp-phat"])
    status: Status
    reason: str | None = Field(description="Why it is not simply located; null if there is nothing to explain.")
    position_m: PositionM | None = Field(description="Position of the source; null when refused.")
    covariance_m2: CovarianceM2 | None = Field(description="Covariance of the position; null when refused.")
    std_m: float | None = Field(
        ge=0,
        description="Standard deviation in metres along the axis of largest uncertainty; null when refused.",
        examples=[0.11],
    )
    confidence: Confidence
    arrays: ArrayNames = Field(description="Arrays that contributed to the position.")
    candidates: Candidates


class Relocated(Versioned):
    """Both answers to where an event was; nothing is stored."""

    event_id: str = Field(description="Id of the event.", examples=["lab-35340000000"])
    set_up: Literal["then", "now"] = Field(description="The poses that it was located with again.")
    moved_arrays: ArrayNames = Field(
        description="Arrays of the recordings whose microphones have other places now than when the event was located."
    )
    stored: LocationAnswer = Field(description="The answer in the history.")
    again: LocationAnswer = Field(description="The answer of now.")
    other_sources: list[LocationAnswer] = Field(
        description="Answers for further sources of the same sound, which are events of their own in the history."
    )
    distance_m: float | None = Field(
        ge=0, description="Distance between the two positions in metres; null without one of them.", examples=[0.08]
    )
    took_s: float = Field(ge=0, description="Time that the computation took, in seconds.", examples=[0.4])
    digest: Digest = None


def unanswered(event_id: str, method: str | None, set_up: str, digest: str) -> dict[str, Any]:
    """Return the object that `livessl relocate` prints for an event, as long as there is no answer.

    Parameters
    ----------
    event_id : str
    method : str or None
        None takes the one by which the event was located.
    set_up : "then" or "now"
    digest : str
        Of the settings that decide the answer.
    """
    return {
        "kind": "relocation",
        "event_id": event_id,
        "time_utc": None,
        "method": method,
        "set_up": set_up,
        "digest": digest,
        "moved_arrays": [],
        "stored": None,
        "again": None,
        "other_sources": [],
        "distance_m": None,
        "error": None,
    }
