"""Databases of other releases: older files are migrated without loss, newer ones are refused."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from alembic.script import ScriptDirectory

from livessl.server.api.encode import JsonObject
from livessl.server.history import database, migrations
from livessl.server.history.tables import metadata
from livessl.server.store import Query, Store, StoreError
from messages import small_event

DAY_NS = 86_400_000_000_000
OLD_TABLES = (
    "CREATE TABLE events (number INTEGER PRIMARY KEY AUTOINCREMENT, id TEXT UNIQUE, time_ns INTEGER, "
    "confidence REAL, json TEXT)",
    "CREATE INDEX events_time ON events (time_ns)",
    "CREATE TABLE provisional (id TEXT PRIMARY KEY)",
    "CREATE TABLE settled (site TEXT PRIMARY KEY, raster INTEGER)",
    "CREATE TABLE disabled (site TEXT, array TEXT, PRIMARY KEY (site, array))",
    "CREATE TABLE clocks (site TEXT PRIMARY KEY, json TEXT)",
)
"""The tables of a file of the release before migrations existed."""


def write_old_file(path: Path, events: list[JsonObject]) -> None:
    """Write what the release before migrations wrote; event number k began on day k and has the number 10 k + 1."""
    with closing(sqlite3.connect(path)) as db, db:
        for sql in OLD_TABLES:
            db.execute(sql)
        for k, each in enumerate(events):
            row = (10 * k + 1, each["id"], k * DAY_NS, each["confidence"], json.dumps(each))
            db.execute("INSERT INTO events VALUES (?, ?, ?, ?, ?)", row)
        db.execute("INSERT INTO provisional VALUES ('small-4')")
        db.execute("INSERT INTO settled VALUES ('lab', 1000), ('hall', 7)")
        db.execute("INSERT INTO disabled VALUES ('lab', 'north')")
        db.execute("INSERT INTO clocks VALUES ('lab', '{\"b\": 0.15}')")


@pytest.mark.parametrize("batch", [2, 2000])
def test_older_file_is_migrated_without_loss(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, batch: int) -> None:
    monkeypatch.setattr(migrations, "BATCH", batch)
    refused: JsonObject = {
        "position_m": None,
        "covariance_m2": None,
        "status": "refused",
        "confidence": 0.0,
        "zones": [],
    }
    events = [small_event(k, zones=["Tür"] if k % 2 else [], reason="größer") for k in range(4)] + [
        small_event(4, **refused)
    ]
    write_old_file(tmp_path / "events.db", events)
    for _ in range(2):  # the second time there is nothing to migrate
        store = Store(tmp_path / "events.db")
        assert store.find(Query())[0] == events[::-1]
        assert [cursor.number for cursor in (row.cursor for row in store.page(Query()).rows)] == [41, 31, 21, 11, 1]
        assert [found["id"] for found in store.find(Query(zone="Tür"))[0]] == ["small-3", "small-1"]
        assert [found["id"] for found in store.find(Query(status="refused"))[0]] == ["small-4"]
        assert len(store.find(Query(array=events[0]["arrays"][0]))[0]) == 5
        assert len(store.find(Query(text="GRÖSSER".replace("SS", "ß")))[0]) == 4
        assert store.early_events() == [(4 * DAY_NS, events[4])]
        assert store.finalized("lab") == (1000, {"b": 0.15})
        assert store.finalized("hall") == (7, None)
        assert store.disabled("lab") == {"north"}
        assert store.count() == 5
        store.close()


def test_migration_that_fails_leaves_the_older_file_as_it_was(tmp_path: Path) -> None:
    path = tmp_path / "events.db"
    write_old_file(path, [small_event(0), small_event(1)])
    with closing(sqlite3.connect(path)) as db, db:
        db.execute("UPDATE events SET json = NULL, confidence = NULL WHERE number = 11")
        before = list(db.iterdump())
    with pytest.raises(StoreError, match=r"cannot use .*events.db: .* NoneType"):
        Store(path)
    with closing(sqlite3.connect(path)) as db:
        assert list(db.iterdump()) == before


def test_migrations_make_the_tables_that_the_code_names(opened: Callable[[], Store]) -> None:
    store = opened()
    with store.database.reading() as connection:

        def is_made_here(_thing: object, name: str | None, *_: object) -> bool:
            return name != "event_tags_search" or connection.dialect.name == "postgresql"

        options = {"compare_type": True, "include_object": is_made_here}
        assert compare_metadata(MigrationContext.configure(connection, opts=options), metadata) == []


def test_the_newest_migration_is_the_one_that_the_code_expects() -> None:
    assert ScriptDirectory(str(Path(database.__file__).parent / "migrations")).get_current_head() == database.HEAD


def test_database_of_a_newer_release_is_refused(tmp_path: Path) -> None:
    Store(tmp_path / "events.db").close()
    with closing(sqlite3.connect(tmp_path / "events.db")) as db, db:
        db.execute("UPDATE alembic_version SET version_num = '9000'")
    with pytest.raises(StoreError, match=r"got 9000 of a newer livessl; update livessl, or name another database"):
        Store(tmp_path / "events.db")
