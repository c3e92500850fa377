"""Tracks in zones: who enters, leaves and loiters, with hysteresis."""

from __future__ import annotations

from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from livessl.core.types import Track, TrackState
from livessl.server.api.encode import Messages
from livessl.server.zones.presence import Presence
from livessl.server.zones.zone_map import ZoneMap
from livessl.site.models import Site
from livessl.site.zone_models import Zone
from small_site import site_of

START_NS = 1_767_225_600_000_000_000
L_SHAPE = [[1.0, 1.0], [3.0, 1.0], [3.0, 2.0], [2.0, 2.0], [2.0, 4.0], [1.0, 4.0]]
INSIDE, IN_NOTCH, OUTSIDE = (1.5, 3.0), (2.8, 3.5), (0.3, 0.3)


class Walk:
    """A track that walks through the zones of a site, and what is reported of it."""

    def __init__(self, **zones: Any) -> None:
        self.site: Site = site_of({"zones": zones})
        self.zones = ZoneMap(self.site)
        self.reports: list[dict[str, Any]] = []
        self.presence = Presence(lambda: self.zones, lambda report, _: self.reports.append(report))
        self._messages = Messages(self.site, START_NS, utc=True)

    def at(
        self, second: float, place: tuple[float, float], std_m: float = 0.1, state: str = "update", number: int = 1
    ) -> None:
        position_m = np.array([*place, 1.5])
        time_ns = START_NS + round(second * 1e9)
        track = Track(number, TrackState(state), time_ns, position_m, np.zeros(3), np.eye(3) * std_m**2)
        self.presence.take(track, self._messages.track(track))

    @property
    def changes(self) -> list[tuple[str, str]]:
        return [(report["change"], report["zone"]) for report in self.reports]


def test_track_enters_and_leaves_a_polygon() -> None:
    walk = Walk(hall={"polygon_m": L_SHAPE})
    for second, place in enumerate((OUTSIDE, IN_NOTCH, INSIDE, INSIDE, IN_NOTCH)):
        walk.at(second, place, state="new" if second == 0 else "update")
    assert walk.changes == [("enter", "hall"), ("leave", "hall")]
    enter, leave = walk.reports
    assert (enter["track_id"], enter["start_s"], enter["stay_s"], enter["probability"] > 0.99) == (1, 2.0, 0.0, True)
    assert (leave["start_s"], leave["stay_s"], leave["since_utc"]) == (4.0, 2.0, enter["time_utc"])


def test_track_loiters_once_in_a_stay() -> None:
    walk = Walk(hall={"polygon_m": L_SHAPE, "loiter_s": 3})
    for second in range(8):
        walk.at(second, INSIDE)
    walk.at(8, OUTSIDE)
    for second in range(9, 13):
        walk.at(second, INSIDE)
    assert [each for each, _ in walk.changes] == ["enter", "loiter", "leave", "enter", "loiter"]
    assert [report["stay_s"] for report in walk.reports] == [0.0, 3.0, 8.0, 0.0, 3.0]


@settings(max_examples=20)
@given(st.lists(st.floats(0.9, 1.1), min_size=2, max_size=12), st.floats(0.2, 0.5))
def test_track_at_an_edge_does_not_flicker(places: list[float], std_m: float) -> None:
    """The edge is at x = 1; half a standard deviation beside it, the probability is 0.31 or 0.69."""
    walk = Walk(hall={"polygon_m": [[1.0, 0.0], [4.0, 0.0], [4.0, 5.0], [1.0, 5.0]]})
    walk.at(0, (2.5, 2.5), std_m)
    for second, x in enumerate(places, 1):
        walk.at(second, (x, 2.5), std_m)
    assert walk.changes == [("enter", "hall")]


def test_unsure_position_neither_enters_nor_leaves() -> None:
    walk = Walk(hall={"polygon_m": L_SHAPE})
    walk.at(0, INSIDE, std_m=1.0)
    assert walk.changes == []
    walk.at(1, INSIDE)
    walk.at(2, INSIDE, std_m=0.7)
    assert walk.changes == [("enter", "hall")]


def test_track_that_ends_leaves_all_its_zones() -> None:
    walk = Walk(hall={"polygon_m": L_SHAPE}, all={"bounds_m": [[0, 4], [0, 5], [0, 3]]})
    walk.at(0, INSIDE)
    walk.at(0, INSIDE, number=2)
    walk.at(5, INSIDE, state="end")
    assert walk.changes[4:] == [("leave", "hall"), ("leave", "all")]
    walk.presence.end_all()
    assert [(report["track_id"], report["change"]) for report in walk.reports[6:]] == [(2, "leave")] * 2
    walk.presence.end_all()
    assert len(walk.reports) == 8


def test_track_in_an_excluded_zone_is_nowhere_else() -> None:
    fan = {"bounds_m": [[1.0, 2.0], [2.5, 3.5], [0, 3]], "exclude": True}
    walk = Walk(hall={"polygon_m": L_SHAPE}, fan=fan)
    walk.at(0, (1.5, 1.5))
    walk.at(1, INSIDE)
    walk.at(2, (2.5, 1.5))
    assert walk.changes == [("enter", "hall"), ("leave", "hall"), ("enter", "hall")]


def test_zones_that_change_under_a_track() -> None:
    walk = Walk(hall={"polygon_m": L_SHAPE})
    walk.at(0, INSIDE)
    walk.zones = ZoneMap(walk.site, {"corner": Zone.model_validate({"polygon_m": L_SHAPE})})
    walk.at(1, INSIDE)
    walk.zones = ZoneMap(walk.site, {})
    walk.at(2, INSIDE)
    assert walk.changes == [("enter", "hall"), ("enter", "corner"), ("leave", "corner")]
    assert [change["change"] for change in walk.presence.changes] == ["enter", "enter", "leave"]
