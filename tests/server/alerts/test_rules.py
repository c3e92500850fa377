"""Which events match a rule, and which of those alert."""

from __future__ import annotations

import random
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from alert_desk import ELSEWHERE, alert_site, encoded, refused, sound
from livessl.core.types import Event, Status
from livessl.server.alerts.rules import RuleState, Verdict, judge_event, match
from livessl.server.forwarding.tile import Tile
from livessl.server.zones.zone_map import ZoneMap
from livessl.site.alert_models import AlertRule, EventCondition

ZONES = ZoneMap(alert_site())
EAGER = {"hold_off_s": 0}


def rule(events: dict[str, Any], **more: Any) -> AlertRule:
    return AlertRule.model_validate({"events": events, **more})


def matches(condition: dict[str, Any], event: Event) -> bool:
    events = rule(condition).events
    assert events is not None
    return match(events, encoded(event), ZONES) is not None


def verdicts(judged: AlertRule, *events: Event, state: RuleState | None = None) -> list[Verdict]:
    found = []
    state = state or RuleState()
    for event in events:
        verdict, state = judge_event(judged, state, encoded(event), event.start_ns, "UTC")
        found.append(verdict)
    return found


@pytest.mark.parametrize(
    ("condition", "event", "expected"),
    [
        ({}, sound(position_m=ELSEWHERE), True),
        ({"zones": ["door"]}, sound(), True),
        ({"zones": ["door"]}, sound(position_m=ELSEWHERE), False),
        ({"min_confidence": 0.9}, sound(confidence=0.9), True),
        ({"min_confidence": 0.9}, sound(confidence=0.89), False),
        ({"min_level_dbfs": -20.5}, sound(power=0.01), True),
        ({"min_level_dbfs": -19.5}, sound(power=0.01), False),
        ({"min_level_dbfs": -200}, sound(power=0.0), False),
        ({"min_duration_s": 0.5}, sound(), True),
        ({"min_duration_s": 0.55}, sound(), False),
        ({}, sound(status=Status.DIRECTION_ONLY), False),
        ({"statuses": ["direction-only"]}, sound(status=Status.DIRECTION_ONLY), True),
        ({"statuses": ["direction-only"]}, sound(), False),
        ({}, refused(), False),
        ({"statuses": ["located", "direction-only"]}, refused(), False),
    ],
)
def test_conditions(condition: dict[str, Any], event: Event, expected: bool) -> None:
    assert matches(condition, event) is expected


@settings(max_examples=20)
@given(std_m=st.floats(0.01, 2.0), threshold=st.floats(0.05, 0.95))
def test_uncertain_position_is_in_the_zone_only_with_enough_probability(std_m: float, threshold: float) -> None:
    """The door's walls are at 0, its free sides at 1 m: within them is the square of one axis, and z hardly counts."""
    condition = rule({"zones": ["door"], "probability": threshold}).events
    assert condition is not None
    event = encoded(sound(std_m=std_m))
    probability = ZONES.probabilities(event["position_m"], event["covariance_m2"])["door"]
    found = match(condition, event, ZONES)
    assert (found is not None) is (probability >= threshold)
    assert found is None or found.zones == {"door": probability}


def test_position_in_the_zone_does_not_match_if_it_is_too_uncertain() -> None:
    assert matches({"zones": ["door"], "probability": 0.5}, sound(std_m=0.2))
    assert not matches({"zones": ["door"], "probability": 0.5}, sound(std_m=2.0))


def test_position_outside_the_zone_matches_if_it_is_probable_enough() -> None:
    beside = (1.05, 0.5, 1.0)
    assert matches({"zones": ["door"], "probability": 0.2}, sound(position_m=beside, std_m=0.2))
    assert not matches({"zones": ["door"], "probability": 0.2}, sound(position_m=beside, std_m=0.02))


def test_hold_off_suppresses_until_it_has_passed_since_the_last_alert() -> None:
    held = rule({}, hold_off_s=10)
    events = [sound(number, at_s=at_s) for number, at_s in enumerate((0, 9.9, 10, 19, 20.5))]
    assert verdicts(held, *events) == ["alert", "held-off", "alert", "held-off", "alert"]


def test_sound_that_was_held_off_stays_so_when_its_final_result_comes_after_a_later_alert() -> None:
    held = rule({}, hold_off_s=60)
    events = [sound(number, at_s=at_s) for number, at_s in enumerate((0, 50, 120))]
    assert verdicts(held, *events, events[1]) == ["alert", "held-off", "alert", "held-off"]


def test_nothing_alerts_that_began_before_the_rule_was_armed() -> None:
    events = [sound(number) for number in range(3)]
    state = RuleState(armed_since_ns=events[1].start_ns)
    assert verdicts(rule({}, **EAGER), *events, state=state) == ["disarmed", "alert", "alert"]
    assert verdicts(rule({}), events[2], state=RuleState(armed=False)) == ["disarmed"]


def test_schedule_is_compared_with_the_start_of_the_event() -> None:
    scheduled = rule({}, schedule=[{"days": ["thu"], "begin": "00:00", "end": "00:01"}], **EAGER)
    assert verdicts(scheduled, sound(at_s=59), sound(at_s=60)) == ["alert", "off-schedule"]


