"""Hands messages on to subscribers, hub, journal and alerts, and decides what of a replay these do not get.

Of what is handed on, `forwarding/hub_messages.py` and `journal.py` choose what they keep.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from livessl.server.alerts.service import Alerts
from livessl.server.api.encode import JsonObject
from livessl.server.forwarding.link import HubLink
from livessl.server.journal import Journal
from livessl.server.site_time import SiteTime


@dataclass(frozen=True, slots=True)
class Distribution:
    """Hands messages on, on the thread that has made them.

    Neither the hub nor the rules about zones get anything of a replay.

    Parameters
    ----------
    publish : callable
        Gets every message for subscribers.
    site_time : SiteTime
        Knows whether a replay runs.
    journal : Journal
    hub_link : HubLink or None
        None for a site without a hub.
    alerts : callable
        Returns the alerts of the site, which hand their own messages to here.
    keeps_journal : bool
        Whether the journal outlives the server, so that the alerts may forget what it has.
    """

    publish: Callable[[JsonObject], None]
    site_time: SiteTime
    journal: Journal
    hub_link: HubLink | None
    alerts: Callable[[], Alerts]
    keeps_journal: bool

    def take(self, message: JsonObject) -> None:
        """Hand on a message that is for the hub and the subscribers."""
        if self.hub_link is not None and not self.site_time.is_replay:
            self.hub_link.messages.take(message)
        self.publish(message)

    def take_arrays(self, message: JsonObject) -> None:
        """Hand on the states of the arrays, whose changes the journal keeps."""
        self.journal.arrays(message)
        self.take(message)

    def take_alert(self, alert: JsonObject) -> None:
        """Hand on an alert, which the journal keeps."""
        self.journal.alert(alert, partial(self.alerts().note_in_journal, alert) if self.keeps_journal else None)
        self.take(alert)

    def take_change(self, change: JsonObject, time_ns: int) -> None:
        """Hand on what a track does in a zone, and its site time, for the rules about it and the subscribers."""
        if not self.site_time.is_replay:
            self.alerts().take_change(change, time_ns)
        self.publish(change)
