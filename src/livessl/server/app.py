"""The fusion server as one process: engine thread, event loop, HTTP. `serve` runs until it is told to end."""

from __future__ import annotations

import asyncio
import errno
import gc
import logging
import socket
import ssl
import sys
import threading
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Final

import uvicorn
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.exceptions import InvalidState

from livessl.clock import Clock
from livessl.core.locate.peak_search import warm_up
from livessl.server.api.app import create_app
from livessl.server.api.auth import Access
from livessl.server.api.encode import JsonObject
from livessl.server.array_states import ArrayStates
from livessl.server.engine import Engine
from livessl.server.event_log import EventLog
from livessl.server.fanout import Fanout
from livessl.server.latency import Latency
from livessl.server.maps import Maps
from livessl.server.parts import Parts
from livessl.server.publisher import Publisher
from livessl.server.receiver import BindError, Receiver, Source
from livessl.server.sinks import Sinks
from livessl.server.site_time import SiteTime
from livessl.server.store import Store, StoreError
from livessl.server.tracks import Tracks
from livessl.site.keys import file_stamp, read_tokens
from livessl.site.models import ConfigError, Fault, HttpConfig, Site, open_doors

SWITCH_S: Final = 0.0005
"""How long a thread may keep the interpreter from another one. What listens and searches leaves it for moments,
thousands of times a second, and would wait for it 5 ms each time if somebody else had work."""

NOTICE_S: Final = 2.0
"""Time, in seconds, that the kernels may take to load before the log says that they are being compiled."""

SHUTDOWN_S: Final = 2
"""Open connections get this long to end."""

MAX_CONNECTIONS: Final = 1000
"""More than any site has clients, and fewer than the 1024 open files that most systems allow a process."""

MAX_SAID_BYTES: Final = 4096
"""Of a subscriber, who has nothing to say."""

MAX_HEAD_BYTES: Final = 16_384
"""Of a request: its line and all of its headers."""

CIPHERS: Final = "ECDHE+AESGCM:ECDHE+CHACHA20"
"""Of TLS 1.2: forward secret and authenticated. Those of 1.3 all are."""

MAX_UNREAD_BYTES: Final = 131_072
"""What the system keeps for a client that does not read; left to itself it would be megabytes for each."""

REFRESH_S: Final = 1.0
"""How often the file of tokens is looked at."""

EXPIRE_S: Final = 600.0
"""How often events are looked through for those that have been kept long enough."""

DAY_NS: Final = 86_400_000_000_000

_log = logging.getLogger(__name__)


def assemble(
    site: Site,
    clock: Clock,
    store: Store,
    sinks: Sinks,
    fanout: Fanout,
    publish: Callable[[JsonObject], None],
    receiver: Source | None = None,
) -> Parts:
    """Make everything that runs in a server; nothing runs yet.

    Parameters
    ----------
    publish : callable
        Gets every message for subscribers; called on the fusion thread.
    receiver : Source or None
        Stands in for the nodes' socket.

    Raises
    ------
    BindError
        If the address for the nodes is taken.
    ConfigError
        If the site uses keys that cannot be read.
    """
    with ExitStack() as undo:
        if receiver is None:
            receiver = Receiver(site, clock)
            undo.callback(receiver.stop)
        site_time = SiteTime(clock)
        latency, maps, tracks = Latency(clock, receiver.arrivals), Maps(clock), Tracks()
        array_states = ArrayStates(site, clock, store, site_time, receiver.ingest, publish)
        event_log = EventLog(site.site, clock, store, latency, publish)
        publisher = Publisher(publish, receiver.request, site_time, event_log, tracks, maps, latency)
        engine = Engine(site, clock, receiver, site_time, array_states, event_log, maps, publisher)
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
        tracks=tracks,
        maps=maps,
        latency=latency,
        store=store,
        sinks=sinks,
        fanout=fanout,
    )


