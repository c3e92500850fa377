"""The list of everything that runs in a server: makes all parts and connects them; `app` starts and stops them.

Each part is a property of `_Assembly`, which makes it when it is first needed. What a part needs is therefore made
before it, and a part that another one needs only while the server runs is passed as a function.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cached_property

from livessl.clock import Clock
from livessl.server.alerts.evidence import Evidence
from livessl.server.alerts.in_force import Surroundings
from livessl.server.alerts.service import Alerts, Conditions
from livessl.server.api.encode import JsonObject
from livessl.server.array_states import ArrayStates
from livessl.server.clips.listeners import Listeners
from livessl.server.clips.relocate import Relocator
from livessl.server.clips.service import Clips
from livessl.server.distribution import Distribution
from livessl.server.engine import Engine
from livessl.server.event_log import EventLog
from livessl.server.event_traces import EventTraces
from livessl.server.fanout import Fanout
from livessl.server.forwarding.link import HubLink
from livessl.server.journal import Journal
from livessl.server.latency import Latency
from livessl.server.maps import Maps
from livessl.server.overload import Overload
from livessl.server.parts import Parts
from livessl.server.pose_refiner import PoseRefiner
from livessl.server.proposals import Proposals
from livessl.server.publisher import Publisher
from livessl.server.receiver import Inbox, Receiver
from livessl.server.recent_log import RecentLog
from livessl.server.reload import Reloader
from livessl.server.set_up_in_force import SetUpInForce
from livessl.server.set_up_watch import SetUpWatch
from livessl.server.shared_state import SharedState
from livessl.server.signed_links import SignedLinks
from livessl.server.sinks import Sinks
from livessl.server.site_time import SiteTime
from livessl.server.store import Store
from livessl.server.tracks import Tracks
from livessl.server.trails import Trails
from livessl.server.zones.book import ZoneBook
from livessl.server.zones.presence import Presence
from livessl.server.zones.zone_map import ZoneMap
from livessl.site.floor_plan import read_floor_plan
from livessl.site.models import Site
from livessl.traces import traces_in_use


@dataclass(frozen=True, slots=True)
class Outlets:
    """Destinations of a server's results.

    Parameters
    ----------
    store : Store
        Keeps events, and what a restarted server must know.
    sinks : Sinks
        Get every event first.
    fanout : Fanout
        Hands messages to the subscribers, on the event loop.
    publish : callable
        Gets every message for subscribers; called on the thread that makes the message.
    on_event : callable or None
        Gets every event after the sinks and before `publish`; called on the fusion thread.
    """

    store: Store
    sinks: Sinks
    fanout: Fanout
    publish: Callable[[JsonObject], None]
    on_event: Callable[[JsonObject], None] | None = None

    def publish_event(self, event: JsonObject) -> None:
        """Hand an event to the sinks, to `on_event`, and to subscribers."""
        self.sinks.take(event)
        if self.on_event is not None:
            self.on_event(event)
        self.publish(event)


def assemble(
    site: Site,
    clock: Clock,
    outlets: Outlets,
    receiver: Inbox | None = None,
    url: str = "",
    read_site: Callable[[], Site] | None = None,
    links: SignedLinks | None = None,
) -> Parts:
    """Make everything that runs in a server; nothing runs yet.

    Parameters
    ----------
    site : Site
    clock : Clock
    outlets : Outlets
    receiver : Inbox or None
        Stands in for the nodes' socket.
    url : str
        Address of the server, for the links in alerts.
    read_site : callable or None
        Reads the site file again; None for a server without one.
    links : SignedLinks or None
        Signs links for people without a token; None if every reader has one.

    Raises
    ------
    BindError, ConfigError, ClipsError
        See `Receiver`, `Alerts` and `Clips`.
    """
    with ExitStack() as undo:
        if receiver is None:
            receiver = Receiver(site, clock)
            undo.callback(receiver.stop)
        parts = _Assembly(site, clock, outlets, receiver, url, read_site, links, undo).parts()
        undo.pop_all()
    return parts


@dataclass
class _Assembly:
    """The parts of a server while they are made; `undo` gets what stops those that hold something."""

    site: Site
    clock: Clock
    outlets: Outlets
    receiver: Inbox
    url: str
    read_site: Callable[[], Site] | None
    links: SignedLinks | None
    undo: ExitStack

    def parts(self) -> Parts:
        """Make all parts, and connect those that follow the poses in force."""
        parts = Parts(
            site=self.site,
            clock=self.clock,
            receiver=self.receiver,
            refusals=self.receiver.refusals,
            store=self.outlets.store,
            sinks=self.outlets.sinks,
            fanout=self.outlets.fanout,
            site_time=self.shared.site_time,
            latency=self.shared.latency,
            maps=self.shared.maps,
            overload=self.shared.overload,
            journal=self.journal,
            hub_link=self.hub_link,
            zone_book=self.zone_book,
            set_up_watch=self.set_up_watch,
            array_states=self.array_states,
            set_up=self.set_up,
            listeners=self.listeners,
            clips=self.clips,
            relocator=self.relocator,
            alerts=self.alerts,
            presence=self.presence,
            tracks=self.tracks,
            event_log=self.event_log,
            engine=self.engine,
            proposals=self.proposals,
            refiner=PoseRefiner(self.proposals, self.set_up, self.set_up_watch.heard, self.shared.overload),
            floor_plan=read_floor_plan(self.site),
            reloader=self.reloader,
            recent_log=RecentLog(),
        )
        for follower in (self.engine, self.set_up_watch, parts.refiner, self.clips):
            if follower is not None:
                self.set_up.follow(follower.prepare)
        return parts

    @cached_property
    def shared(self) -> SharedState:
        latency = Latency(self.clock, self.receiver.arrivals)
        return SharedState(self.site, self.clock, SiteTime(self.clock), latency, Maps(self.clock), Overload(self.clock))

    # --- what is kept and passed on

    @cached_property
    def journal(self) -> Journal:
        journal = Journal(self.outlets.store, self.clock)
        journal.site(self.site)
        return journal

    @cached_property
    def hub_link(self) -> HubLink | None:
        store = self.outlets.store
        if store.outbox is None:
            return None
        return HubLink(
            self.site, self.clock, store.outbox, store.backlog, lambda: self.array_states.describe(levels=False)
        )

    @cached_property
    def distribution(self) -> Distribution:
        return Distribution(
            self.outlets.publish,
            self.shared.site_time,
            self.journal,
            self.hub_link,
            lambda: self.alerts,
            self.outlets.store.is_durable,
        )

    @cached_property
    def traces(self) -> EventTraces | None:
        found = traces_in_use()
        return None if found is None else EventTraces(found)

    # --- arrays and their poses

    @cached_property
    def set_up_watch(self) -> SetUpWatch:
        # milliseconds since the epoch: a restarted server gives no sound the number of an earlier one
        return SetUpWatch(self.site, self.shared.overload, first_sound=self.clock.now_ns() // 1_000_000)

    @cached_property
    def array_states(self) -> ArrayStates:
        return ArrayStates(
            self.site,
            self.clock,
            self.outlets.store,
            self.shared.site_time,
            self.receiver.ingest,
            self.shared.overload,
            self.set_up_watch,
            self.distribution.take_arrays,
        )

    @cached_property
    def set_up(self) -> SetUpInForce:
        return SetUpInForce(self.site, self.clock, self.outlets.publish)

    @cached_property
    def proposals(self) -> Proposals:
        return Proposals(self.set_up, self.set_up_watch.heard, self.clock)

    # --- zones and tracks

    @cached_property
    def zone_book(self) -> ZoneBook:
        return ZoneBook(self.site, self.outlets.publish)

    def zones(self) -> ZoneMap:
        """Return the zones that are in force."""
        return self.zone_book.current

    @cached_property
    def presence(self) -> Presence:
        return Presence(self.zones, self.distribution.take_change)

    @cached_property
    def tracks(self) -> Tracks:
        return Tracks(self.presence, Trails(self.journal, lambda: self.shared.site_time.is_replay))

    # --- sound

    @cached_property
    def listeners(self) -> Listeners:
        return Listeners()

    @cached_property
    def clips(self) -> Clips | None:
        config = self.site.server.clips
        if config is None:
            return None
        return Clips(self.site, config, self.clock, self.shared.site_time, self.shared.overload)

    @cached_property
    def relocator(self) -> Relocator | None:
        if self.clips is None:
            return None
        return Relocator(self.clips.folder, self.clock, lambda: self.set_up.site, self.shared.overload)

    # --- events and alerts

    @cached_property
    def alerts(self) -> Alerts:
        evidence = Evidence(lambda: self.set_up.site, self.zones, self.clips)
        around = Surroundings(self.clock, self.outlets.store, self.zones, self.url, evidence, self.traces, self.links)
        conditions = Conditions(self.array_states, self.set_up_watch, self.shared.site_time)
        alerts = Alerts(self.site, around, conditions, self.distribution.take_alert)
        self.undo.callback(alerts.stop)
        return alerts

    @cached_property
    def event_log(self) -> EventLog:
        return EventLog(
            self.site.site,
            self.clock,
            self.outlets.store,
            self.shared.latency,
            self.outlets.publish_event,
            self.alerts,
            self.traces,
        )

    @cached_property
    def engine(self) -> Engine:
        publisher = Publisher(
            self.shared,
            self.distribution.take,
            self.receiver.request,
            self.event_log,
            self.tracks,
            self.set_up_watch,
            self.clips,
        )
        return Engine(
            self.shared,
            self.receiver,
            self.array_states,
            self.event_log,
            publisher,
            self.zones,
            (self.listeners,) if self.clips is None else (self.listeners, self.clips),
            self.traces,
        )

    @cached_property
    def reloader(self) -> Reloader:
        return Reloader(self.site, self.read_site, self.zone_book, self.alerts, self.journal.site, self.set_up)
