"""API models of the hub: sites with their conditions, and events, arrays, tracks and alerts with their sites."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Literal

from pydantic import BaseModel, Field

from livessl.schema.alerts import Alert
from livessl.schema.values import ArrayCondition, Event, Track, UtcTime, Versioned

SiteName = Annotated[str, Field(description="Name of the site.", examples=["lab"])]


class SiteCondition(StrEnum):
    """Condition of a site.

    `ok`: every enabled array is healthy. `starting`: an enabled array has not sent anything yet, and the others are
    healthy. `degraded`: an enabled array does not work, or all arrays are disabled. `away`: nothing has come from the
    site for 30 s.
    """

    OK = "ok"
    STARTING = "starting"
    DEGRADED = "degraded"
    AWAY = "away"


class HubCondition(StrEnum):
    """Condition of the hub: `ok`, or `degraded` while it cannot reach NATS; `reasons` says why."""

    OK = "ok"
    DEGRADED = "degraded"


class Tile(BaseModel):
    """The hall that a site shares with others, and its part of it."""

    name: str = Field(description="Name of the hall.", examples=["works"])
    tile_m: list[list[float]] = Field(
        description="Corners [x, y] of the site's tile on the floor plan of the hall, in metres.",
        examples=[[[0.0, 0.0], [30.0, 0.0], [30.0, 30.0], [0.0, 30.0]]],
    )


class SiteState(BaseModel):
    """A site, as the hub knows it."""

    site: SiteName
    status: SiteCondition
    contact_utc: UtcTime = Field(description="When the hub last received something from it.")
    age_s: float = Field(ge=0, description="Seconds since then.", examples=[1.2])
    version: str | None = Field(description="Version of livessl that its server runs.", examples=["0.1.0"])
    location_deg: list[float] | None = Field(
        description="Latitude and longitude in degrees, where its site file has them.", examples=[[52.52, 13.40]]
    )
    hall: Tile | None = Field(description="Hall and tile of the site; null if it has its room to itself.")
    arrays: dict[str, ArrayCondition] = Field(description="State of each array by name.")
    waiting: int = Field(ge=0, description="Messages that waited at the site at its last report.", examples=[0])
    missing: int = Field(ge=0, description="Messages that never came: the site or NATS had deleted them.", examples=[0])
    newest_event_utc: UtcTime | None = Field(description="Start of its newest event; null if there is none.")


class Sites(Versioned):
    """All sites from which a message or a report has come."""

    sites: list[SiteState]


class EventName(BaseModel):
    """The name of an event at the hub."""

    site: SiteName
    id: str = Field(description="Its id at the site.", examples=["lab-1767225600000-1"])


class EventHall(BaseModel):
    """The hall of an event."""

    name: str = Field(description="Name of the hall.", examples=["works"])
    in_tile: bool = Field(description="Whether its position lies in the tile of its site.", examples=[True])


class SiteEvent(Event):
    """A final event of a site."""

    site: SiteName
    hall: EventHall | None = Field(default=None, description="Hall of the site; null if it has its room to itself.")
    copy_of: EventName | None = Field(
        default=None,
        description="Event of a neighbouring server that is shown for this sound instead; null for an event that is "
        "shown itself.",
    )
    copies: list[EventName] = Field(
        default=[],
        description="Events of neighbouring servers that are the same sound, and are not shown.",
        examples=[[]],
    )


class SiteEventPage(Versioned):
    """A page of events of all sites, the latest start first."""

    events: list[SiteEvent]
    next_cursor: str | None = Field(
        description="Cursor of the next page: pass it unchanged as `cursor` and treat it as opaque. Null at the end.",
        examples=["1767225600050000000-17"],
    )
    previous_cursor: str | None = Field(
        description="Cursor of the first event: pass it unchanged as `after` for events that began later. Events that "
        "a site sends late have their place by time. Null if no event was found.",
        examples=["1767225900050000000-42"],
    )


class OneSiteEvent(Versioned, SiteEvent):
    """One event."""


class SiteArray(BaseModel):
    """Last change of an array's state."""

    kind: Literal["array"]
    site: SiteName
    name: str = Field(description="Name of the array.", examples=["north"])
    state: ArrayCondition
    reason: str | None = Field(description="Why it is in that state; null while it is healthy.", examples=[None])
    node: str | None = Field(description="Node that captures it; null if no node does.", examples=["lab-pc"])
    enabled: bool = Field(description="False while an operator has disabled it.", examples=[True])
    time_utc: UtcTime = Field(description="When the state changed.")


class SiteArrays(Versioned):
    """Arrays of all sites."""

    arrays: list[SiteArray]


class SiteTrack(Track):
    """A track of a site, as it began."""

    site: SiteName


class SiteTracks(Versioned):
    """Tracks of all sites that have begun and not ended."""

    tracks: list[SiteTrack]


class SiteAlertPage(Versioned):
    """A page of alerts of all sites, those that the hub received last first."""

    alerts: list[Alert]
    next_before: int | None = Field(
        description="Pass it as `before` for the next page; null at the end.", examples=[1234]
    )


class HubHealthStatus(Versioned):
    """Health as everyone may read it, without a token."""

    status: HubCondition


class HubHealth(HubHealthStatus):
    """Health of the hub."""

    hub: str = Field(description="Name of the hub.", examples=["hub"])
    version: str = Field(description="Version of livessl that it runs.", examples=["0.1.0"])
    takes_in: bool = Field(description="Whether this one of several hubs takes messages in now.", examples=[True])
    taken: int = Field(ge=0, description="Messages taken in since its start.", examples=[12345])
    rejected: int = Field(ge=0, description="Messages that could not be stored since its start.", examples=[0])
    sites: dict[str, int] = Field(description="Number of sites in each condition.", examples=[{"ok": 3}])
    reasons: list[str] = Field(description="What is wrong, one sentence each.", examples=[[]])
