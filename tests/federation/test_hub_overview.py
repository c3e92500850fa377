"""What a hub shows of all its sites: at once at every hub, by few statements, and as the messages say one by one."""

from __future__ import annotations

import random
from collections.abc import Iterator, Sequence
from typing import Any

import orjson
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sqlalchemy import Connection, create_engine, select

from history_places import Place as DatabasePlace
from livessl.clock import SystemClock, utc_text
from livessl.federation.archive import Archive
from livessl.federation.halls import Halls
from livessl.federation.metrics import site_metrics
from livessl.federation.overview import AWAY_S, Contact, describe
from livessl.federation.storing import Delivery, put
from livessl.server.api.encode import JsonObject
from livessl.server.forwarding import tables
from livessl.server.forwarding.stream import Place
from livessl.server.history import tables as history
from livessl.server.history.query import Query
from messages import event_message

START_NS = 1_767_225_600_000_000_000


@pytest.fixture
def hubs(place: DatabasePlace) -> Iterator[tuple[Archive, Archive]]:
    """Two hubs of one database."""
    assert place is not None
    made = Archive(place, SystemClock()), Archive(place, SystemClock())
    yield made
    for archive in made:
        archive.close()


def message_of(kind: str, **fields: Any) -> JsonObject:
    return {"kind": kind, "time_utc": utc_text(START_NS), **fields}


def deliver(archive: Archive, site: str, *messages: JsonObject, first: int = 1) -> None:
    sent = [
        Delivery(site, message["kind"], Place("box", number), orjson.dumps(message))
        for number, message in enumerate(messages, first)
    ]
    assert archive.take(sent, 0.0).done == sent


def shown(hubs: Sequence[Archive]) -> dict[str, Any]:
    """What all hubs show of the sites; they agree."""
    one, other = (
        {site["site"]: (site["status"], site["arrays"], site["waiting"]) for site in hub.sites()} for hub in hubs
    )
    assert one == other
    assert [each.site for each in hubs[0].contacts()] == sorted(one)
    return one


def test_every_hub_shows_at_once_what_one_of_them_has_taken_in(hubs: tuple[Archive, Archive]) -> None:
    """Until a site reports on itself, its arrays are those of its messages; then they are those of the report."""
    taking, _ = hubs
    assert shown(hubs) == {}
    deliver(taking, "yard", message_of("start"), message_of("array", name="north", state="lost"))
    assert shown(hubs) == {"yard": ("degraded", {"north": "lost"}, 0)}
    deliver(taking, "lab", message_of("start"))
    assert shown(hubs)["lab"] == ("starting", {}, 0)
    taking.note_reports({"yard": {"waiting": 2, "arrays": {"north": "healthy", "east": "disabled"}}})
    assert shown(hubs)["yard"] == ("ok", {"north": "healthy", "east": "disabled"}, 2)
    deliver(taking, "lab", message_of("array", name="west", state="healthy"), first=2)
    assert shown(hubs)["lab"] == ("ok", {"west": "healthy"}, 0)


@pytest.mark.parametrize(("age_s", "status"), [(AWAY_S, "ok"), (AWAY_S + 0.001, "away")])
def test_a_site_is_away_after_some_silence(age_s: float, status: str) -> None:
    contact = Contact("lab", age_s, START_NS, 3, 0, {"waiting": 4, "version": "9"})
    found = describe(contact, {"north": "healthy", "south": "disabled"})
    assert (found["status"], found["age_s"], found["newest_event_utc"]) == (status, age_s, None)
    metrics = {metric.name: [(one.labels, one.value) for one in metric.samples] for metric in site_metrics([contact])}
    lab = {"site": "lab"}
    assert metrics == {
        "livessl_site_up": [(lab, float(status == "ok"))],
        "livessl_site_age_seconds": [(lab, round(age_s, 3))],
        "livessl_site_waiting": [(lab, 4)],
        "livessl_site_missing": [(lab, 3)],
    }


@pytest.mark.parametrize(
    ("states", "status"),
    [
        ({}, "starting"),
        ({"north": "starting", "south": "healthy"}, "starting"),
        ({"north": "healthy", "south": "disabled"}, "ok"),
        ({"north": "lost", "south": "starting"}, "degraded"),
        ({"north": "disabled", "south": "disabled"}, "degraded"),
    ],
)
def test_condition_of_a_site_is_that_of_its_enabled_arrays(states: dict[str, str], status: str) -> None:
    """A site that locates nothing, because all its arrays are disabled, is not well."""
    contact = Contact("lab", 0.0, START_NS, 0, 0, {})
    assert describe(contact, states)["status"] == status


