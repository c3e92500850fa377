"""The parts of a running server, by name: `assembly` makes them, the API reads them."""

from __future__ import annotations

from dataclasses import dataclass

from livessl.clock import Clock
from livessl.server.alerts.service import Alerts
from livessl.server.array_states import ArrayStates
from livessl.server.clips.listeners import Listeners
from livessl.server.clips.relocate import Relocator
from livessl.server.clips.service import Clips
from livessl.server.engine import Engine
from livessl.server.event_log import EventLog
from livessl.server.fanout import Fanout
from livessl.server.forwarding.link import HubLink
from livessl.server.journal import Journal
from livessl.server.latency import Latency
from livessl.server.maps import Maps
from livessl.server.overload import Overload
from livessl.server.pose_refiner import PoseRefiner
from livessl.server.proposals import Proposals
from livessl.server.receiver import Inbox
from livessl.server.recent_log import RecentLog
from livessl.server.refusals import Refusals
from livessl.server.reload import Reloader
from livessl.server.set_up_in_force import SetUpInForce
from livessl.server.set_up_watch import SetUpWatch
from livessl.server.sinks import Sinks
from livessl.server.site_time import SiteTime
from livessl.server.store import Store
from livessl.server.tracks import Tracks
from livessl.server.zones.book import ZoneBook
from livessl.server.zones.presence import Presence
from livessl.site.floor_plan import FloorPicture
from livessl.site.models import Site


@dataclass(frozen=True, slots=True)
class Parts:
    """Everything that runs in a server, and everything that its parts share.

    `site` is the site as it was when the server started; `set_up.site` has the poses that are in force.
    """

    site: Site
    clock: Clock
    receiver: Inbox
    refusals: Refusals
    engine: Engine
    site_time: SiteTime
    array_states: ArrayStates
    event_log: EventLog
    alerts: Alerts
    clips: Clips | None
    relocator: Relocator | None
    listeners: Listeners
    tracks: Tracks
    maps: Maps
    latency: Latency
    overload: Overload
    set_up: SetUpInForce
    proposals: Proposals
    refiner: PoseRefiner
    set_up_watch: SetUpWatch
    store: Store
    sinks: Sinks
    fanout: Fanout
    zone_book: ZoneBook
    journal: Journal
    presence: Presence
    floor_plan: FloorPicture | None
    hub_link: HubLink | None
    reloader: Reloader
    recent_log: RecentLog

    @property
    def failure(self) -> BaseException | None:
        """The error that has ended one of the threads, if any has ended."""
        parts = (
            *(self.engine, self.receiver, self.maps, self.set_up_watch.thread, self.refiner.thread),
            *(self.alerts, self.clips, self.store.backlog, self.reloader, self.hub_link),
        )
        failures = (thread.failure for thread in parts if thread is not None)
        return next((failure for failure in failures if failure is not None), None)
