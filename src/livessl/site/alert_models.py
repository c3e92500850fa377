"""Keys and defaults of `alerts` in the site file: rules (hold-off, count, schedule) and actions (attempts, waits).

Whether a rule alerts is decided in `server/alerts/rules.py`.
"""

from __future__ import annotations

import re
from typing import Annotated, Any, Final, Literal, TypeVar
from urllib.parse import urlsplit

from pydantic import AfterValidator, BeforeValidator, Field, field_validator, model_validator

from livessl.clock import check_time_zone
from livessl.core.commission.finding import Severity
from livessl.site.fields import FileName, Model, Positive

MINUTES_OF_DAY: Final = 1440

Day = Literal["mon", "tue", "wed", "thu", "fri", "sat", "sun"]
DAYS: Final[tuple[Day, ...]] = ("mon", "tue", "wed", "thu", "fri", "sat", "sun")

Seconds = Annotated[float, Field(ge=0, le=1e6, allow_inf_nan=False)]
"""A span of time that may be zero, in seconds."""


LIFETIME_S: Final = 86_400.0
"""Default lifetime of a link that needs no token, in seconds: a day, so that people who were away can still look."""

LinkLifetimeS = Annotated[float, Field(ge=60, le=2_592_000)]
"""Lifetime of a link that needs no token, in seconds: at most 30 days, because a single link cannot be revoked."""

T = TypeVar("T")


def _not_empty(items: tuple[T, ...]) -> tuple[T, ...]:
    """Check that there is an item. Pydantic's `min_length` would report a second fault where an item is wrong."""
    if not items:
        raise ValueError("expected at least 1 item, got none; leave the key out for the default")
    return items


def _zones(names: tuple[str, ...]) -> tuple[str, ...]:
    """Check that there is a zone: this key has no default."""
    if not names:
        raise ValueError("expected at least 1 zone, got none; name zones of this site")
    return names


def _minutes(value: Any) -> int:
    """Return the minutes since midnight of a time of day.

    YAML reads 22:00 without quotes as the number 1320, which is the same time in minutes. A number up to 24
    was probably meant as an hour.
    """
    if isinstance(value, int) and not isinstance(value, bool) and 60 <= value <= MINUTES_OF_DAY:
        return value
    if isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= 24:
        raise ValueError(f'expected a time of day from "00:00" to "24:00", got {value}; write "{value:02d}:00"')
    match = re.fullmatch(r"(\d{1,2}):(\d\d)", value) if isinstance(value, str) else None
    minutes = None if match is None else 60 * int(match[1]) + int(match[2])
    if match is None or minutes is None or int(match[2]) > 59 or minutes > MINUTES_OF_DAY:
        raise ValueError(f'expected a time of day from "00:00" to "24:00", got {value!r}')
    return minutes


TimeOfDay = Annotated[int, BeforeValidator(_minutes)]
"""Minutes since midnight, written as "22:30" in the site file."""


class ScheduleSpan(Model):
    """A span of the week. If `end` is earlier than `begin`, it lasts until `end` on the next day."""

    days: Annotated[tuple[Day, ...], AfterValidator(_not_empty)] = DAYS
    begin: TimeOfDay = 0
    end: TimeOfDay = MINUTES_OF_DAY

    @model_validator(mode="after")
    def _lasts(self) -> ScheduleSpan:
        if self.begin == self.end:
            raise ValueError("expected begin and end to differ; leave both out for the whole day")
        return self


class EventCondition(Model):
    """Condition on events that raises an alert."""

    zones: tuple[str, ...] = ()
    probability: Annotated[float, Field(gt=0, lt=1)] = 0.5
    statuses: Annotated[tuple[Literal["located", "direction-only"], ...], AfterValidator(_not_empty)] = ("located",)
    min_confidence: Annotated[float, Field(ge=0, le=1)] = 0.0
    min_level_dbfs: Annotated[float, Field(ge=-300, le=20)] | None = None
    min_duration_s: Seconds = 0.0
    early: bool = False
    count: Annotated[int, Field(ge=1, le=1000)] = 1
    within_s: Positive | None = None

    @field_validator("statuses", mode="before")
    @classmethod
    def _not_refused(cls, statuses: Any) -> Any:
        if isinstance(statuses, list | tuple) and "refused" in statuses:
            raise ValueError("expected located or direction-only: refused events never alert; remove refused")
        return statuses

    @model_validator(mode="after")
    def _span(self) -> EventCondition:
        if (self.count > 1) != (self.within_s is not None):
            raise ValueError(
                f"expected count above 1 and within_s together, got {'count' if self.count > 1 else 'within_s'} alone; "
                "add the other one"
            )
        return self


class TrackCondition(Model):
    """Condition on tracks that raises an alert: what a track does in one of the zones."""

    zones: Annotated[tuple[str, ...], AfterValidator(_zones)]
    changes: Annotated[tuple[Literal["enter", "leave", "loiter"], ...], AfterValidator(_not_empty)] = ("enter",)


class ArrayCondition(Model):
    """Condition on arrays that raises an alert. Empty `names` mean all arrays."""

    names: tuple[str, ...] = ()
    states: Annotated[tuple[Literal["starting", "quiet", "degraded", "lost"], ...], AfterValidator(_not_empty)] = (
        "degraded",
        "lost",
    )
    lasts_s: Seconds = 5.0


class FindingCondition(Model):
    """Condition on findings that raises an alert: of `severity` or worse. Empty `faults` mean all codes."""

    severity: Severity = Severity.ERROR
    faults: tuple[str, ...] = ()


