"""The database of the history: its migrations, its outages, and what waits meanwhile."""

from __future__ import annotations

import logging
import sqlite3
from collections.abc import Callable
from contextlib import ExitStack, closing
from itertools import count
from pathlib import Path
from threading import Event as Flag
from threading import Thread

import pytest
from sqlalchemy import Connection, text

from livessl.errors import ConfigError
from livessl.server.history import backlog as backlog_module
from livessl.server.history import database
from livessl.server.history.backlog import MAX_UNSAVED, RETRY_NS, Backlog, Write
from livessl.server.store import Query, Store, StoreError
from messages import small_event
from postgresql import PostgreSQL, running_postgresql
from small_site import HANG_S, site_of, wait_until

FOREVER = "WITH RECURSIVE n(k) AS (SELECT 1 UNION ALL SELECT k + 1 FROM n) SELECT count(*) FROM n"


def test_server_that_comes_late_gets_what_waited(caplog: pytest.LogCaptureFixture) -> None:
    """Nothing waits for PostgreSQL at the start, and everything is there when it comes."""
    with running_postgresql() as server:
        url = server.url()
        server.stop()
        store, ready = Store(url), Flag()
        store.when_ready(ready.set)
        try:
            assert "cannot use postgresql://livessl@127.0.0.1" in caplog.text
            assert store.count() is None
            for read in (lambda: store.find(Query()), lambda: store.get("small-1"), lambda: store.finalized("lab")):
                with pytest.raises(StoreError, match="see that PostgreSQL runs"):
                    read()
            store.backlog.start()
            store.backlog.put(Write(lambda: store.finalize("lab", [(small_event(1), 0)], [], 5, {}), 1, True), 0)
            wait_until(lambda: store.backlog.is_failing, "a failure")
            assert (store.backlog.unsaved, store.backlog.is_saved) == (1, False)
            server.start()
            wait_until(lambda: store.backlog.is_saved, "the event to be stored")
            assert ready.is_set()
            assert store.find(Query())[0] == [small_event(1)]
            _go_down_and_come_back(server, store)
        finally:
            store.close()


def _go_down_and_come_back(server: PostgreSQL, store: Store) -> None:
    """What is put while the server is down is stored in order when it is there again."""
    server.stop()
    for k in range(2, 30):
        store.backlog.put(Write(lambda k=k: store.add(small_event(k % 20, duration_s=float(k)), k), 1, False), 0)  # type: ignore[misc]
    wait_until(lambda: store.backlog.is_failing, "a failure")
    with pytest.raises(StoreError):
        store.find(Query())
    server.start()
    wait_until(lambda: store.backlog.unsaved == 0, "all to be stored")
    found, _ = store.find(Query())
    assert store.backlog.discarded == 0
    assert {each["id"]: each["duration_s"] for each in found if each["duration_s"] >= 2} == {
        f"small-{k % 20}": float(k) for k in range(10, 30)
    }
    assert store.count() == 20


def test_readers_see_what_was_put_before_they_asked(opened: Callable[[], Store]) -> None:
    store = opened()
    store.backlog.start()
    for k in range(50):
        store.backlog.put(Write(lambda k=k: store.add(small_event(k), k), 1, False), 0)  # type: ignore[misc]
        assert store.get(f"small-{k}") == small_event(k)


def test_event_that_the_database_refuses_holds_up_no_other(
    postgresql: PostgreSQL, caplog: pytest.LogCaptureFixture
) -> None:
    """PostgreSQL's texts cannot hold NUL."""
    store = Store(postgresql.url())
    for name in ("small-1", "small\0-2", "small-3"):
        store.backlog.put(Write(lambda name=name: store.add({**small_event(0), "id": name}, 0), 1, False), 0)  # type: ignore[misc]
    assert [found["id"] for found in store.find(Query())[0]] == ["small-3", "small-1"]
    assert (store.backlog.discarded, store.backlog.unsaved) == (1, 0)
    assert "cannot store event 'small\\x00-2'" in caplog.text
    store.close()


class Jammed:
    """A database that stands still until it is let go, and counts what it was given."""

    def __init__(self) -> None:
        self.go, self.begun, self.done = Flag(), Flag(), list[int]()

    def write(self, number: int) -> None:
        self.begun.set()
        assert self.go.wait(60)
        self.done.append(number)


