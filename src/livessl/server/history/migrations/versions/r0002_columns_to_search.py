"""Columns and indices for searches, and tables that SQLite and PostgreSQL have in common.

The events of an older SQLite file are copied in batches; the file needs about as much free space on its disk.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator
from typing import Any, Final

import sqlalchemy as sa
from alembic import op

from livessl.server.history import migrations

revision: Final = "0002"
down_revision: Final = "0001"

NOTICE: Final = 100_000
"""Events after which the log reports how far the copy has come."""

_log = logging.getLogger(__name__)


def upgrade() -> None:
    """Make the tables, and move what an older file holds into them."""
    connection = op.get_bind()
    is_sqlite = connection.dialect.name == "sqlite"
    if is_sqlite:
        op.drop_index("events_time")
        op.rename_table("events", "events_before")
        op.rename_table("disabled", "disabled_before")
    _create_tables()
    if is_sqlite:
        _copy_events(connection)
        for sql in (
            "INSERT INTO early SELECT id FROM provisional WHERE id IS NOT NULL",
            "INSERT INTO progress SELECT site, raster, json FROM settled LEFT JOIN clocks USING (site)",
            "INSERT INTO disabled SELECT site, array FROM disabled_before",
        ):
            op.execute(sql)
        for table in ("events_before", "provisional", "settled", "disabled_before", "clocks"):
            op.drop_table(table)


def _create_tables() -> None:
    """Make the tables of this revision."""
    op.create_table(
        "events",
        sa.Column("number", sa.BigInteger().with_variant(sa.Integer(), "sqlite"), autoincrement=True),
        sa.Column("id", sa.String, nullable=False),
        sa.Column("time_ns", sa.BigInteger, nullable=False),
        sa.Column("confidence", sa.Double, nullable=False),
        sa.Column("status", sa.String),
        sa.Column("level_dbfs", sa.Double),
        *(sa.Column(name, sa.Integer) for name in ("x_mm", "y_mm", "z_mm")),
        sa.Column("words", sa.Text, nullable=False),
        sa.Column("body", sa.Text, nullable=False),
        sa.PrimaryKeyConstraint("number", name="events_key"),
        sa.UniqueConstraint("id", name="events_id_unique"),
        sqlite_autoincrement=True,
    )
    op.create_table(
        "event_tags",
        *(sa.Column(name, sa.String, nullable=False) for name in ("kind", "name")),
        *(sa.Column(name, sa.BigInteger, nullable=False) for name in ("time_ns", "number")),
        sa.Column("confidence", sa.Double, nullable=False),
        sa.Column("status", sa.String),
        sa.Column("level_dbfs", sa.Double),
        sa.PrimaryKeyConstraint("kind", "name", "time_ns", "number", name="event_tags_key"),
        sqlite_with_rowid=False,
    )
    op.create_index(
        "events_time", "events", ["time_ns", "number", "confidence", "status", "level_dbfs", "x_mm", "y_mm"]
    )
    op.create_index("event_tags_number", "event_tags", ["number"])
    op.create_table(
        "early", sa.Column("id", sa.String, nullable=False), sa.PrimaryKeyConstraint("id", name="early_key")
    )
    op.create_table(
        "progress",
        sa.Column("site", sa.String, nullable=False),
        sa.Column("frame_index", sa.BigInteger, nullable=False),
        sa.Column("clocks", sa.Text),
        sa.PrimaryKeyConstraint("site", name="progress_key"),
    )
    op.create_table(
        "disabled",
        sa.Column("site", sa.String, nullable=False),
        sa.Column("array", sa.String, nullable=False),
        sa.PrimaryKeyConstraint("site", "array", name="disabled_key"),
    )


def _copy_events(connection: sa.Connection) -> None:
    """Copy the events of an older file, with their numbers, so that cursors stay valid."""
    rows = sa.text(
        "SELECT number, time_ns, json FROM events_before WHERE number > :last AND id IS NOT NULL ORDER BY number "
        "LIMIT :batch"
    )
    tables = sa.MetaData()
    tables.reflect(connection, only=["events", "event_tags"])
    copied, last = 0, -(2**63)
    while batch := connection.execute(rows, {"last": last, "batch": migrations.BATCH}).all():
        events: list[dict[str, Any]] = []
        tags: list[dict[str, Any]] = []
        for number, time_ns, text in batch:
            event = json.loads(text)
            events.append({"number": number, **_columns(event, time_ns)})
            tags += _tags(event, events[-1])
        connection.execute(tables.tables["events"].insert(), events)
        if tags:
            connection.execute(tables.tables["event_tags"].insert(), tags)
        last, copied = batch[-1][0], copied + len(batch)
        if copied % NOTICE == 0:
            _log.info("%d events of the older database are copied", copied)


def _columns(event: dict[str, Any], time_ns: int) -> dict[str, Any]:
    """Return an event's columns as this revision has them."""
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
        "body": json.dumps(event, ensure_ascii=False, separators=(",", ":")),
    }


def _tags(event: dict[str, Any], row: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield the rows of an event's zones and arrays as this revision has them."""
    arrays = [*(event.get("arrays") or ()), *(event.get("heard_by") or ())]
    compared = {name: row[name] for name in ("time_ns", "number", "confidence", "status", "level_dbfs")}
    for kind, names in (("zone", event.get("zones") or ()), ("array", arrays)):
        for name in dict.fromkeys(names):
            yield {"kind": kind, "name": name, **compared}
