"""A search for events as values: filters, cursors of pages; it knows no database."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any, NamedTuple

import orjson

JsonObject = dict[str, Any]


class Cursor(NamedTuple):
    """Place of an event in the list of events; a page ends before or begins after it."""

    time_ns: int
    number: int

    def __str__(self) -> str:
        return f"{self.time_ns}-{self.number}"

    @classmethod
    def parse(cls, text: str) -> Cursor:
        """Return the cursor for its text form, the inverse of `str`.

        Raises
        ------
        ValueError
            If the text is not a cursor.
        """
        parts = re.fullmatch(r"(-?[0-9]{1,19})-([0-9]{1,19})", text, re.ASCII)
        cursor = None if parts is None else cls(*map(int, parts.groups()))
        if cursor is None or not all(abs(part) < 2**63 for part in cursor):
            raise ValueError(f"expected a cursor of a page, got {text!r}")
        return cursor


@dataclass(frozen=True, slots=True)
class Query:
    """A search for events; a filter that is None admits every event.

    Parameters
    ----------
    since_ns, until_ns : int or None
        First and last start of an event, in nanoseconds since the epoch.
    zone : str or None
        Zone that the event lies in.
    min_confidence : float or None
    limit : int
        Most events of a page.
    before : Cursor or None
        Cursor of an event: only older ones are found.
    after : Cursor or None
        Cursor of an event: only newer ones are found, and of these the ones next to it.
    oldest_first : bool
        True to find the oldest events first; only events newer than `before` are then found.
    status : str or None
        `located`, `direction-only` or `refused`.
    min_level_dbfs : float or None
        Lowest level, in dB relative to full scale. An event without a level is not found.
    array : str or None
        Array that detected the event or contributed to it.
    text : str or None
        Part of the event's id, status, reason, method, zones or arrays, ignoring case.
    excluded : bool or None
        True for events in excluded zones only, False for all others only.
    site : str or None
        Site that the event comes from, in the history of a hub.
    copies : bool
        Whether events are found for whose sound a hub shows another event.
    """

    since_ns: int | None = None
    until_ns: int | None = None
    zone: str | None = None
    min_confidence: float | None = None
    limit: int = 50
    before: Cursor | None = None
    after: Cursor | None = None
    oldest_first: bool = False
    status: str | None = None
    min_level_dbfs: float | None = None
    array: str | None = None
    text: str | None = None
    excluded: bool | None = None
    site: str | None = None
    copies: bool = True


class Row(NamedTuple):
    """A stored event: its place in the list, and its JSON."""

    time_ns: int
    number: int
    body: str

    @property
    def cursor(self) -> Cursor:
        """Place of the event in the list of events."""
        return Cursor(self.time_ns, self.number)

    @property
    def event(self) -> JsonObject:
        """The event, decoded."""
        return dict(orjson.loads(self.body))


class Page(NamedTuple):
    """Events of a page, newest first.

    Parameters
    ----------
    rows : list of Row
    older : Cursor or None
        The query's `before` for the next page; None if there are no older events.
    newer : Cursor or None
        The query's `after` for the events that are newer than these, now or later; None if no event was found.
    """

    rows: list[Row]
    older: Cursor | None
    newer: Cursor | None
