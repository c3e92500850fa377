"""Marks the events of a hall that are copies of others, in the transaction that stores the last event of a sound.

An event of a hall has `copy_of`, the event that is shown instead of it, or `copies`, the events that it is shown for.
A tag of the kind `flag` keeps copies out of searches. One of the kind `hall`, whose time is the end of the event, finds
the events of a hall that overlap with a new one; those that come at once after their end are the last ones.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import groupby
from typing import Any, Final, NamedTuple

import orjson
from sqlalchemy import ColumnElement, Connection, and_, bindparam, delete, insert, or_, select, text, update
from sqlalchemy.exc import SQLAlchemyError

from livessl.federation.halls import Halls
from livessl.federation.one_sound import SLACK_NS, Name, Sighting, pairs, sighting, sounds
from livessl.server.api.encode import JsonObject
from livessl.server.history.tables import COPY, events, tags

LOCK: Final = 0x11_7E_55_3
"""Number of the PostgreSQL lock of a transaction that stores events of halls, so that none misses those of another."""

LONGEST_NS: Final = 60_000_000_000
"""Longest event, in nanoseconds, that a site file allows. A longer one may not be found by one that ends before it."""

MOST_TOGETHER: Final = 100
"""Number of connected events from which on no further ones are searched to place a new one. Sounds that follow each
other without a pause, and overlap at two servers in turns, could connect any number."""

SPANS_AT_ONCE: Final = 100
"""Spans of time that one statement asks for."""

_CHANGE: Final = update(events).where(events.c.number == bindparam("of_number")).values(body=bindparam("new_body"))
_UNFLAG: Final = delete(tags).where(
    tags.c.kind == "flag", tags.c.name == COPY, tags.c.time_ns == bindparam("at_ns"), tags.c.number == bindparam("of")
)

_log = logging.getLogger(__name__)

Span = tuple[int, int]
"""A time from which on events end, and one until which they begin, in nanoseconds."""


class _Stored(NamedTuple):
    """An event of a hall in the database: its row, its JSON, and what it says of its sound."""

    row: Any
    message: JsonObject
    seen: Sighting


def as_stored(message: JsonObject) -> JsonObject:
    """Return an event as a hub stores it first: one of a hall is a copy of none, and only hubs mark copies."""
    own = {key: value for key, value in message.items() if key not in ("copy_of", "copies")}
    return {**own, "copy_of": None, "copies": []} if message.get("hall") else own


def hall_tags(message: JsonObject, row: Mapping[str, Any]) -> Iterator[JsonObject]:
    """Yield the tag by which an event of a hall is found, if it is one.

    Parameters
    ----------
    message : JsonObject
        The event.
    row : mapping of str to Any
        The columns of a tag of this event, without kind and name.
    """
    if message.get("hall"):
        yield {**row, "kind": "hall", "name": _hall(message), "time_ns": sighting(message).end_ns}


def lock_halls(connection: Connection) -> None:
    """Let no other transaction store events of halls until this one ends; SQLite has one at a time anyway."""
    if connection.dialect.name == "postgresql":
        connection.execute(text("SELECT pg_advisory_xact_lock(:number)"), {"number": LOCK})


def mark_copies(connection: Connection, stored: Iterable[JsonObject], halls: Halls) -> None:
    """Decide anew about the sounds that new events belong to; call `lock_halls` before these are stored.

    Parameters
    ----------
    connection : Connection
        Its transaction has stored the events.
    stored : iterable of JsonObject
        The new events; those of no hall are left alone.
    halls : Halls
        Notes a hall in which too many events are connected.
    """
    of_halls = sorted((message for message in stored if message.get("hall")), key=_hall)
    for hall, messages in groupby(of_halls, _hall):
        new = [sighting(message) for message in messages]
        try:
            changed = _decided(connection, hall, new, halls)
        except SQLAlchemyError:
            raise
        except Exception:  # noqa: BLE001 - whatever another event does to the code, it costs the new ones their marks only
            names = ", ".join(map(_in_words, sorted(seen.name for seen in new)[:3]))
            _log.exception("hall %r: the sounds of %d events (%s) are not compared", hall, len(new), names)
            continue
        _store(connection, [each for each in changed if each[0].message | each[1] != each[0].message])


def _decided(
    connection: Connection, hall: str, new: Sequence[Sighting], halls: Halls
) -> list[tuple[_Stored, JsonObject]]:
    """Return the marks of all events that may be one sound with new ones."""
    connected, is_whole = _connected(connection, hall, new)
    if not is_whole:
        halls.note_crowd(hall, len(connected))
        connected = _unbound(connected)
    marks: list[tuple[_Stored, JsonObject]] = []
    for group in sounds([each.seen for each in connected.values()]):
        kept, *copies = (connected[seen.name] for seen in group)
        marks.append((kept, {"copy_of": None, "copies": [_named(copy) for copy in copies]}))
        marks += [(copy, {"copy_of": _named(kept), "copies": []}) for copy in copies]
    return marks


def _hall(message: JsonObject) -> str:
    return str(message["hall"]["name"])


def _in_words(name: Name) -> str:
    return f"{name.site}/{name.id}"


def _named(stored: _Stored) -> JsonObject:
    return stored.seen.name._asdict()


def _connected(connection: Connection, hall: str, new: Sequence[Sighting]) -> tuple[dict[Name, _Stored], bool]:
    """Return the new events, and all that may be one sound with them, or with one of those, and so on.

    False if there are more: from `MOST_TOGETHER` connected events on, no further ones are searched.
    """
    known: dict[Name, _Stored] = {}
    partners: dict[Name, list[Name]] = {}
    asked = {seen.name for seen in new}
    searched: Iterable[Sighting] = new
    while True:
        found = _overlapping(connection, hall, searched)
        fresh = {stored.seen.name: stored for stored in found if stored.seen.name not in known}
        known |= fresh
        for one, other, _ in pairs([stored.seen for stored in known.values()], fresh.keys()):
            partners.setdefault(one.name, []).append(other.name)
            partners.setdefault(other.name, []).append(one.name)
        groups = _components(partners, [seen.name for seen in new])
        further = {name for group in groups if len(group) <= MOST_TOGETHER for name in group} - asked
        if not further:
            linked = set().union(*groups)
            return {name: known[name] for name in linked}, linked <= asked
        asked |= further
        searched = [known[name].seen for name in further]


def _components(partners: Mapping[Name, Sequence[Name]], names: Iterable[Name]) -> list[set[Name]]:
    """Return the connected events of each of some events, each once."""
    groups: list[set[Name]] = []
    seen: set[Name] = set()
    for name in names:
        if name in seen:
            continue
        group, waiting = {name}, [name]
        while waiting:
            fresh = set(partners.get(waiting.pop(), ())) - group
            group |= fresh
            waiting += fresh
        groups.append(group)
        seen |= group
    return groups


def _unbound(connected: Mapping[Name, _Stored]) -> dict[Name, _Stored]:
    """Return those events that are marked together with none that is missing here, so that no mark loses its other."""
    free = dict(connected)
    while bound := [name for name, stored in free.items() if not _marked_with(stored) <= free.keys()]:
        for name in bound:
            del free[name]
    return free


def _marked_with(stored: _Stored) -> set[Name]:
    """Return the events that an event's marks name."""
    others = [*stored.message.get("copies", ()), stored.message.get("copy_of")]
    return {Name(other["site"], other["id"]) for other in others if other is not None}


