"""Stores messages for the hub in the history's database until the stream has acknowledged them; limits how many.

What a final pass stores and what it sends are written in one transaction, so neither exists without the other.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

import orjson
from sqlalchemy import Connection, delete, insert, select, update

from livessl.server.forwarding.stream import outbox_name
from livessl.server.forwarding.tables import outbox, outbox_head
from livessl.server.forwarding.tile import Tile
from livessl.server.history.database import Database
from livessl.server.history.query import JsonObject

MAX_UNSENT: Final = 2_000_000
"""Most messages that wait, about 3 GB: three weeks of a site with 100 000 events a day. Beyond it the oldest are
deleted. The hub notices the missing numbers and counts the lost messages."""


class Outgoing(NamedTuple):
    """A message for the hub: its kind, its site time in nanoseconds, and its JSON."""

    kind: str
    time_ns: int
    message: JsonObject


class Unsent(NamedTuple):
    """A message that waits, with its number, and its JSON as text."""

    number: int
    kind: str
    body: str


class Head(NamedTuple):
    """The name of an outbox, the number of its newest message, and that of the newest one that the stream has."""

    outbox: str
    last: int
    acknowledged: int


class Outbox:
    """The outbox in a database; every thread may call it.

    Methods that open a transaction raise `StoreError` if the database cannot be used. The methods whose names end in
    `_with` use a transaction of the caller, which raises it.

    Parameters
    ----------
    database : Database
        Has the tables of `livessl.server.forwarding.tables`.
    tile : Tile or None
        Chooses the events for the hub; None for a site that has its room to itself, and sends all of them.
    """

    def __init__(self, database: Database, tile: Tile | None = None) -> None:
        self._database = database
        self._tile = tile
        self._on_put: Callable[[], None] | None = None

    def on_put(self, call: Callable[[], None]) -> None:
        """Register what `wake` calls, on whichever thread calls `wake`."""
        self._on_put = call

    def wake(self) -> None:
        """Report that the transaction of `put_with` has ended."""
        if self._on_put is not None:
            self._on_put()

    def put(self, messages: Sequence[Outgoing]) -> None:
        """Append messages, all or nothing."""
        with self._database.writing(f"store {len(messages)} messages for the hub") as connection:
            self.put_with(connection, messages)
        self.wake()

    def put_with(self, connection: Connection, messages: Sequence[Outgoing]) -> None:
        """Append messages in the caller's transaction, which stores what they report; call `wake` after its end."""
        if not messages:
            return
        head = _head(connection)
        rows = [
            {"number": number, "kind": kind, "time_ns": time_ns, "body": orjson.dumps(message).decode()}
            for number, (kind, time_ns, message) in enumerate(messages, head.last + 1)
        ]
        connection.execute(insert(outbox), rows)
        last = head.last + len(rows)
        connection.execute(update(outbox_head).values(last=last))
        connection.execute(delete(outbox).where(outbox.c.number <= last - MAX_UNSENT))

    def put_final_with(
        self,
        connection: Connection,
        found: Sequence[tuple[JsonObject, int]],
        kept: Sequence[tuple[JsonObject, int]],
    ) -> None:
        """Append events that have become final, in order of time; see `put_with`.

        Parameters
        ----------
        connection : Connection
            Of the transaction that stores the events.
        found : sequence of (JsonObject, int)
            Events that the final pass found, each with its start in nanoseconds.
        kept : sequence of (JsonObject, int)
            Early events that are final as they are, unless one of `found` has the same id.
        """
        known = {event["id"] for event, _ in found}
        final = [*found, *((event, time_ns) for event, time_ns in kept if event["id"] not in known)]
        final.sort(key=lambda each: each[1])
        sent = [(event if self._tile is None else self._tile.sent(event), time_ns) for event, time_ns in final]
        self.put_with(connection, [Outgoing("event", time_ns, event) for event, time_ns in sent if event is not None])

    def rename(self) -> None:
        """Give the outbox a new name, under which all messages are sent that wait now.

        A database that was restored from a backup would reuse numbers that the hub has already received; the new name
        makes them different. Messages that the hub receives twice do no harm, because it recognises events and alerts
        by their ids.
        """
        with self._database.writing("rename the site's outbox") as connection:
            name = outbox_name(_head(connection).acknowledged + 1)
            connection.execute(update(outbox_head).values(outbox=name))

    def head(self) -> Head:
        """Return the name of the outbox, and how far it has come."""
        with self._database.writing("read the site's outbox") as connection:
            return _head(connection)

    def unsent(self, most: int) -> list[Unsent]:
        """Return the messages that wait, the oldest first, a limited number of them."""
        query = select(outbox.c.number, outbox.c.kind, outbox.c.body).order_by(outbox.c.number).limit(most)
        with self._database.reading() as connection:
            return [Unsent(*row) for row in connection.execute(query)]

    def acknowledge(self, number: int) -> None:
        """Forget the messages up to a number: the stream has them."""
        with self._database.writing("note what the hub's stream has acknowledged") as connection:
            connection.execute(delete(outbox).where(outbox.c.number <= number))
            connection.execute(
                update(outbox_head).where(outbox_head.c.acknowledged < number).values(acknowledged=number)
            )

    def expire_with(self, connection: Connection, before_ns: int) -> None:
        """Delete messages whose `time_ns` is earlier than `before_ns`, in the transaction that deletes old events."""
        connection.execute(delete(outbox).where(outbox.c.time_ns < before_ns))


def _head(connection: Connection) -> Head:
    columns = (outbox_head.c.outbox, outbox_head.c.last, outbox_head.c.acknowledged)
    row = connection.execute(select(*columns)).one_or_none()
    if row is not None:
        return Head(*row)
    head = Head(outbox_name(1), 0, 0)
    connection.execute(insert(outbox_head), {"only": 1, **head._asdict()})
    return head
