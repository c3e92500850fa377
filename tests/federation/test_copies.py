"""Copies in the hub's archive: which events are shown, whatever the order in which they come."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import permutations
from threading import Thread
from typing import Any

import orjson
import pytest
from sqlalchemy import update

from hall_events import delivered, hall_event
from history_places import Place as DatabasePlace
from livessl.clock import SystemClock
from livessl.core.types import Status
from livessl.federation.archive import Archive
from livessl.federation.copies import MOST_TOGETHER
from livessl.federation.halls import Halls
from livessl.federation.schema import SiteEvent
from livessl.federation.storing import Delivery
from livessl.server.api.encode import JsonObject
from livessl.server.history.query import Query
from livessl.server.history.tables import events
from small_site import HANG_S

PATIENCE_S = 3.0
HALLS = Halls({"works": ("west", "east", "north", "a", "b", "c", "d"), "other": ("east",)})
HERE, NEAR, FAR = (2.0, 2.0, 1.0), (2.1, 2.0, 1.0), (3.5, 4.0, 1.0)


@pytest.fixture
def archive(place: DatabasePlace) -> Iterator[Archive]:
    assert place is not None
    made = Archive(place, SystemClock(), HALLS)
    yield made
    made.close()


def take(archive: Archive, *deliveries: Delivery) -> None:
    """Take deliveries in by one transaction."""
    taken = archive.take(deliveries, PATIENCE_S)
    assert (len(taken.done), taken.rejected) == (len(deliveries), [])


def found(archive: Archive, limit: int = 1000, **query: Any) -> list[JsonObject]:
    """Events by their ids."""
    return sorted(
        (row.event for row in archive.store.page(Query(limit=limit, **query)).rows), key=lambda event: str(event["id"])
    )


def shown(archive: Archive, **query: Any) -> list[str]:
    """Ids of the events that are no copies."""
    return [event["id"] for event in found(archive, copies=False, **query)]


def name(site: str, event: str) -> JsonObject:
    return {"site": site, "id": event}


def marks(archive: Archive) -> dict[str, tuple[Any, Any]]:
    return {event["id"]: (event["copy_of"], event["copies"]) for event in found(archive)}


def test_a_sound_at_a_border_is_shown_once_and_names_its_copy(archive: Archive) -> None:
    take(archive, delivered("east", 1, hall_event("e", NEAR, in_tile=False)))
    assert shown(archive) == ["e"]
    take(archive, delivered("west", 1, hall_event("w", HERE)))
    assert (shown(archive), [event["id"] for event in found(archive)]) == (["w"], ["e", "w"])
    assert marks(archive) == {"w": (None, [name("east", "e")]), "e": (name("west", "w"), [])}
    for event in found(archive):
        SiteEvent.model_validate(event)
    assert (shown(archive, site="west"), shown(archive, site="east")) == (["w"], [])
    assert [event["id"] for event in found(archive, site="east")] == ["e"]


def test_two_sounds_at_one_time_in_different_places_are_two(archive: Archive) -> None:
    take(archive, delivered("west", 1, hall_event("w", HERE)), delivered("east", 1, hall_event("e", FAR)))
    assert shown(archive) == ["e", "w"]
    assert marks(archive) == {"w": (None, []), "e": (None, [])}


@pytest.mark.parametrize("hall", [None, {"name": "other", "in_tile": True}])
def test_events_of_other_halls_and_of_none_are_no_copies(archive: Archive, hall: JsonObject | None) -> None:
    other = {**hall_event("e", HERE), "hall": hall}
    take(archive, delivered("west", 1, hall_event("w", HERE)), delivered("east", 1, other))
    assert shown(archive) == ["e", "w"]


def corner() -> list[tuple[str, JsonObject]]:
    """Four servers' events of a sound at a corner, one of them refused, and a further sound of two of them."""
    return [
        ("a", hall_event("a-0", HERE, in_tile=False)),
        ("b", hall_event("b-0", (2.1, 2.05, 1.0), std_m=0.1)),
        ("c", hall_event("c-0", (2.2, 2.0, 1.0), in_tile=False)),
        ("d", hall_event("d-0", None, heard_by=("north",))),
        ("a", hall_event("a-1", (2.6, 2.0, 1.0))),
        ("c", hall_event("c-1", (2.65, 2.0, 1.0), in_tile=False)),
    ]


