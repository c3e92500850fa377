"""Nodes whose clocks are off: the same answers as of clocks that agree, each sound once, whatever starts again."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from livessl.clock import UnpacedClock
from livessl.core.stream.array_health import ArrayState, ArrayStatus
from livessl.core.stream.clock_offsets import LEAST_SOUNDS, ClockOffset, ClockOffsets
from livessl.core.stream.final_pass import FinalResults, TwoPassFusion
from livessl.core.types import FRAME_NS, Event, Frame, Mark, Message, Output
from livessl.recordings.assign import make_pipelines
from livessl.recordings.play import paced_messages
from livessl.site.build.fusion import make_clock_offsets, make_fusion, make_two_pass_fusion
from livessl.site.models import Site
from small_site import RATE_HZ, scene, scene_recordings, site_of

START_NS = 1_767_225_600_000_000_000
SOUNDS = 8
NODES: dict[str, Any] = {
    "nodes": {
        name: {"device": {"name": "x", "sample_rate_hz": RATE_HZ}, "arrays": {array: [1, 2, 3, 4]}}
        for name, array in (("a", "north"), ("b", "south"))
    }
}

Batches = Sequence[tuple[int, list[Message]]]


@cache
def site() -> Site:
    return site_of(NODES)


@cache
def batches(ahead_s: float) -> Batches:
    """The messages of two nodes, the second with its clock ahead, and when they come."""
    ahead_ns = round(ahead_s * 1e9)
    parts = [
        replace(part, recording=part.recording, start_ns=START_NS + ahead_ns * (part.array == "south"))
        for part in scene_recordings(START_NS, SOUNDS)
    ]
    return list(paced_messages(*make_pipelines(site(), parts), UnpacedClock()))


def located(ahead_s: float) -> tuple[list[Event], ArrayStatus]:
    """Offline: the events, and how the array with the wrong clock is doing in the end."""
    fusion = make_fusion(site(), updates=False)
    outputs: list[Output] = []
    for now_ns, batch in batches(ahead_s):
        outputs += fusion.step(batch, now_ns)
    outputs += fusion.flush(now_ns)
    _, south = fusion.status(now_ns)
    return [output for output in outputs if isinstance(output, Event)], south


def told(events: Sequence[Event]) -> list[tuple[object, ...]]:
    """All of events that does not depend on when they were found out."""
    return [
        (
            e.id,
            e.start_ns,
            e.end_ns,
            e.status,
            e.heard_by,
            None if e.estimate is None else e.estimate.position_m.tolist(),
        )
        for e in events
    ]


@pytest.mark.parametrize("ahead_s", [0.137, -0.15, 0.15, -0.09])
def test_events_are_those_of_clocks_that_agree(ahead_s: float) -> None:
    expected, agreeing = located(0.0)
    events, south = located(ahead_s)
    assert len(events) == len(expected) == SOUNDS
    for event, other in zip(events, expected, strict=True):
        assert event.heard_by == ("north", "south")
        assert event.estimate is not None
        assert other.estimate is not None
        # frames are cut elsewhere in the sound, which moves a place by millimetres
        assert np.linalg.norm(event.estimate.position_m - other.estimate.position_m) < 0.02
    for event, source in zip(events[LEAST_SOUNDS:], scene(SOUNDS).sources[LEAST_SOUNDS:], strict=True):
        begun_s = (event.start_ns - START_NS) / 1e9 - source.start_s
        assert -0.051 < begun_s < 0.03  # a frame of 50 ms holds its beginning; it travelled up to 10 ms
    assert south.clock_offset is not None
    assert south.clock_offset.offset_s == pytest.approx(ahead_s, abs=0.003)
    assert south.clock_offset.std_s < 0.003
    assert south.state is ArrayState.DEGRADED
    assert south.reason is not None
    assert f"{1e3 * abs(south.clock_offset.offset_s):.0f} ms" in south.reason
    assert ("ahead of" if ahead_s > 0 else "behind") in south.reason
    assert "set both by NTP" in south.reason
    assert agreeing.clock_offset is not None
    assert abs(agreeing.clock_offset.offset_s) < 0.003
    assert agreeing.state is ArrayState.HEALTHY
    assert agreeing.corrected_frames == 0


def test_sounds_close_to_one_another_stay_apart() -> None:
    """Pauses of 0.4 s are longer than the hang-over of 0.3 s, but not by as much as the clocks differ.

    By the times of the arrays' own clocks there would be no pause, and both sounds would be one event.
    """

    def told_of(*, corrected: bool) -> list[Event]:
        clocks = make_clock_offsets(site())
        for k in range(LEAST_SOUNDS):
            clocks.learn(START_NS + k, {"north": 0.0, "south": 0.15})
        fusion = make_fusion(
            site(), updates=False, corrects_clocks=corrected, clock_offsets=clocks if corrected else None
        )
        messages: list[Message] = []
        for first in (20, 33):
            for array, ahead in (("north", 0), ("south", 3)):
                messages += [_frame(array, START_NS // FRAME_NS + first + ahead + k) for k in range(5)]
        ends = {"north": 60, "south": 63}
        messages += [Mark(name, 0, START_NS // FRAME_NS + end, 0.0, 0.0, ()) for name, end in ends.items()]
        begin: list[Message] = [Mark(name, 0, START_NS // FRAME_NS, 0.0, 0.0, ()) for name in ends]
        outputs = fusion.step(begin, START_NS)
        outputs += fusion.step(messages, START_NS + 60 * FRAME_NS)
        return [output for output in outputs if isinstance(output, Event)]

    assert len(told_of(corrected=False)) == 1
    events = told_of(corrected=True)
    assert [event.start_ns for event in events] == [START_NS + 20 * FRAME_NS, START_NS + 33 * FRAME_NS]
    assert [event.heard_by for event in events] == [("north", "south")] * 2


def _frame(array: str, frame_index: int) -> Frame:
    samples = np.random.default_rng(frame_index).standard_normal((4, 800)).astype(np.float32)
    return Frame(array, 1, frame_index, frame_index * FRAME_NS, float(RATE_HZ), samples, 0.01, True)


def settled_events(outputs: Iterable[Output | FinalResults]) -> list[Event]:
    return [event for output in outputs if isinstance(output, FinalResults) for event in output.events]


def two_passes(clocks: ClockOffsets | None = None, settled: int | None = None) -> TwoPassFusion:
    return make_two_pass_fusion(site(), ("north", "south"), settled, live=True, clock_offsets=clocks)


@pytest.mark.parametrize("step", [1, 7, 100])
@pytest.mark.parametrize("ahead_s", [0.137, -0.15])
def test_live_events_are_the_same_and_final_at_once(ahead_s: float, step: int) -> None:
    """This does not depend on how many messages come at a time, and the early pass reports none by itself."""
    into = two_passes()
    outputs: list[Output | FinalResults] = []
    all_batches = batches(ahead_s)
    for at in range(0, len(all_batches), step):
        some = all_batches[at : at + step]
        outputs += into.step([m for _, batch in some for m in batch], some[-1][0])
    outputs += into.flush(all_batches[-1][0])
    assert told(settled_events(outputs)) == told(located(ahead_s)[0])
    assert not [output for output in outputs if isinstance(output, Event)]


@pytest.mark.parametrize("ahead_s", [0.137, -0.15])
def test_each_sound_is_reported_once_however_often_the_server_restarts(ahead_s: float) -> None:
    """Nodes keep what is not settled by their own clocks, and send it again; the server knows the clocks it had."""
    expected = told(located(ahead_s)[0])
    arrays = ("north", "south")
    kept: dict[str, list[Frame]] = {name: [] for name in arrays}
    stored: tuple[int | None, dict[str, Any] | None] = (None, None)
    events: list[Event] = []
    clocks = make_clock_offsets(site())
    into = two_passes(clocks)
    for k, (now_ns, batch) in enumerate(batches(ahead_s)):
        for message in batch:
            if isinstance(message, Frame):
                kept[message.array].append(message)
        outputs = into.step(batch, now_ns)
        if k % 29 == 28:  # it is killed, and starts again with what is stored
            clocks = make_clock_offsets(site())
            if stored[1] is not None:
                clocks.restore(stored[1])
            again = two_passes(clocks, stored[0])
            for name in arrays:
                if kept[name]:
                    again.greet(name, (kept[name][0].frame_index, kept[name][-1].frame_index + 1), now_ns)
            outputs += again.step([frame for name in arrays for frame in kept[name]], now_ns)
            for name in arrays:
                again.greet(name, None, now_ns)
            into = again
        for output in outputs:
            if isinstance(output, FinalResults):
                events += output.events
                stored = output.until, clocks.state()
        for name, settled in into.settled_of.items():
            kept[name] = [frame for frame in kept[name] if frame.frame_index >= settled]
    events += settled_events(into.flush(now_ns))
    assert told(events) == expected


def test_status_shows_the_offset_from_the_reference_clock() -> None:
    north, south = _status_after(0.137)
    assert north.clock_offset is not None
    assert north.clock_offset.reference == "a"
    assert (north.clock_offset.offset_s, north.clock_offset.std_s) == (0.0, 0.0)
    assert isinstance(south.clock_offset, ClockOffset)
    assert south.corrected_frames == 3


def _status_after(ahead_s: float) -> list[ArrayStatus]:
    fusion = make_fusion(site(), updates=False)
    for now_ns, batch in batches(ahead_s):
        fusion.step(batch, now_ns)
    return fusion.status(now_ns)