def test_nobody_waits_for_a_database_that_stands_still(monkeypatch: pytest.MonkeyPatch) -> None:
    """Beyond the bound the oldest are given up, but not the one that is being written."""
    monkeypatch.setattr(backlog_module, "SETTLE_S", 0.0)
    jam, waiting = Jammed(), Backlog(lambda: None)
    waiting.start()
    waiting.put(Write(lambda: jam.write(0), 1, False), 0)
    assert jam.begun.wait(60)
    for k in range(1, MAX_UNSAVED + 6):
        waiting.put(Write(lambda k=k: jam.write(k), 1, False), 0)  # type: ignore[misc]
    waiting.settle()
    assert (waiting.unsaved, waiting.discarded) == (MAX_UNSAVED, 6)
    jam.go.set()
    wait_until(lambda: waiting.unsaved == 0, "all to be written")
    waiting.stop()
    assert jam.done == [0, *range(7, MAX_UNSAVED + 6)]


def test_what_waits_is_bounded_in_bytes_and_given_up_entries_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(backlog_module, "MAX_BYTES", 1000)
    jam, waiting = Jammed(), Backlog(lambda: None)
    waiting.start()
    waiting.put(Write(lambda: jam.write(0), 0, False, others=1, nbytes=900), 0)
    assert jam.begun.wait(60)
    for k in range(1, 5):
        waiting.put(Write(lambda k=k: jam.write(k), k % 2, False, others=2 * (1 - k % 2), nbytes=60 - k), 0)  # type: ignore[misc]
    assert (waiting.discarded, waiting.discarded_others, waiting.unsaved) == (2, 2, 0)  # 900 + 56 bytes are left
    jam.go.set()
    waiting.settle(60)
    waiting.stop()
    assert jam.done == [0, 4]