CORNER_MARKS = {
    "b-0": (None, [name("a", "a-0"), name("c", "c-0"), name("d", "d-0")]),
    "a-0": (name("b", "b-0"), []),
    "c-0": (name("b", "b-0"), []),
    "d-0": (name("b", "b-0"), []),
    "a-1": (None, [name("c", "c-1")]),
    "c-1": (name("a", "a-1"), []),
}


def in_order(events: Sequence[tuple[str, JsonObject]]) -> Iterator[Delivery]:
    """The events as deliveries, numbered at each site in this order."""
    counts: dict[str, int] = {}
    for site, event in events:
        counts[site] = counts.get(site, 0) + 1
        yield delivered(site, counts[site], event)


@pytest.mark.parametrize("turn", range(12))
def test_marks_do_not_depend_on_the_order_of_arrival(archive: Archive, turn: int) -> None:
    """Each event in a transaction of its own, so that those that came first are marked anew."""
    order = list(permutations(corner()))[turn * 59]
    for delivery in in_order(order):
        take(archive, delivery)
    assert marks(archive) == CORNER_MARKS
    assert shown(archive) == ["a-1", "b-0"]


def test_marks_are_the_same_if_all_come_in_one_transaction_or_twice(archive: Archive) -> None:
    deliveries = list(in_order(corner()))
    take(archive, *deliveries)
    take(archive, *deliveries)
    assert marks(archive) == CORNER_MARKS


def test_an_event_that_comes_after_hours_of_others_finds_its_copy(archive: Archive) -> None:
    """A server was away, and sends what its nodes kept."""
    others = [hall_event(f"w-{number}", HERE, at_s=30.0 * number) for number in range(300)]
    for first in range(0, 300, 100):
        take(archive, *(delivered("west", number + 1, others[number]) for number in range(first, first + 100)))
    take(archive, delivered("east", 1, hall_event("e", NEAR, in_tile=False, at_s=30.0 * 7)))
    assert marks(archive)["w-7"] == (None, [name("east", "e")])
    assert len(found(archive, copies=False)) == 300


@pytest.mark.parametrize("long_first", [True, False])
def test_a_short_event_and_a_long_one_that_holds_it_find_each_other(archive: Archive, long_first: bool) -> None:
    """Whichever comes first, although minutes of others lie between their starts, or their ends, and the new event."""
    lasting = {**hall_event("w", HERE, at_s=100.0), "duration_s": 50.0}
    short = hall_event("e", NEAR, in_tile=False, at_s=110.0)
    pair = [("west", lasting), ("east", short)]
    others = [("north", hall_event(f"n-{number}", FAR, at_s=10.0 * number)) for number in range(60)]
    take(archive, *in_order(others))
    for delivery in in_order(pair if long_first else pair[::-1]):
        take(archive, delivery)
    assert (marks(archive)["w"], marks(archive)["e"]) == ((None, [name("east", "e")]), (name("west", "w"), []))


def test_a_backlog_of_one_server_is_matched_in_one_transaction(archive: Archive) -> None:
    def of(site: str, number: int) -> Delivery:
        moved = (2.0 + 0.05 * (site == "east"), 2.0, 1.0)
        return delivered(
            site, number + 1, hall_event(f"{site}-{number}", moved, in_tile=site == "west", at_s=90.0 * number)
        )

    take(archive, *(of("west", number) for number in range(150)))
    take(archive, *(of("east", number) for number in range(150)))
    assert {event["site"] for event in found(archive, copies=False)} == {"west"}
    assert len(found(archive)) == 300


def test_filters_and_pages_pass_copies_over(archive: Archive) -> None:
    for number in range(6):
        at_s = 5.0 * number
        take(archive, delivered("west", number + 1, hall_event(f"w-{number}", HERE, at_s=at_s)))
        take(archive, delivered("east", number + 1, hall_event(f"e-{number}", NEAR, in_tile=False, at_s=at_s)))
    page = archive.store.page(Query(copies=False, limit=4))
    following = archive.store.page(Query(copies=False, limit=4, before=page.older))
    assert [row.event["id"] for row in (*page.rows, *following.rows)] == [f"w-{number}" for number in range(5, -1, -1)]
    assert shown(archive, array="north", min_confidence=0.5) == [f"w-{number}" for number in range(6)]