def test_count_in_a_span_alerts_at_the_last_one_and_then_counts_anew() -> None:
    counting = rule({"count": 3, "within_s": 10}, **EAGER)
    events = [sound(number, at_s=at_s) for number, at_s in enumerate((0, 4, 11, 12, 13, 13.5, 14))]
    found = verdicts(counting, *events)
    assert found == ["counting", "counting", "counting", "alert", "counting", "counting", "alert"]


@settings(max_examples=25)
@given(st.lists(st.integers(0, 5), min_size=1, max_size=12), st.integers(1, 4))
def test_an_event_judged_again_counts_once(numbers: list[int], count: int) -> None:
    counting = rule({"count": count, "within_s": 1000} if count > 1 else {}, **EAGER)
    distinct: set[int] = set()
    state = RuleState()
    for number in numbers:
        event = sound(number)
        verdict, state = judge_event(counting, state, encoded(event), event.start_ns, "UTC")
        distinct.add(number)
        assert (verdict is Verdict.ALERT) is (len(distinct) >= count)
        if verdict is Verdict.ALERT:
            return


def test_a_final_event_takes_the_place_of_the_early_one_that_it_replaces() -> None:
    counting = rule({"count": 2, "within_s": 60}, **EAGER)
    early, final, other = sound(1), sound(2), sound(3)
    _, state = judge_event(counting, RuleState(), encoded(early), early.start_ns, "UTC")
    verdict, state = judge_event(counting, state, encoded(final, [early.id]), final.start_ns, "UTC")
    assert verdict is Verdict.COUNTING
    assert judge_event(counting, state, encoded(other), other.start_ns, "UTC")[0] is Verdict.ALERT


@settings(max_examples=20)
@given(st.lists(st.integers(0, 8), min_size=1, max_size=30), st.integers(2, 4), st.sampled_from([0.0, 1e-3]))
def test_an_event_counts_towards_one_alert_however_often_it_is_judged(
    numbers: list[int], count: int, hold_off_s: float
) -> None:
    counting = rule({"count": count, "within_s": 1000}, hold_off_s=hold_off_s)
    found = verdicts(counting, *(sound(number) for number in numbers))
    assert found.count(Verdict.ALERT) == len(set(numbers)) // count


def test_final_events_count_no_more_if_their_early_ones_have() -> None:
    counting = rule({"count": 3, "within_s": 60, "early": True}, hold_off_s=10)
    early, finals, new = ([sound(first + number) for number in range(3)] for first in (0, 10, 20))
    state = RuleState()
    for event in early:
        verdict, state = judge_event(counting, state, encoded(event), event.start_ns, "UTC")
    assert verdict is Verdict.ALERT
    for event, before in zip(finals, early, strict=True):
        again = encoded(event, [before.id])
        assert judge_event(counting, state, again, before.start_ns, "UTC")[0] is Verdict.COUNTED
        _, state = judge_event(counting, state, again, before.start_ns, "UTC")
    assert verdicts(counting, *finals, *new, state=state) == [*["counted"] * 3, "counting", "counting", "alert"]


def test_match_that_does_not_alert_is_counted_once_as_suppressed() -> None:
    held = rule({"early": True}, hold_off_s=60)
    state = RuleState()
    for event in (sound(0), sound(1), sound(2), sound(1), sound(2)):
        _, state = judge_event(held, state, encoded(event), event.start_ns, "UTC")
    assert state.suppressed == {"held-off": 2}


def test_state_survives_its_text() -> None:
    state = RuleState(armed=False, armed_since_ns=5, alerted_ns=(7,), recent=((1, "a"),), ongoing=("north",), alerts=3)
    state = replace(state, counted=("b",), noted=("c", "d"))
    state = state.noting(Verdict.HELD_OFF, 9)
    assert RuleState.restored(state.as_json()) == state


def test_state_of_an_older_version_can_be_read() -> None:
    stored = {name: value for name, value in RuleState(alerts=3).as_json().items() if name not in ("counted", "noted")}
    assert RuleState.restored(stored) == RuleState(alerts=3)


def test_events_in_any_order_within_the_span_alert_once() -> None:
    counting = rule({"count": 3, "within_s": 60}, **EAGER)
    events = [sound(number) for number in range(3)]
    random.Random(4).shuffle(events)
    assert verdicts(counting, *events) == ["counting", "counting", "alert"]


def test_a_rule_without_zones_leaves_sounds_in_a_neighbours_tile_to_the_neighbour() -> None:
    """Both servers of a hall locate them; a rule that names zones means them wherever they are."""
    tile = Tile("works", ((0.0, 0.0), (4.0, 0.0), (4.0, 1.0), (0.0, 1.0)), frozenset(("north",)))
    here, there = (encoded(sound(position_m=(0.5, y_m, 1.0))) for y_m in (0.5, 4.0))
    anything = EventCondition()
    assert [match(anything, event, ZONES, tile) is not None for event in (here, there)] == [True, False]
    assert match(anything, there, ZONES) is not None
    door = EventCondition(zones=("door",))
    far = Tile("works", ((3.0, 4.0), (4.0, 4.0), (4.0, 5.0)), frozenset(("north",)))
    assert match(door, here, ZONES, far) is not None
