"""Takes the sites' messages out of NATS into the hub's archive; of several hubs one does it, and another takes over.

It decides how long a missing message is awaited (`PATIENCE_S`). The consumer is durable and shared: what one hub took
and did not acknowledge, the stream gives to the next one.
"""

from __future__ import annotations

import asyncio
import logging
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final

import orjson
from pydantic import ValidationError
from sqlalchemy.exc import SQLAlchemyError

from livessl.clock import Clock
from livessl.errors import RunError
from livessl.federation.archive import Archive, Turn
from livessl.federation.config import Hub
from livessl.federation.received import Report
from livessl.federation.standstill import Standstill
from livessl.federation.storing import Delivery
from livessl.server.api.encode import JsonObject
from livessl.server.forwarding.stream import (
    CONSUMER,
    KINDS,
    MESSAGE_ID,
    RECONNECT_S,
    STREAM,
    connect_options,
    connected,
    health_of_all,
    nats_library,
    parse_message_id,
    parse_subject,
    subjects_of_stream,
    until_one_ends,
)
from livessl.server.history.database import StoreError

if TYPE_CHECKING:
    from nats.aio.client import Client
    from nats.aio.msg import Msg
    from nats.aio.subscription import Subscription
    from nats.js import JetStreamContext

BATCH: Final = 500
"""Most messages that are stored in one transaction."""

REQUEST_S: Final = 1.0
"""Time, in seconds, for which a request for messages stands; then the right to take them is checked."""

ACK_WAIT_S: Final = 2.0
"""Time, in seconds, after which the stream gives a message again that was not acknowledged: a hub has died."""

EARLY_S: Final = 0.1
"""Wait, in seconds, before a message comes again whose predecessors had not come."""

PATIENCE_S: Final = 10.0
"""Time, in seconds, for which a message waits for its predecessors."""

DUPLICATES_S: Final = 600.0
"""Time, in seconds, for which the stream recognizes a message that it already has; the archive always recognizes it."""

LOOK_S: Final = 1.0
"""Interval, in seconds, at which a hub that waits for its turn looks whether another one takes messages in."""

REPORTS_S: Final = 1.0
"""Interval, in seconds, at which reports of sites are stored."""

TURN_S: Final = 0.25
"""Interval, in seconds, at which a hub that waits for its turn tries to get it."""

DAY_S: Final = 86_400.0

PLACE: Final = "nats"

_END: Final = ("404", "408")
"""Statuses by which a request for messages ends in good order: there are no more, or its time is over."""

_STANDSTILL: Final = (
    "no hub takes messages in, though one holds the lock in PostgreSQL, which is freed a few seconds after that hub's "
    "machine has vanished; if it is not, stop that hub"
)

_log = logging.getLogger(__name__)


class RefusedError(RunError):
    """NATS does not give messages: its stream or consumer is gone, or about to move."""


