"""Arrays joined on the grid of frames: whatever comes, when it comes, or does not come at all."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from free_field import C_M_S, RATE_HZ, tetra
from fusion_steps import (
    DEADLINE,
    GRID,
    HANG_OVER,
    NORTH,
    SOURCE_M,
    SOUTH,
    START,
    Arrivals,
    Scripted,
    events_of,
    frame,
    fusion_of,
    live,
    mark,
    node,
    now_ns,
    only_event,
    play,
    position_of,
    sound_frames,
    state_of,
    status_of,
    told,
)
from livessl.core.joint_array import joined
from livessl.core.locate.estimator import Localization, Sound
from livessl.core.locate.srp_phat import SrpPhat
from livessl.core.stream.array_health import ArrayState
from livessl.core.stream.fusion import EVENTS_ONLY, Fusion
from livessl.core.types import (
    FRAME_NS,
    Event,
    Status,
    Track,
    TrackState,
)


@pytest.fixture(scope="module")
def located() -> SrpPhat:
    return SrpPhat([NORTH, SOUTH], GRID, C_M_S)


# --- what an event is made of


def test_two_arrays_locate_together(located: SrpPhat) -> None:
    frames = [sound_frames(spec, 10, 6) for spec in (NORTH, SOUTH)]
    said = play(fusion_of(located), live(frames[0], 30) + live(frames[1], 30), 30)
    ((when, event),) = events_of(said)
    assert (event.status, event.reason) == (Status.LOCATED, None)
    assert event.heard_by == ("north", "south")
    assert event.id == f"site-{(START + 10) * 50}"  # site and milliseconds
    # all of the burst; 1 mm is derived at the estimator's test, and the frames cut off only its faded ends
    assert np.linalg.norm(position_of(event) - SOURCE_M) < 2e-3
    assert event.start_ns == now_ns(10)
    assert event.duration_s == pytest.approx(0.3)
    assert event.power == max(made.power for some in frames for made in some)
    assert event.method == "srp-phat"
    assert event.late_frames == 0
    # out when the hang-over has been seen to be quiet: the interval 15 + 6 ends at 22
    assert when == 16 + HANG_OVER
    assert event.latency_s == pytest.approx(HANG_OVER * 0.05)
    assert event.complete_ns - event.end_ns == HANG_OVER * FRAME_NS
    for contribution, spec in zip(event.contributions, (NORTH, SOUTH), strict=True):
        assert contribution.array == spec.name
        assert contribution.active_s == pytest.approx(0.3)
        assert contribution.distance_m == pytest.approx(float(np.linalg.norm(SOURCE_M - spec.centre_m)), abs=2e-3)
    assert event.contributions[0].azimuth_deg == pytest.approx(np.degrees(np.arctan2(3.31 - 4.2, 1.13 - 2.7)), abs=0.2)


def test_clocks_may_differ_by_a_fraction_of_a_frame(located: SrpPhat) -> None:
    """An array's clock a whole frame off costs nothing: delays are formed within an array only."""
    frames = [sound_frames(spec, first, 6) for spec, first in ((NORTH, 10), (SOUTH, 11))]
    event = only_event(play(fusion_of(located), live(frames[0], 30) + live(frames[1], 30), 30))
    assert np.linalg.norm(position_of(event) - SOURCE_M) < 2e-3


def test_sounds_apart_are_two_events_of_one_array_each() -> None:
    arrivals = node("north", range(10, 16), range(50)) + node("south", range(30, 36), range(50))
    assert [event.heard_by for _, event in events_of(play(fusion_of(), arrivals, 50))] == [("north",), ("south",)]
    # a pause within the hang-over does not part them
    arrivals = node("north", range(10, 16), range(50)) + node("south", range(16 + HANG_OVER - 1, 30), range(50))
    assert only_event(play(fusion_of(), arrivals, 50)).heard_by == ("north", "south")


def test_one_small_array_gives_only_a_direction() -> None:
    spec = tetra("north", NORTH.centre_m, edge_m=0.06)
    fusion = Fusion(state_of(SrpPhat([spec], GRID, C_M_S), [spec]), EVENTS_ONLY)
    event = only_event(play(fusion, live(sound_frames(spec, 10, 6, noise=0.03), 30), 30))
    # Its lags change with distance by d^2 / (2 c R^2) = 1.6 us a metre; side lobes of 0.1 in the GCCs leave them
    # uncertain by s / sqrt(kappa) = 0.1 / 22 kHz = 5 us.
    assert event.status is Status.DIRECTION_ONLY
    assert event.reason is not None
    assert event.reason.startswith("one array cannot resolve the distance: ±")
    towards, right = position_of(event) - spec.centre_m, SOURCE_M - spec.centre_m
    # the direction by 5 us of 0.06 m over sqrt(3) independent lags, 0.9 degrees; by far less in truth, at 10 dB
    assert towards @ right / np.linalg.norm(towards) / np.linalg.norm(right) > np.cos(np.radians(0.9))


