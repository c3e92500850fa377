"""The list of what runs in a server: `assemble` makes all parts and connects them; `app` starts and stops them."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial

from livessl.clock import Clock
from livessl.server.alerts.evidence import Evidence
from livessl.server.alerts.in_force import Surroundings
from livessl.server.alerts.service import Alerts, Conditions
from livessl.server.api.encode import JsonObject
from livessl.server.array_states import ArrayStates
from livessl.server.clips.listeners import Listeners
from livessl.server.clips.relocate import Relocator
from livessl.server.clips.service import Clips
from livessl.server.engine import Engine
from livessl.server.event_log import EventLog
from livessl.server.event_traces import EventTraces
from livessl.server.fanout import Fanout
from livessl.server.forwarding.link import HubLink
from livessl.server.journal import Journal, also
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
        Signs links for people without a token; None if nobody needs one.

    Raises
    ------
    BindError, ConfigError, ClipsError
        See `Receiver`, `Alerts` and `Clips`.
    """
    store, publish = outlets.store, outlets.publish

    def publish_to_all(message: JsonObject) -> None:
        if hub_link is not None and not site_time.is_replay:
            hub_link.messages.take(message)
        publish(message)

    with ExitStack() as undo:
        if receiver is None:
            receiver = Receiver(site, clock)
            undo.callback(receiver.stop)
        site_time = SiteTime(clock)
        journal = Journal(store, clock)
        journal.site(site)
        hub_link = None
        if store.outbox is not None:
            hub_link = HubLink(site, clock, store.outbox, store.backlog, lambda: array_states.describe(levels=False))
        zone_book = ZoneBook(site, publish)

        def zones() -> ZoneMap:
            return zone_book.current

        latency, maps = Latency(clock, receiver.arrivals), Maps(clock)
        overload = Overload(clock)
        # milliseconds since the epoch: a restarted server gives no sound the number of an earlier one
        set_up_watch = SetUpWatch(site, overload, first_sound=clock.now_ns() // 1_000_000)
        found = traces_in_use()
        traces = None if found is None else EventTraces(found)

        def keep_alert(alert: JsonObject) -> None:
            journal.alert(alert, partial(alerts.note_in_journal, alert) if store.is_durable else None)

        publish_arrays, publish_alert = also(journal.arrays, publish_to_all), also(keep_alert, publish_to_all)
        array_states = ArrayStates(
            site, clock, store, site_time, receiver.ingest, overload, set_up_watch, publish_arrays
        )
        set_up = SetUpInForce(site, clock, publish)
        kept, listeners = site.server.clips, Listeners()
        clips = None if kept is None else Clips(site, kept, clock, site_time, overload)
        relocator = None if clips is None else Relocator(clips.folder, clock, lambda: set_up.site, overload)
        evidence = Evidence(lambda: set_up.site, zones, clips)
        around = Surroundings(clock, store, zones, url, evidence, traces, links)
        alerts = Alerts(site, around, Conditions(array_states, set_up_watch, site_time), publish_alert)
        undo.callback(alerts.stop)

        def publish_change(change: JsonObject, time_ns: int) -> None:
            if not site_time.is_replay:
                alerts.take_change(change, time_ns)
            publish(change)

        presence = Presence(zones, publish_change)
        tracks = Tracks(presence, Trails(journal, lambda: site_time.is_replay))
        event_log = EventLog(site.site, clock, store, latency, outlets.publish_event, alerts, traces)
        publisher = Publisher(
            publish_to_all, receiver.request, site_time, event_log, tracks, maps, latency, overload, set_up_watch, clips
        )
        sound = (listeners,) if clips is None else (listeners, clips)
        engine = Engine(
            site, clock, receiver, site_time, array_states, event_log, maps, publisher, overload, zones, sound, traces
        )
        proposals = Proposals(set_up, set_up_watch.heard, clock)
        refiner = PoseRefiner(proposals, set_up, set_up_watch.heard, overload)
        for follower in (engine.prepare, set_up_watch.prepare, *(() if clips is None else (clips.prepare,))):
            set_up.follow(follower)
        floor_plan = read_floor_plan(site)
        reloader = Reloader(site, read_site, zone_book, alerts, journal.site, set_up)
        undo.pop_all()
    return Parts(
        site=site,
        clock=clock,
        receiver=receiver,
        refusals=receiver.refusals,
        engine=engine,
        site_time=site_time,
        array_states=array_states,
        event_log=event_log,
        alerts=alerts,
        clips=clips,
        relocator=relocator,
        listeners=listeners,
        tracks=tracks,
        maps=maps,
        latency=latency,
        overload=overload,
        set_up=set_up,
        proposals=proposals,
        refiner=refiner,
        set_up_watch=set_up_watch,
        store=store,
        sinks=outlets.sinks,
        fanout=outlets.fanout,
        zone_book=zone_book,
        journal=journal,
        presence=presence,
        floor_plan=floor_plan,
        hub_link=hub_link,
        reloader=reloader,
        recent_log=RecentLog(),
    )
