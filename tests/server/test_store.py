"""The history of events in each database: queries, pages, bounds, and files."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from threading import Event, Thread, Timer
from typing import Any

import pytest
from sqlalchemy import text

from livessl.core.types import FRAME_NS
from livessl.server.api.encode import JsonObject
from livessl.server.history import records
from livessl.server.history.backlog import Write
from livessl.server.history.database import READERS
from livessl.server.store import MAX_EVENTS_IN_MEMORY, Cursor, Query, Store, StoreError
from small_site import HANG_S

START_NS = 1_767_225_600_000_000_000
NS = 1_000_000_000


def event(number: int, confidence: float = 0.5, zones: tuple[str, ...] = ()) -> JsonObject:
    return {
        "kind": "event",
        "id": f"e-{number}",
        "confidence": confidence,
        "zones": list(zones),
        "position_m": [1, 2, 3],
    }


def fill(store: Store, count: int) -> Store:
    """Store events of which number k began k seconds after the start."""
    store.add_all([(event(k, k / count, ("door",) if k % 3 == 0 else ()), START_NS + k * NS) for k in range(count)])
    return store


def filled(count: int, path: Path | None = None) -> Store:
    """Return a store of such events."""
    return fill(Store(path), count)


@pytest.fixture(scope="module", params=["memory", "sqlite", "postgresql"])
def ten(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Store]:
    """Ten events, which no test changes."""
    place: Path | str | None = None
    if request.param == "sqlite":
        place = tmp_path_factory.mktemp("ten") / "events.db"
    elif request.param == "postgresql":
        place = request.getfixturevalue("postgresql").url()
    store = fill(Store(place), 10)
    yield store
    store.close()


def ids(store: Store, **query: Any) -> list[int]:
    events, _ = store.find(Query(**query))
    return [int(found["id"].removeprefix("e-")) for found in events]


def test_event_comes_back_as_it_was(store: Store) -> None:
    whole = {**event(1, 0.25, ("Tür",)), "reason": None, "covariance_m2": [[0.1, 0, 0]], "nested": {"ä": [1.5, None]}}
    store.add(whole, START_NS)
    assert store.get("e-1") == whole
    assert store.get("e-2") is None
    assert store.find(Query()) == ([whole], None)


def test_id_with_nul_is_that_of_no_event(store: Store) -> None:
    """PostgreSQL's texts cannot hold NUL."""
    assert store.get("small-\0") is None


def test_newest_come_first(ten: Store) -> None:
    assert ids(ten) == [9, 8, 7, 6, 5, 4, 3, 2, 1, 0]


@pytest.mark.parametrize(
    ("query", "expected"),
    [
        ({"since_ns": START_NS + 7 * NS}, [9, 8, 7]),
        ({"since_ns": START_NS + 7 * NS + 1}, [9, 8]),
        ({"until_ns": START_NS + 2 * NS}, [2, 1, 0]),
        ({"until_ns": START_NS + 2 * NS - 1}, [1, 0]),
        ({"since_ns": START_NS + 3 * NS, "until_ns": START_NS + 4 * NS}, [4, 3]),
        ({"since_ns": START_NS + 100 * NS}, []),
        ({"min_confidence": 0.8}, [9, 8]),
        ({"min_confidence": 0.0}, [9, 8, 7, 6, 5, 4, 3, 2, 1, 0]),
        ({"zone": "door"}, [9, 6, 3, 0]),
        ({"zone": "doo"}, []),
        ({"zone": "door", "min_confidence": 0.5}, [9, 6]),
        ({"limit": 2}, [9, 8]),
        ({"limit": 2, "zone": "door"}, [9, 6]),
    ],
)
def test_query_finds_what_matches(ten: Store, query: dict[str, Any], expected: list[int]) -> None:
    assert ids(ten, **query) == expected


