"""SQL statements that write and delete events, and find early ones, in the caller's transaction."""

from __future__ import annotations

import secrets
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import orjson
from sqlalchemy import Connection, delete, func, insert, select

from livessl.core.types import FRAME_NS
from livessl.server.history.query import JsonObject
from livessl.server.history.tables import early, event_row, events, life, tag_rows, tags

_INSERT_EVENT = insert(events)
_INSERT_TAG = insert(tags)


def begin_life(connection: Connection) -> None:
    """Give a history that has none yet the number by which positions in its log are recognized."""
    if connection.execute(select(life.c.number)).first() is None:
        connection.execute(insert(life), {"number": secrets.randbits(63)})


def put_events(connection: Connection, given: Sequence[tuple[JsonObject, int]]) -> int:
    """Store events, each with its start in nanoseconds; one of a known id replaces that event.

    An event that has changed gets a new number, so that numbers are the order in which events were stored: see
    `history.log`. One that is the same as before is left alone.

    Returns
    -------
    int
        Number of events whose id was not known.
    """
    latest = {event["id"]: (event, time_ns) for event, time_ns in given}
    if not latest:
        return 0
    before = _stored(connection, list(latest))
    rows = {name: event_row(event, time_ns) for name, (event, time_ns) in latest.items()}
    rows = {name: row for name, row in rows.items() if name not in before or before[name].body != row["body"]}
    if not rows:
        return 0
    remove_numbers(connection, [before[name].number for name in rows if name in before])
    connection.execute(_INSERT_EVENT, list(rows.values()))
    numbers = {name: stored.number for name, stored in _stored(connection, list(rows)).items()}
    tagged = [each for name, row in rows.items() for each in tag_rows(latest[name][0], row, numbers[name])]
    if tagged:
        connection.execute(_INSERT_TAG, tagged)
    return sum(name not in before for name in rows)


def remove_events(connection: Connection, ids: Iterable[str]) -> int:
    """Delete the events of these ids; return how many there were."""
    names = list(ids)
    return remove_numbers(connection, [stored.number for stored in _stored(connection, names).values()])


def remove_numbers(connection: Connection, numbers: Sequence[int]) -> int:
    """Delete the events of these numbers; return how many there were."""
    if not numbers:
        return 0
    connection.execute(delete(tags).where(tags.c.number.in_(numbers)))
    return connection.execute(delete(events).where(events.c.number.in_(numbers))).rowcount


def remove_older(connection: Connection, before_ns: int, most: int) -> int:
    """Delete the oldest events that began before a time, a limited number of them; return how many."""
    query = select(events.c.number).where(events.c.time_ns < before_ns).order_by(events.c.time_ns).limit(most)
    return remove_numbers(connection, connection.execute(query).scalars().all())


def keep_newest(connection: Connection, most: int) -> int:
    """Delete the events that were stored first, so that at most so many stay; return how many."""
    newest = connection.execute(select(func.max(events.c.number))).scalar()
    if newest is None:
        return 0
    query = select(events.c.number).where(events.c.number <= newest - most)
    return remove_numbers(connection, connection.execute(query).scalars().all())


def put_early(connection: Connection, name: str) -> None:
    """Note that the final pass may still replace the event of that id."""
    connection.execute(delete(early).where(early.c.id == name))
    connection.execute(insert(early), {"id": name})


def end_early(connection: Connection, frame_index: int) -> list[tuple[JsonObject, int]]:
    """Let the early events before a frame index be final, and forget those that are gone.

    Returns
    -------
    list of (JsonObject, int)
        The events that are final now, each with its start in nanoseconds, oldest first.
    """
    ids = early_ids(connection)
    if not ids:
        return []
    later = select(events.c.id).where(events.c.id.in_(ids), events.c.time_ns >= frame_index * FRAME_NS)
    ended = set(ids) - set(connection.execute(later).scalars())
    connection.execute(delete(early).where(early.c.id.in_(ended)))
    query = select(events.c.time_ns, events.c.body).where(events.c.id.in_(ended)).order_by(events.c.time_ns)
    return [(orjson.loads(body), time_ns) for time_ns, body in connection.execute(query)]


def count_events(connection: Connection) -> int:
    """Return the number of events; a large database reads all of an index for it."""
    return int(connection.execute(select(func.count()).select_from(events)).scalar_one())


def early_ids(connection: Connection) -> list[str]:
    """Return the ids of early events: few. A join would have PostgreSQL read all events, as it knows no better."""
    return list(connection.execute(select(early.c.id)).scalars())


def early_events(connection: Connection) -> list[tuple[int, JsonObject]]:
    """Return the early events, oldest first, each with its start in nanoseconds of site time."""
    query = select(events.c.time_ns, events.c.body).where(events.c.id.in_(early_ids(connection)))
    return [(time_ns, orjson.loads(body)) for time_ns, body in connection.execute(query.order_by(events.c.time_ns))]


class _Stored(NamedTuple):
    number: int
    body: str


def _stored(connection: Connection, ids: Sequence[str]) -> dict[str, _Stored]:
    """Return the number and the JSON of the events of these ids, as far as they are stored."""
    found: dict[str, _Stored] = {}
    for first in range(0, len(ids), 500):
        some = ids[first : first + 500]
        rows = connection.execute(select(events.c.id, events.c.number, events.c.body).where(events.c.id.in_(some)))
        found |= {row.id: _Stored(row.number, row.body) for row in rows}
    return found