class AlertRule(Model):
    """A condition that raises an alert, and the actions that deliver it."""

    events: EventCondition | None = None
    tracks: TrackCondition | None = None
    arrays: ArrayCondition | None = None
    findings: FindingCondition | None = None
    schedule: tuple[ScheduleSpan, ...] = ()
    hold_off_s: Seconds = 60.0
    armed: bool = True
    actions: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _one(self) -> AlertRule:
        _exactly_one(self, ("events", "tracks", "arrays", "findings"))
        return self

    @property
    def kind(self) -> Literal["events", "tracks", "arrays", "findings"]:
        """Name of the rule's condition: `events`, `tracks`, `arrays` or `findings`."""
        if self.events is not None:
            return "events"
        if self.tracks is not None:
            return "tracks"
        return "arrays" if self.arrays is not None else "findings"

    @property
    def zones(self) -> tuple[str, ...]:
        """Names of the zones that the rule watches."""
        condition = self.events or self.tracks
        return () if condition is None else condition.zones


class WebhookConfig(Model):
    """An address that gets each alert as a signed HTTP request."""

    url: str
    secret: FileName | None = None
    ca: FileName | None = None

    @field_validator("url")
    @classmethod
    def _url(cls, url: str) -> str:
        return _http_url(url)


class MqttConfig(Model):
    """An MQTT broker, with discovery by Home Assistant unless `discovery` is empty."""

    host: Annotated[str, Field(min_length=1)] = "127.0.0.1"
    port: Annotated[int, Field(ge=1, le=65535)] | None = None
    tls: bool = False
    ca: FileName | None = None
    username: str | None = None
    password: FileName | None = None
    topic: str | None = None
    discovery: str = "homeassistant"

    @field_validator("topic", "discovery")
    @classmethod
    def _topic(cls, topic: str | None) -> str | None:
        if topic is not None and (re.search(r"[#+\0]", topic) or topic.startswith("$") or topic.strip("/") != topic):
            raise ValueError(f"expected a topic without '#', '+', a leading '$' or slashes at its ends, got {topic!r}")
        return topic

    @model_validator(mode="after")
    def _user(self) -> MqttConfig:
        if self.password is not None and self.username is None:
            raise ValueError("password needs username; add it")
        return self


class AppriseConfig(Model):
    """One service of those that Apprise knows; its URL holds secrets and stands in a file of its own.

    Recordings leave the building only where the site file says so.
    """

    url: FileName
    attach: tuple[Literal["picture", "clip"], ...] = ("picture",)


class ActionKinds(Model):
    """The kinds of actions: each field is one, by the name that it has in `livessl.server.alerts.actions.ACTIONS`."""

    webhook: WebhookConfig | None = None
    mqtt: MqttConfig | None = None
    command: Annotated[tuple[Annotated[str, Field(min_length=1)], ...], Field(min_length=1)] | None = None
    apprise: AppriseConfig | None = None


class AlertAction(ActionKinds):
    """One way to deliver alerts, of exactly one kind, with its time-out and retries."""

    timeout_s: Annotated[Positive, Field(le=600)] = 10.0
    attempts: Annotated[int, Field(ge=1, le=1000)] = 16
    first_wait_s: Positive = 1.0
    longest_wait_s: Positive = 3600.0

    @model_validator(mode="after")
    def _one(self) -> AlertAction:
        _exactly_one(self, tuple(ActionKinds.model_fields))
        return self

    @property
    def kind(self) -> str:
        """Kind of the action: a field of `ActionKinds`."""
        return next(name for name in ActionKinds.model_fields if getattr(self, name) is not None)


class LinksConfig(Model):
    """Links in alerts that open something without a token until they expire.

    Recordings leave the building only where the site file says so.
    """

    of: tuple[Literal["picture", "clip"], ...] = ("picture",)
    lifetime_s: LinkLifetimeS = LIFETIME_S


class AlertsConfig(Model):
    """All rules and actions of a site."""

    rules: dict[str, AlertRule] = Field(default_factory=dict)
    actions: dict[str, AlertAction] = Field(default_factory=dict)
    outbox: FileName | None = None
    timezone: str | None = None
    url: str | None = None
    links: LinksConfig = LinksConfig()

    @field_validator("timezone")
    @classmethod
    def _zone(cls, name: str | None) -> str | None:
        if name is not None:
            check_time_zone(name)
        return name

    @field_validator("url")
    @classmethod
    def _url(cls, url: str | None) -> str | None:
        return None if url is None else _http_url(url).rstrip("/")


def _exactly_one(model: Model, names: tuple[str, ...]) -> None:
    given = [name for name in names if getattr(model, name) is not None]
    if len(given) != 1:
        raise ValueError(f"expected exactly one of {', '.join(names)}; got {', '.join(given) or 'none'}")


def _http_url(url: str) -> str:
    """Return an address of HTTP or HTTPS.

    Raises
    ------
    ValueError
        If it is something else, or holds a password, which would be in every log.
    """
    try:
        parts = urlsplit(url)
        is_url = parts.scheme in ("http", "https") and bool(parts.hostname) and parts.port != 0
    except ValueError:
        is_url = False
    if not is_url or not re.fullmatch(r"[\x21-\x7e]+", url):
        raise ValueError(f"expected http://HOST/PATH or https://HOST/PATH, got {url!r}")
    if parts.username is not None:
        raise ValueError(
            "expected an address without user and password; leave them out, and let `secret` sign what a webhook sends"
        )
    return url
