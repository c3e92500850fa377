"""Sends a site's outbox to the hub through NATS JetStream, again after a failure, and reports on the site.

No other thread waits for it. It sends a window of messages at a time and goes on when the stream has acknowledged all
of them. After a failure it sends again from the first one without an acknowledgement; ids prevent duplicates.
"""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from itertools import takewhile
from typing import TYPE_CHECKING, Final

import orjson

from livessl import __version__
from livessl.clock import Clock, utc_text
from livessl.server.api.encode import API_VERSION, JsonObject
from livessl.server.forwarding.hub_messages import HubMessages
from livessl.server.forwarding.outbox import Outbox, Unsent
from livessl.server.forwarding.stream import (
    HEALTH,
    MESSAGE_ID,
    RECONNECT_S,
    STREAM,
    Place,
    connect_options,
    connected,
    message_id,
    nats_library,
    subject,
    until_one_ends,
)
from livessl.server.history.backlog import Backlog
from livessl.server.history.database import StoreError
from livessl.site.models import Site

if TYPE_CHECKING:
    from nats.aio.client import Client
    from nats.js import JetStreamContext
    from nats.js.api import PubAck

WINDOW: Final = 500
"""Most messages that are sent before the first of them is acknowledged: about 750 kB, 40 ms at 150 Mbit/s."""

HEADERS_BYTES: Final = 256
"""Size of a message's headers at most, which NATS counts as part of it."""

ACKNOWLEDGED_S: Final = 5.0
"""Longest wait, in seconds, for the acknowledgement of a window."""

RETRY_S: Final = 0.25
"""Wait, in seconds, after a window was not acknowledged."""

REST_S: Final = 1.0
"""Wait, in seconds, after the outbox could not be read or written."""

REPORT_S: Final = 5.0
"""Interval, in seconds, at which a site reports on itself; also the longest wait before the outbox is read again."""

STOP_S: Final = 3.0
"""Longest wait, in seconds, for the thread when the server stops."""

PLACE: Final = "server.hub"

_log = logging.getLogger(__name__)


