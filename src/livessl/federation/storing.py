"""The parts of each message that a hub stores, by its kind."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from itertools import groupby
from typing import Any, Final, NamedTuple

import orjson
from sqlalchemy import Connection, delete, insert, select

from livessl.clock import utc_ns
from livessl.federation.received import RECEIVED
from livessl.server.api.encode import JsonObject
from livessl.server.forwarding.stream import Place
from livessl.server.forwarding.tables import alerts, arrays, tracks
from livessl.server.history import tables as history

_log = logging.getLogger(__name__)


class Delivery(NamedTuple):
    """A message from the stream.

    Parameters
    ----------
    site : str
        Site, by the subject that its credentials permit, whatever the message says.
    kind : str
    place : Place
        Name of the outbox, and number there.
    body : bytes
        JSON.
    """

    site: str
    kind: str
    place: Place
    body: bytes


class Taken(NamedTuple):
    """Outcome of some deliveries: those that are done with, those that wait for earlier ones, and those of no use."""

    done: list[Delivery]
    early: list[Delivery]
    rejected: list[Delivery]


def read(delivery: Delivery) -> JsonObject | None:
    """Return a message as it is stored: its checked fields, further ones as they are, and its site.

    None if it is not what its kind has to be.
    """
    try:
        message = orjson.loads(delivery.body)
        checked = RECEIVED[delivery.kind].model_validate(message)
    except (ValueError, KeyError) as error:  # pydantic's and orjson's errors are ValueErrors
        what = " ".join(str(error).split())
        _log.error("site %r: message %d is left out: %s", delivery.site, delivery.place.number, what)
        return None
    return {**message, **checked.model_dump(exclude_unset=True), "site": delivery.site}


def put(connection: Connection, batch: Sequence[tuple[str, str, JsonObject]]) -> None:
    """Store messages in their order: events at once, as their order is that of their time, and the rest one by one."""
    for is_event, group in groupby(batch, key=lambda each: each[1] == "event"):
        if is_event:
            _put_events(connection, [message for _, _, message in group])
        else:
            for site, kind, message in group:
                _PUT[kind](connection, site, message)


def _put_events(connection: Connection, messages: Sequence[JsonObject]) -> None:
    rows: dict[str, dict[str, Any]] = {}
    known_as = {f"{message['site']}/{message['id']}": message for message in messages}
    for key, message in known_as.items():
        rows[key] = {**history.event_row(message, utc_ns(message["time_utc"])), "id": key}
    query = select(history.events.c.id).where(history.events.c.id.in_(list(rows)))
    for known in connection.execute(query).scalars().all():
        del rows[known]
    if not rows:
        return
    connection.execute(insert(history.events), list(rows.values()))
    columns = history.events.c.number, history.events.c.id
    numbers = connection.execute(select(*columns).where(history.events.c.id.in_(list(rows)))).all()
    tags: list[dict[str, Any]] = []
    for number, key in numbers:
        message, row = known_as[key], rows[key]
        tags += history.tag_rows(message, row, number)
        compared = {name: row[name] for name in ("time_ns", "confidence", "status", "level_dbfs")}
        tags.append({"kind": "site", "name": message["site"], "number": number, **compared})
    connection.execute(insert(history.tags), tags)


def _put_start(connection: Connection, site: str, _message: JsonObject) -> None:
    """A server that starts follows no track of before, and reports all arrays that it has."""
    for table in (tracks, arrays):
        connection.execute(delete(table).where(table.c.site == site))


def _put_array(connection: Connection, site: str, message: JsonObject) -> None:
    connection.execute(delete(arrays).where(arrays.c.site == site, arrays.c.name == message["name"]))
    connection.execute(insert(arrays), {"site": site, "name": message["name"], "body": orjson.dumps(message).decode()})


def _put_track(connection: Connection, site: str, message: JsonObject) -> None:
    connection.execute(delete(tracks).where(tracks.c.site == site, tracks.c.id == message["id"]))
    if message["state"] != "end":
        connection.execute(insert(tracks), {"site": site, "id": message["id"], "body": orjson.dumps(message).decode()})


def _put_alert(connection: Connection, site: str, message: JsonObject) -> None:
    mine = (alerts.c.site == site) & (alerts.c.key == message["key"])
    if connection.execute(select(alerts.c.number).where(mine)).first() is None:
        row = {
            "site": site,
            "key": message["key"],
            "time_ns": utc_ns(message["raised_utc"]),
            "body": orjson.dumps(message).decode(),
        }
        connection.execute(insert(alerts), row)


_PUT: Final = {"start": _put_start, "array": _put_array, "track": _put_track, "alert": _put_alert}
