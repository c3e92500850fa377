"""The log of events in the order of storing, and positions in it, for clients that resume.

An event that is stored again, because sound has arrived late, appears once: where its last version was stored.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import NamedTuple

from sqlalchemy import Connection, func, select

from livessl.server.history.query import Query, Row
from livessl.server.history.search import matching
from livessl.server.history.tables import events
from livessl.server.history.tables import life as lives


class LogPosition(NamedTuple):
    """A place in the order in which events were stored.

    Parameters
    ----------
    life : int
        Number of the history in which the place is. A history in memory gets another number at each start of the
        server; one in a database keeps its number until the database is replaced.
    number : int
        Number of the last event before the place.
    """

    life: int
    number: int

    def __str__(self) -> str:
        return f"{self.life:x}-{self.number}"

    @classmethod
    def parse(cls, text: str) -> LogPosition:
        """Return the position that `str` of it gave as `text`.

        Raises
        ------
        ValueError
            If the text is not that of a position.
        """
        parts = re.fullmatch(r"([0-9a-f]{1,16})-([0-9]{1,18})", text, re.ASCII)
        if parts is None:
            raise ValueError(f"expected the position from an earlier answer, such as 1a-42, got {text!r}")
        return cls(int(parts[1], 16), int(parts[2]))


class LogPage(NamedTuple):
    """Events in the order in which they were stored.

    Parameters
    ----------
    rows : sequence of Row
    position : LogPosition
        The place after `rows`; the next page begins there.
    has_more : bool
        Whether more events are stored already.
    is_complete : bool
        False if events may be missing: the requested position is of another history, or older than the events that a
        history of limited size still keeps.
    """

    rows: Sequence[Row]
    position: LogPosition
    has_more: bool
    is_complete: bool


def log_page(connection: Connection, query: Query, after: LogPosition | None, kept: int | None) -> LogPage:
    """Return the events that were stored after a position.

    Parameters
    ----------
    connection : Connection
    query : Query
        Filters, and the largest number of events on the page.
    after : LogPosition or None
        With None, return the end of the log and no events.
    kept : int or None
        Number of events that the history keeps at most; None if there is no limit.
    """
    life = connection.execute(select(lives.c.number)).scalar_one()
    newest = connection.execute(select(func.max(events.c.number))).scalar() or 0
    if after is None:
        return LogPage([], LogPosition(life, newest), has_more=False, is_complete=True)
    begin, is_complete = after.number, True
    if after.life != life or after.number > newest > 0:
        begin, is_complete = 0, False
    elif kept is not None and after.number < newest - kept:
        is_complete = False
    statement, searched = matching(query, events.c.time_ns, events.c.number, events.c.body)
    number = searched.c.number
    statement = statement.where(number > begin, number <= newest).order_by(number).limit(query.limit + 1)
    rows = [Row(*row) for row in connection.execute(statement)]
    has_more = len(rows) > query.limit
    rows = rows[: query.limit]
    end = rows[-1].number if has_more else max(newest, begin)
    return LogPage(rows, LogPosition(life, end), has_more, is_complete)
