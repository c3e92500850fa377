"""How fusion takes arrays: which messages it refuses, and what it says of their health."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from fusion_steps import (
    HANG_OVER,
    Arrivals,
    Scripted,
    events_of,
    frame,
    fusion_of,
    mark,
    node,
    now_ns,
    only_event,
    play,
    status_of,
    told,
)
from livessl.core.stream.array_health import ArrayState, ArrayStatus
from livessl.core.types import (
    ClockState,
    Frame,
)


def test_unknown_array_is_counted_and_ignored() -> None:
    fusion = fusion_of()
    said = play(fusion, node("west", range(10, 16), range(40)), 40)
    assert said == []
    assert fusion.unknown_arrays == len(node("west", range(10, 16), range(40)))


def test_wrong_number_of_channels_is_rejected() -> None:
    fusion = fusion_of()
    three = np.zeros((3, 20), np.float32)
    arrivals: Arrivals = [
        (when, replace(m, samples=three.copy()) if isinstance(m, Frame) else m)
        for when, m in node("south", range(10, 16), range(40))
    ]
    event = only_event(play(fusion, node("north", range(10, 16), range(40)) + arrivals, 40))
    assert event.heard_by == ("north",)
    status = status_of(fusion, "south", 40)
    assert status.state is ArrayState.DEGRADED
    assert status.reason == "its frames have 3 channels, the server's site file says 4"
    assert status.counters["rejected"] == 2 + 6 + HANG_OVER
    assert status.counters["frames"] == 0


@pytest.mark.parametrize(("off", "side"), [(72_000, "ahead of"), (-72_000, "behind")])
def test_clock_an_hour_off_is_rejected_and_others_go_on(off: int, side: str) -> None:
    fusion = fusion_of()
    north = node("north", range(10, 16), range(40))
    astray = [
        (when, replace(m, frame_index=m.frame_index + off)) for when, m in node("south", range(10, 16), range(40))
    ]
    said = play(fusion, north + astray, 40)
    alone = play(fusion_of(), north, 40)
    assert told(output for _, output in said) == told(output for _, output in alone)
    assert [when for when, _ in said] == [when for when, _ in alone]
    status = status_of(fusion, "south", 40)
    assert status.state is ArrayState.DEGRADED
    assert status.reason is not None
    assert status.reason.startswith("its clock is 3")
    assert status.reason.endswith(f" s {side} the server's; set both by NTP")
    assert status.counters["rejected"] == len(astray)


def test_frames_up_to_half_a_minute_old_are_accepted() -> None:
    for age, rejected in ((590, 0), (610, 1)):
        fusion = fusion_of()
        fusion.step([frame("north", 0)], now_ns(age))
        assert status_of(fusion, "north", age).counters["rejected"] == rejected


def test_array_starts_then_is_healthy_then_lost() -> None:
    fusion = fusion_of()
    assert status_of(fusion, "north", 0) == ArrayStatus(
        "north", ArrayState.STARTING, "no message yet", False, None, None, None, (), None, None, None,
        dict.fromkeys(("frames", "marks", "late", "rejected", "lost_frames", "overflows"), 0),
    )  # fmt: skip
    play(fusion, node("north", (), range(10)), 10)
    status = status_of(fusion, "north", 12)
    assert (status.state, status.reason) == (ArrayState.HEALTHY, None)
    assert status.age_s == pytest.approx(0.1)
    assert (status.power, status.noise_power, status.clock) == (1e-7, 1e-7, ClockState.LOCKED)
    assert status.counters["marks"] == 10
    assert status_of(fusion, "north", 39).state is ArrayState.HEALTHY
    status = status_of(fusion, "north", 40)  # one and a half seconds later
    assert (status.state, status.reason) == (ArrayState.LOST, "no message for 1.5 s")
    play(fusion, node("north", (), range(60, 62)), 62, start=61)
    assert status_of(fusion, "north", 62).state is ArrayState.HEALTHY
    assert status_of(fusion, "south", 62).state is ArrayState.STARTING


def test_array_is_active_while_its_frames_are() -> None:
    fusion = fusion_of()
    for frame_index, active in ((5, False), (12, True), (17, False), (30, False)):
        play(fusion, node("north", range(10, 16), range(frame_index + 1)), frame_index + 1, start=frame_index)
        assert status_of(fusion, "north", frame_index + 1).active == active
    fusion = fusion_of()
    play(fusion, node("north", range(10, 16), range(13)), 13)
    assert status_of(fusion, "north", 14).active
    assert not status_of(fusion, "north", 60).active  # lost


def test_node_that_has_ended_is_lost_and_not_awaited() -> None:
    fusion = fusion_of()
    play(fusion, node("north", (), range(10)) + node("south", (), range(10)), 10)
    fusion.leave("south")
    fusion.leave("nobody")
    status = status_of(fusion, "south", 10)
    assert (status.state, status.reason) == (ArrayState.LOST, "its node has ended")
    ((when, _),) = events_of(play(fusion, node("north", range(12, 16), range(10, 40)), 40, start=11))
    assert when == 16 + HANG_OVER
    play(fusion, node("south", (), range(40, 42)), 42, start=41)
    assert status_of(fusion, "south", 42).state is ArrayState.HEALTHY


@pytest.mark.parametrize(
    ("powers", "said"),
    [
        ((1e-7, 1e-7, 0.0, 1e-7), "microphone [3] is dead: all-zero samples; check cable, gain and channel numbers"),
        ((0.0,) * 4, "all channels are dead: all-zero samples; check cable, gain and channel numbers"),
    ],
)
def test_dead_microphone_is_reported_after_a_second(powers: tuple[float, ...], said: str) -> None:
    fusion = fusion_of()
    for frame_index in range(60):
        dead = 10 <= frame_index < 50
        message = mark("north", frame_index, channel_power=powers) if dead else mark("north", frame_index)
        fusion.step([message], now_ns(frame_index + 1))
        status = status_of(fusion, "north", frame_index + 1)
        if 10 + 20 <= frame_index < 50:
            assert (status.state, status.reason) == (ArrayState.DEGRADED, said)
        else:
            assert (status.state, status.reason) == (ArrayState.HEALTHY, None)


@pytest.mark.parametrize(
    ("trouble", "said"),
    [
        ({"overflows": 3}, "its device loses samples; use larger blocks or a less busy machine"),
        ({"lost_frames": 3}, "the device skipped samples; frames at the gap were dropped"),
        ({"clock": ClockState.STEPPED}, "its clock has stepped"),
    ],
)
def test_fault_is_reported_for_ten_seconds(trouble: dict[str, Any], said: str) -> None:
    fusion = fusion_of()
    lasting = {name: value for name, value in trouble.items() if name != "clock"}
    for frame_index in range(240):
        changes = trouble if frame_index == 20 else lasting if frame_index > 20 else {}
        fusion.step([mark("north", frame_index, **changes)], now_ns(frame_index + 1))
        status = status_of(fusion, "north", frame_index + 1)
        troubled = 20 <= frame_index < 20 + 200
        assert status.state is (ArrayState.DEGRADED if troubled else ArrayState.HEALTHY)
        assert status.reason == (said if troubled else None)
    assert status.counters["overflows"] == trouble.get("overflows", 0)
    assert status.counters["lost_frames"] == trouble.get("lost_frames", 0)


def test_counters_from_before_the_connection_are_no_fault() -> None:
    fusion = fusion_of()
    play(fusion, [(1.0, mark("north", 0, overflows=7, lost_frames=9))], 1)
    assert status_of(fusion, "north", 1).state is ArrayState.HEALTHY


def test_prepare_is_passed_to_the_estimator() -> None:
    scripted = Scripted()
    fusion_of(scripted).prepare("north", 44_100.0)
    assert scripted.prepared == [("north", 44_100.0)]
