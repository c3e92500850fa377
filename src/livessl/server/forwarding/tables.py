"""Tables of the outbox of a site and of the hub, which stand beside those of the history.

The migrations make these tables; a test compares both. A new column or table needs a migration.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

from sqlalchemy import (
    BigInteger,
    Column,
    Connection,
    Index,
    Integer,
    MetaData,
    PrimaryKeyConstraint,
    String,
    Table,
    Text,
    UniqueConstraint,
    inspect,
    select,
    text,
)

from livessl.server.history.database import StoreError, upgrade
from livessl.server.history.tables import ROW_NUMBER

HEAD: Final = "0001"
"""The newest revision in `migrations/`; a database that has it needs no Alembic."""

VERSION_TABLE: Final = "alembic_version_hub"

metadata: Final = MetaData(
    naming_convention={
        "ix": "%(table_name)s_%(column_0_N_name)s",
        "pk": "%(table_name)s_key",
        "uq": "%(table_name)s_%(column_0_N_name)s_unique",
    }
)
"""All tables of outbox and hub."""

outbox: Final = Table(
    "outbox",
    metadata,
    Column("number", BigInteger, nullable=False, autoincrement=False),
    Column("kind", String, nullable=False),
    Column("time_ns", BigInteger, nullable=False),
    Column("body", Text, nullable=False),
    PrimaryKeyConstraint("number"),
)
"""Messages that the stream has not acknowledged yet, numbered without gaps; `body` is JSON."""

Index("outbox_time", outbox.c.time_ns)

outbox_head: Final = Table(
    "outbox_head",
    metadata,
    Column("only", Integer, nullable=False, autoincrement=False),
    Column("outbox", String, nullable=False),
    Column("last", BigInteger, nullable=False),
    Column("acknowledged", BigInteger, nullable=False),
    PrimaryKeyConstraint("only"),
)
"""One row: the name of the outbox, random so that a new database is not taken for the old one, the number of its last
message, and that of the last one that the stream has acknowledged."""

sites: Final = Table(
    "hub_sites",
    metadata,
    Column("site", String, nullable=False),
    Column("contact_ns", BigInteger, nullable=False),
    Column("missing", BigInteger, nullable=False),
    Column("newest_ns", BigInteger, nullable=False),
    Column("report", Text, nullable=False),
    PrimaryKeyConstraint("site"),
)
"""Sites of the hub: last contact, messages that never came, start of the newest event (0 for none), and the last report
of the site on itself as JSON."""

received: Final = Table(
    "hub_received",
    metadata,
    Column("site", String, nullable=False),
    Column("outbox", String, nullable=False),
    Column("last", BigInteger, nullable=False),
    PrimaryKeyConstraint("site", "outbox"),
)
"""Number of the last message of each outbox that the hub has taken in."""

arrays: Final = Table(
    "hub_arrays",
    metadata,
    Column("site", String, nullable=False),
    Column("name", String, nullable=False),
    Column("body", Text, nullable=False),
    PrimaryKeyConstraint("site", "name"),
)
"""The last state of each array."""

tracks: Final = Table(
    "hub_tracks",
    metadata,
    Column("site", String, nullable=False),
    Column("id", BigInteger, nullable=False),
    Column("body", Text, nullable=False),
    PrimaryKeyConstraint("site", "id"),
)
"""Tracks that have begun and not ended."""

alerts: Final = Table(
    "hub_alerts",
    metadata,
    Column("number", ROW_NUMBER, autoincrement=True),
    Column("site", String, nullable=False),
    Column("key", String, nullable=False),
    Column("time_ns", BigInteger, nullable=False),
    Column("body", Text, nullable=False),
    PrimaryKeyConstraint("number"),
    UniqueConstraint("site", "key"),
    sqlite_autoincrement=True,
)
"""Alerts of all sites."""

Index("hub_alerts_time", alerts.c.time_ns)


def prepare(connection: Connection) -> None:
    """Make or migrate the tables, in the transaction of the connection.

    Raises
    ------
    StoreError
        If a newer release has made them.
    """
    if inspect(connection).has_table(VERSION_TABLE):
        revision = connection.execute(select(text("version_num")).select_from(text(VERSION_TABLE))).scalar()
        if revision == HEAD:
            return
        if revision is not None and revision > HEAD:
            raise StoreError(
                f"server.events_db: expected tables of the hub of revision {HEAD} or before, got {revision} of a newer "
                "livessl; update livessl, or name another database"
            )
    upgrade(connection, Path(__file__).parent / "migrations")
