"""The history of events: queries, pages, bounds, and files."""

from __future__ import annotations

from pathlib import Path
from threading import Thread
from typing import Any

import pytest

from livessl.messages import JsonObject
from livessl.server.store import MAX_EVENTS_IN_MEMORY, Query, Store, StoreError

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


def filled(count: int, path: Path | None = None) -> Store:
    """Event k began k seconds after the start."""
    store = Store(path)
    for k in range(count):
        store.add(event(k, k / count, ("door",) if k % 3 == 0 else ()), START_NS + k * NS)
    return store


def ids(store: Store, **query: Any) -> list[int]:
    events, _ = store.find(Query(**query))
    return [int(found["id"].removeprefix("e-")) for found in events]


def test_event_comes_back_as_it_was() -> None:
    store = Store()
    whole = {**event(1, 0.25, ("Tür",)), "reason": None, "covariance_m2": [[0.1, 0, 0]], "nested": {"ä": [1.5, None]}}
    store.add(whole, START_NS)
    assert store.get("e-1") == whole
    assert store.get("e-2") is None
    assert store.find(Query()) == ([whole], None)


def test_newest_come_first() -> None:
    assert ids(filled(5)) == [4, 3, 2, 1, 0]


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
def test_queries(query: dict[str, Any], expected: list[int]) -> None:
    assert ids(filled(10), **query) == expected


@pytest.mark.parametrize("limit", [1, 3, 5, 7, 100])
@pytest.mark.parametrize("zone", [None, "door"])
def test_pages_leave_nothing_out_and_repeat_nothing(limit: int, zone: str | None) -> None:
    """Even while new events come and an old one is told again."""
    store = filled(20)
    expected = ids(store, limit=1000, zone=zone)
    seen: list[int] = []
    cursor: int | None = None
    for page in range(100):
        events, cursor = store.find(Query(limit=limit, before=cursor, zone=zone))
        assert len(events) <= limit
        seen += [int(found["id"].removeprefix("e-")) for found in events]
        store.add(event(100 + page, zones=("door",)), START_NS + 100 * NS)
        if cursor is None:
            break
    assert seen == expected


def test_last_page_has_no_next() -> None:
    store = filled(4)
    _, cursor = store.find(Query(limit=4))
    assert cursor is None
    _, cursor = store.find(Query(limit=3))
    assert cursor is not None


def test_event_told_again_replaces_itself() -> None:
    store = filled(3)
    store.add({**event(1), "confidence": 0.99}, START_NS)
    assert store.count() == 3
    found = store.get("e-1")
    assert found is not None
    assert found["confidence"] == 0.99


def test_memory_is_bounded() -> None:
    store = filled(MAX_EVENTS_IN_MEMORY + 25)
    assert store.count() == MAX_EVENTS_IN_MEMORY
    assert store.get("e-24") is None
    assert store.get("e-25") is not None


def test_file_persists(tmp_path: Path) -> None:
    path = tmp_path / "events.db"
    store = filled(3, path)
    store.close()
    again = Store(path)
    assert ids(again) == [2, 1, 0]
    again.add(event(3), START_NS)
    assert ids(again) == [3, 2, 1, 0]
    again.close()


def test_path_that_cannot_be_used(tmp_path: Path) -> None:
    (tmp_path / "notes.db").write_text("dear diary, " * 500, encoding="utf-8")
    for path in (tmp_path / "nowhere" / "events.db", tmp_path, tmp_path / "notes.db"):
        with pytest.raises(StoreError) as caught:
            Store(path)
        said = str(caught.value)
        assert said.startswith(f"server.events_db: cannot use {path}: ")
        assert said.endswith("; name a file in a writable folder")


def test_any_thread_may_ask_and_add() -> None:
    store = Store()

    def add(offset: int) -> None:
        for k in range(100):
            store.add(event(offset + k), START_NS + k)
            store.find(Query(limit=3))

    threads = [Thread(target=add, args=(1000 * n,)) for n in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert store.count() == 400
    assert len(set(ids(store, limit=1000))) == 400


def test_quotes_in_a_zone_are_only_quotes() -> None:
    store = filled(3)
    assert ids(store, zone="' OR 1=1 --") == []
    assert store.get("' OR 1=1 --") is None
