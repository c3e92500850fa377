"""Which events of a server in a hall go to the hub, and with what."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from alert_desk import encoded, sound
from livessl.core.stream import verdict
from livessl.core.types import Status
from livessl.server.api.encode import JsonObject
from livessl.server.forwarding.tile import MARGIN_M, Tile
from livessl.server.forwarding.whereabouts import RANGE_UNKNOWN
from livessl.site.polygon import distance_m
from small_site import site_of

CORNERS = ((0.0, 0.0), (2.0, 0.0), (2.0, 4.0), (0.0, 4.0))
TILE = Tile("works", CORNERS, frozenset(("north",)))


def event(
    position_m: Sequence[float] | None, heard_by: Sequence[str] = ("north", "south"), **changes: Any
) -> JsonObject:
    changed = {**({"status": Status.REFUSED} if position_m is None else {}), **changes}
    return {**encoded(sound(position_m=position_m, **changed)), "heard_by": list(heard_by)}


@pytest.mark.parametrize(
    ("x_m", "std_m", "wanted"),
    [
        (1.9, 0.05, {"name": "works", "in_tile": True}),
        (2.0, 0.05, {"name": "works", "in_tile": True}),
        (2.1, 0.05, {"name": "works", "in_tile": False}),
        (2.0 + MARGIN_M - 0.01, 0.05, {"name": "works", "in_tile": False}),
        (2.0 + MARGIN_M + 0.01, 0.05, None),
        (3.4, 0.5, {"name": "works", "in_tile": False}),  # less than three standard deviations outside
        (3.6, 0.5, None),
    ],
)
def test_events_in_the_tile_and_near_it_are_sent(x_m: float, std_m: float, wanted: JsonObject | None) -> None:
    given_event = event((x_m, 2.0, 1.0), std_m=std_m)
    sent = TILE.sent(given_event)
    assert sent == (None if wanted is None else {**given_event, "hall": wanted})


def test_a_direction_is_sent_if_a_place_along_it_may_be_in_the_tile() -> None:
    far = {**event((9.0, 2.0, 1.0), status=Status.DIRECTION_ONLY), "contributions": []}
    assert TILE.sent(far) is None
    towards = [{"array": "north", "azimuth_deg": 0.0, "elevation_deg": 0.0, "distance_m": 8.0}]
    assert TILE.sent({**far, "contributions": towards}) is not None
    assert TILE.sent({**far, "contributions": [{**towards[0], "distance_m": 4.0}]}) is None
    places = [{"position_m": [x, 2.0, 1.0], "probability": 0.5} for x in (9.0, 1.0)]
    assert TILE.sent({**far, "candidates": places}) is not None


def test_candidates_at_a_known_distance_are_places() -> None:
    """A sound beyond the search volume, deep in a neighbour's tile, is not sent: other arrays confirm its distance."""
    assert RANGE_UNKNOWN == verdict.RANGE_UNKNOWN
    far = event((9.0, 2.0, 1.0), status=Status.DIRECTION_ONLY)
    seen = [{"array": name, "azimuth_deg": 0.0, "elevation_deg": 0.0, "distance_m": 8.0} for name in ("north", "south")]
    places = [{"position_m": [x, 2.0, 1.0], "probability": 0.5} for x in (9.0, 6.0)]
    assert TILE.sent({**far, "candidates": places, "contributions": seen}) is None
    assert TILE.sent({**far, "candidates": places, "contributions": seen[:1]}) is not None
    assert TILE.sent({**far, "candidates": [], "contributions": seen}) is not None


@pytest.mark.parametrize(("heard_by", "is_sent"), [(("north",), True), (("south",), False), ((), True)])
def test_a_refused_event_is_sent_if_an_array_of_the_tile_detected_it(heard_by: Sequence[str], is_sent: bool) -> None:
    sent = TILE.sent(event(None, heard_by))
    assert (sent is not None) == is_sent
    assert sent is None or sent["hall"] == {"name": "works", "in_tile": False}


def test_the_arrays_of_a_tile_are_those_whose_centre_is_inside() -> None:
    hub = {
        "servers": ["nats://127.0.0.1:4222"],
        "hall": {"name": "works", "tile_m": [[0, 0], [4, 0], [4, 2.5], [0, 2.5]]},
    }
    tile = Tile.of(site_of({"server.events_db": "events.sqlite", "server.hub": hub}))
    assert tile is not None
    assert tile.hall == "works"
    assert tile.sent(event(None, ["north"])) is not None
    assert tile.sent(event(None, ["south"])) is None
    assert Tile.of(site_of()) is None


@given(st.floats(-10, 10), st.floats(-10, 10))
def test_a_point_is_as_far_outside_a_rectangle_as_its_coordinates_say(x: float, y: float) -> None:
    wanted = (max(0.0, -x, x - 2.0) ** 2 + max(0.0, -y, y - 4.0) ** 2) ** 0.5
    assert distance_m(CORNERS, x, y) == pytest.approx(wanted, abs=1e-9)
