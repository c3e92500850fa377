"""The journal, a tag on the events in excluded zones, and an index with all that PostgreSQL compares in a search."""

from __future__ import annotations

from typing import Final

import sqlalchemy as sa
from alembic import op

revision: Final = "0003"
down_revision: Final = "0002"

COPY_TAGS: Final = sa.text(
    "INSERT INTO event_tags (kind, name, time_ns, number, confidence, status, level_dbfs) "
    "SELECT 'flag', 'excluded', time_ns, number, confidence, status, level_dbfs FROM events WHERE body LIKE :part"
)


def upgrade() -> None:
    """Make the table of the journal, and tag the events of before."""
    op.create_table(
        "journal",
        sa.Column("number", sa.BigInteger().with_variant(sa.Integer(), "sqlite"), autoincrement=True),
        sa.Column("kind", sa.String, nullable=False),
        sa.Column("name", sa.String, nullable=False),
        sa.Column("key", sa.String, nullable=False),
        sa.Column("time_ns", sa.BigInteger, nullable=False),
        *(sa.Column(name, sa.Text, nullable=False) for name in ("text", "words", "body")),
        sa.PrimaryKeyConstraint("number", name="journal_key"),
        sa.UniqueConstraint("key", name="journal_key_unique"),
        sqlite_autoincrement=True,
    )
    op.create_index("journal_time", "journal", ["time_ns", "number"])
    op.create_index("journal_kind", "journal", ["kind", "time_ns", "number"])
    if op.get_bind().dialect.name == "postgresql":  # SQLite keeps the rows in the order of the key
        keys, compared = ["kind", "name", "time_ns", "number"], ["confidence", "status", "level_dbfs"]
        op.create_index("event_tags_search", "event_tags", keys, postgresql_include=compared)
    op.get_bind().execute(COPY_TAGS, {"part": '%"excluded":true%'})
