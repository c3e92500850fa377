"""Alerts without sound: a site with rules, events at chosen places, and the parts of a server that alert about them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, cast

import numpy as np

from livessl.clock import Clock, SystemClock
from livessl.core.stream.final_pass import FinalResults
from livessl.core.types import FRAME_NS, Estimate, Event, Status
from livessl.server.alerts.evidence import ClipSource, Evidence
from livessl.server.alerts.in_force import Surroundings
from livessl.server.alerts.message import AlertMessages
from livessl.server.alerts.service import Alerts, Conditions
from livessl.server.api.encode import JsonObject, Messages
from livessl.server.event_log import EventLog
from livessl.server.latency import Arrivals, Latency
from livessl.server.set_up_watch import SetUpState
from livessl.server.store import Store
from livessl.server.zones.zone_map import fixed_zones
from livessl.site.models import Site
from small_site import Changes, site_of

START: Final = 1_767_225_600_000_000_000 // FRAME_NS
"""Frame index at which the sounds of a test begin: a Thursday at midnight UTC."""

IN_DOOR: Final = (0.5, 0.5, 1.0)
ELSEWHERE: Final = (2.0, 2.0, 1.0)

PATIENT: Final = {"first_wait_s": 0.05, "longest_wait_s": 0.2, "attempts": 1000}
"""Settings of an action that tries again and again, quickly."""


def alert_site(directory: Path | None = None, changes: Changes | None = None, **alerts: Any) -> Site:
    """The small site with alerts."""
    return site_of({"alerts": alerts, **(changes or {})}, directory)


def kept_site(directory: Path | None = None, **rules: dict[str, Any]) -> Site:
    """The small site with rules, and a history in the folder, if there is one."""
    return alert_site(directory, {} if directory is None else {"server.events_db": "events.sqlite"}, rules=rules)


def sound(
    number: int = 0,
    position_m: Sequence[float] | None = IN_DOOR,
    *,
    at_s: float | None = None,
    status: Status = Status.LOCATED,
    std_m: float = 0.05,
    confidence: float = 0.9,
    power: float = 0.01,
    event_id: str | None = None,
) -> Event:
    """An event of 0.5 s; by default each begins a second after the one numbered before it."""
    first = START + round(20 * (number if at_s is None else at_s))
    start_ns, end_ns = first * FRAME_NS, (first + 10) * FRAME_NS
    estimate = None
    if position_m is not None:
        covariance_m2 = np.eye(3) * std_m**2
        estimate = Estimate(start_ns, np.array(position_m), covariance_m2, confidence, ("north", "south"))
    name = f"small-{number}" if event_id is None else event_id
    return Event(name, start_ns, end_ns, status, None, estimate, power, "onset", complete_ns=end_ns)


def refused(number: int = 0) -> Event:
    """An event that was refused."""
    return sound(number, None, status=Status.REFUSED)


def encoded(event: Event, replaces: Sequence[str] = ()) -> JsonObject:
    """The message of an event."""
    return Messages(site_of(), 0, utc=True).event(event, replaces=replaces)


def dated(*events: Event) -> list[tuple[JsonObject, int]]:
    """Messages of events with their starts, as alerts get them."""
    return [(encoded(event), event.start_ns) for event in events]


def after(*events: Event) -> int:
    """The frame index after these events."""
    return max(event.end_ns for event in events) // FRAME_NS


def key_of(event: Event, rule: str = "door") -> str:
    """The key of a rule's alert about an event."""
    return AlertMessages(site_of(), "").key(rule, event.id)


class QuietArrays:
    """Stands in for the states of the arrays."""

    def __init__(self, state: str) -> None:
        self.states: dict[str, str] = {"north": state, "south": state}

    def describe(self, *, levels: bool = True) -> list[JsonObject]:
        return [{"name": name, "state": state, "reason": None} for name, state in self.states.items()]


class NoFindings:
    """Stands in for the examination of the set-up."""

    def __init__(self) -> None:
        self.state = SetUpState()


class LiveTime:
    """Stands in for site time."""

    is_replay = False


class Desk:
    """Alerts with a store and an event log, without sockets and sound."""

    def __init__(
        self, site: Site, clock: Clock | None = None, state: str = "healthy", clips: ClipSource | None = None
    ) -> None:
        self.clock = SystemClock() if clock is None else clock
        self.site = site
        self.published: list[JsonObject] = []
        self.arrays, self.findings, self.time = QuietArrays(state), NoFindings(), LiveTime()
        self.store = Store.of(site)
        self.on_alert: Callable[[JsonObject], None] = lambda _: None
        zones = fixed_zones(site)
        evidence = Evidence(lambda: site, zones, clips)
        around = Surroundings(self.clock, self.store, zones, "http://127.0.0.1:8000", evidence)
        conditions = Conditions(cast(Any, self.arrays), cast(Any, self.findings), cast(Any, self.time))
        self.alerts = Alerts(site, around, conditions, self.publish)
        latency = Latency(self.clock, Arrivals())
        self.log = EventLog(site.site, self.clock, self.store, latency, lambda _: None, self.alerts)
        self.log.begin_live()

    def publish(self, alert: JsonObject) -> None:
        """Keep an alert, and call `on_alert` on the thread of the alerts."""
        self.published.append(alert)
        self.on_alert(alert)

    def finish(self, *events: Event) -> None:
        """Let events become final."""
        self.log.add_final(FinalResults(events, after(*events)), Messages(self.site, 0, utc=True), {})

    def close(self) -> None:
        """Stop everything."""
        self.alerts.stop()
        self.store.close()


@contextmanager
def running_desk(site: Site, clock: Clock | None = None, state: str = "healthy") -> Iterator[Desk]:
    """A desk whose alerts run, and whose arrays begin in a state."""
    desk = Desk(site, clock, state)
    try:
        desk.alerts.start()
        yield desk
        assert desk.alerts.failure is None
    finally:
        desk.close()