@pytest.mark.parametrize(("limit", "zone"), [(1, "door"), (3, None), (5, "door"), (7, None), (100, None)])
def test_pages_leave_nothing_out_and_repeat_nothing(store: Store, limit: int, zone: str | None) -> None:
    """Even while new events come and an old one is stored again."""
    fill(store, 20)
    expected = ids(store, limit=1000, zone=zone)
    seen: list[int] = []
    cursor: Cursor | None = None
    for page in range(100):
        events, cursor = store.find(Query(limit=limit, before=cursor, zone=zone))
        assert len(events) <= limit
        seen += [int(found["id"].removeprefix("e-")) for found in events]
        store.add(event(100 + page, zones=("door",)), START_NS + 100 * NS)
        if cursor is None:
            break
    assert seen == expected


def test_last_page_has_no_next(ten: Store) -> None:
    _, cursor = ten.find(Query(limit=10))
    assert cursor is None
    _, cursor = ten.find(Query(limit=9))
    assert cursor is not None


def test_event_stored_again_replaces_itself(store: Store) -> None:
    fill(store, 3)
    store.add({**event(1), "confidence": 0.99}, START_NS)
    assert store.count() == 3
    found = store.get("e-1")
    assert found is not None
    assert found["confidence"] == 0.99
    assert ids(store, min_confidence=0.9) == [1]


def test_event_stored_again_is_found_by_its_new_zones_only(store: Store) -> None:
    fill(store, 3)
    store.add(event(0, zones=("hall",)), START_NS)
    assert (ids(store, zone="door"), ids(store, zone="hall")) == ([], [0])


def test_event_stored_again_keeps_its_place_among_equals(store: Store) -> None:
    """A cursor from before stays valid."""
    for k in range(3):
        store.add(event(k), START_NS)
    assert ids(store) == [2, 1, 0]
    _, cursor = store.find(Query(limit=1))
    store.add(event(1), START_NS)
    assert ids(store) == [2, 1, 0]
    assert ids(store, before=cursor) == [1, 0]


def test_order_is_by_time_and_not_by_storing(store: Store) -> None:
    for k in (3, 0, 2, 1):
        store.add(event(k), START_NS + k * NS)
    assert ids(store) == [3, 2, 1, 0]
    events, cursor = store.find(Query(limit=2))
    assert ids(store, before=cursor) == [1, 0]
    assert len(events) == 2


@pytest.mark.parametrize("cursor", [Cursor(START_NS, 7), Cursor(-5, 1), Cursor(0, 0)])
def test_cursor_is_read_back_from_its_text(cursor: Cursor) -> None:
    assert Cursor.parse(str(cursor)) == cursor


@pytest.mark.parametrize("text", ["", "7", "7-", "-7", "a-b", "7-7 ", "٧-٧", f"{2**63}-1", f"1-{10**30}"])
def test_text_that_is_no_cursor_is_an_error(text: str) -> None:
    with pytest.raises(ValueError, match="expected a cursor of a page"):
        Cursor.parse(text)


def test_file_that_another_program_holds_is_an_error(tmp_path: Path) -> None:
    path = tmp_path / "events.db"
    store = filled(1, path)
    with closing(sqlite3.connect(path)) as other:
        other.execute("BEGIN IMMEDIATE")
        with pytest.raises(StoreError) as caught:
            store.add(event(1), START_NS + NS)
        other.rollback()
    said = str(caught.value)
    assert said.startswith("server.events_db: cannot store event 'e-1': database is locked;")
    assert said.endswith("; free space on its disk, or close the program that locks the file")
    store.add(event(2), START_NS + 2 * NS)
    assert ids(store) == [2, 0]
    store.close()


def test_slow_query_does_not_delay_an_event(opened: Callable[[], Store]) -> None:
    """All connections for reading are taken throughout, as by slow queries."""
    store = fill(opened(), 1)
    adding = Thread(target=lambda: store.add(event(1), START_NS + NS))
    with ExitStack() as reading:
        for _ in range(READERS):
            reading.enter_context(store.database.reading()).execute(text("SELECT * FROM events"))
        adding.start()
        adding.join(timeout=HANG_S)
        assert not adding.is_alive()
    assert ids(store) == [1, 0]