def test_distance_from_a_wide_array_is_at_least_half_its_aperture() -> None:
    """Half a centimetre from its middle, a place may be as uncertain as a quarter of the half width, not of that."""
    both = joined([NORTH, SOUTH], {"north": "rack", "south": "rack"}, "both")

    def judged(spread_m: float) -> Status:
        class Uncertain(Scripted):
            def locate(self, sounds: Mapping[str, Sound]) -> Localization:
                place_m = both.centre_m + np.array([0.003, -0.004, 0.0])
                return replace(super().locate(sounds), position_m=place_m, covariance_m2=spread_m**2 * np.eye(3))

        frames = [frame("both", k, samples=np.ones((8, 20), dtype=np.float32)) for k in (10, 11)]
        return only_event(play(Fusion(state_of(Uncertain(), [both]), EVENTS_ONLY), live(frames, 30), 30)).status

    quarter_m = 0.25 * both.aperture_m / 2.0
    assert judged(0.99 * quarter_m) is Status.LOCATED
    assert judged(1.01 * quarter_m) is Status.DIRECTION_ONLY


def test_arrays_of_different_rates_locate_together(located: SrpPhat) -> None:
    north, south = sound_frames(NORTH, 10, 6), sound_frames(SOUTH, 10, 6, 48_000.0)
    fusion = fusion_of(located)
    event = only_event(play(fusion, live(north, 30) + live(south, 30), 30))
    assert event.status is Status.LOCATED
    assert np.linalg.norm(position_of(event) - SOURCE_M) < 2e-3
    rates = [status.sample_rate_hz for status in fusion.status(now_ns(30))]
    assert rates == [16_000.0, 48_000.0]
    # and a rate misread is another place
    wrong = [replace(made, sample_rate_hz=RATE_HZ) for made in south]
    event = only_event(play(fusion_of(located), live(north, 30) + live(wrong, 30), 30))
    assert np.linalg.norm(position_of(event) - SOURCE_M) > 0.02


def test_event_uses_the_exact_rule_and_gaps_divide_segments() -> None:
    scripted = Scripted()
    powers = {10: 1e-2, 11: 1e-3, 12: 0.9e-3, 13: 5e-3, 15: 5e-3}  # the third is under a tenth; 14 never comes
    arrivals: Arrivals = [(k + 1.0, frame("north", k, power=power)) for k, power in powers.items()]
    event = only_event(play(fusion_of(scripted), arrivals + node("north", (), range(16, 30)), 30))
    assert scripted.calls == [{"north": [40, 20, 20]}]  # of 20 samples a frame
    (contribution,) = event.contributions
    assert contribution.active_s == pytest.approx(0.2)
    assert contribution.power == pytest.approx(np.mean([1e-2, 1e-3, 5e-3, 5e-3]))
    assert event.power == 1e-2
    assert (event.start_ns, event.end_ns) == (now_ns(10), now_ns(16))


def test_event_begins_in_the_pre_roll_where_the_exact_rule_is_met() -> None:
    """Live it was too soft to be sound, knowing only the past; it is a tenth of what then came."""
    arrivals: Arrivals = [(k + 1.0, mark("north", k)) for k in range(10)]
    arrivals += [(11.0, frame("north", k, False, 2e-3)) for k in (8, 9)]
    arrivals += node("north", (), range(16, 30))
    arrivals += [(11.0, frame("north", 10)), *((k + 1.0, frame("north", k, False, 1e-7)) for k in range(11, 16))]
    event = only_event(play(fusion_of(), arrivals, 30))
    assert event.start_ns == now_ns(8)
    assert event.id == f"site-{(START + 10) * 50}"  # stable: it was told already in updates


def test_event_of_too_few_arrays_is_refused() -> None:
    scripted = Scripted()
    arrivals = node("north", range(10, 15), range(30)) + node("south", (), range(30))
    event = only_event(play(fusion_of(scripted, min_arrays=2, updates=True), arrivals, 30))
    assert (event.status, event.estimate, event.contributions) == (Status.REFUSED, None, ())
    assert event.reason == "detected by 1 array; fusion.min_arrays is 2"
    assert event.heard_by == ("north",)
    assert scripted.calls == []