def test_a_message_that_cannot_be_compared_is_left_out_alone(archive: Archive) -> None:
    broken = {**hall_event("e", NEAR, status=Status.DIRECTION_ONLY), "contributions": [{"azimuth_deg": "north"}]}
    taken = archive.take([delivered("west", 1, hall_event("w", HERE)), delivered("east", 1, broken)], PATIENCE_S)
    assert ([each.site for each in taken.done], [each.site for each in taken.rejected]) == (["west"], ["east"])
    assert marks(archive) == {"w": (None, [])}


@pytest.mark.parametrize(("site", "hall"), [("guest", "works"), ("west", "other"), ("west", "unheard-of")])
def test_a_site_that_a_hall_does_not_list_hides_no_event_there(
    place: DatabasePlace, caplog: pytest.LogCaptureFixture, site: str, hall: str
) -> None:
    assert place is not None
    archive = Archive(place, SystemClock(), Halls({"works": ("east", "west"), "other": ("east",)}))
    take(archive, delivered("east", 1, hall_event("e", HERE, hall=hall, in_tile=False)))
    for number in (1, 2):
        sharp = hall_event(f"g{number}", NEAR, hall=hall, std_m=0.01)
        take(archive, delivered(site, number, sharp))
    assert shown(archive) == ["e", "g1", "g2"]
    assert [event["hall"] for event in found(archive)[1:]] == [None, None]
    for event in found(archive):
        SiteEvent.model_validate(event)
    warned = [record.getMessage() for record in caplog.records if f"site {site!r}" in record.getMessage()]
    assert (len(warned), f"halls: {{{hall}: [" in warned[0]) == (1, True)
    assert archive.halls.ignored >= 2
    archive.close()


@pytest.mark.parametrize("together", [1, 40])
def test_an_endless_chain_of_events_is_marked_in_bounds_and_logged_once(
    archive: Archive, caplog: pytest.LogCaptureFixture, together: int
) -> None:
    """Events of two servers in turns, each of which overlaps with the one before and the one after it."""
    archive.halls = Halls({"works": ("west", "east")})
    count = 2 * MOST_TOGETHER + 40
    chain = [
        ({0: "west", 1: "east"}[k % 2], {**hall_event(f"c{k:03d}", HERE, at_s=0.5 * k), "duration_s": 1.0})
        for k in range(count)
    ]
    deliveries = list(in_order(chain))
    for first in range(0, count, together):
        take(archive, *deliveries[first : first + together])
    found_marks = marks(archive)
    for event, (copy_of, copies) in found_marks.items():  # each mark has its other, and no event is shown twice
        assert all(found_marks[copy["id"]][0]["id"] == event for copy in copies)
        assert copy_of is None or [copy["id"] for copy in found_marks[copy_of["id"]][1]] == [event]
    assert len(shown(archive)) <= count // 2 + 5
    assert len([record for record in caplog.records if "overlap in turns" in record.getMessage()]) == 1


def direction(event: str, **changes: Any) -> JsonObject:
    """An event of the hall with a direction only."""
    return {**hall_event(event, NEAR, status=Status.DIRECTION_ONLY), **changes}


@pytest.mark.parametrize(
    "changes",
    [
        {"candidates": [{"position_m": [1.0, 2.0]}]},
        {"candidates": [{"position_m": [1.0, 2.0, 3.0, 4.0]}]},
        {"candidates": [{"position_m": [1.0, "2", 3.0]}]},
        {"candidates": [{"position_m": [1.0, 2.0, 1e9]}]},
        {"candidates": [{}]},
        {"candidates": "none"},
        {"contributions": [{"azimuth_deg": 1.0, "elevation_deg": 2.0, "distance_m": 1e200}]},
        {"contributions": [{"azimuth_deg": 1.0, "elevation_deg": 2.0, "distance_m": -1.0}]},
        {"contributions": [{"azimuth_deg": 1e9, "elevation_deg": 2.0, "distance_m": 1.0}]},
        {"contributions": [{"azimuth_deg": 1.0, "elevation_deg": [2.0], "distance_m": 1.0}]},
        {"contributions": [{"azimuth_deg": 1.0, "distance_m": 1.0}]},
    ],
)
def test_an_event_whose_places_are_not_valid_costs_its_neighbours_nothing(
    archive: Archive, changes: JsonObject
) -> None:
    taken = archive.take([delivered("east", 1, direction("e", **changes))], PATIENCE_S)
    assert [each.site for each in taken.rejected] == ["east"]
    take(archive, delivered("west", 1, hall_event("w", HERE)))
    assert marks(archive) == {"w": (None, [])}