class HubLink:
    """Sends what waits in the outbox to the hub's stream, and reports on the site.

    Parameters
    ----------
    site : Site
        Has `server.hub`.
    clock : Clock
    outbox : Outbox
    backlog : Backlog
        Writes into the outbox, in order with the events, without anyone waiting for it.
    arrays : callable
        Returns the states of the arrays as `GET arrays` does.

    Raises
    ------
    ConfigError
        If nats-py is not installed, or a file of `server.hub` cannot be used.
    """

    def __init__(
        self, site: Site, clock: Clock, outbox: Outbox, backlog: Backlog, arrays: Callable[[], list[JsonObject]]
    ) -> None:
        config = site.server.hub
        assert config is not None
        self._nats = nats_library(PLACE)
        self._options = connect_options(config, site.file, PLACE) | {"name": f"livessl {site.site}"}
        self._site = site.site
        self._location_deg = config.location_deg
        self._hall = None if config.hall is None else config.hall.model_dump(mode="json")
        self._clock = clock
        self._outbox = outbox
        self.messages = HubMessages(clock, outbox, backlog)
        """Puts messages into the outbox."""
        self._arrays = arrays
        self._loop: asyncio.AbstractEventLoop | None = None
        self._thread: threading.Thread | None = None
        self._news, self._end = asyncio.Event(), asyncio.Event()
        self._is_named = False  # whether the outbox has its name of this run
        self._problem: str | None = "not connected yet"
        self._complaint: str | None = None  # what NATS has said since the last window was sent
        self.sent = 0
        """Messages that the stream has acknowledged since the start."""
        self.dropped = 0
        """Messages that were larger than NATS takes, and were given up, since the start."""
        self.waiting = 0
        """Messages that wait in the outbox, as of the last look at it."""
        self.failure: BaseException | None = None
        """The error that has ended the thread, if one has."""

    @property
    def problem(self) -> str | None:
        """Reason why messages wait, as a sentence for `health`; None while they are sent."""
        if self._problem is None:
            return None
        return f"{PLACE}: {self._problem}; {self.waiting} messages wait for the hub"

    def start(self) -> None:
        """Begin to send."""
        self.messages.note_start()
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._run, args=(self._loop,), name="hub", daemon=True)
        self._thread.start()
        self._outbox.on_put(partial(self._call, self._news.set))

    def stop(self) -> None:
        """Stop; what waits is sent after the next start."""
        if self._thread is not None:
            self._call(self._end.set)
            self._thread.join(timeout=STOP_S)

    # --- the thread

    def _run(self, loop: asyncio.AbstractEventLoop) -> None:
        try:
            loop.run_until_complete(self._work())
        except BaseException as error:
            self.failure = error
            _log.exception("the thread of the link to the hub has failed; the server ends")
            raise
        finally:
            loop.close()

    def _call(self, work: Callable[[], None]) -> None:
        """Have something done on the thread's loop, if it runs."""
        loop = self._loop
        if loop is not None:
            with suppress(RuntimeError):  # it has just been closed
                loop.call_soon_threadsafe(work)

    async def _work(self) -> None:
        """Send until `stop`."""
        await until_one_ends(self._stay_connected(), self._end.wait())

    async def _stay_connected(self) -> None:
        """Connect, send as long as the connection lasts, and connect again, until cancelled."""
        lost = asyncio.Event()

        async def failed(error: Exception) -> None:
            self._complaint = _told(error)
            self._note(self._complaint)

        async def end() -> None:
            lost.set()
            self._news.set()

        while True:
            lost.clear()
            try:
                async with connected(self._nats, self._options, failed, end) as client:
                    await self._send_while_connected(client, lost)
            except (self._nats.errors.Error, OSError, TimeoutError) as error:
                self._note(_told(error))
            await asyncio.sleep(RECONNECT_S)

    async def _send_while_connected(self, client: Client, lost: asyncio.Event) -> None:
        reporting = asyncio.create_task(self._report(client))
        try:
            await self._send_all(client, lost)
        finally:
            reporting.cancel()
            await asyncio.gather(reporting, return_exceptions=True)

    async def _send_all(self, client: Client, lost: asyncio.Event) -> None:
        """Send what waits and what comes, until the connection is lost.

        A connection that dies silently is closed without `lost`: its TLS cannot be ended in good order.
        """
        stream = client.jetstream()  # one for the connection, because each has its own subscription, which never ends
        while not (lost.is_set() or client.is_closed):
            self._news.clear()
            wait_s = REPORT_S
            try:
                if not self._is_named:
                    await asyncio.to_thread(self._outbox.rename)
                    self._is_named = True
                head = await asyncio.to_thread(self._outbox.head)
                window = await asyncio.to_thread(self._outbox.unsent, WINDOW)
                self.waiting = head.last - head.acknowledged if window else 0
                if window:
                    small = _small_enough(window, client.max_payload)
                    if not small:
                        await self._drop(window[0], client.max_payload)
                        continue
                    count = await self._send(stream, head.outbox, small, lost)
                    if count:
                        await asyncio.to_thread(self._outbox.acknowledge, small[count - 1].number)
                        self.sent += count
                    if count == len(small):
                        self._note(None)
                        continue
                    wait_s = RETRY_S
                elif not lost.is_set():
                    self._note(None)
            except StoreError as error:
                self._note(str(error))
                wait_s = REST_S
            with suppress(TimeoutError):
                async with asyncio.timeout(wait_s):
                    await self._news.wait()

    async def _drop(self, message: Unsent, limit: int) -> None:
        """Give a message up that NATS would never take, so that its successors do not wait for it."""
        await asyncio.to_thread(self._outbox.acknowledge, message.number)
        self.dropped += 1
        _log.error(
            "%s: message %d (%s) is given up: its %d bytes are more than max_payload of NATS, %d bytes; raise that",
            *(PLACE, message.number, message.kind, len(message.body.encode()), limit),
        )

    async def _send(self, stream: JetStreamContext, outbox: str, window: Sequence[Unsent], lost: asyncio.Event) -> int:
        """Send messages; return how many of the first ones the stream has acknowledged without a gap."""
        waiting: list[asyncio.Future[PubAck]] = []
        losing = asyncio.create_task(lost.wait())
        self._complaint = None
        try:
            for message in window:
                headers = {MESSAGE_ID: message_id(Place(outbox, message.number)), "Nats-Expected-Stream": STREAM}
                address = subject(self._site, message.kind)
                waiting.append(await stream.publish_async(address, message.body.encode(), headers=headers))
            done = asyncio.gather(*waiting, return_exceptions=True)
            await asyncio.wait((done, losing), timeout=ACKNOWLEDGED_S, return_when=asyncio.FIRST_COMPLETED)
        except self._nats.errors.Error as error:
            self._note(_told(error))
        finally:
            losing.cancel()
        count = next((place for place, each in enumerate(waiting) if not _is_acknowledged(each)), len(waiting))
        if count < len(waiting):
            refusal = _error_of(waiting[count])
            unknown = self._complaint or "the stream did not acknowledge a message in time"
            self._note(unknown if refusal is None else _told(refusal))
        for each in waiting:
            each.cancel()
        return count

    async def _report(self, client: Client) -> None:
        """Publish a report of the site on itself at every `REPORT_S`, until cancelled; none is kept for later."""
        while True:
            with suppress(self._nats.errors.Error):
                await client.publish(subject(self._site, HEALTH), orjson.dumps(self._described()))
            await asyncio.sleep(REPORT_S)

    def _described(self) -> JsonObject:
        return {
            "v": API_VERSION,
            "kind": HEALTH,
            "site": self._site,
            "version": __version__,
            "now_utc": utc_text(self._clock.now_ns()),
            "waiting": self.waiting,
            "location_deg": self._location_deg,
            "hall": self._hall,
            "arrays": {array["name"]: array["state"] for array in self._arrays()},
        }

    def _note(self, problem: str | None) -> None:
        """Remember why messages wait, and log it if that is news."""
        if problem == self._problem:
            return
        if problem is None:
            _log.info("%s: the hub's stream takes messages", PLACE)
        else:
            _log.warning("%s: %s; messages wait in the database, and are sent later", PLACE, problem)
        self._problem = problem


def _small_enough(window: Sequence[Unsent], limit: int) -> list[Unsent]:
    """Return the messages before the first one that is larger than NATS takes."""
    return list(takewhile(lambda message: len(message.body.encode()) + HEADERS_BYTES <= limit, window))


def _is_acknowledged(sent: asyncio.Future[PubAck]) -> bool:
    return sent.done() and not sent.cancelled() and sent.exception() is None


def _error_of(sent: asyncio.Future[PubAck]) -> BaseException | None:
    return sent.exception() if sent.done() and not sent.cancelled() else None


def _told(error: BaseException) -> str:
    """Return what an error of NATS means, with its cure where that is known."""
    match type(error).__name__:
        case "NoStreamResponseError" | "NoRespondersError":
            return f"no stream {STREAM!r} takes this site's messages; start `livessl hub`, which makes it"
        case "AuthorizationError":
            return "NATS refuses the user or password; correct server.hub.user, password or credentials"
        case _:
            return f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
