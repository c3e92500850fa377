"""The fusion server as one process: start-up and shutdown of the parts that `assembly` lists."""

from __future__ import annotations

import asyncio
import logging
import sys
from collections.abc import Callable
from contextlib import ExitStack
from typing import Final

from livessl.clock import Clock
from livessl.errors import ConfigError
from livessl.garbage import collect_as_usual
from livessl.server.alerts.restoration import restore_alerts
from livessl.server.api.app import create_app
from livessl.server.api.auth import Access
from livessl.server.api.encode import JsonObject
from livessl.server.assembly import Outlets, assemble
from livessl.server.compiling import KernelLoader
from livessl.server.event_retention import delete_old_events
from livessl.server.fanout import Fanout
from livessl.server.http import certificate_of, listen, url_of, uvicorn_server
from livessl.server.receiver import Inbox
from livessl.server.sign_of_life import SignOfLife
from livessl.server.signed_links import SignedLinks
from livessl.server.sinks import Sinks
from livessl.server.store import Store
from livessl.service_manager import ServiceManager
from livessl.site.alert_checks import link_secret_file
from livessl.site.checks import missing_packages, unprotected_addresses
from livessl.site.models import Site

SWITCH_S: Final = 0.0005
"""Longest time, in seconds, that a thread holds the GIL while another one waits for it. The fusion thread
releases it thousands of times a second; by Python's default it would wait 5 ms each time to get it back."""

WATCH_S: Final = 0.2
"""Interval, in seconds, at which the threads are checked for a failure."""

_log = logging.getLogger(__name__)


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
        Gets reports; None without a service manager.

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
            outlets = Outlets(store, sinks, fanout, self.publish, on_event)
            self.parts = assemble(site, clock, outlets, receiver, url, read, links)
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
            self.parts.set_up_watch.thread.stop()
            self.parts.refiner.thread.stop()
        if self.parts.failure is not None:
            raise self.parts.failure

    def stop(self) -> None:
        """End `run`; from any thread."""
        self.uvicorn.should_exit = True

    def publish(self, message: JsonObject) -> None:
        """Hand a message to subscribers; from any thread."""
        published_ns = self._clock.monotonic_ns() if message.get("latency_stages_s") else None
        loop = self.loop
        if loop is None:
            return
        try:
            loop.call_soon_threadsafe(self.parts.fanout.publish, message, published_ns)
        except RuntimeError:  # the loop has just closed, and no subscriber is left
            _log.debug("a message was published after the event loop had closed")

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
        self.parts.set_up_watch.thread.start()
        self.parts.refiner.thread.start()
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
        """Stop if a task has failed: a server without it would look alive and do a part of its work only."""
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


def _usable(site: Site, method: str | None) -> Site:
    """Return a site with the method of the command line, if it may be served.

    Raises
    ------
    ConfigError
        If the server would be open to the network, or lacks a package.
    """
    faults = [*unprotected_addresses(site), *missing_packages(site)]
    if faults:
        raise ConfigError(faults)
    if method is None:
        return site
    return site.model_copy(update={"fusion": site.fusion.model_copy(update={"method": method})})
