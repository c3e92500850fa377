"""The outbox of a site, and the tables of a hub."""

from __future__ import annotations

from typing import Final

import sqlalchemy as sa
from alembic import op

revision: Final = "0001"
down_revision: Final = None


def upgrade() -> None:
    """Make the tables."""
    op.create_table(
        "outbox",
        sa.Column("number", sa.BigInteger, nullable=False, autoincrement=False),
        sa.Column("kind", sa.String, nullable=False),
        sa.Column("time_ns", sa.BigInteger, nullable=False),
        sa.Column("body", sa.Text, nullable=False),
        sa.PrimaryKeyConstraint("number", name="outbox_key"),
    )
    op.create_index("outbox_time", "outbox", ["time_ns"])
    op.create_table(
        "outbox_head",
        sa.Column("only", sa.Integer, nullable=False, autoincrement=False),
        sa.Column("outbox", sa.String, nullable=False),
        *(sa.Column(name, sa.BigInteger, nullable=False) for name in ("last", "acknowledged")),
        sa.PrimaryKeyConstraint("only", name="outbox_head_key"),
    )
    op.create_table(
        "hub_sites",
        sa.Column("site", sa.String, nullable=False),
        *(sa.Column(name, sa.BigInteger, nullable=False) for name in ("contact_ns", "missing", "newest_ns")),
        sa.Column("report", sa.Text, nullable=False),
        sa.PrimaryKeyConstraint("site", name="hub_sites_key"),
    )
    op.create_table(
        "hub_received",
        *(sa.Column(name, sa.String, nullable=False) for name in ("site", "outbox")),
        sa.Column("last", sa.BigInteger, nullable=False),
        sa.PrimaryKeyConstraint("site", "outbox", name="hub_received_key"),
    )
    op.create_table(
        "hub_arrays",
        *(sa.Column(name, sa.String, nullable=False) for name in ("site", "name")),
        sa.Column("body", sa.Text, nullable=False),
        sa.PrimaryKeyConstraint("site", "name", name="hub_arrays_key"),
    )
    op.create_table(
        "hub_tracks",
        sa.Column("site", sa.String, nullable=False),
        sa.Column("id", sa.BigInteger, nullable=False),
        sa.Column("body", sa.Text, nullable=False),
        sa.PrimaryKeyConstraint("site", "id", name="hub_tracks_key"),
    )
    op.create_table(
        "hub_alerts",
        sa.Column("number", sa.BigInteger().with_variant(sa.Integer(), "sqlite"), autoincrement=True),
        *(sa.Column(name, sa.String, nullable=False) for name in ("site", "key")),
        sa.Column("time_ns", sa.BigInteger, nullable=False),
        sa.Column("body", sa.Text, nullable=False),
        sa.PrimaryKeyConstraint("number", name="hub_alerts_key"),
        sa.UniqueConstraint("site", "key", name="hub_alerts_site_key_unique"),
        sqlite_autoincrement=True,
    )
    op.create_index("hub_alerts_time", "hub_alerts", ["time_ns"])
