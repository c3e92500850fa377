"""Early and final results: what is reported at once, what is final, and how long an array is awaited."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import pytest

from fusion_steps import HANG_OVER, START, Arrivals, frame, mark, node, now_ns, state_of
from livessl.core.stream.array_health import LOST_NS
from livessl.core.stream.final_pass import FinalResults, TwoPassFusion
from livessl.core.stream.held_frames import HEADER_BYTES, HOLD_BYTES, HOLD_NS
from livessl.core.stream.reception import FinalReception
from livessl.core.types import FRAME_NS, Event, Frame, Message

NAMES = ("north", "south")
SECOND = 20


def two_passes(settled: int | None = None, *, hold_ns: int = HOLD_NS, hold_bytes: int = HOLD_BYTES) -> TwoPassFusion:
    return TwoPassFusion(state_of(), NAMES, settled, hold_ns=hold_ns, hold_bytes=hold_bytes)


def play(into: TwoPassFusion, arrivals: Arrivals, until: int, since: int = 0) -> list[tuple[int, Event | FinalResults]]:
    """Step through time, in frame indices; the events that came out, and when."""
    said: list[tuple[int, Event | FinalResults]] = []
    for now in range(since, until + 1):
        here = [message for when, message in arrivals if since <= now and (when <= now < when + 1 or when == now)]
        outputs = into.step(here, now_ns(now))
        said += [(now, output) for output in outputs if isinstance(output, Event | FinalResults)]
    return said


def settled_events(said: Iterable[tuple[int, Event | FinalResults]]) -> list[Event]:
    return [event for _, output in said if isinstance(output, FinalResults) for event in output.events]


def provisional(said: Iterable[tuple[int, Event | FinalResults]]) -> list[Event]:
    return [output for _, output in said if isinstance(output, Event)]


def both(active: range, frame_indices: range) -> Arrivals:
    return node("north", active, frame_indices) + node("south", active, frame_indices)


def test_without_delays_only_final_events_are_reported_and_at_once() -> None:
    said = play(two_passes(), both(range(10, 16), range(40)), 40)
    assert provisional(said) == []
    ((when, output),) = said
    assert when == 16 + HANG_OVER
    assert isinstance(output, FinalResults)
    (event,) = output.events
    assert (event.heard_by, event.late) == (NAMES, False)
    assert event.latency_s == pytest.approx(HANG_OVER * 0.05)
    assert output.until == START + 16  # the sound's end: what follows may be the run-up of the next


def test_silence_is_settled_except_for_a_pre_roll() -> None:
    into = two_passes()
    assert into.settled is None
    play(into, both(range(0), range(100)), 100)
    assert into.settled == START + 100 - 8


def test_sound_that_goes_on_is_not_settled() -> None:
    into = two_passes()
    play(into, both(range(30, 90), range(60)), 60)
    assert into.settled == START + 30 - 8


def test_array_that_is_away_delays_no_early_event_and_corrects_the_final_one() -> None:
    into = two_passes()
    north, south = node("north", range(40, 46), range(200)), node("south", range(40, 46), range(30))
    said = play(into, north + south, 100)
    assert settled_events(said) == []
    (event,) = provisional(said)
    assert event.heard_by == ("north",)
    # it comes back, and has kept its frames
    into.greet("south", (START + 38, START + 50), now_ns(100))
    kept: Arrivals = [(101.0, m) for _, m in node("south", range(40, 46), range(35, 50)) if isinstance(m, Frame)]
    said = play(into, north + kept + [(101.0, mark("south", 100))], 110, 101)
    assert settled_events(said) == []  # there may be more
    into.greet("south", None, now_ns(110))
    said = play(into, [*north, (111.0, mark("south", 110))], 111, 111)
    (late,) = settled_events(said)
    assert (late.heard_by, late.late) == (NAMES, True)
    assert late.latency_s == pytest.approx((111 - 46) * 0.05)
    assert into.input.backlog_frames == {"north": 0, "south": len(kept)}


def test_array_that_is_away_is_awaited_for_a_limited_time() -> None:
    into = two_passes(hold_ns=5 * 1_000_000_000)
    said = play(into, node("north", range(40, 46), range(300)) + node("south", (), range(30)), 300)
    (event,) = settled_events(said)
    assert (event.heard_by, event.late) == (("north",), False)
    (told,) = provisional(said)
    assert (event.id, event.start_ns, event.end_ns) == (told.id, told.start_ns, told.end_ns)
    # the last frame of its hang-over came at 52
    assert next(when for when, output in said if isinstance(output, FinalResults)) == 52 + 5 * SECOND + 1
    # the frames that the other has kept come too late, and are counted
    into.greet("south", (START + 38, START + 52), now_ns(300))
    play(into, [(301.0, frame("south", k)) for k in range(40, 46)], 301, 301)
    assert into.input.too_late == {"north": 0, "south": 6}


def test_hold_is_longer_than_a_restart_takes() -> None:
    assert HOLD_NS > 60 * 1_000_000_000 > LOST_NS


def test_memory_of_held_frames_is_bounded() -> None:
    size = HEADER_BYTES + frame("north", 0).samples.nbytes
    into = two_passes(hold_bytes=50 * size)
    play(into, node("south", (), range(5)), 5)
    said = play(into, node("north", range(10, 400), range(5, 420)), 420, 5)
    assert into.input.held.nbytes <= 50 * size
    assert len(settled_events(said)) >= 1


def test_backlog_of_a_time_that_was_given_up_is_counted_as_too_late() -> None:
    """Its node sends live sound meanwhile: the frames are older than the newest, and yet they have not come before."""
    into = two_passes(hold_bytes=50 * (HEADER_BYTES + frame("north", 0).samples.nbytes))
    play(into, both(range(0), range(5)), 5)
    into.greet("south", (START + 6, START + 200), now_ns(6))
    sounds = [message for k in range(0, 200, 50) for message in node("north", range(k + 10, k + 30), range(k, k + 50))]
    play(into, sounds + node("south", (), range(200, 250)), 250, 6)
    assert into.input.too_late == {"north": 0, "south": 0}
    play(into, [(251.0, frame("south", k)) for k in range(10, 20)], 251, 251)
    assert into.input.too_late == {"north": 0, "south": 10}
    assert into.input.duplicates == {"north": 0, "south": 0}


def test_array_whose_node_has_ended_is_not_awaited() -> None:
    into = two_passes()
    play(into, both(range(10, 16), range(14)), 14)
    into.leave("south")
    said = play(into, node("north", range(10, 16), range(14, 40)), 40, 15)
    (event,) = settled_events(said)
    assert event.heard_by == NAMES


def test_everything_is_settled_when_all_nodes_have_ended() -> None:
    into = two_passes()
    play(into, both(range(10, 16), range(14)), 14)
    into.leave("south")
    into.leave("north")
    (event,) = settled_events(play(into, [], 15, 15))
    assert event.heard_by == NAMES


def test_settled_events_are_not_reported_again_after_a_restart() -> None:
    """A server that starts again knows up to where all results are final; frames of that time are dropped."""
    into = two_passes()
    first = play(into, both(range(10, 16), range(30)), 30)
    (output,) = [output for _, output in first if isinstance(output, FinalResults)]
    again = two_passes(output.until)
    for name in NAMES:
        again.greet(name, (START + 8, START + 31), now_ns(31))
    kept: Arrivals = [(31.0, m) for _, m in both(range(10, 16), range(30)) if isinstance(m, Frame)]
    said = play(again, kept, 31, 31)
    for name in NAMES:
        again.greet(name, None, now_ns(32))
    said += play(again, [(w, m) for w, m in both(range(40, 46), range(32, 60)) if w >= 32], 60, 32)
    (event,) = settled_events(said)
    assert event.start_ns == (START + 40) * FRAME_NS
    assert sum(again.input.duplicates.values()) == sum(m.frame_index < output.until for _, m in kept)


def test_final_pass_begins_anew_when_the_servers_clock_is_set_back() -> None:
    into = two_passes()
    play(into, both(range(10, 16), range(100)), 100)
    hour = 3600 * SECOND
    said: list[tuple[int, Event | FinalResults]] = []
    for now in range(-hour, -hour + 40):
        messages: list[Message] = [
            m for w, m in both(range(-hour + 10, -hour + 16), range(-hour, -hour + 40)) if w == now
        ]
        said += [(now, o) for o in into.step(messages, now_ns(now)) if isinstance(o, Event | FinalResults)]
    (event,) = settled_events(said)
    assert event.start_ns == now_ns(-hour + 10)


def test_node_an_hour_ahead_is_rejected_with_a_reason() -> None:
    """The messages of a node an hour ahead are rejected; the other node goes on."""
    into = two_passes()
    ahead = [
        (w, replace(m, frame_index=m.frame_index + 3600 * SECOND)) for w, m in node("south", range(10, 16), range(40))
    ]
    said = play(into, node("north", range(10, 16), range(40)) + ahead, 40)
    (event,) = provisional(said)
    assert event.heard_by == ("north",)
    south = into.status(now_ns(40))[1]
    assert south.counters["rejected"] == len(ahead)
    assert south.reason is not None
    assert "ahead of the server's; set both by NTP" in south.reason


def test_excluded_array_is_neither_used_nor_awaited() -> None:
    into = two_passes()
    into.exclude({"south"})
    said = play(into, node("north", range(10, 16), range(40)) + node("south", range(8, 18), range(20)), 40)
    ((when, output),) = said
    assert isinstance(output, FinalResults)
    assert [event.heard_by for event in output.events] == [("north",)]
    assert when == 16 + HANG_OVER


def test_only_active_frames_of_excluded_arrays_are_changed() -> None:
    state = state_of()
    active, quiet, south = frame("north", 1), frame("north", 2, active=False), frame("south", 1)
    assert state.without_excluded(active) is active
    state.exclude({"north"})
    changed = state.without_excluded(active)
    assert isinstance(changed, Frame)
    assert not changed.active
    assert state.without_excluded(quiet) is quiet
    assert state.without_excluded(mark("north", 1)) == mark("north", 1)
    assert state.without_excluded(south) is south


def test_frames_of_an_array_that_had_sent_nothing_are_too_late_as_well() -> None:
    into = two_passes(hold_ns=5 * 1_000_000_000)
    play(into, node("north", range(40, 46), range(300)), 300)
    into.greet("south", (START + 38, START + 52), now_ns(300))
    play(into, [(301.0, frame("south", k)) for k in range(40, 46)], 301, 301)
    assert into.input.too_late == {"north": 0, "south": 6}
    assert into.input.duplicates == {"north": 0, "south": 0}


def test_what_was_given_up_once_is_forgotten_when_an_array_has_caught_up() -> None:
    reception = FinalReception()
    reception.take_mark(100)
    reception.forget(150)  # given up from 101 on
    reception.take_mark(400)
    reception.forget(380)
    assert reception.is_first_arrival(140)
    reception.forget(450)  # given up from 401 on
    assert not reception.is_first_arrival(140)
    assert reception.is_first_arrival(420)