def _overlapping(connection: Connection, hall: str, searched: Iterable[Sighting]) -> Iterator[_Stored]:
    """Yield the stored events of a hall that may overlap with some in time."""
    columns = (*(events.c[name] for name in ("number", "time_ns", "confidence", "status", "level_dbfs")), events.c.body)
    query = select(*columns).select_from(tags.join(events, events.c.number == tags.c.number))
    query = query.where(tags.c.kind == "hall", tags.c.name == hall)
    spans = _joined(searched)
    for begin in range(0, len(spans), SPANS_AT_ONCE):
        some = spans[begin : begin + SPANS_AT_ONCE]
        for row in connection.execute(query.where(or_(*map(_is_within, some)))):
            message = orjson.loads(row.body)
            try:
                seen = sighting(message)
            except (ValueError, KeyError, TypeError) as error:  # one that a release before this one has stored
                name = _in_words(Name(message["site"], message["id"]))
                _log.warning("hall %r: event %s cannot be compared with others: %s", hall, name, error)
                continue
            yield _Stored(row, message, seen)


def _is_within(span: Span) -> ColumnElement[bool]:
    """Return the condition that an event overlaps with a span."""
    first, last = span
    return and_(tags.c.time_ns >= first, tags.c.time_ns <= last + LONGEST_NS, events.c.time_ns <= last)


def _joined(searched: Iterable[Sighting]) -> list[Span]:
    """Return the spans in which events may overlap with some, those that meet as one."""
    joined: list[Span] = []
    for first, last in sorted((seen.start_ns - SLACK_NS, seen.end_ns + SLACK_NS) for seen in searched):
        if joined and first <= joined[-1][1]:
            joined[-1] = joined[-1][0], max(last, joined[-1][1])
        else:
            joined.append((first, last))
    return joined


def _store(connection: Connection, changed: Sequence[tuple[_Stored, JsonObject]]) -> None:
    """Write what has changed of the marks of events."""
    if not changed:
        return
    bodies = [
        {"of_number": stored.row.number, "new_body": orjson.dumps({**stored.message, **marks}).decode()}
        for stored, marks in changed
    ]
    connection.execute(_CHANGE, bodies)
    connection.execute(_UNFLAG, [{"at_ns": stored.row.time_ns, "of": stored.row.number} for stored, _ in changed])
    flags = [
        {
            "kind": "flag",
            "name": COPY,
            **{name: getattr(stored.row, name) for name in ("number", "time_ns", "confidence", "status", "level_dbfs")},
        }
        for stored, marks in changed
        if marks["copy_of"] is not None
    ]
    if flags:
        connection.execute(insert(tags), flags)
