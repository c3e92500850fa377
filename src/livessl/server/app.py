"""The fusion server as one process: `assemble` is the list of what runs, `Server` runs it until it is stopped."""

from __future__ import annotations

import asyncio
import logging
import sys
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from typing import Final

from livessl.clock import Clock
from livessl.errors import ConfigError
from livessl.garbage import collect_as_usual
from livessl.server.alerts.evidence import Evidence
from livessl.server.alerts.in_force import Surroundings
from livessl.server.alerts.restoration import restore_alerts
from livessl.server.alerts.service import Alerts, Conditions
from livessl.server.api.app import create_app
from livessl.server.api.auth import Access
from livessl.server.api.encode import JsonObject
from livessl.server.array_states import ArrayStates
from livessl.server.clips.listeners import Listeners
from livessl.server.clips.relocate import Relocator
from livessl.server.clips.service import Clips
from livessl.server.compiling import KernelLoader
from livessl.server.engine import Engine
from livessl.server.event_log import EventLog
from livessl.server.event_retention import delete_old_events
from livessl.server.event_traces import EventTraces
from livessl.server.fanout import Fanout
from livessl.server.forwarding.link import HubLink
from livessl.server.http import certificate_of, listen, url_of, uvicorn_server
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
from livessl.server.sign_of_life import SignOfLife
from livessl.server.signed_links import SignedLinks
from livessl.server.sinks import Sinks
from livessl.server.site_time import SiteTime
from livessl.server.store import Store
from livessl.server.tracks import Tracks
from livessl.server.trails import Trails
from livessl.server.zones.book import ZoneBook
from livessl.server.zones.presence import Presence
from livessl.server.zones.zone_map import ZoneMap
from livessl.service_manager import ServiceManager
from livessl.site.alert_checks import link_secret_file
from livessl.site.checks import unprotected_addresses
from livessl.site.floor_plan import read_floor_plan
from livessl.site.models import Site
from livessl.traces import traces_in_use

SWITCH_S: Final = 0.0005
"""Longest time, in seconds, that a thread holds the GIL while another one waits for it. The fusion thread
releases it thousands of times a second; by Python's default it would wait 5 ms each time to get it back."""

WATCH_S: Final = 0.2
"""Interval, in seconds, at which the threads are checked for a failure."""

_log = logging.getLogger(__name__)


