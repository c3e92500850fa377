"""The SQL statements that find events by filters and words, a page at a time."""

from __future__ import annotations

from typing import Any

from sqlalchemy import ColumnElement, Connection, FromClause, Select, Tuple, and_, exists, literal, select, tuple_

from livessl.server.history.query import Cursor, Page, Query, Row
from livessl.server.history.tables import COPY, events, tags


def matching(query: Query, *columns: ColumnElement[Any]) -> tuple[Select[Any], FromClause]:
    """Return the statement for these columns of the events that a query admits, regardless of its pages.

    Returns
    -------
    Select, FromClause
        The statement, and the table that has `time_ns` and `number` in the order of the index that is searched: with
        a site, a zone, an array or a flag that of the tags, else that of the events. Of several it is the first of
        these: a hub of many sites has far fewer events of one site than of one zone or array, whose names repeat.
    """
    flag = "excluded" if query.excluded else None
    named = (("site", query.site), ("flag", flag), ("zone", query.zone), ("array", query.array))
    wanted = [(kind, name) for kind, name in named if name is not None]
    searched: FromClause = tags if wanted else events
    statement = select(*columns)
    if wanted:
        kind, name = wanted[0]
        statement = statement.select_from(tags.join(events, events.c.number == tags.c.number))
        statement = statement.where(tags.c.kind == kind, tags.c.name == name)
    for kind, name in wanted[1:]:
        statement = statement.where(_is_tagged(searched, kind, name))
    if query.excluded is False:
        statement = statement.where(~_is_tagged(searched, "flag", "excluded"))
    if not query.copies:
        statement = statement.where(~_is_tagged(searched, "flag", COPY))
    compared = searched.c
    if query.since_ns is not None:
        statement = statement.where(compared.time_ns >= query.since_ns)
    if query.until_ns is not None:
        statement = statement.where(compared.time_ns <= query.until_ns)
    if query.min_confidence is not None:
        statement = statement.where(compared.confidence >= query.min_confidence)
    if query.status is not None:
        statement = statement.where(compared.status == query.status)
    if query.min_level_dbfs is not None:
        statement = statement.where(compared.level_dbfs >= query.min_level_dbfs)
    if query.text is not None:
        statement = statement.where(events.c.words.contains(query.text.lower(), autoescape=True))
    return statement, searched


def _is_tagged(searched: FromClause, kind: str, name: str) -> ColumnElement[bool]:
    """Return the condition that an event has a tag; the key of the tags answers it."""
    other = tags.alias()
    here = (other.c.kind == kind, other.c.name == name, other.c.time_ns == searched.c.time_ns)
    return exists().where(and_(*here, other.c.number == searched.c.number))


def event_page(connection: Connection, query: Query) -> Page:
    """Return a page of the events that a query admits, with the cursors of its neighbours."""
    found = connection.execute(_page_statement(query, query.limit + 1)).all()
    rows = [Row(*row) for row in found[: query.limit]]
    has_more = len(found) > query.limit
    if query.after is not None:
        rows.reverse()
        return Page(rows, rows[-1].cursor if rows else None, rows[0].cursor if rows else query.after)
    return Page(rows, rows[-1].cursor if has_more else None, rows[0].cursor if rows else None)


def _page_statement(query: Query, most: int) -> Select[Any]:
    """Return the statement for a page of at most so many events: time, number and JSON.

    They come newest first, or oldest first if the query wants this or names the event after which the page begins.
    """
    statement, searched = matching(query, events.c.time_ns, events.c.number, events.c.body)
    place, time_ns = tuple_(searched.c.time_ns, searched.c.number), searched.c.time_ns
    newer_than, older_than = query.after, query.before
    if query.oldest_first:
        newer_than, older_than = query.before, query.after
    if older_than is not None:
        statement = statement.where(time_ns <= older_than.time_ns, place < _place(older_than))
    if newer_than is not None:
        statement = statement.where(time_ns >= newer_than.time_ns, place > _place(newer_than))
    if query.oldest_first or query.after is not None:
        return statement.order_by(time_ns, searched.c.number).limit(most)
    return statement.order_by(time_ns.desc(), searched.c.number.desc()).limit(most)


def _place(cursor: Cursor) -> Tuple:
    return tuple_(literal(cursor.time_ns), literal(cursor.number))