@pytest.mark.parametrize("runs", [False, True])
def test_what_waits_for_the_database_may_put_more(tmp_path: Path, *, runs: bool) -> None:
    """As the journal does once the database can be read: on one thread, with no thread waiting for itself."""
    store, tries = Store(tmp_path / "events.db"), count()

    def work() -> None:
        if next(tries) == 0:
            raise StoreError("the database is not there yet")
        store.backlog.put(Write(lambda: store.add(small_event(1), 1), 1, False), 0)
        assert store.get("small-1") is None  # no wait for what this thread is to write

    def put() -> None:
        store.when_ready(work)
        if runs:
            store.backlog.start()
        store.backlog.put(Write(lambda: store.add(small_event(2), 2), 1, False), 0)
        store.backlog.retry(RETRY_NS)

    putting = Thread(target=put, daemon=True)
    putting.start()
    putting.join(HANG_S)
    assert not putting.is_alive()
    wait_until(lambda: store.backlog.unsaved == 0, "both to be stored")
    assert store.backlog.is_failing is False
    assert {each["id"] for each in store.find(Query())[0]} == {"small-1", "small-2"}
    store.close()


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("mysql://root@localhost/events", "got a URL of 'mysql'"),
        ("sqlite:///events.db", "expected the name of a file for SQLite"),
        ("postgresql://localhost:port/events", "got a URL with Port could not be cast"),
    ],
)
def test_url_of_another_database_is_a_fault(name: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        site_of({"server.events_db": name})


def test_missing_driver_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(database, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"server.events_db: PostgreSQL needs .* pip install 'livessl\[postgres\]'"):
        Store.of(site_of({"server.events_db": "postgres://livessl@localhost/events"}))


def test_password_is_not_shown(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG)
    store = Store("postgresql://livessl:geheim@127.0.0.1:1/events")
    with pytest.raises(StoreError) as caught:
        store.find(Query())
    store.close()
    assert "geheim" not in caplog.text + str(caught.value)


def test_database_that_cannot_be_migrated_is_refused_with_the_reason(tmp_path: Path) -> None:
    Store(tmp_path / "events.db").close()
    with closing(sqlite3.connect(tmp_path / "events.db")) as db, db:
        db.execute("UPDATE alembic_version SET version_num = '0000'")
    refusing = database.Database(tmp_path / "events.db")
    for refused in (refusing.prepare, lambda: refusing.reading().__enter__()):
        with pytest.raises(StoreError, match=r"cannot migrate the database: .*'0000'.*; update livessl, or name"):
            refused()
    assert "cannot migrate" in str(refusing.problem)
    refusing.close()


def test_search_that_takes_too_long_is_ended(place: Path | str, monkeypatch: pytest.MonkeyPatch) -> None:
    check_long_search(place, monkeypatch)


def test_search_in_memory_that_takes_too_long_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    check_long_search(None, monkeypatch)


def check_long_search(place: Path | str | None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(database, "STATEMENT_S", 0.5)
    store = Store(place)
    with (
        pytest.raises(StoreError, match=r"a search was ended after 0.5 s; narrow the span"),
        store.database.reading() as connection,
    ):
        connection.execute(text(FOREVER))
    store.add(small_event(1), 0)
    assert store.get("small-1") == small_event(1)
    store.close()


def test_search_in_memory_limits_no_write_after_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Both have the same connection there, and a write is no search."""
    monkeypatch.setattr(database, "STATEMENT_S", 0.0)
    store = Store(None)
    with pytest.raises(StoreError, match="a search was ended"), store.database.reading() as connection:
        connection.execute(
            text("WITH RECURSIVE n(k) AS (SELECT 1 UNION ALL SELECT k + 1 FROM n) SELECT count(*) FROM n")
        )
    many = "WITH RECURSIVE n(k) AS (SELECT 1 UNION ALL SELECT k + 1 FROM n WHERE k < 50000) SELECT count(*) FROM n"
    with store.database.writing("count") as connection:
        assert connection.execute(text(many)).scalar() == 50_000
    store.close()


def test_events_of_before_the_journal_are_found_by_their_exclusion(place: Path | str) -> None:
    """The database is of the revision before: no journal, and no tags of excluded events."""
    store = Store(place)
    store.add_all([(small_event(number) | {"excluded": number == 2}, number) for number in range(4)])
    with store.database.writing("go back") as connection:
        for sql in (
            "DELETE FROM event_tags WHERE kind = 'flag'",
            "DROP TABLE journal",
            "DROP TABLE life",
            "DROP INDEX IF EXISTS event_tags_search",
            "UPDATE alembic_version SET version_num = '0002'",
        ):
            connection.execute(text(sql))
    store.close()
    store = Store(place)
    found = [[each["id"] for each in store.find(Query(excluded=flag))[0]] for flag in (True, False)]
    assert found == [["small-2"], ["small-3", "small-1", "small-0"]]
    store.close()


def test_reader_does_not_wait_long_for_other_readers(place: Path | str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(database, "READER_S", 0.1)
    store = Store(place)
    with ExitStack() as others:
        for _ in range(database.READERS):
            others.enter_context(store.database.reading())
        with pytest.raises(StoreError, match=r"all 4 connections for reading are taken .*; wait for them, or narrow"):
            store.get("small-1")
    assert store.get("small-1") is None
    store.close()


def test_reader_sees_one_state(opened: Callable[[], Store]) -> None:
    store, count_all = opened(), text("SELECT count(*) FROM events")
    with store.database.reading() as connection:
        assert connection.execute(count_all).scalar() == 0
        store.add(small_event(1), 0)
        assert connection.execute(count_all).scalar() == 0


def test_what_waits_for_the_database_is_not_lost_by_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A count that fails holds up nothing."""

    def fail(_: Connection) -> None:
        raise StoreError("cannot count")

    monkeypatch.setattr("livessl.server.history.records.count_events", fail)
    store, done = Store(tmp_path / "events.db"), list[int]()

    def work() -> None:
        done.append(1)
        if len(done) == 1:
            raise StoreError("not yet")

    store.when_ready(work)
    with pytest.raises(StoreError, match="not yet"):
        store.prepare()
    for _ in range(2):
        store.prepare()
    assert (len(done), store.count()) == (2, None)
    store.close()


def test_who_writes_all_the_time_keeps_out_nobody(tmp_path: Path) -> None:
    """A thread that stores event after event must not keep an operator's change waiting."""
    store, done = Store(tmp_path / "events.db"), Flag()

    def write() -> None:
        for k in count():
            store.add(small_event(k % 100), k)
            if done.is_set():
                return

    writers = [Thread(target=write) for _ in range(2)]
    for writer in writers:
        writer.start()
    for k in range(5):
        store.enable("lab", f"array-{k}", False)
    done.set()
    for writer in writers:
        writer.join()
    assert len(store.disabled("lab")) == 5
    store.close()
