"""Sites that exist at the broker only: what their servers would send to a hub in the course of an hour."""

from __future__ import annotations

import random
from collections.abc import Iterator
from typing import Final

import orjson

from history_rows import START_NS, Rows, random_event, random_rows
from livessl import __version__
from livessl.clock import utc_text
from livessl.federation.storing import Delivery
from livessl.server.api.encode import API_VERSION, JsonObject
from livessl.server.forwarding.stream import HEALTH, Place, outbox_name

ARRAYS: Final = tuple(f"array-{number}" for number in range(1, 9))
"""Arrays of each site."""

HEARD_BY: Final = 4
"""Arrays that contribute to an event."""

MINUTE_NS: Final = 60_000_000_000

CHANGE_MINUTES: Final = 8
"""From one change of an array's state at a site to the next, in minutes."""

ALERT_MINUTES: Final = 20
"""From one alert of a site to the next, in minutes."""

EVENTS_PER_HOUR: Final = 60
"""Events of a site in an hour: one a minute."""

MESSAGES_PER_HOUR: Final = 3 * EVENTS_PER_HOUR + -(-60 // CHANGE_MINUTES) + -(-60 // ALERT_MINUTES)
"""Messages of a site in an hour: events, beginnings and ends of their tracks, changes of arrays, alerts."""


MIN_PACE: Final = 10.0
"""Messages a second of all sites at the pace of real time at least, so that few sites give figures as well."""


def site_name(number: int) -> str:
    """Return the name of a simulated site."""
    return f"site-{number:04d}"


def hub_rows(first: int, count: int, sites: int) -> Rows:
    """Return the rows of random events of several sites in turns, as a hub has them (`random_rows`)."""
    found = random_rows(first, count)
    named = [(site_name(number % sites), row) for number, row in enumerate(found.events, first)]
    events = [(row[0], f"{site}/{row[1]}", *row[2:-1], f'{str(row[-1])[:-1]},"site":"{site}"}}') for site, row in named]
    tags = [("site", site, row[2], row[0], row[3], row[4], row[5]) for site, row in named]
    return Rows(events, [*found.tags, *tags])


class SimulatedSite:
    """One site, whose messages are numbered as its outbox would number them.

    Parameters
    ----------
    number : int
        Which of the sites.
    """

    def __init__(self, number: int) -> None:
        self.name = site_name(number)
        self._rng = random.Random(number)
        self._outbox = outbox_name(1)
        self._last = 0
        self._minute = 0

    def begin(self) -> Iterator[Delivery]:
        """Yield what a server sends that has just started."""
        yield self._message("start", {"time_utc": utc_text(START_NS), "version": __version__})
        for array in ARRAYS:
            yield self._array(array, START_NS)

    def minute(self) -> Iterator[Delivery]:
        """Yield the messages of the next minute."""
        time_ns, self._minute = START_NS + self._minute * MINUTE_NS, self._minute + 1
        event = self._event(time_ns)
        track = {"id": self._minute, "time_utc": event["time_utc"], "position_m": event["position_m"]}
        yield self._message("track", {**track, "state": "new", "velocity_m_s": [0.1, 0.2, 0.0]})
        yield self._message("event", event)
        yield self._message("track", {**track, "state": "end", "velocity_m_s": [0.1, 0.2, 0.0]})
        if self._minute % CHANGE_MINUTES == 1:
            yield self._array(self._rng.choice(ARRAYS), time_ns)
        if self._minute % ALERT_MINUTES == 1:
            alert = {"key": f"{self.name}-{self._minute}", "rule": "door", "raised_utc": utc_text(time_ns)}
            yield self._message("alert", {**alert, "text": "a sound in zone 'door'", "event": event})

    def report(self) -> bytes:
        """Return the site's report on itself, as its server publishes it every few seconds."""
        report = {
            "v": API_VERSION,
            "kind": HEALTH,
            "site": self.name,
            "version": __version__,
            "now_utc": utc_text(START_NS + self._minute * MINUTE_NS),
            "waiting": 0,
            "location_deg": [52.52, 13.4],
            "arrays": dict.fromkeys(ARRAYS, "healthy"),
        }
        return orjson.dumps(report)

    def _event(self, time_ns: int) -> JsonObject:
        """Return an event with as many arrays as that of a real hall."""
        event = random_event(self._rng, self._minute, time_ns)
        [one, *_] = event["contributions"]
        heard_by = self._rng.sample(ARRAYS, HEARD_BY)
        return {
            **event,
            "id": f"{self.name}-{self._minute}",
            "arrays": heard_by if event["status"] == "located" else [],
            "heard_by": heard_by,
            "contributions": [{**one, "array": array} for array in heard_by],
        }

    def _array(self, name: str, time_ns: int) -> Delivery:
        fields = {"state": "healthy", "reason": None, "node": f"{self.name}-pc", "enabled": True}
        return self._message("array", {"time_utc": utc_text(time_ns), "name": name, **fields})

    def _message(self, kind: str, body: JsonObject) -> Delivery:
        self._last += 1
        return Delivery(self.name, kind, Place(self._outbox, self._last), orjson.dumps({"kind": kind, **body}))