# --- order and time


@settings(deadline=None, max_examples=25)
@given(data=st.data())
def test_order_between_arrays_does_not_matter(data: st.DataObject, located: SrpPhat) -> None:
    queues = [
        [m for _, m in sorted(live(sound_frames(spec, 10, 5), 24), key=lambda arrival: arrival[0])]
        for spec in (NORTH, SOUTH)
    ]
    straight = fusion_of(located)
    expected = straight.step([m for pair in zip(*queues, strict=True) for m in pair], now_ns(24))
    expected += straight.flush(now_ns(24))
    turns = data.draw(st.permutations([0] * len(queues[0]) + [1] * len(queues[1])), label="whose turn")
    batches = data.draw(st.lists(st.integers(1, 48), min_size=1), label="messages a step")
    fusion, outputs = fusion_of(located), []
    mixed = [queues[who].pop(0) for who in turns]
    while mixed:
        size = batches.pop(0) if batches else len(mixed)
        outputs += fusion.step(mixed[:size], now_ns(24))
        mixed = mixed[size:]
    outputs += fusion.flush(now_ns(24))
    assert told(outputs) == told(expected)
    assert '"located"' in told(expected)


def test_result_is_the_same_live_and_all_at_once() -> None:
    active = {*range(10, 17), *range(40, 95)}
    arrivals = node("north", active, range(120)) + node("south", active, range(120))
    one, other = Scripted(), Scripted()
    parted = [event for _, event in events_of(play(fusion_of(one, max_event_s=1.0), arrivals, 120))]
    fusion = fusion_of(other, max_event_s=1.0)
    at_once = fusion.step([message for _, message in arrivals], now_ns(120)) + fusion.flush(now_ns(120))
    assert told(at_once) == told(replace(event, latency_s=(now_ns(120) - event.end_ns) / 1e9) for event in parted)
    assert one.calls == other.calls
    assert len(parted) == 4


@pytest.mark.parametrize("stops", [0, 5, 12, 18])
def test_silent_array_delays_an_event_by_at_most_the_deadline(stops: int) -> None:
    """It stops sending before, in or after a sound of the other array; one deadline later it is not awaited."""
    prompt = 16 + HANG_OVER
    arrivals = node("north", range(10, 16), range(60)) + node("south", range(10, 16), range(stops))
    ((when, event),) = events_of(play(fusion_of(), arrivals, 60))
    # its first missing interval is closed a deadline after the other's has come; then all that have come meanwhile
    assert when == max(prompt, stops + 1 + DEADLINE if stops else 0)
    assert event.heard_by == (("north", "south") if stops > 10 else ("north",))


def test_delay_follows_the_chosen_deadline() -> None:
    arrivals = node("north", range(10, 16), range(60)) + node("south", (), range(12))
    for deadline_s in (0.1, 0.5, 1.0):
        ((when, _),) = events_of(play(fusion_of(deadline_s=deadline_s), arrivals, 60))
        assert when == max(22, 13 + round(deadline_s / 0.05))


def test_late_array_is_awaited_up_to_the_deadline() -> None:
    for delay, heard_by in ((DEADLINE - 1, ("north", "south")), (3 * DEADLINE, ("north",))):
        arrivals = node("north", range(10, 16), range(80)) + node("south", range(10, 16), range(80), delay)
        (when, event), *_ = events_of(play(fusion_of(), arrivals, 80))
        assert event.heard_by == heard_by
        assert when <= 22 + DEADLINE


def test_array_that_was_away_is_used_again() -> None:
    active = {*range(10, 16), *range(60, 66), *range(100, 106)}
    south = [
        (max(when, 46.0) if 5 <= message.frame_index - START < 45 else when, message)
        for when, message in node("south", active, range(140))
    ]
    south = [(when + (4.0 if message.frame_index - START >= 95 else 0.0), message) for when, message in south]
    fusion = fusion_of()
    said = events_of(play(fusion, node("north", active, range(140)) + south, 140))
    assert [event.heard_by for _, event in said] == [("north",), ("north", "south"), ("north", "south")]
    # and it is waited for again: the third time it is 0.2 s behind
    assert [when for when, _ in said] == [22, 72, 116]
    assert status_of(fusion, "south", 140).counters["late"] == 6


