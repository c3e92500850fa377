"""Tables and columns of the history, and which words of an event a search looks through.

The migrations make these tables; a test compares both. A new column or table needs a migration.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final

import orjson
from sqlalchemy import (
    BigInteger,
    Column,
    Double,
    Index,
    Integer,
    MetaData,
    PrimaryKeyConstraint,
    String,
    Table,
    Text,
    UniqueConstraint,
)

from livessl.server.history.query import JsonObject

metadata: Final = MetaData(
    naming_convention={
        "ix": "%(table_name)s_%(column_0_N_name)s",
        "pk": "%(table_name)s_key",
        "uq": "%(table_name)s_%(column_0_name)s_unique",
    }
)
"""All tables of the history."""

ROW_NUMBER: Final = BigInteger().with_variant(Integer(), "sqlite")  # SQLite numbers rows in INTEGER columns only

events: Final = Table(
    "events",
    metadata,
    Column("number", ROW_NUMBER, autoincrement=True),
    Column("id", String, nullable=False),
    Column("time_ns", BigInteger, nullable=False),
    Column("confidence", Double, nullable=False),
    Column("status", String),
    Column("level_dbfs", Double),
    Column("x_mm", Integer),
    Column("y_mm", Integer),
    Column("z_mm", Integer),
    Column("words", Text, nullable=False),
    Column("body", Text, nullable=False),
    PrimaryKeyConstraint("number"),
    UniqueConstraint("id"),
    sqlite_autoincrement=True,
)
"""Events. `words` is the text that searches look through, in lower case; `body` is the event's JSON."""

Index(
    "events_time",
    *(events.c[name] for name in ("time_ns", "number", "confidence", "status", "level_dbfs", "x_mm", "y_mm")),
)

tags: Final = Table(
    "event_tags",
    metadata,
    Column("kind", String, nullable=False),
    Column("name", String, nullable=False),
    Column("time_ns", BigInteger, nullable=False),
    Column("number", BigInteger, nullable=False),
    Column("confidence", Double, nullable=False),
    Column("status", String),
    Column("level_dbfs", Double),
    PrimaryKeyConstraint("kind", "name", "time_ns", "number"),
    sqlite_with_rowid=False,
)
"""Zones, arrays and flags of the events, and in a hub their sites and halls: one row for each, of the kind `zone`,
`array`, `flag`, `site` or `hall`. The other columns repeat those of the event that a search compares. Flags are
`excluded`, and in a hub `COPY`. The time of a `hall` is the end of the event."""

COPY: Final = "copy"
"""Flag of an event that a hub shows only where copies are wanted: another event is shown for its sound."""

Index("event_tags_number", tags.c.number)
Index(
    "event_tags_search",
    *(tags.c[name] for name in ("kind", "name", "time_ns", "number")),
    postgresql_include=["confidence", "status", "level_dbfs"],
).ddl_if(dialect="postgresql")  # SQLite needs no index: it keeps whole rows in the order of the key

early: Final = Table("early", metadata, Column("id", String, nullable=False), PrimaryKeyConstraint("id"))
"""Ids of events that a final pass may still replace."""

progress: Final = Table(
    "progress",
    metadata,
    Column("site", String, nullable=False),
    Column("frame_index", BigInteger, nullable=False),
    Column("clocks", Text),
    PrimaryKeyConstraint("site"),
)
"""The frame index up to which the results of each site are final, and its clocks."""

disabled: Final = Table(
    "disabled",
    metadata,
    Column("site", String, nullable=False),
    Column("array", String, nullable=False),
    PrimaryKeyConstraint("site", "array"),
)
"""Arrays that an operator has disabled."""

journal: Final = Table(
    "journal",
    metadata,
    Column("number", ROW_NUMBER, autoincrement=True),
    Column("kind", String, nullable=False),
    Column("name", String, nullable=False),
    Column("key", String, nullable=False),
    Column("time_ns", BigInteger, nullable=False),
    Column("text", Text, nullable=False),
    Column("words", Text, nullable=False),
    Column("body", Text, nullable=False),
    PrimaryKeyConstraint("number"),
    UniqueConstraint("key"),
    sqlite_autoincrement=True,
)
"""Alerts, tracks, and changes of arrays and of the configuration: see `history.journal`. `words` is the text that
searches look through, in lower case; `body` is the JSON of the details."""

Index("journal_time", journal.c.time_ns, journal.c.number)
Index("journal_kind", journal.c.kind, journal.c.time_ns, journal.c.number)


life: Final = Table(
    "life",
    metadata,
    Column("number", BigInteger, autoincrement=False, nullable=False),
    PrimaryKeyConstraint("number"),
)
"""One row: a random number, drawn when the tables are made. Positions in the log contain it, so that positions of a
history that was replaced are recognized."""


def event_row(event: JsonObject, time_ns: int) -> dict[str, Any]:
    """Return an event's columns, without its number."""
    position_m = event.get("position_m")
    x_mm, y_mm, z_mm = (None, None, None) if position_m is None else (round(1000 * metres) for metres in position_m)
    zones, arrays = event.get("zones") or (), event.get("arrays") or ()
    words = (event["id"], event.get("status"), event.get("method"), event.get("reason"), *zones, *arrays)
    return {
        "id": event["id"],
        "time_ns": time_ns,
        "confidence": event["confidence"],
        "status": event.get("status"),
        "level_dbfs": event.get("level_dbfs"),
        "x_mm": x_mm,
        "y_mm": y_mm,
        "z_mm": z_mm,
        "words": "\n".join(word for word in words if word).lower(),
        "body": orjson.dumps(event).decode(),
    }


def tag_rows(event: JsonObject, row: dict[str, Any], number: int) -> Iterator[dict[str, Any]]:
    """Yield the rows of an event's zones, arrays and flags, each once."""
    arrays = [*(event.get("arrays") or ()), *(event.get("heard_by") or ())]
    compared = {name: row[name] for name in ("time_ns", "confidence", "status", "level_dbfs")}
    flags = ("excluded",) if event.get("excluded") else ()
    for kind, names in (("zone", event.get("zones") or ()), ("array", arrays), ("flag", flags)):
        for name in dict.fromkeys(names):
            yield {"kind": kind, "name": name, "number": number, **compared}
