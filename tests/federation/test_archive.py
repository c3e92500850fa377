"""The hub's archive: each message once and in order, however often and in whatever order it is delivered."""

from __future__ import annotations

import random
from collections.abc import Iterator
from typing import Any

import orjson
import pytest
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from alembic.script import ScriptDirectory
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from sqlalchemy import text

from alert_desk import encoded, sound
from history_places import Place as DatabasePlace
from livessl.clock import SystemClock, utc_text
from livessl.federation.archive import Archive
from livessl.federation.halls import Halls
from livessl.federation.storing import Delivery, read
from livessl.server.api.encode import JsonObject
from livessl.server.forwarding import tables
from livessl.server.forwarding.stream import Place, outbox_name
from livessl.server.history.database import StoreError
from livessl.server.history.query import Query

PATIENCE_S = 3.0


class TestClock(SystemClock):
    """The machine's clock, and a monotonic time that the test sets."""

    __test__ = False
    monotonic_s = 0.0

    def monotonic_ns(self) -> int:
        return round(1e9 * self.monotonic_s)


@pytest.fixture
def clock() -> TestClock:
    return TestClock()


@pytest.fixture
def archive(place: DatabasePlace, clock: TestClock) -> Iterator[Archive]:
    assert place is not None
    made = Archive(place, clock)
    yield made
    made.close()


def event(number: int, site: str = "lab") -> JsonObject:
    return encoded(sound(number, event_id=f"{site}-{number}"))


def delivery(
    number: int,
    body: JsonObject | None = None,
    *,
    site: str = "lab",
    kind: str = "event",
    box: str = "a",
) -> Delivery:
    message = event(number, site) if body is None else body
    return Delivery(site, kind, Place(box, number), orjson.dumps(message))


def stored(archive: Archive, site: str = "lab") -> list[str]:
    """The ids of a site's events in the order in which they were stored."""
    rows = sorted(archive.store.page(Query(site=site, limit=1000)).rows, key=lambda row: row.number)
    return [row.event["id"] for row in rows]


def names(first: int, last: int, site: str = "lab") -> list[str]:
    return [f"{site}-{number}" for number in range(first, last + 1)]


def site_of(archive: Archive, name: str = "lab") -> JsonObject:
    return next(site for site in archive.sites() if site["site"] == name)


def test_the_migrations_make_the_tables_that_the_code_names(archive: Archive) -> None:
    def ours(_object: object, name: str | None, kind: str, _reflected: bool, _other: object) -> bool:
        return kind != "table" or name in tables.metadata.tables

    options = {"compare_type": True, "include_object": ours, "version_table": tables.VERSION_TABLE}
    with archive.store.database.reading() as connection:
        assert compare_metadata(MigrationContext.configure(connection, opts=options), tables.metadata) == []
    folder = str(tables.__file__).removesuffix("tables.py") + "migrations"
    assert ScriptDirectory(folder).get_current_head() == tables.HEAD


def test_messages_are_taken_in_once_and_in_order(archive: Archive) -> None:
    late = archive.take([delivery(3), delivery(2)], PATIENCE_S)
    assert (late.done, [each.place.number for each in late.early]) == ([], [2, 3])
    first = archive.take([delivery(4), delivery(1), delivery(2)], PATIENCE_S)
    assert [each.place.number for each in first.done] == [1, 2]
    assert [each.place.number for each in first.early] == [4]
    again = archive.take([delivery(number) for number in (4, 1, 3, 2)], PATIENCE_S)
    assert (len(again.done), again.early) == (4, [])
    assert stored(archive) == names(1, 4)
    assert site_of(archive)["newest_event_utc"] == event(4)["time_utc"]


def test_sites_and_outboxes_do_not_wait_for_each_other(archive: Archive) -> None:
    """A site with a new database begins to number anew, and its events are not taken for known ones."""
    archive.take([delivery(1), delivery(1, site="yard"), delivery(2)], PATIENCE_S)
    taken = archive.take([delivery(1, event(7), box="b"), delivery(2, event(1), box="b")], PATIENCE_S)
    assert len(taken.done) == 2
    assert stored(archive) == ["lab-1", "lab-2", "lab-7"]  # the second is known by its id
    assert stored(archive, "yard") == ["yard-1"]


def test_two_sites_may_use_the_same_ids(archive: Archive) -> None:
    archive.take([delivery(1, event(5)), delivery(1, event(5), site="yard")], PATIENCE_S)
    assert stored(archive) == stored(archive, "yard") == ["lab-5"]
    assert [each["site"] for each in (archive.event("lab", "lab-5"), archive.event("yard", "lab-5")) if each] == [
        "lab",
        "yard",
    ]