# --- batches

SITES, NAMES = ("lab", "yard"), ("a", "b")


def event(number: int, **fields: Any) -> JsonObject:
    at_utc = utc_text(START_NS + number * 10**9)
    return {**event_message(id=f"event-{number}", time_utc=at_utc), "confidence": 0.5, **fields}


sites_of = st.sampled_from(SITES)
batches = st.lists(
    st.one_of(
        st.tuples(sites_of, st.just("start"), st.just({})),
        st.tuples(
            sites_of,
            st.just("track"),
            st.fixed_dictionaries({"id": st.integers(1, 2), "state": st.sampled_from(["new", "end"])}),
        ),
        st.tuples(
            sites_of,
            st.just("array"),
            st.fixed_dictionaries({"name": st.sampled_from(NAMES), "state": st.sampled_from(["healthy", "lost"])}),
        ),
        st.tuples(
            sites_of,
            st.just("alert"),
            st.fixed_dictionaries(
                {"key": st.sampled_from(NAMES), "raised_utc": st.integers(0, 9).map(lambda n: utc_text(START_NS + n))}
            ),
        ),
        st.tuples(sites_of, st.just("event"), st.integers(0, 2).map(event)),
    ),
    max_size=12,
)


@pytest.fixture(scope="module")
def database() -> Iterator[Connection]:
    """The hub's tables in memory."""
    engine = create_engine("sqlite://")
    with engine.connect() as connection:
        for metadata in (tables.metadata, history.metadata):
            metadata.create_all(connection)
        connection.commit()
        yield connection
    engine.dispose()


def left_by(database: Connection, batch: Sequence[Sequence[tuple[str, str, JsonObject]]]) -> list[Any]:
    """What is stored once some batches are taken in, one after the other; nothing of it stays."""
    for some in batch:
        put(database, some, Halls({}))
    stored = tables.tracks, tables.arrays, tables.alerts, history.events
    found: list[Any] = [_rows(database, table) for table in stored]
    found.append(
        sorted(database.execute(select(history.tags.c.kind, history.tags.c.name, history.tags.c.number)).all())
    )
    database.rollback()
    return found


def _rows(connection: Connection, table: Any) -> list[Any]:
    return [tuple(row) for row in connection.execute(select(table).order_by(*table.primary_key.columns))]


@settings(max_examples=25)
@given(drawn=batches, middle=st.integers(0, 12))
def test_messages_stored_together_leave_what_they_leave_one_by_one(
    database: Connection, drawn: list[tuple[str, str, JsonObject]], middle: int
) -> None:
    batch = [(site, kind, {**message, "number": n, "site": site}) for n, (site, kind, message) in enumerate(drawn)]
    together = left_by(database, [batch[:middle], batch[middle:]])
    assert together == left_by(database, [[each] for each in batch])


# --- searches

ZONES, ARRAYS = ("door", "hall"), ("north", "south")


def test_events_of_a_site_are_found_by_further_filters(hubs: tuple[Archive, Archive]) -> None:
    """Sites give the same names to zones and arrays."""
    rng, taking = random.Random(3), hubs[0]
    sent: dict[str, list[JsonObject]] = {site: [] for site in SITES}
    for number in range(60):
        zones, arrays = rng.sample(ZONES, rng.randint(0, 2)), rng.sample(ARRAYS, rng.randint(0, 2))
        is_excluded, status = rng.random() < 0.5, rng.choice(["located", "refused"])
        made = event(number, zones=zones, arrays=arrays, heard_by=arrays, excluded=is_excluded, status=status)
        sent[rng.choice(SITES)].append(made)
    for site, messages in sent.items():
        deliver(taking, site, *messages)
    for site in SITES:
        for zone in (None, *ZONES):
            for array in (None, *ARRAYS):
                for excluded in (None, True, False):
                    wanted = [
                        each["id"]
                        for each in reversed(sent[site])
                        if (zone is None or zone in each["zones"])
                        and (array is None or array in each["arrays"])
                        and excluded in (None, each["excluded"])
                    ]
                    query = Query(site=site, zone=zone, array=array, excluded=excluded, limit=100)
                    assert [row.event["id"] for row in hubs[1].store.page(query).rows] == wanted