def assemble(
    site: Site,
    clock: Clock,
    store: Store,
    sinks: Sinks,
    fanout: Fanout,
    publish: Callable[[JsonObject], None],
    receiver: Inbox | None = None,
    on_event: Callable[[JsonObject], None] | None = None,
    url: str = "",
    read_site: Callable[[], Site] | None = None,
    links: SignedLinks | None = None,
) -> Parts:
    """Make everything that runs in a server; nothing runs yet.

    Parameters
    ----------
    publish : callable
        Gets every message for subscribers; called on the fusion thread.
    receiver : Inbox or None
        Stands in for the nodes' socket.
    on_event : callable or None
        Gets every event after the sinks and before `publish`; called on the fusion thread.
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

    def publish_to_all(message: JsonObject) -> None:
        if hub_link is not None and not site_time.is_replay:
            hub_link.take(message)
        publish(message)

    def publish_event(event: JsonObject) -> None:
        sinks.take(event)
        if on_event is not None:
            on_event(event)
        publish(event)

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
        event_log = EventLog(site.site, clock, store, latency, publish_event, alerts, traces)
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
        sinks=sinks,
        fanout=fanout,
        zone_book=zone_book,
        journal=journal,
        presence=presence,
        floor_plan=floor_plan,
        hub_link=hub_link,
        reloader=reloader,
        recent_log=RecentLog(),
    )


class Server:
    """A fusion server bound to its two addresses, not yet running.

    Parameters
    ----------
    site : Site
    clock : Clock
    method : str or None
        Estimator, instead of the site's.
    on_event : callable or None
        Gets every event, as subscribers do; called on the fusion thread.
    receiver : Inbox or None
        Stands in for the nodes' socket.
    stepped : bool
        If true, the caller steps the fusion by `parts.engine.turn()`; else it runs in a thread of its own.
    read_site : callable or None
        Reads the site file again, for a reload; it raises `ConfigError` with all faults of the file.
    service : ServiceManager or None
        Gets reports; None for nobody.

    Raises
    ------
    BindError
        If an address is taken.
    ConfigError
        If the server would be open to the network, or keys, tokens or certificate cannot be used.
    StoreError, SinkError, OutboxError, ClipsError
        If the event database, a sink, the outbox of the alerts or the folder of clips cannot be used.
    """

    def __init__(
        self,
        site: Site,
        clock: Clock,
        *,
        method: str | None = None,
        on_event: Callable[[JsonObject], None] | None = None,
        receiver: Inbox | None = None,
        stepped: bool = False,
        read_site: Callable[[], Site] | None = None,
        service: ServiceManager | None = None,
    ) -> None:
        site = _usable(site, method)
        read = None if read_site is None else lambda: _usable(read_site(), method)
        http = site.server.http
        links = None if http.tokens is None else SignedLinks(clock, link_secret_file(site))
        self._access = Access(None if http.tokens is None else site.file(http.tokens), links)
        certificate = certificate_of(http, site.file)
        self._clock = clock
        self._stepped = stepped
        self._kernel_loader = KernelLoader()
        self.loop: asyncio.AbstractEventLoop | None = None
        """The event loop of HTTP and subscribers, while the server runs."""
        with ExitStack() as undo:  # closes what is open if a later step fails
            self._listener = listen(http.host, http.port)
            undo.callback(self._listener.close)
            sinks = Sinks([sink.model_copy(update={"path": str(site.file(sink.path))}) for sink in site.server.sinks])
            undo.callback(sinks.close)
            store = Store.of(site)
            undo.callback(store.close)
            url = url_of(self._listener, tls=certificate is not None)
            # milliseconds since the epoch: fewer than one message per millisecond is published, so none is used again
            fanout = Fanout(clock.now_ns() // 1_000_000)
            self.parts = assemble(
                site, clock, store, sinks, fanout, self._publish, receiver, on_event, url, read, links
            )
            undo.pop_all()
        self.uvicorn = uvicorn_server(create_app(self.parts, self._access), certificate)
        """The HTTP server."""
        self.endpoint = self.parts.receiver.endpoint
        """The address that nodes connect to."""
        self.url = url
        """The address of API and dashboard."""
        self._service = service or ServiceManager(clock)
        self._sign_of_life = SignOfLife(self.parts, self._service, url, lambda: self.uvicorn.started)

    def run(self) -> None:
        """Serve until SIGINT, SIGTERM or `stop`; raise the error of a thread that has failed, if one has."""
        before_s = sys.getswitchinterval()
        sys.setswitchinterval(SWITCH_S)
        collect_as_usual()
        try:
            with self.parts.recent_log.attached():
                asyncio.run(self._serve())
        finally:
            sys.setswitchinterval(before_s)
            self._end_relocation()
            self._kernel_loader.stop()
            self.parts.reloader.stop()
            self.parts.engine.stop()
            self.parts.alerts.stop()
            if self.parts.clips is not None:
                self.parts.clips.stop()
            self.parts.receiver.stop()
            if self.parts.hub_link is not None:
                self.parts.hub_link.stop()
            self.parts.store.close()
            self.parts.sinks.close()
            self._listener.close()
            # what computes at leisure comes last: what has to be on the disk does not wait for it
            self.parts.maps.stop()
            self.parts.set_up_watch.stop()
            self.parts.refiner.stop()
        if self.parts.failure is not None:
            raise self.parts.failure

    def stop(self) -> None:
        """End `run`; from any thread."""
        self.uvicorn.should_exit = True

    def wait_idle(self) -> None:
        """Return when the running replay has ended and its last event is published."""
        self.parts.engine.wait_idle()

    async def _serve(self) -> None:
        self.loop = asyncio.get_running_loop()
        if not self._stepped:
            self.parts.store.backlog.start()  # before everything that stores: from now on nothing waits for a database
        restore_alerts(self.parts)
        self.parts.receiver.start()
        self.parts.maps.start()
        self.parts.set_up_watch.start()
        self.parts.refiner.start()
        self.parts.alerts.start()
        if self.parts.clips is not None:
            self.parts.clips.start()
        if self.parts.hub_link is not None:
            self.parts.hub_link.start()
        self.parts.reloader.start(self._service.reloading)
        if not self._stepped:
            self.parts.engine.start(self._kernel_loader.load)
        retention = delete_old_events(self.parts.store, self._clock, self.parts.site.store.retention_days)
        works = self._watch(), self._sign_of_life.describe(), retention, self._access.reload_tokens()
        tasks = [asyncio.create_task(work) for work in works]
        for task in tasks:
            task.add_done_callback(self._stop_on_error)
        try:
            await self.uvicorn.serve(sockets=[self._listener])
        finally:
            self._service.stopping()
            for task in tasks:
                task.cancel()
            ends = await asyncio.gather(*tasks, return_exceptions=True)
            self.loop = None
        for error in ends:
            if isinstance(error, Exception):
                raise error

    def _stop_on_error(self, task: asyncio.Task[None]) -> None:
        """Stop if a task has failed: what it did would be missed, and nobody would know."""
        if not task.cancelled() and task.exception() is not None:
            self.stop()

    async def _watch(self) -> None:
        """Stop when a thread has failed: a service manager restarts a server that ends, not one that looks alive."""
        while self.parts.failure is None and not self.uvicorn.should_exit:
            self._sign_of_life.give()
            await asyncio.sleep(WATCH_S)
        self.stop()
        self.parts.fanout.ended.set()
        self._end_relocation()

    def _end_relocation(self) -> None:
        """End the request that waits for an event to be located again; a thread that waited on would hold the exit."""
        if self.parts.relocator is not None:
            self.parts.relocator.stop()

    def _publish(self, message: JsonObject) -> None:
        """Hand a message to subscribers; on the fusion thread."""
        published_ns = self._clock.monotonic_ns() if message.get("latency_stages_s") else None
        loop = self.loop
        if loop is None:
            return
        try:
            loop.call_soon_threadsafe(self.parts.fanout.publish, message, published_ns)
        except RuntimeError:  # the loop has just closed, and no subscriber is left
            _log.debug("a message was published after the event loop had closed")


def _usable(site: Site, method: str | None) -> Site:
    """Return a site with the method of the command line, if it may be served.

    Raises
    ------
    ConfigError
        If the server would be open to the network.
    """
    faults = unprotected_addresses(site)
    if faults:
        raise ConfigError(faults)
    if method is None:
        return site
    return site.model_copy(update={"fusion": site.fusion.model_copy(update={"method": method})})
