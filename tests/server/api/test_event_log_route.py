"""`GET event-log`: events in the order of storing, filters, positions, and what is not stored yet."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from livessl.server.app import Server
from livessl.server.history.log import LogPosition
from livessl.server.store import Query, Store, StoreError
from messages import START_NS, event_message
from scene_server import get
from small_site import running_server, site_of


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    with running_server(site_of()) as server:
        yield server


@pytest.fixture
def client(server: Server) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=server.url) as client:
        yield client


def test_events_stored_since_a_position_are_listed_once(server: Server, client: httpx.Client) -> None:
    begin = get(client, "event-log")
    assert begin["events"] == []
    assert (begin["more"], begin["complete"], begin["unsaved"]) == (False, True, 0)
    for k in (2, 0, 1):  # not in order of time
        server.parts.store.add(event_message(id=f"a-{k}"), START_NS + k)
    first = get(client, "event-log", after=begin["position"], limit=2)
    assert [event["id"] for event in first["events"]] == ["a-2", "a-0"]
    assert first["more"]
    server.parts.store.add(event_message(id="a-2", confidence=0.9, late=True), START_NS + 2)
    second = get(client, "event-log", after=first["position"])
    assert [(event["id"], event["confidence"]) for event in second["events"]] == [("a-1", 0.5), ("a-2", 0.9)]
    assert not second["more"]
    assert get(client, "event-log", after=second["position"])["events"] == []


def test_filters_select_and_do_not_hold_the_position_back(server: Server, client: httpx.Client) -> None:
    begin = get(client, "event-log")["position"]
    store = server.parts.store
    store.add(event_message(id="b-0", zones=["door"], confidence=0.3), START_NS)
    store.add(event_message(id="b-1", zones=["door"], confidence=0.7), START_NS)
    store.add(event_message(id="b-2", confidence=0.7), START_NS)
    page = get(client, "event-log", after=begin, zone="door", min_confidence=0.5)
    assert [event["id"] for event in page["events"]] == ["b-1"]
    assert page["position"] == get(client, "event-log")["position"]


@pytest.mark.parametrize(
    ("query", "status", "what"),
    [
        ({"after": "yesterday"}, 422, "position from an earlier answer, such as 1a-42, got 'yesterday'"),
        ({"zone": "hall"}, 404, "no zone 'hall'; zones are door"),
        ({"limit": 0}, 422, "greater than or equal to 1"),
        ({"until": "x"}, 422, "unknown parameter 'until'"),
    ],
)
def test_wrong_query_is_refused(client: httpx.Client, query: dict[str, str], status: int, what: str) -> None:
    assert what in str(get(client, "event-log", status, **query)["detail"])


def test_position_outlives_a_database_and_no_memory(opened: Callable[[], Store]) -> None:
    first = opened()
    begin = first.log(Query(), None).position
    first.add(event_message(id="a"), START_NS)
    first.close()
    page = opened().log(Query(), begin)
    assert [row.event["id"] for row in page.rows] == ["a"]
    assert page.is_complete
    memory, other = Store(), Store()
    try:
        begin = memory.log(Query(), None).position
        other.add(event_message(id="b"), START_NS)
        page = other.log(Query(), begin)
        assert not page.is_complete
        assert [row.event["id"] for row in page.rows] == ["b"]
    finally:
        memory.close()
        other.close()


def test_database_that_was_replaced_is_another_history(tmp_path: Path) -> None:
    """Also if it has as many events as the one before."""
    found = []
    for name in ("before.sqlite", "after.sqlite"):
        store = Store(tmp_path / name)
        store.add(event_message(id=name), START_NS)
        found.append(store)
    try:
        end = found[0].log(Query(), None).position
        assert found[0].log(Query(), end).is_complete
        page = found[1].log(Query(), end)
        assert not page.is_complete
        assert [row.event["id"] for row in page.rows] == ["after.sqlite"]
    finally:
        for store in found:
            store.close()


def test_history_that_was_begun_anew_gives_all_that_it_has(store: Store) -> None:
    store.add(event_message(id="a"), START_NS)
    end = store.log(Query(), None).position
    page = store.log(Query(), LogPosition(end.life, end.number + 7))
    assert not page.is_complete
    assert [row.event["id"] for row in page.rows] == ["a"]
    assert page.position == end


def test_deleted_events_leave_no_trace_in_the_log(store: Store) -> None:
    begin = store.log(Query(), None).position
    store.add(event_message(id="early"), START_NS, early=True)
    final = event_message(id="final", replaces=["early"])
    store.finalize("small", [(final, START_NS)], ["early"], 0, {})
    assert [row.event["id"] for row in store.log(Query(), begin).rows] == ["final"]


def test_event_that_is_stored_unchanged_stays_where_it_is(store: Store) -> None:
    store.add(event_message(id="a"), START_NS)
    end = store.log(Query(), None).position
    store.finalize("small", [(event_message(id="a"), START_NS)], [], 0, {})
    assert store.log(Query(), end).rows == []


def test_events_that_wait_are_counted(server: Server, client: httpx.Client, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server.parts.store.backlog, "unsaved", 3)
    assert get(client, "event-log")["unsaved"] == 3


def test_event_that_is_stored_while_the_page_is_read_is_announced(
    server: Server, client: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    backlog, log = server.parts.store.backlog, server.parts.store.log
    monkeypatch.setattr(backlog, "unsaved", 1)

    def log_and_store(*given: Any) -> Any:
        page = log(*given)
        backlog.unsaved = 0
        return page

    monkeypatch.setattr(server.parts.store, "log", log_and_store)
    assert get(client, "event-log")["unsaved"] == 1


def test_log_of_a_store_that_fails_is_unavailable(
    server: Server, client: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise StoreError("disk gone")

    monkeypatch.setattr(server.parts.store, "log", fail)
    assert get(client, "event-log", 503) == {"detail": "disk gone"}