def test_a_gap_that_is_never_filled_is_waited_for_a_while_and_counted(archive: Archive, clock: TestClock) -> None:
    archive.take([delivery(1)], PATIENCE_S)
    while clock.monotonic_s < PATIENCE_S:
        assert archive.take([delivery(4)], PATIENCE_S).done == []
        clock.monotonic_s += 0.5
    assert len(archive.take([delivery(4)], PATIENCE_S).done) == 1
    assert len(archive.take([delivery(5)], PATIENCE_S).done) == 1
    assert (stored(archive), site_of(archive)["missing"]) == (["lab-1", "lab-4", "lab-5"], 2)


def test_a_time_without_a_database_declares_no_gap(
    archive: Archive, clock: TestClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However often a message comes meanwhile; what it waits for is still in the stream."""
    archive.take([delivery(1)], PATIENCE_S)
    archive.take([delivery(3)], PATIENCE_S)
    with monkeypatch.context() as broken:
        broken.setattr(archive, "_touch", refuse)
        for _ in range(20):
            clock.monotonic_s += PATIENCE_S
            with pytest.raises(StoreError, match="away"):
                archive.take([delivery(3)], PATIENCE_S)
    assert [each.place.number for each in archive.take([delivery(3)], PATIENCE_S).early] == [3]
    archive.take([delivery(2), delivery(3)], PATIENCE_S)
    assert (stored(archive), site_of(archive)["missing"]) == (names(1, 3), 0)


def refuse(*_: object) -> None:
    raise StoreError("the database is away")


def test_an_error_that_nobody_foresaw_costs_its_message_alone(
    archive: Archive, monkeypatch: pytest.MonkeyPatch
) -> None:
    def read_two_wrongly(message: Delivery, halls: Halls) -> JsonObject | None:
        if message.place.number == 2:
            raise TypeError("unforeseen")
        return read(message, halls)

    monkeypatch.setattr("livessl.federation.archive.read", read_two_wrongly)
    taken = archive.take([delivery(1), delivery(2), delivery(3)], PATIENCE_S)
    assert [each.place.number for each in taken.rejected] == [2]
    assert stored(archive) == ["lab-1", "lab-3"]


def test_an_outbox_that_was_renamed_begins_at_the_number_that_its_name_says(archive: Archive) -> None:
    """As after a restored database: numbers repeat under a new name, and what was known by its id comes once."""
    archive.take([delivery(1), delivery(2)], PATIENCE_S)
    box = outbox_name(2)
    taken = archive.take([delivery(2, box=box), delivery(3, event(7), box=box)], PATIENCE_S)
    assert len(taken.done) == 2
    assert (stored(archive), site_of(archive)["missing"]) == ([*names(1, 2), "lab-7"], 0)


ODD: list[Any] = [None, True, "1", -1, 2**63, 1e300, [], ["a", "b", "c"], {}, "9999-12-31T23:59:59Z", "0001-01-01"]
"""Values of a wrong type or size."""


def test_no_odd_field_of_an_event_holds_up_others(archive: Archive) -> None:
    whole = event(1)
    bodies = [
        {**whole, name: odd, **({} if name == "id" else {"id": f"{name}-{n}"})}
        for name in whole
        for n, odd in enumerate(ODD)
    ]
    bodies += [{key: value for key, value in whole.items() if key != name} for name in whole]
    bodies.append(event(2))
    taken = archive.take([delivery(number, body) for number, body in enumerate(bodies, 1)], PATIENCE_S)
    assert len(taken.done) + len(taken.rejected) == len(bodies)
    assert {each.place.number for each in taken.rejected} != set()
    assert archive.event("lab", "lab-2") is not None
    archive.sites()


@pytest.mark.parametrize(
    "body",
    [
        {"id": "lab-2", "confidence": 0.9},
        {"id": "lab-2", "confidence": 0.9, "time_utc": "yesterday", "status": "located"},
        {"id": "lab-2", "confidence": 0.9, "time_utc": "2026-01-01T00:00:00Z"},
        {"id": "lab-2", "confidence": True, "time_utc": "2026-01-01T00:00:00Z", "status": "located"},
        {
            "id": "lab-2",
            "confidence": 0.9,
            "time_utc": "2026-01-01T00:00:00Z",
            "status": "located",
            "position_m": [1.0],
        },
        {**event(2), "id": "lab-\0-2", "reason": "a\0b"},
    ],
)
def test_a_message_that_cannot_be_stored_holds_up_no_other(archive: Archive, body: JsonObject) -> None:
    taken = archive.take([delivery(1), delivery(2, body), delivery(3)], PATIENCE_S)
    assert taken.early == []
    assert {"lab-1", "lab-3"} <= set(stored(archive))
    if taken.rejected:  # SQLite stores a NUL, and PostgreSQL does not
        assert [each.place.number for each in taken.rejected] == [2]
        assert stored(archive) == ["lab-1", "lab-3"]
    else:
        assert "\0" in str(body["id"])


@pytest.mark.parametrize(
    ("given", "shown"),
    [
        ("2026-01-01T00:00:00Z", "2026-01-01T00:00:00.000000Z"),
        ("2026-01-01T01:00:00.5+01:00", "2026-01-01T00:00:00.500000Z"),
    ],
)
def test_times_are_stored_as_servers_write_them(archive: Archive, given: str, shown: str) -> None:
    archive.take([delivery(1, {**event(1), "time_utc": given})], PATIENCE_S)
    found = archive.event("lab", "lab-1")
    assert found is not None
    assert found["time_utc"] == shown


def test_states_tracks_and_alerts_follow_the_messages(archive: Archive) -> None:
    now = utc_text(SystemClock().now_ns())
    track = {"kind": "track", "id": 7, "state": "new", "time_utc": now}
    array = {"kind": "array", "name": "north", "state": "lost", "time_utc": now}
    alert = {"kind": "alert", "key": "alert_1", "raised_utc": now}
    bodies: list[tuple[str, JsonObject]] = [
        ("start", {}),
        ("track", track),
        ("track", {**track, "id": 8}),
        ("array", array),
        ("alert", alert),
    ]
    archive.take([delivery(n, body, kind=kind) for n, (kind, body) in enumerate(bodies, 1)], PATIENCE_S)
    assert [each["id"] for each in archive.tracks("lab")] == [7, 8]
    assert archive.arrays(None) == [{**array, "site": "lab"}]
    assert site_of(archive)["status"] == "degraded"
    bodies = [("track", {**track, "state": "end"}), ("array", {**array, "state": "healthy"}), ("alert", alert)]
    archive.take([delivery(n, body, kind=kind) for n, (kind, body) in enumerate(bodies, 6)], PATIENCE_S)
    assert [each["id"] for each in archive.tracks("lab")] == [8]
    assert [each["key"] for _, each in archive.alerts("lab", 10, None)] == ["alert_1"]
    assert site_of(archive)["status"] == "ok"
    archive.take([delivery(9, {}, kind="start")], PATIENCE_S)
    assert archive.tracks("lab") == archive.arrays("lab") == []  # a server that starts reports all that it has


def test_newest_reports_of_sites_are_kept_and_one_that_is_refused_holds_up_no_other(
    archive: Archive, caplog: pytest.LogCaptureFixture
) -> None:
    """A lone surrogate is a name that no database stores; NATS lets no such subject pass."""
    archive.take([delivery(1)], PATIENCE_S)
    archive.note_reports({})
    archive.note_reports({"lab": {"waiting": 3}, "yard": {"waiting": 4}})
    archive.note_reports({"yard": {"waiting": 5, "version": "9"}, "a\ud800": {"waiting": 6}, "hall": {"waiting": 7}})
    assert {site["site"]: site["waiting"] for site in archive.sites()} == {"hall": 7, "lab": 3, "yard": 5}
    assert [site["version"] for site in archive.sites() if site["site"] == "yard"] == ["9"]
    assert "a report is left out" in caplog.text


def test_old_events_and_alerts_are_deleted(archive: Archive) -> None:
    alert = {"kind": "alert", "key": "old", "raised_utc": event(1)["time_utc"]}
    newer = {"kind": "alert", "key": "new", "raised_utc": event(3)["time_utc"]}
    archive.take([delivery(1), delivery(2, event(3)), delivery(3, alert, kind="alert")], PATIENCE_S)
    archive.take([delivery(4, newer, kind="alert")], PATIENCE_S)
    assert archive.expire(sound(2).start_ns) == 1
    assert stored(archive) == ["lab-3"]
    assert [each["key"] for _, each in archive.alerts(None, 10, None)] == ["new"]


def test_only_one_hub_at_a_time_has_the_turn(place: DatabasePlace, archive: Archive) -> None:
    if not isinstance(place, str):
        pytest.skip("the hubs of an SQLite file are not kept apart")
    other = Archive(place, SystemClock())
    with archive.store.database.session() as session:  # the lock of a hub whose machine vanished is freed soon
        assert session.execute(text("SHOW tcp_keepalives_count")).scalar() == "3"
        assert session.execute(text("SHOW tcp_user_timeout")).scalar() == "10000"
    with archive.turn() as first, other.turn() as second:
        assert (first is not None, second) == (True, None)
    with other.turn() as second:
        assert second is not None
        second.check()
    other.close()


@settings(max_examples=5, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 8))
def test_any_order_and_repetition_of_deliveries_ends_in_the_same_history(
    archive: Archive, seed: int, count: int
) -> None:
    """Batches are drawn at random, as if from a stream that gives again what is not acknowledged."""
    chance, box = random.Random(seed), f"{seed}-{count}"
    site = f"site-{box}"
    waiting = dict.fromkeys(range(1, count + 1), 0)
    while waiting:
        drawn = chance.choices(sorted(waiting), k=chance.randint(1, count)) + chance.choices(range(1, count + 1))
        taken = archive.take([delivery(number, site=site, box=box) for number in drawn], 10**6)
        for each in taken.done:
            waiting.pop(each.place.number, None)
    assert stored(archive, site) == names(1, count, site)
    assert site_of(archive, site)["missing"] == 0