def test_further_fields_of_candidates_and_contributions_are_kept(archive: Archive) -> None:
    candidates = [{"position_m": [2.0, 2, 1.0], "weight": 0.7}]
    contributions = [{"array": "north", "azimuth_deg": 1.0, "elevation_deg": 0.0, "distance_m": 2, "new": [1]}]
    take(archive, delivered("east", 1, direction("e", candidates=candidates, contributions=contributions)))
    [event] = found(archive)
    assert (event["candidates"], event["contributions"]) == (candidates, contributions)


def test_a_covariance_without_bounds_costs_its_neighbours_nothing(archive: Archive) -> None:
    """It is singular, so that its inverse does not exist, even if a millimetre is added to it."""
    take(archive, delivered("east", 1, {**hall_event("e", NEAR), "covariance_m2": [[1e12] * 3] * 3}))
    take(archive, delivered("west", 1, hall_event("w", HERE)))
    assert set(marks(archive)) == {"e", "w"}


def test_an_event_stored_before_that_cannot_be_compared_is_named_and_passed_over(
    archive: Archive, caplog: pytest.LogCaptureFixture
) -> None:
    take(archive, delivered("east", 1, direction("e", candidates=[])))
    broken = orjson.dumps({**found(archive)[0], "candidates": [{"position_m": [1.0]}]}).decode()
    with archive.store.database.writing("damage an event") as connection:
        connection.execute(update(events).values(body=broken))
    take(archive, delivered("west", 1, hall_event("w", HERE)), delivered("north", 1, hall_event("n", NEAR)))
    assert (marks(archive)["n"], marks(archive)["w"]) == ((None, [name("west", "w")]), (name("north", "n"), []))
    assert "event east/e cannot be compared with others" in caplog.text


def test_two_hubs_that_store_at_the_same_time_miss_no_copy(place: DatabasePlace) -> None:
    """As for a moment when one hub takes over from another that has lost its connection."""
    assert place is not None
    count = 40
    hubs = {site: Archive(place, SystemClock(), HALLS) for site in ("west", "east")}

    def store(site: str) -> None:
        for number in range(count):
            event = hall_event(
                f"{site[0]}-{number}", HERE if site == "west" else NEAR, in_tile=site == "west", at_s=5.0 * number
            )
            take(hubs[site], delivered(site, number + 1, event))

    threads = [Thread(target=store, args=(site,)) for site in hubs]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(timeout=HANG_S)
    assert shown(hubs["east"]) == sorted(f"w-{number}" for number in range(count))
    assert len(found(hubs["west"])) == 2 * count
    for archive in hubs.values():
        archive.close()


def test_copies_are_deleted_with_the_events_that_are_shown(archive: Archive) -> None:
    take(archive, delivered("west", 1, hall_event("w", HERE)), delivered("east", 1, hall_event("e", NEAR)))
    event_ns = archive.store.page(Query()).rows[0].time_ns
    assert archive.expire(event_ns + 1) == 2
    assert found(archive) == []


@pytest.mark.parametrize(
    "marks_of_site", [{"copies": 5}, {"copies": [{"site": "x", "id": "y"}], "copy_of": {"site": "x"}}]
)
def test_a_site_marks_no_copies_of_its_own(archive: Archive, marks_of_site: JsonObject) -> None:
    event = {**hall_event("e", HERE), "hall": None, **marks_of_site}
    take(archive, delivered("west", 1, event))
    [stored] = found(archive)
    assert not stored.get("copies")
    assert stored.get("copy_of") is None