def test_array_that_is_always_late_delays_no_event() -> None:
    active = range(100, 106)
    arrivals = node("north", active, range(140)) + node("south", active, range(140), 3 * DEADLINE)
    (when, event), *_ = events_of(play(fusion_of(), arrivals, 140))
    assert (when, event.heard_by) == (106 + HANG_OVER, ("north",))


def test_array_that_is_punctual_again_is_awaited() -> None:
    """Behind by less than the deadline, it never comes first again; but it need not."""
    active = {*range(10, 16), *range(100, 106)}
    south = node("south", active, range(140), 3 * DEADLINE)
    south = [(max(when - 25, 80.0) if message.frame_index - START >= 50 else when, message) for when, message in south]
    said = events_of(play(fusion_of(), node("north", active, range(140)) + south, 145))
    assert said[0][1].heard_by == ("north",)
    assert (said[-1][0], said[-1][1].heard_by) == (106 + HANG_OVER + 5, ("north", "south"))


def test_late_active_frames_are_counted() -> None:
    delay = 12  # over the deadline, but before the event is over
    fusion = fusion_of()
    arrivals = node("north", range(10, 30), range(80)) + node("south", range(10, 30), range(80), delay)
    first = events_of(play(fusion, arrivals, 80))[0][1]
    assert first.late_frames > 0
    assert status_of(fusion, "south", 80).counters["late"] >= first.late_frames
    assert status_of(fusion, "north", 80).counters["late"] == 0
    status = status_of(fusion, "south", 80)
    assert (status.state, status.reason) == (ArrayState.DEGRADED, "its frames come after their deadline")


def test_long_sound_is_split_and_no_frame_is_used_twice() -> None:
    active = range(10, 110)
    scripted = Scripted()
    arrivals = node("north", active, range(140)) + node("south", active, range(140))
    said = events_of(play(fusion_of(scripted, max_event_s=2.0), arrivals, 140))
    assert [(event.start_ns, event.end_ns) for _, event in said] == [
        (now_ns(10), now_ns(50)),
        (now_ns(50), now_ns(90)),
        (now_ns(90), now_ns(110)),
    ]
    assert [when for when, _ in said] == [50, 90, 110 + HANG_OVER]
    assert sum(sum(call["north"]) for call in scripted.calls) == 20 * len(active)
    assert len({event.id for _, event in said}) == 3


def test_event_ends_when_all_arrays_stop_sending() -> None:
    arrivals = node("north", range(10, 100), range(20)) + node("south", range(10, 100), range(20))
    ((when, event),) = events_of(play(fusion_of(), arrivals, 60))
    # heard last at 20; nothing more for a deadline and a hang-over
    assert when == 20 + DEADLINE + HANG_OVER + 1
    assert event.end_ns == now_ns(20)


def test_flush_reports_the_open_event() -> None:
    fusion = fusion_of()
    assert fusion.flush(now_ns(0)) == []
    said = play(fusion, node("north", range(10, 100), range(20)) + node("south", (), range(15)), 20)
    assert events_of(said) == []
    (event,) = fusion.flush(now_ns(21))
    assert isinstance(event, Event)
    assert event.end_ns == now_ns(20)
    assert event.latency_s == pytest.approx(0.05)


def test_long_pause_is_skipped() -> None:
    fusion = fusion_of()
    play(fusion, node("north", range(10, 100), range(20)), 20)
    later = 20 * 3600 * 24 * 365 * 10  # ten years: walked through they would take hours
    frame_indices = range(later, later + 40)
    said = play(fusion, node("north", range(later + 10, later + 15), frame_indices), later + 40, start=later)
    assert [event.start_ns for _, event in events_of(said)] == [now_ns(10), now_ns(later + 10)]


def test_fusion_starts_over_when_the_servers_clock_is_set_back() -> None:
    fusion = fusion_of(updates=True)
    hour = 20 * 3600
    said = play(fusion, node("north", range(hour + 10, hour + 100), range(hour, hour + 20)), hour + 20, start=hour)
    assert any(isinstance(output, Track) for _, output in said)
    said = play(fusion, node("north", range(10, 15), range(40)), 40)
    assert [event.start_ns for _, event in events_of(said)] == [now_ns(hour + 10), now_ns(10)]
    assert [track.id for _, track in said if isinstance(track, Track) and track.state is TrackState.END] == [1]
    assert status_of(fusion, "north", 40).state is ArrayState.HEALTHY
    assert status_of(fusion, "north", 40).counters["late"] == 0
