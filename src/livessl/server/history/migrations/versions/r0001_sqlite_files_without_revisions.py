"""Tables of the SQLite files that were written before migrations existed.

PostgreSQL has none of them, because it came with the next revision.
"""

from __future__ import annotations

from typing import Final

from alembic import op

revision: Final = "0001"
down_revision: Final = None

TABLES: Final = (
    "CREATE TABLE IF NOT EXISTS events (number INTEGER PRIMARY KEY AUTOINCREMENT, id TEXT UNIQUE, time_ns INTEGER, "
    "confidence REAL, json TEXT)",
    "CREATE INDEX IF NOT EXISTS events_time ON events (time_ns)",
    "CREATE TABLE IF NOT EXISTS provisional (id TEXT PRIMARY KEY)",
    "CREATE TABLE IF NOT EXISTS settled (site TEXT PRIMARY KEY, raster INTEGER)",
    "CREATE TABLE IF NOT EXISTS disabled (site TEXT, array TEXT, PRIMARY KEY (site, array))",
    "CREATE TABLE IF NOT EXISTS clocks (site TEXT PRIMARY KEY, json TEXT)",
)


def upgrade() -> None:
    """Make the tables that the file lacks: the oldest files have no `clocks`, and a new file has none of them."""
    if op.get_bind().dialect.name == "sqlite":
        for sql in TABLES:
            op.execute(sql)