def test_searches_cannot_change_the_database(opened: Callable[[], Store]) -> None:
    store = fill(opened(), 1)
    with pytest.raises(StoreError, match=r"cannot read: .*read-?only"), store.database.reading() as connection:
        connection.execute(text("DELETE FROM events"))
    assert ids(store) == [0]


def test_file_of_an_odd_name_is_read(tmp_path: Path) -> None:
    store = filled(1, tmp_path / "odd ?#%20 name.db")
    assert ids(store) == [0]
    store.close()


def test_memory_is_bounded() -> None:
    store = filled(MAX_EVENTS_IN_MEMORY + 25)
    assert store.count() == MAX_EVENTS_IN_MEMORY
    assert store.get("e-24") is None
    assert store.get("e-25") is not None


def test_database_persists(opened: Callable[[], Store]) -> None:
    fill(opened(), 3).close()
    again = opened()
    assert again.count() == 3
    assert ids(again) == [2, 1, 0]
    again.add(event(3), START_NS)
    assert ids(again) == [2, 1, 3, 0]  # the last one told is among the oldest


def test_unusable_path_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "notes.db").write_text("dear diary, " * 500, encoding="utf-8")
    for path in (tmp_path / "nowhere" / "events.db", tmp_path, tmp_path / "notes.db"):
        with pytest.raises(StoreError) as caught:
            Store(path)
        said = str(caught.value)
        assert said.startswith(f"server.events_db: cannot use {path}: ")
        assert said.endswith("; name a file in a writable folder")


