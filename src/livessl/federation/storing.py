"""Writes the rows of each kind of message that a hub stores, and refuses a message that is not valid."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any, NamedTuple

import orjson
from sqlalchemy import Connection, Table, bindparam, delete, insert, select

from livessl.clock import utc_ns
from livessl.federation.copies import as_stored, hall_tags, lock_halls, mark_copies
from livessl.federation.halls import Halls
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


def read(delivery: Delivery, halls: Halls) -> JsonObject | None:
    """Return a message as it is stored: its checked fields, further ones as they are, and its site.

    Its hall is left out if its site is not in that.

    None if it is not what its kind has to be.
    """
    try:
        message = orjson.loads(delivery.body)
        checked = RECEIVED[delivery.kind].model_validate(message)
    except (ValueError, KeyError) as error:  # pydantic's and orjson's errors are ValueErrors
        what = " ".join(str(error).split())
        _log.error("site %r: message %d is left out: %s", delivery.site, delivery.place.number, what)
        return None
    made = {**message, **checked.model_dump(exclude_unset=True), "site": delivery.site}
    return halls.admitted(delivery.site, made) if delivery.kind == "event" else made


def put(connection: Connection, batch: Sequence[tuple[str, str, JsonObject]], halls: Halls) -> None:
    """Store messages with the outcome that they have one by one in their order, by a few statements for all of them."""
    by_kind: dict[str, list[JsonObject]] = {"event": [], "alert": []}
    tracks_now, arrays_now = _States(tracks, "id"), _States(arrays, "name")
    for site, kind, message in batch:
        match kind:
            case "start":  # the server follows no track of before, and reports all arrays that it has
                tracks_now.clear(site)
                arrays_now.clear(site)
            case "track":
                tracks_now.change(site, message, is_over=message["state"] == "end")
            case "array":
                arrays_now.change(site, message)
            case _:
                by_kind[kind].append(message)
    _put_events(connection, by_kind["event"], halls)
    _put_alerts(connection, by_kind["alert"])
    tracks_now.store(connection)
    arrays_now.store(connection)


class _States:
    """The rows that some messages leave in a table which has the last message about each thing of a site.

    Parameters
    ----------
    table : Table
    key : str
        Column, and field of the messages, that says which thing it is.
    """

    def __init__(self, table: Table, key: str) -> None:
        self._table, self._key = table, key
        self._cleared: set[str] = set()
        self._last: dict[tuple[str, Any], JsonObject | None] = {}

    def clear(self, site: str) -> None:
        """Forget everything of a site."""
        self._cleared.add(site)
        self._last = {place: message for place, message in self._last.items() if place[0] != site}

    def change(self, site: str, message: JsonObject, *, is_over: bool = False) -> None:
        """Take the last message about a thing, which exists no longer if it is over."""
        self._last[site, message[self._key]] = None if is_over else message

    def store(self, connection: Connection) -> None:
        """Store all of that."""
        site, key = self._table.c.site, self._table.c[self._key]
        if self._cleared:
            connection.execute(delete(self._table).where(site.in_(sorted(self._cleared))))
        known = [{"of_site": name, "of_key": of} for name, of in self._last if name not in self._cleared]
        if known:
            connection.execute(
                delete(self._table).where(site == bindparam("of_site"), key == bindparam("of_key")), known
            )
        rows = [
            {"site": name, self._key: of, "body": orjson.dumps(message).decode()}
            for (name, of), message in self._last.items()
            if message is not None
        ]
        if rows:
            connection.execute(insert(self._table), rows)


def _put_events(connection: Connection, messages: Sequence[JsonObject], halls: Halls) -> None:
    """Store the events that are not known yet, with the rows by which they are found."""
    if not messages:
        return
    rows: dict[str, dict[str, Any]] = {}
    known_as: dict[str, JsonObject] = {}
    for message in messages:
        known_as.setdefault(f"{message['site']}/{message['id']}", as_stored(message))
    if any(message.get("hall") for message in messages):
        lock_halls(connection)
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
        tags += hall_tags(message, {"number": number, **compared})
    connection.execute(insert(history.tags), tags)
    mark_copies(connection, [known_as[key] for key in rows], halls)


def _put_alerts(connection: Connection, messages: Sequence[JsonObject]) -> None:
    """Store the alerts that are not known yet, each once and in their order."""
    first: dict[tuple[str, str], JsonObject] = {}
    for message in messages:
        first.setdefault((message["site"], message["key"]), message)
    if not first:
        return
    names, keys = ({place[part] for place in first} for part in (0, 1))
    query = select(alerts.c.site, alerts.c.key).where(alerts.c.site.in_(names), alerts.c.key.in_(keys))
    known = {(site, key) for site, key in connection.execute(query)}
    rows = [
        {
            "site": site,
            "key": key,
            "time_ns": utc_ns(message["raised_utc"]),
            "body": orjson.dumps(message).decode(),
        }
        for (site, key), message in first.items()
        if (site, key) not in known
    ]
    if rows:
        connection.execute(insert(alerts), rows)