def _compile_kernels() -> None:
    """Compile the kernels before anybody waits for a result; reading them from numba's cache takes a moment only."""
    notice = threading.Timer(NOTICE_S, _log.info, ["First start: compiling kernels. This can take a minute."])
    notice.start()
    try:
        warm_up()
    finally:
        notice.cancel()


class _Socket(WebSocketsSansIOProtocol):
    """A WebSocket whose end is no trouble where its client is just closing it: uvicorn's would stop the server's."""

    def shutdown(self) -> None:
        try:
            super().shutdown()
        except InvalidState:
            self.transport.close()


class Server:
    """A fusion server bound to its two addresses, not yet running.

    Parameters
    ----------
    site : Site
    clock : Clock
    method : str or None
        Estimator, instead of the site's.
    on_event : callable or None
        Gets every event besides the subscribers; called on the fusion thread.
    receiver : Source or None
        Stands in for the nodes' socket.
    stepped : bool
        Whether the caller steps the fusion by `parts.engine.turn()`; else it runs in a thread of its own.

    Raises
    ------
    BindError
        Where an address is taken.
    ConfigError
        Where the server would be open to the network, or where keys, tokens or certificate cannot be used.
    StoreError, SinkError
        Where the event database or a sink cannot be used.
    """

    def __init__(
        self,
        site: Site,
        clock: Clock,
        *,
        method: str | None = None,
        on_event: Callable[[JsonObject], None] | None = None,
        receiver: Source | None = None,
        stepped: bool = False,
    ) -> None:
        faults = open_doors(site)
        if faults:
            raise ConfigError(faults)
        if method is not None:
            site = site.model_copy(update={"fusion": site.fusion.model_copy(update={"method": method})})
        http = site.server.http
        self._tokens_file = None if http.tokens is None else site.file(http.tokens)
        self._tokens_seen = None if self._tokens_file is None else file_stamp(self._tokens_file)
        self._access = Access(None if self._tokens_file is None else read_tokens(self._tokens_file))
        certificate = _certificate(site)
        self._on_event = on_event
        self._clock = clock
        self._stepped = stepped
        first_seq = clock.now_ns() // 1_000_000  # fewer than a message a millisecond, so no number comes twice
        self._loop: asyncio.AbstractEventLoop | None = None
        with ExitStack() as undo:  # what is open when a later step fails
            self._http = _listen(http.host, http.port)
            undo.callback(self._http.close)
            sinks = Sinks(site.server.sinks)
            undo.callback(sinks.close)
            store = Store(Path(site.server.events_db) if site.server.events_db else None)
            undo.callback(store.close)
            _compile_kernels()
            self.parts = assemble(site, clock, store, sinks, Fanout(first_seq), self._publish, receiver)
            undo.pop_all()
        app = create_app(self.parts, self._access)
        self._uvicorn = uvicorn.Server(
            uvicorn.Config(
                app,
                ws=_Socket,  # of all kinds the quickest to send many small messages
                log_level="warning",
                http="h11",  # the one that limits a request's head
                h11_max_incomplete_event_size=MAX_HEAD_BYTES,
                ssl_certfile=certificate,
                ssl_ciphers=CIPHERS,
                ssl_keyfile=None if http.private_key is None else site.file(http.private_key),
                limit_concurrency=MAX_CONNECTIONS,
                ws_max_size=MAX_SAID_BYTES,
                ws_per_message_deflate=False,  # small messages hardly shrink, and each would cost time and memory
                timeout_graceful_shutdown=SHUTDOWN_S,
            )
        )
        self.endpoint = self.parts.receiver.endpoint
        """The address that nodes connect to."""
        host, port = self._http.getsockname()[:2]
        self.url = f"{'http' if certificate is None else 'https'}://{f'[{host}]' if ':' in host else host}:{port}"
        """The address of API and dashboard."""

    def run(self) -> None:
        """Serve until SIGINT, SIGTERM or `stop`; raises what made the engine fail, if it did."""
        before_s = sys.getswitchinterval()
        sys.setswitchinterval(SWITCH_S)
        gc.collect()
        gc.freeze()  # what is there now stays: the collector need not look through it for ever
        try:
            asyncio.run(self._serve())
        finally:
            sys.setswitchinterval(before_s)
            self.parts.engine.stop()
            self.parts.maps.stop()
            self.parts.receiver.stop()
            self.parts.store.close()
            self.parts.sinks.close()
            self._http.close()
        if self.parts.failure is not None:
            raise self.parts.failure

    def stop(self) -> None:
        """End `run`; from any thread."""
        self._uvicorn.should_exit = True

    def wait_idle(self) -> None:
        """Return when the running replay has ended and its last event is published."""
        self.parts.engine.wait_idle()

    async def _serve(self) -> None:
        self._loop = asyncio.get_running_loop()
        self.parts.receiver.start()
        self.parts.maps.start()
        if not self._stepped:
            self.parts.engine.start()
        tasks = [asyncio.create_task(work) for work in (self._watch(), self._expire(), self._refresh())]
        try:
            await self._uvicorn.serve(sockets=[self._http])
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            self._loop = None

    async def _watch(self) -> None:
        """Without its engine the server is of no use: better to end and be restarted than to look alive."""
        while self.parts.failure is None:
            await asyncio.sleep(0.2)
        self.stop()

    async def _refresh(self) -> None:
        """Take over the file of tokens when it has changed; one that cannot be used changes nothing, and is told."""
        while (path := self._tokens_file) is not None:
            await asyncio.sleep(REFRESH_S)
            stamp = await asyncio.to_thread(file_stamp, path)
            if stamp == self._tokens_seen:
                continue
            self._tokens_seen = stamp
            try:
                self._access.replace(await asyncio.to_thread(read_tokens, path, missing_ok=True))
                _log.info("%s has changed: %d tokens are in force", path, len(self._access.clients))
            except ConfigError as error:
                _log.error("%s; the tokens of before stay in force", error)

    async def _expire(self) -> None:
        """Forget events that are older than they may become."""
        days, store = self.parts.site.store.retention_days, self.parts.store
        while days is not None:
            before_ns = self._clock.now_ns() - round(days * DAY_NS)
            try:
                if gone := await asyncio.to_thread(store.expire, before_ns):
                    _log.info("%d events older than %g days were deleted", gone, days)
            except StoreError as error:
                _log.error("%s", error)
            await asyncio.sleep(EXPIRE_S)

    def _publish(self, message: JsonObject) -> None:
        published_ns = self._clock.monotonic_ns() if message.get("latency_stages_s") else None
        if message["kind"] == "event":
            self.parts.sinks.take(message)
            if self._on_event is not None:
                self._on_event(message)
        loop = self._loop
        if loop is None:
            return
        try:
            loop.call_soon_threadsafe(self.parts.fanout.publish, message, published_ns)
        except RuntimeError:  # the loop has just closed: nobody is left to tell
            _log.debug("a message came after the end")


def _certificate(site: Site) -> Path | None:
    """The certificate's file, once it is known to fit its key: uvicorn would find out only when it is too late."""
    http: HttpConfig = site.server.http
    if http.certificate is None or http.private_key is None:
        return None
    certificate, key = site.file(http.certificate), site.file(http.private_key)
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(certificate, key, password="")
    except (OSError, ssl.SSLError) as error:
        reason = getattr(error, "reason", None) or error.strerror
        what = f"cannot use {certificate} with {key}: {reason}; name a PEM certificate and its key without a passphrase"
        raise ConfigError([Fault("server.http.certificate", what)]) from error
    return certificate


def _listen(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, MAX_UNREAD_BYTES)  # and of all that it accepts
    try:
        listener.bind((host, port))
        listener.listen(128)
    except OSError as error:
        listener.close()
        cure = _CURES.get(error.errno or 0, "write an address of this machine")
        raise BindError(f"server.http: cannot listen on {host}:{port}: {error.strerror}; {cure}") from error
    return listener


_CURES: Final = {
    errno.EADDRINUSE: "is another server running? Stop it or choose another port",
    errno.EACCES: "choose a port from 1024 on",
}