def test_any_thread_may_query_and_add(store: Store) -> None:
    def add(offset: int) -> None:
        for k in range(25):
            store.add(event(offset + k), START_NS + k)
            store.find(Query(limit=3))

    threads = [Thread(target=add, args=(1000 * n,)) for n in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert store.count() == 100
    assert len(set(ids(store, limit=1000))) == 100


def test_quotes_in_a_zone_are_only_quotes(ten: Store) -> None:
    assert ids(ten, zone="' OR 1=1 --") == []
    assert ten.get("' OR 1=1 --") is None


def test_final_events_take_the_place_of_early_ones(opened: Callable[[], Store]) -> None:
    store = opened()
    assert store.finalized("lab") == (None, None)
    for n in range(3):
        store.add(event(n), START_NS + n * NS, early=True)
    frame_index = (START_NS + 2 * NS) // FRAME_NS
    assert store.early_events() == [(START_NS + n * NS, event(n)) for n in range(3)]
    store.finalize("lab", [(event(7), START_NS)], ["e-0"], frame_index, {"heard": {"b": [[1, 0.15]]}})
    assert ids(store) == [2, 1, 7]
    assert store.early_events() == [(START_NS + 2 * NS, event(2))]  # e-1 is final now
    store.close()
    again = opened()
    assert again.finalized("lab") == (frame_index, {"heard": {"b": [[1, 0.15]]}})
    assert again.finalized("elsewhere") == (None, None)
    assert again.early_events() == [(START_NS + 2 * NS, event(2))]


def test_database_of_an_older_version_is_read(tmp_path: Path) -> None:
    """Its table of the final pass has this very column, and it has no table of clocks."""
    with closing(sqlite3.connect(tmp_path / "events.db")) as db, db:
        db.execute("CREATE TABLE settled (site TEXT PRIMARY KEY, raster INTEGER)")
        db.execute("INSERT INTO settled VALUES ('lab', 1000)")
    store = Store(tmp_path / "events.db")
    assert store.finalized("lab") == (1000, None)
    store.finalize("lab", [(event(1), START_NS)], [], 2000, {"b": 0.15})
    assert store.finalized("lab") == (2000, {"b": 0.15})
    store.close()


def test_finalize_is_all_or_nothing(tmp_path: Path) -> None:
    store = filled(1, tmp_path / "events.db")
    large = {**event(6), "note": "x" * 500_000}

    def limit(pages: int) -> None:
        with store.database.writing("test") as connection:
            connection.execute(text(f"PRAGMA max_page_count = {pages}"))

    with store.database.writing("test") as connection:
        pages = connection.execute(text("PRAGMA page_count")).scalar_one()
    limit(pages + 3)  # the disk is as good as full
    with pytest.raises(StoreError, match="cannot store 2 events: database or disk is full; free space"):
        store.finalize("lab", [(event(5), START_NS), (large, START_NS + NS)], ["e-0"], 1000, {})
    assert ids(store) == [0]
    assert store.finalized("lab") == (None, None)
    limit(1_000_000)
    store.finalize("lab", [(event(5), START_NS), (large, START_NS + NS)], ["e-0"], 1000, {})
    assert (ids(store), store.count()) == ([6, 5], 2)
    store.close()


def test_disabled_arrays_are_remembered(opened: Callable[[], Store]) -> None:
    store = opened()
    store.enable("lab", "north", False)
    store.enable("lab", "north", False)
    store.enable("lab", "south", False)
    store.enable("lab", "south", True)
    store.enable("elsewhere", "west", False)
    assert opened().disabled("lab") == {"north"}


class EndsAfterTheFirstBatch(Event):
    """The end of a server that comes while the deletion pauses."""

    def wait(self, timeout: float | None = None) -> bool:
        assert timeout is not None
        self.set()
        return True


def test_deletion_ends_when_the_server_does(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("livessl.server.history.deletion.DELETED_AT_ONCE", 3)
    fill(store, 10)
    end = EndsAfterTheFirstBatch()
    assert store.expire(START_NS + 7 * NS, end) == 3
    assert store.expire(START_NS + 7 * NS, end) == 0


@pytest.mark.parametrize("batches", [1, 3])
def test_deletion_gives_way_to_events_that_are_to_be_stored(
    opened: Callable[[], Store], monkeypatch: pytest.MonkeyPatch, batches: int
) -> None:
    """Before every batch; otherwise each event would wait for a batch, and a busy store would fall behind."""
    monkeypatch.setattr("livessl.server.history.deletion.GIVE_WAY_S", HANG_S)
    monkeypatch.setattr("livessl.server.history.deletion.DELETED_AT_ONCE", 2)
    store, done = opened(), list[str]()
    fill(store, 2 * batches)
    store.backlog.start()
    settle, remove_older = store.backlog.settle, records.remove_older

    def settle_with_an_event(within_s: float) -> None:
        """An event comes that takes a while to be stored; only then it is waited for."""
        begun, gate = Event(), Event()

        def work() -> None:
            begun.set()
            gate.wait(HANG_S)
            done.append("stored")

        store.backlog.put(Write(work, 1, is_final=False), 0)
        assert begun.wait(HANG_S)
        Timer(0.05, gate.set).start()
        settle(within_s)

    def delete(*given: Any) -> int:
        done.append("deleted")
        return remove_older(*given)

    monkeypatch.setattr(store.backlog, "settle", settle_with_an_event)
    monkeypatch.setattr(records, "remove_older", delete)
    assert store.expire(START_NS + 10**6 * NS) == 2 * batches
    assert done == ["stored", "deleted"] * (batches + 1)


def test_nothing_is_older_than_any_time_that_can_be_stored(store: Store) -> None:
    fill(store, 2)
    assert store.expire(-(10**20)) == 0


def test_expired_events_are_gone_in_batches(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("livessl.server.history.deletion.DELETED_AT_ONCE", 3)
    fill(store, 10)
    assert store.expire(START_NS + 7 * NS) == 7
    assert (ids(store), ids(store, zone="door"), store.count()) == ([9, 8, 7], [9], 3)
