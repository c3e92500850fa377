"""The journal's table: stores, lists and deletes the entries of each kind. `server/journal.py` writes them."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

import orjson
from sqlalchemy import Connection, delete, func, insert, literal, select, tuple_

from livessl.server.history.query import Cursor, JsonObject
from livessl.server.history.tables import journal


class EntryKind(StrEnum):
    """Kinds of entries.

    An `alert` that a rule has raised; a `track` that has ended; an `array` whose state has changed; and a change of the
    `configuration`, by an operator or in the site file.
    """

    ALERT = "alert"
    TRACK = "track"
    ARRAY = "array"
    CONFIGURATION = "configuration"


@dataclass(frozen=True, slots=True)
class Entry:
    """Something that happened.

    Parameters
    ----------
    kind : EntryKind
    name : str
        What it is about: the rule, the number of the track, the array, or what was changed.
    key : str
        Permanent key of the entry. An entry whose key is already stored is not stored again.
    time_ns : int
        When it happened, in nanoseconds of site time.
    text : str
        The same for people, in one sentence.
    detail : JsonObject
    """

    kind: EntryKind
    name: str
    key: str
    time_ns: int
    text: str
    detail: JsonObject


@dataclass(frozen=True, slots=True)
class JournalQuery:
    """A search for entries; a filter that is None admits every entry.

    Parameters
    ----------
    kind : EntryKind or None
    name : str or None
    since_ns, until_ns : int or None
        First and last time, in nanoseconds since the epoch.
    text : str or None
        Part of the sentence, in any case.
    limit : int
        Most entries of a page.
    before : Cursor or None
        Cursor of an entry: only older ones are found.
    """

    kind: EntryKind | None = None
    name: str | None = None
    since_ns: int | None = None
    until_ns: int | None = None
    text: str | None = None
    limit: int = 50
    before: Cursor | None = None


class JournalPage(NamedTuple):
    """Entries, newest first, and the query's `before` for the next page; None if there are no older ones."""

    entries: list[Entry]
    older: Cursor | None


def put_entry(connection: Connection, entry: Entry) -> None:
    """Store an entry, unless one of its key is stored."""
    if connection.execute(select(journal.c.number).where(journal.c.key == entry.key)).first() is not None:
        return
    row = {name: getattr(entry, name) for name in ("name", "key", "time_ns", "text")}
    row |= {"kind": str(entry.kind), "words": f"{entry.name}\n{entry.text}".lower()}
    connection.execute(insert(journal), {**row, "body": orjson.dumps(entry.detail).decode()})


def journal_page(connection: Connection, query: JournalQuery) -> JournalPage:
    """Return a page of entries, newest first."""
    columns = journal.c
    statement = select(columns.number, *(columns[name] for name in ("kind", "name", "key", "time_ns", "text", "body")))
    if query.kind is not None:
        statement = statement.where(columns.kind == str(query.kind))
    if query.name is not None:
        statement = statement.where(columns.name == query.name)
    if query.since_ns is not None:
        statement = statement.where(columns.time_ns >= query.since_ns)
    if query.until_ns is not None:
        statement = statement.where(columns.time_ns <= query.until_ns)
    if query.text is not None:
        statement = statement.where(columns.words.contains(query.text.lower(), autoescape=True))
    if query.before is not None:
        place = tuple_(literal(query.before.time_ns), literal(query.before.number))
        statement = statement.where(columns.time_ns <= query.before.time_ns)
        statement = statement.where(tuple_(columns.time_ns, columns.number) < place)
    statement = statement.order_by(columns.time_ns.desc(), columns.number.desc()).limit(query.limit + 1)
    rows = connection.execute(statement).all()
    entries = [
        Entry(EntryKind(row.kind), row.name, row.key, row.time_ns, row.text, orjson.loads(row.body))
        for row in rows[: query.limit]
    ]
    has_more = len(rows) > query.limit
    last = rows[query.limit - 1] if has_more else None
    return JournalPage(entries, None if last is None else Cursor(last.time_ns, last.number))


def remove_older_entries(connection: Connection, before_ns: int, most: int) -> int:
    """Delete the oldest entries from before a time, a limited number of them; return how many."""
    oldest = select(journal.c.number).where(journal.c.time_ns < before_ns).order_by(journal.c.time_ns).limit(most)
    numbers = connection.execute(oldest).scalars().all()
    if not numbers:
        return 0
    return connection.execute(delete(journal).where(journal.c.number.in_(numbers))).rowcount


def keep_newest_entries(connection: Connection, most: int) -> None:
    """Delete the entries that were stored first, so that at most so many stay."""
    newest = connection.execute(select(func.max(journal.c.number))).scalar()
    if newest is not None and newest > most:
        connection.execute(delete(journal).where(journal.c.number <= newest - most))
