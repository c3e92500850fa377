"""API models of alerts, rules and dead letters: their JSON fields and descriptions. See `values.py`."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from livessl.core.commission.finding import Severity
from livessl.schema.base import Model
from livessl.schema.values import ArrayCondition, Event, Membership, UtcTime, Versioned
from livessl.schema.zones import ZoneChange

RuleName = Annotated[str, Field(description="Name of the rule in the site file.", examples=["door"])]
ActionName = Annotated[str, Field(description="Name of the action in the site file.", examples=["guard"])]
Count = Annotated[int, Field(ge=0)]


class DeliveryState(StrEnum):
    """Progress of one alert to one action.

    It waits for the next attempt, arrived, was given up (a dead letter), or was dismissed by an operator after that.
    """

    WAITING = "waiting"
    DELIVERED = "delivered"
    DEAD = "dead"
    DISMISSED = "dismissed"


class AlertedArray(Model):
    """An array that an alert is about, in its state at that time."""

    name: str = Field(description="Name of the array.", examples=["north"])
    state: ArrayCondition
    reason: str | None = Field(description="Why it is in that state.", examples=["nothing received for 1.5 s"])


class AlertedFinding(Model):
    """A fault of the set-up that an alert is about."""

    kind: Literal["finding"]
    fault: str = Field(description="Code of the fault.", examples=["swapped"])
    array: str | None = Field(description="The array; null for the whole site.", examples=["south"])
    channel: int | None = Field(ge=1, description="Channel of the array, from 1; null for all.", examples=[3])
    severity: Severity
    confidence: float = Field(ge=0, le=1, description="How sure it is.", examples=[0.99])
    message: str = Field(description="What is wrong.", examples=["channels 2 and 3 of 'south' are swapped"])
    cure: str = Field(description="What to do.", examples=["exchange the plugs"])
    input: int | None = Field(ge=1, description="Input of the device that carries the channel, if known.", examples=[7])


class OpenLinks(Model):
    """Links that open what an alert shows without a token until they expire."""

    picture: str | None = Field(description="Link to the picture; null if there is none, or the site gives none.")
    clip: str | None = Field(description="Link to the recording, once it is cut; null if the site gives none.")
    until_utc: UtcTime = Field(description="When the links expire.")


class Alert(Model):
    """An alert of a rule about an event, a change of a track, an array or a finding; the others are null."""

    kind: Literal["alert"]
    key: str = Field(
        description="Permanent key of the alert. All deliveries of one alert have the same key.",
        examples=["alert_0f3c5b9d7e8a41c6a2b4d6e8f0a1b2c3"],
    )
    rule: RuleName
    site: str = Field(description="Name of the site.", examples=["lab"])
    raised_utc: UtcTime = Field(description="When the rule decided.")
    time_utc: UtcTime | None = Field(description="When the sound began, or since when the condition holds.")
    text: str = Field(
        description="What, where, and how sure, for people.",
        examples=["sound at (0.52, 0.61, 1.20) m, uncertain by 0.09 m, confidence 0.93"],
    )
    link: str = Field(
        description="Address of the event on the dashboard.", examples=["http://127.0.0.1:8000/#event=lab-1"]
    )
    picture: str | None = Field(
        default=None,
        description="Address of a picture of the floor plan with the place; null for an alert about no place.",
        examples=["http://127.0.0.1:8000/api/v1/alerts/alert_0f3c5b9d7e8a41c6a2b4d6e8f0a1b2c3/picture.png"],
    )
    clips: str | None = Field(
        default=None,
        description="Address of the list of the event's recordings; null if the site keeps none.",
        examples=["http://127.0.0.1:8000/api/v1/events/lab-1/clips"],
    )
    links: OpenLinks | None = Field(
        default=None, description="Only where an action delivers the alert: links for people without a token."
    )
    zones: list[str] = Field(description="Zones of the rule that it came from.", examples=[["door"]])
    membership: list[Membership] = Field(description="The same zones with their probabilities.")
    count: int = Field(ge=1, description="Events that the rule asks for within its span.", examples=[1])
    event: Event | None = Field(description="The event, the last one of several.")
    array: AlertedArray | None = Field(description="The array, if the alert is about one.")
    finding: AlertedFinding | None = Field(description="The finding, if the alert is about one.")
    change: ZoneChange | None = Field(description="What a track did in a zone, if the alert is about that.")


class Delivery(Model):
    """Progress of one alert to one action."""

    number: int = Field(ge=1, description="Number of the delivery.", examples=[17])
    action: ActionName
    state: DeliveryState
    attempts: Count = Field(description="Attempts so far; they start anew when a dead letter is sent again.")
    next_utc: UtcTime | None = Field(description="Time of the next attempt; null unless it waits.")
    error: str | None = Field(description="Why the last attempt failed.", examples=["answered 503, expected 2xx"])


class KeptAlert(Alert):
    """An alert with its deliveries."""

    deliveries: list[Delivery] = Field(description="One for each action of the rule.")


class DeadLetter(Delivery):
    """An alert that was given up for one action."""

    alert: Alert


class AlertPage(Versioned):
    """A page of alerts, the latest first."""

    alerts: list[KeptAlert]
    next_before: int | None = Field(
        description="Pass it as `before` for the next page; null at the end.", examples=[1234]
    )


class DeadLetterPage(Versioned):
    """A page of dead letters, the latest first."""

    dead_letters: list[DeadLetter]
    next_before: int | None = Field(
        description="Pass it as `before` for the next page; null at the end.", examples=[1234]
    )


class RuleKind(StrEnum):
    """Kinds of things that a rule can watch."""

    EVENTS = "events"
    TRACKS = "tracks"
    ARRAYS = "arrays"
    FINDINGS = "findings"


class Suppressed(Model):
    """Matches that did not alert, by the reason."""

    disarmed: Count = Field(description="The rule was disarmed.")
    off_schedule: Count = Field(description="Outside the rule's schedule.")
    counting: Count = Field(description="Too few events within the rule's span so far.")
    held_off: Count = Field(description="Too soon after the alert before.")


class Rule(Model):
    """A rule and its state."""

    name: RuleName
    watches: RuleKind
    armed: bool = Field(description="Whether it can alert; an operator can arm and disarm it.")
    open_now: bool = Field(description="Whether its schedule holds now.")
    actions: list[ActionName] = Field(description="Actions that deliver its alerts.")
    alerts: Count = Field(description="Alerts so far.", examples=[3])
    last_utc: UtcTime | None = Field(description="Time of what alerted last; null before the first alert.")
    suppressed: Suppressed
    ongoing: list[str] = Field(
        description="Conditions that have alerted and still last: names of arrays, or findings.", examples=[["north"]]
    )


class Rules(Versioned):
    """All rules of the site."""

    rules: list[Rule]


class ArmSwitch(BaseModel):
    """Request to arm or disarm a rule."""

    model_config = ConfigDict(extra="forbid", strict=True)

    armed: bool = Field(description="`false` disarms the rule, `true` arms it.", examples=[True])


class Armed(Versioned):
    """Confirmation that a rule was armed or disarmed."""

    name: RuleName
    armed: bool = Field(description="Whether it can alert from now on.", examples=[True])


class Resent(Versioned):
    """Confirmation that a dead letter waits for delivery again."""

    number: int = Field(ge=1, description="Number of the delivery.", examples=[17])


class Dismissed(Versioned):
    """Confirmation that dead letters were dismissed."""

    dismissed: Count = Field(description="Number of dead letters that were dismissed.", examples=[1])


class TriedAlert(Model):
    """An event about which a rule would have alerted."""

    event_id: str = Field(description="Id of the event.", examples=["small-1767225600000-1"])
    time_utc: UtcTime | None = Field(description="When the sound began.")


class Tried(Versioned):
    """Result of a dry run: the alerts that an armed rule would have raised."""

    name: RuleName
    since_utc: UtcTime = Field(description="Begin of the span that was tried.")
    until_utc: UtcTime = Field(description="End of the span that was tried.")
    events: Count = Field(description="Stored events of that time that were tried.", examples=[512])
    matched: Count = Field(description="Events that meet the rule's condition.", examples=[20])
    alerts: Count = Field(description="Alerts that it would have raised.", examples=[14])
    suppressed: Suppressed
    latest: list[TriedAlert] = Field(description="The latest of these alerts, newest first.")
    complete: bool = Field(description="Whether all events of that time were tried; only the newest are if not.")
    text: str = Field(
        description="The same in words.", examples=["rule 'door' would have alerted 14 times in the last 7 days"]
    )
