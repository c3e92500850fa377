"""Which events of the servers of a hall are one sound: rules by hand, and properties over drawn events."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import combinations, permutations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from livessl.federation.one_sound import LEAST_OVERLAP, SAME_PLACE, SLACK_NS, Name, Sighting, cost, sighting, sounds

SECOND_NS = 1_000_000_000
START_NS = 1_767_225_600 * SECOND_NS
LOCATED, DIRECTION, REFUSED = 0, 1, 2


def seen(
    site: str,
    x_m: float = 0.0,
    *,
    at_s: float = 0.0,
    for_s: float = 1.0,
    std_m: float = 0.1,
    rank: int = LOCATED,
    in_tile: bool = False,
    heard_by: str = "",
    number: int = 0,
) -> Sighting:
    """An event of a site on a line; the letters of `heard_by` are the arrays that detected it."""
    start_ns = START_NS + round(at_s * SECOND_NS)
    places_m = np.empty((0, 3)) if rank == REFUSED else np.array([[x_m, 0.0, 0.0]])
    end_ns = start_ns + round(for_s * SECOND_NS)
    name, heard = Name(site, str(number)), frozenset(heard_by)
    return Sighting(name, start_ns, end_ns, rank, places_m, np.eye(3) * std_m**2, in_tile, heard)


def named(groups: list[list[Sighting]]) -> list[list[str]]:
    """The sites of the events of each sound, the kept one first, in the order of the kept ones."""
    return sorted([event.name.site + event.name.id.replace("0", "") for event in group] for group in groups)


def limit_m(std_m: float = 0.1) -> float:
    """Largest distance of two positions of one sound, both with this standard deviation."""
    return math.sqrt(2.0 * SAME_PLACE) * std_m


def test_events_at_one_place_and_time_are_one_sound() -> None:
    assert named(sounds([seen("a"), seen("b", 0.1)])) == [["a", "b"]]


@pytest.mark.parametrize("share", [0.99, 1.01])
def test_positions_agree_within_the_limit_of_their_covariances(share: float) -> None:
    assert len(sounds([seen("a"), seen("b", share * limit_m())])) == (1 if share < 1.0 else 2)


def test_two_sounds_far_apart_at_the_same_time_stay_two() -> None:
    assert named(sounds([seen("a"), seen("b", 20.0)])) == [["a"], ["b"]]


def test_two_sounds_at_one_place_one_after_the_other_stay_two() -> None:
    assert named(sounds([seen("a"), seen("b", at_s=1.2)])) == [["a"], ["b"]]


def test_a_short_sound_that_reaches_the_arrays_of_one_server_a_frame_later_is_one() -> None:
    assert SLACK_NS == 0.1 * SECOND_NS
    assert len(sounds([seen("a", for_s=0.05), seen("b", at_s=0.1, for_s=0.05)])) == 1


def test_parts_of_a_lasting_sound_are_joined_to_the_part_that_they_overlap_most() -> None:
    """Two servers that cut a lasting sound half a second apart do not chain all parts together."""
    assert LEAST_OVERLAP == 0.5
    parts = [
        seen(site, at_s=10.0 * n + late, for_s=10.0, number=n)
        for site, late in (("a", 0.0), ("b", 0.5))
        for n in range(4)
    ]
    assert named(sounds(parts)) == [["a", "b"], ["a1", "b1"], ["a2", "b2"], ["a3", "b3"]]


def test_events_of_one_server_are_never_one_sound() -> None:
    assert named(sounds([seen("a"), seen("a", number=1)])) == [["a"], ["a1"]]


def test_of_two_events_of_one_server_the_likelier_one_is_matched() -> None:
    assert named(sounds([seen("a", 0.3), seen("a", 0.05, number=1), seen("b")])) == [["a"], ["a1", "b"]]


def test_two_sounds_near_each_other_are_matched_one_to_one() -> None:
    """Also where the best partner of an event is taken by a better pair."""
    events = [seen("a", 0.0), seen("a", 0.3, number=1), seen("b", 0.12), seen("b", 0.5, number=1)]
    assert named(sounds(events)) == [["a", "b"], ["a1", "b1"]]


def test_a_vague_event_does_not_take_the_partner_of_a_sharp_one() -> None:
    """The squared distance alone would prefer it, because its covariance is large."""
    events = [seen("a", 0.4, std_m=2.0), seen("a", 0.1, std_m=0.1, number=1), seen("b", std_m=0.1)]
    assert named(sounds(events)) == [["a"], ["a1", "b"]]


def test_an_uncertain_event_does_not_join_two_sounds_at_different_places() -> None:
    """It agrees with both of them, and joins the nearer one."""
    sharp = [seen("a"), seen("c", 1.5)]
    assert cost(*sharp) is None
    for x_m, wanted in ((0.7, [["a", "b"], ["c"]]), (0.8, [["a"], ["c", "b"]])):
        vague = seen("b", x_m, std_m=0.4)
        assert None not in [cost(vague, each) for each in sharp]
        assert named(sounds([*sharp, vague])) == wanted


def test_a_direction_or_a_refusal_joins_no_two_sounds_either() -> None:
    for rank in (DIRECTION, REFUSED):
        unsure = seen("b", 0.75, std_m=5.0, rank=rank, heard_by="x")
        groups = named(sounds([seen("a", heard_by="x"), seen("c", 1.5, heard_by="x"), unsure]))
        assert sorted(len(group) for group in groups) == [1, 2]


def test_four_servers_at_a_corner_find_two_sounds_each() -> None:
    events = [seen(site, x, number=n) for site in "abcd" for n, x in enumerate((0.0, 3.0))]
    assert named(sounds(events)) == [["a", "b", "c", "d"], ["a1", "b1", "c1", "d1"]]


def test_the_event_in_the_tile_of_its_own_server_is_kept() -> None:
    assert named(sounds([seen("a"), seen("b", std_m=0.2, in_tile=True)])) == [["b", "a"]]


@pytest.mark.parametrize("in_tile", [True, False])
def test_the_more_certain_event_is_kept_if_both_or_none_are_in_their_tiles(in_tile: bool) -> None:
    events = [seen("a", std_m=0.2, in_tile=in_tile), seen("b", in_tile=in_tile)]
    assert named(sounds(events)) == [["b", "a"]]
    assert named(sounds([seen("b"), seen("a")])) == [["a", "b"]]  # and else the first name


def test_a_located_event_is_kept_before_a_direction_and_a_refusal() -> None:
    direction = seen("a", rank=DIRECTION, in_tile=True, heard_by="xy")
    events = [seen("b", heard_by="xy"), seen("c", rank=REFUSED, heard_by="y"), direction]
    assert named(sounds(events)) == [["b", "a", "c"]]


def test_a_direction_that_agrees_with_two_sounds_does_not_join_them() -> None:
    events = [seen("a", 0.0), seen("b", 10.0), seen("c", 5.5, std_m=5.0, rank=DIRECTION)]
    assert named(sounds(events)) == [["a"], ["b", "c"]]


def test_any_candidate_of_an_ambiguous_event_may_be_the_place() -> None:
    ambiguous = replace(seen("a", rank=DIRECTION), places_m=np.array([[9.0, 0.0, 0.0], [0.1, 0.0, 0.0]]))
    assert named(sounds([ambiguous, seen("b")])) == [["b", "a"]]


def test_a_refused_event_joins_a_sound_that_most_of_its_arrays_detected() -> None:
    located = seen("b", heard_by="vwxy")
    assert named(sounds([seen("a", rank=REFUSED, heard_by="xz"), located])) == [["b", "a"]]
    assert named(sounds([seen("a", rank=REFUSED, heard_by="xzt"), located])) == [["a"], ["b"]]
    assert named(sounds([seen("a", rank=REFUSED), located])) == [["a"], ["b"]]


def test_refused_events_of_two_servers_with_the_same_arrays_are_one() -> None:
    events = [seen("a", rank=REFUSED, heard_by="x"), seen("b", rank=REFUSED, heard_by="xy")]
    assert named(sounds(events)) == [["b", "a"]]  # more arrays detected it there


def test_an_event_is_read_as_a_hub_stores_it() -> None:
    stored = {
        "site": "a",
        "id": "a-1",
        "time_utc": "2026-01-01T00:00:00.050000Z",
        "duration_s": 0.85,
        "status": "direction-only",
        "position_m": [2.0, 0.0, 1.0],
        "covariance_m2": [[0.01, 0.0, 0.0], [0.0, 0.01, 0.0], [0.0, 0.0, 0.01]],
        "contributions": [{"azimuth_deg": 90.0, "elevation_deg": 0.0, "distance_m": 4.0}],
        "heard_by": ["west"],
        "hall": {"name": "works", "in_tile": True},
    }
    read = sighting(stored)
    assert (read.name, read.rank, read.in_tile, read.heard_by) == (
        Name("a", "a-1"),
        DIRECTION,
        True,
        frozenset(("west",)),
    )
    assert (read.start_ns, read.end_ns) == (START_NS + 50_000_000, START_NS + 900_000_000)
    assert np.diag(read.covariance_m2) == pytest.approx([0.01, 4.01, 0.01])  # 2 m along the line of sight
    refused = sighting({**stored, "status": "refused", "position_m": None, "covariance_m2": None})
    assert (refused.rank, len(refused.places_m)) == (REFUSED, 0)


@st.composite
def crowds(draw: st.DrawFn) -> list[Sighting]:
    """Events of up to four servers, crowded in time and place."""
    count = draw(st.integers(1, 9))
    tenths = st.integers(0, 12).map(lambda n: n / 10.0)
    return [
        seen(
            draw(st.sampled_from("abcd")),
            draw(tenths),
            at_s=draw(tenths),
            for_s=draw(tenths),
            std_m=draw(st.sampled_from((0.05, 0.1, 0.4))),
            rank=draw(st.sampled_from((LOCATED, LOCATED, DIRECTION, REFUSED))),
            in_tile=draw(st.booleans()),
            heard_by=draw(st.sampled_from(("", "x", "xy", "yz", "wxyz"))),
            number=number,
        )
        for number in range(count)
    ]


@given(crowds(), st.randoms(use_true_random=False))
def test_the_order_of_events_does_not_matter(events: list[Sighting], random: object) -> None:
    shuffled = list(events)
    random.shuffle(shuffled)  # type: ignore[attr-defined]
    assert named(sounds(shuffled)) == named(sounds(events))


@given(crowds())
def test_the_cost_of_a_pair_is_the_same_from_both_sides(events: list[Sighting]) -> None:
    for one, other in permutations(events, 2):
        assert cost(one, other) == cost(other, one)


@given(crowds())
def test_all_located_events_of_a_sound_agree_with_each_other(events: list[Sighting]) -> None:
    for group in sounds(events):
        located = [event for event in group if event.rank == LOCATED]
        assert all(cost(one, other) is not None for one, other in combinations(located, 2))


@given(crowds())
def test_each_event_is_in_one_sound_which_has_one_event_of_each_server_at_most(events: list[Sighting]) -> None:
    found = sounds(events)
    assert sorted(event.name for group in found for event in group) == sorted(event.name for event in events)
    for group in found:
        sites = [event.name.site for event in group]
        assert len(sites) == len(set(sites))
        assert group[0] is min(group, key=lambda event: event.merit)


@given(crowds())
def test_sounds_that_are_not_connected_do_not_change_each_other(events: list[Sighting]) -> None:
    """So a hub may decide about the events that are connected with a new one, and look at no others."""
    far = [moved(event) for event in events]
    assert named(sounds([*events, *far])) == sorted(named(sounds(events)) + named(sounds(far)))


def moved(event: Sighting) -> Sighting:
    """The same event an hour later, under another name."""
    hour_ns, name = 3600 * SECOND_NS, Name(event.name.site, f"{event.name.id}-far")
    return replace(event, name=name, start_ns=event.start_ns + hour_ns, end_ns=event.end_ns + hour_ns)