class Intake:
    """The part of a hub that receives; it runs on the event loop of the API.

    Parameters
    ----------
    hub : Hub
    archive : Archive
    clock : Clock

    Raises
    ------
    ConfigError
        If nats-py is not installed, or a file of `nats` cannot be used.
    """

    def __init__(self, hub: Hub, archive: Archive, clock: Clock) -> None:
        self._nats = nats_library(PLACE)
        name = f"livessl hub {hub.settings.hub}"
        self._options = connect_options(hub.settings.nats, hub.file, PLACE) | {"name": name}
        self._stream = hub.settings.stream
        self._archive = archive
        self._clock = clock
        self._standstill, self._looked_ns = Standstill(), 0
        self._reports: dict[str, JsonObject] = {}
        self._problem: str | None = "not connected yet"
        self.has_turn = False
        """True while this hub is the one that takes messages in."""
        self.taken = 0
        """Messages taken in since the start."""
        self.rejected = 0
        """Messages that could not be stored since the start."""

    @property
    def problem(self) -> str | None:
        """Reason why no messages can be taken in; None if they can."""
        return None if self._problem is None else f"{PLACE}: {self._problem}"

    async def run(self) -> None:
        """Receive until cancelled, and connect again whenever that is needed."""
        await until_one_ends(self._stay_connected(), self._store_reports())

    async def _stay_connected(self) -> None:
        while True:
            try:
                await self._receive()
            except (self._nats.errors.Error, StoreError, SQLAlchemyError, OSError, TimeoutError) as error:
                self._note(_told(error))
            except RefusedError as error:
                self._note(str(error))
            await asyncio.sleep(RECONNECT_S)

    async def _receive(self) -> None:
        """Receive as long as a connection lasts."""
        lost = asyncio.Event()

        async def failed(error: Exception) -> None:
            if lost.is_set() or self._problem is not None:
                self._note(_told(error))

        async def end() -> None:
            lost.set()

        async with connected(self._nats, self._options, failed, end) as client:
            stream = client.jetstream()
            await self._make_stream(stream)
            self._note(None)
            self._standstill = Standstill()
            await client.subscribe(health_of_all(), queue=CONSUMER, cb=self._take_report)
            while not (lost.is_set() or client.is_closed):  # closed alone is one that has died silently
                await self._take_turn(client)
                await self._look(stream)
                await asyncio.sleep(TURN_S)
        self._note("the connection was lost")

    async def _look(self, stream: JetStreamContext) -> None:
        """Note it if this hub waits for its turn, and no other one takes messages in."""
        now_ns = self._clock.monotonic_ns()
        if now_ns - self._looked_ns < 1e9 * LOOK_S:
            return
        self._looked_ns = now_ns
        is_standing = self._standstill.holds(await stream.consumer_info(STREAM, CONSUMER), now_ns)
        self._note(_STANDSTILL if is_standing else None)

    async def _make_stream(self, stream: JetStreamContext) -> None:
        """Make the stream and the consumer, or change them to what the hub's file says."""
        from nats.js.api import AckPolicy, ConsumerConfig, DeliverPolicy, StreamConfig
        from nats.js.errors import BadRequestError

        wanted = StreamConfig(
            name=STREAM,
            description="results of all sites of livessl",
            subjects=subjects_of_stream(),
            num_replicas=self._stream.replicas,
            max_age=self._stream.max_age_days * DAY_S,
            max_bytes=self._stream.max_bytes,
            duplicate_window=DUPLICATES_S,
        )
        try:
            await stream.add_stream(wanted)
        except BadRequestError:  # it is there, with other limits
            await stream.update_stream(wanted)
        consumer = ConsumerConfig(
            durable_name=CONSUMER,
            ack_policy=AckPolicy.EXPLICIT,
            deliver_policy=DeliverPolicy.ALL,
            ack_wait=ACK_WAIT_S,
            max_ack_pending=4 * BATCH,
        )
        await stream.add_consumer(STREAM, consumer)

    async def _take_turn(self, client: Client) -> None:
        """Take messages in as long as this hub has the turn, if it gets it."""
        turns = self._archive.turn()
        turn = await asyncio.to_thread(turns.__enter__)
        try:
            if turn is not None:
                _log.info("this hub takes the messages of the sites in")
                self.has_turn = True
                self._note(None)
                await self._take_all(client, turn)
        finally:
            self.has_turn = False
            await asyncio.shield(asyncio.to_thread(turns.__exit__, None, None, None))

    async def _take_all(self, client: Client, turn: Turn) -> None:
        inbox = client.new_inbox()
        messages = await client.subscribe(inbox)
        try:
            while True:
                await asyncio.to_thread(turn.check)
                await self._request(client, inbox)
                left, is_ended = BATCH, False
                while left > 0 and not is_ended:
                    batch, is_ended = await self._next_batch(messages, left)
                    left -= len(batch)
                    await self._store(batch)
        finally:
            with suppress(self._nats.errors.Error):
                await messages.unsubscribe()

    async def _request(self, client: Client, inbox: str) -> None:
        """Ask the consumer for a batch; it answers with messages as they come, and with a status if they are fewer."""
        request = {"batch": BATCH, "expires": round(REQUEST_S * 1e9)}
        await client.publish(f"$JS.API.CONSUMER.MSG.NEXT.{STREAM}.{CONSUMER}", orjson.dumps(request), reply=inbox)

    async def _next_batch(self, messages: Subscription, most: int) -> tuple[list[Msg], bool]:
        """Return the messages that are there, after waiting for the first one, and whether the request has ended."""
        batch: list[Msg] = []
        try:
            while len(batch) < most and (not batch or messages.pending_msgs):
                message = await messages.next_msg(timeout=2 * REQUEST_S)
                status = (message.headers or {}).get("Status")
                if status is None:
                    batch.append(message)
                elif status in _END:
                    return batch, True
                elif not batch:
                    said = f"{status} {(message.headers or {}).get('Description', '')}".strip()
                    raise RefusedError(f"the stream gives no messages ({said}); it is made again if it is gone")
                else:  # what came before it is stored; the next request is refused as well
                    return batch, True
        except self._nats.errors.TimeoutError:
            return batch, True
        return batch, False

    async def _store(self, batch: list[Msg]) -> None:
        """Store messages, and acknowledge them after that."""
        by_delivery: dict[Delivery, list[Msg]] = {}
        for message in batch:
            delivery = _delivery(message)
            if delivery is None:
                self.rejected += 1
                await message.term()
            else:
                by_delivery.setdefault(delivery, []).append(message)
        if not by_delivery:
            return
        taken = await asyncio.to_thread(self._archive.take, list(by_delivery), PATIENCE_S)
        for delivery in taken.done:
            for message in by_delivery[delivery]:
                await message.ack()
        for delivery in taken.rejected:
            for message in by_delivery[delivery]:
                await message.term()
        for delivery in taken.early:
            for message in by_delivery[delivery]:
                await message.nak(delay=EARLY_S)
        self.taken += len(taken.done)
        self.rejected += len(taken.rejected)

    async def _take_report(self, message: Msg) -> None:
        """Take a site's report on itself, to be stored soon; only the newest of a site counts."""
        site = parse_subject(message.subject)
        try:
            report: JsonObject = Report.model_validate_json(message.data).model_dump(mode="json")
        except ValidationError as error:
            _log.error("%s: a report is left out: %s", message.subject, " ".join(str(error).split()))
            return
        if site is not None:
            self._reports[site[0]] = self._archive.halls.admitted(site[0], report)

    async def _store_reports(self) -> None:
        """Store the reports that have come, all of a second at once, until cancelled.

        Each by itself would be a transaction of its own: two hundred a second with a thousand sites. Those that cannot
        be stored are followed by the next ones.
        """
        while True:
            await asyncio.sleep(REPORTS_S)
            reports, self._reports = self._reports, {}
            try:
                await asyncio.to_thread(self._archive.note_reports, reports)
            except StoreError as error:
                _log.error("%s", error)

    def _note(self, problem: str | None) -> None:
        """Remember why no messages come in, and log it if that is news."""
        if problem == self._problem:
            return
        if problem is None:
            _log.info("%s: connected; messages of the sites can be taken in", PLACE)
        else:
            _log.warning("%s: %s; trying again", PLACE, problem)
        self._problem = problem


def _delivery(message: Msg) -> Delivery | None:
    """Return what a message from the stream is; None if no site's server has sent it."""
    place = parse_message_id((message.headers or {}).get(MESSAGE_ID))
    source = parse_subject(message.subject)
    if place is None or source is None or source[1] not in KINDS:
        _log.error("%s: a message without a place in an outbox is left out", message.subject)
        return None
    return Delivery(*source, place, message.data)


def _told(error: Any) -> str:
    return f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
