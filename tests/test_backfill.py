"""Frames are requested from arrays that did not detect a sound, offline and live alike; old nodes work as before."""

from __future__ import annotations

import json
import urllib.request
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from livessl import offline
from livessl.capture.node import send_session
from livessl.clock import PacedClock, SystemClock, UnpacedClock
from livessl.core.stream.backfill import MOST_REQUESTED_ARRAYS, SHARE, SURE_WITHOUT_BACKFILL, Allowance, nearest
from livessl.core.stream.clock_offsets import ClockOffsets
from livessl.core.stream.final_pass import FinalResults
from livessl.core.stream.segmenter import RECENT_S
from livessl.core.types import FRAME_NS, FRAME_S, ArraySpec, BackfillRequest, Event, Frame, Message, Output, Status
from livessl.recordings.assign import AssignedRecording, make_pipelines
from livessl.recordings.play import paced_messages
from livessl.recordings.recording import MemoryRecording
from livessl.simulation.scene import render
from livessl.site.build.fusion import make_clock_offsets, make_fusion, make_two_pass_fusion
from livessl.site.models import Site
from small_site import RATE_HZ, running_server, scene, site_of

START_NS = 1_767_225_600_000_000_000
SOUNDS = 4
WEAKER_DB = 39.0
"""Attenuation in dB at which a burst is a little above the microphones' noise, and below the level of sound."""

NODES: dict[str, Any] = {
    "nodes": {
        name: {"device": {"name": "x", "sample_rate_hz": RATE_HZ}, "arrays": {array: [1, 2, 3, 4]}}
        for name, array in (("a", "north"), ("b", "south"))
    }
}


@cache
def site() -> Site:
    return site_of(NODES)


@cache
def recorded(array: str) -> Any:
    weaker = replace(scene(SOUNDS), noise_dbfs=-55.0)
    if array == "south":
        weaker = replace(weaker, level_dbfs=weaker.level_dbfs - WEAKER_DB)
    return render(weaker, site().array(array).microphones_m, seed=3 + len(array))


def parts(start_ns: int = START_NS, ahead_ns: int = 0, times: int = 1) -> list[AssignedRecording]:
    """The scene, `times` in a row, strong at north and faint at south, whose clock may be ahead."""
    begin = {"north": start_ns, "south": start_ns + ahead_ns}
    heard = {name: np.tile(recorded(name), (1, times)) for name in begin}
    return [
        AssignedRecording(name, MemoryRecording(name, float(RATE_HZ), heard[name]), begin[name], (1, 2, 3, 4))
        for name in begin
    ]


def offline_events(*, ask: bool = True, method: str | None = None, ahead_ns: int = 0) -> list[Event]:
    outputs = offline.run(site(), parts(ahead_ns=ahead_ns), UnpacedClock(), backfill=ask, method=method)
    return [output for output in outputs if isinstance(output, Event)]


def error_m(event: Event) -> float:
    assert event.estimate is not None
    starts_ns = np.array([START_NS + round(1e9 * source.start_s) for source in scene(SOUNDS).sources])
    source = scene(SOUNDS).sources[int(np.searchsorted(starts_ns, event.end_ns)) - 1]
    return float(np.linalg.norm(event.estimate.position_m - source.position_m))


def told(events: Sequence[Event]) -> list[tuple[object, ...]]:
    places = [None if event.estimate is None else event.estimate.position_m.tolist() for event in events]
    return [
        (e.id, e.start_ns, e.end_ns, e.status, e.heard_by, e.contributions, at)
        for e, at in zip(events, places, strict=True)
    ]


def test_sound_that_one_array_detected_is_located_with_requested_frames_of_the_other() -> None:
    without = offline_events(ask=False)
    assert [event.heard_by for event in without] == [("north",)] * SOUNDS
    assert {event.status for event in without} == {Status.DIRECTION_ONLY}
    events = offline_events()
    assert [event.id for event in events] == [event.id for event in without]
    for event in events:
        assert event.status is Status.LOCATED
        assert event.heard_by == ("north",)
        assert event.estimate is not None
        assert event.estimate.arrays == ("north", "south")
        assert [contribution.asked for contribution in event.contributions] == [False, True]
        assert error_m(event) < 0.5


def test_methods_without_onsets_request_nothing() -> None:
    assert told(offline_events(method="srp-phat")) == told(offline_events(method="srp-phat", ask=False))


class Live:
    """Two nodes and the two passes of a server; requested frames arrive `way` batches after the request."""

    def __init__(
        self,
        way: int,
        *,
        answers: bool = True,
        deaf: bool = False,
        ahead_ns: int = 0,
        clocks: ClockOffsets | None = None,
    ) -> None:
        self.lines, self.inputs = make_pipelines(site(), parts(ahead_ns=ahead_ns))
        self.settling = make_two_pass_fusion(site(), ("north", "south"), live=True, clock_offsets=clocks)
        for name in ("north", "south"):
            self.settling.greet(name, None, START_NS, answers=answers)
        self.way, self.deaf = way, deaf
        self.asks: list[BackfillRequest] = []

    def run(self) -> list[Output | FinalResults]:
        outputs: list[Output | FinalResults] = []
        coming: list[tuple[int, list[Message]]] = []
        for k, (now_ns, batch) in enumerate(paced_messages(self.lines, self.inputs, UnpacedClock())):
            answers = [message for due, messages in coming if due <= k for message in messages]
            coming = [entry for entry in coming if entry[0] > k]
            new = self.settling.step([*batch, *answers], now_ns)
            for ask in (output for output in new if isinstance(output, BackfillRequest)):
                self.asks.append(ask)
                if not self.deaf:
                    coming.append((k + self.way, self.answer(ask)))
            outputs += new
        return outputs + self.settling.flush(now_ns)

    def answer(self, ask: BackfillRequest) -> list[Message]:
        return [message for line in self.lines for message in line.backfill(ask)]


def settled(outputs: Sequence[Output | FinalResults]) -> list[Event]:
    return [event for output in outputs if isinstance(output, FinalResults) for event in output.events]


@pytest.mark.parametrize("way", [1, 4, 8])
def test_results_are_the_same_live_and_offline(way: int) -> None:
    """Blocks of 20 ms from each node: eight batches are 80 ms."""
    live = Live(way)
    outputs = live.run()
    assert told(settled(outputs)) == told(offline_events())
    assert not [output for output in outputs if isinstance(output, Event)]  # none before it was settled
    assert len(live.asks) == SOUNDS  # one for each array and event
    assert {ask.array for ask in live.asks} == {"south"}
    assert live.settling.asked == {"north": 0, "south": SOUNDS}
    assert live.settling.helped == {"north": 0, "south": SOUNDS}
    assert all((ask.last - ask.first + 1) * FRAME_S <= 0.4 + 0.5 for ask in live.asks)  # run-up and burst


def test_nothing_is_requested_from_old_nodes() -> None:
    live = Live(1, answers=False)
    assert told(settled(live.run())) == told(offline_events(ask=False))
    assert live.asks == []


def test_nothing_is_requested_from_excluded_arrays() -> None:
    live = Live(1)
    live.settling.exclude({"south"})
    live.run()
    assert live.asks == []


def test_requested_frames_are_awaited_for_a_limited_time() -> None:
    live = Live(1, deaf=True)
    events = settled(live.run())
    assert told(events) == told(offline_events(ask=False))
    assert len(live.asks) == SOUNDS
    for event in events:
        assert 0.3 + 0.3 - 0.11 < event.latency_s < 0.3 + 0.3 + 0.11  # the hang-over, and as long again


def test_requests_use_the_frame_indices_of_the_arrays_own_clock() -> None:
    """The offset is usually known only after three sounds that both arrays detect; here it is known from the start."""
    ahead_ns = 150_000_000
    clocks = make_clock_offsets(site())
    for k in range(3):
        clocks.learn(START_NS + k, {"north": 0.0, "south": 0.15})
    events = settled(Live(1, ahead_ns=ahead_ns, clocks=clocks).run())
    expected = offline_events()
    assert [event.estimate and event.estimate.arrays for event in events] == [("north", "south")] * SOUNDS
    for event, other in zip(events, expected, strict=True):
        assert abs(error_m(event) - error_m(other)) < 0.02


def test_nothing_is_requested_for_a_sure_event() -> None:
    loud = [
        replace(
            part, recording=MemoryRecording(part.array, float(RATE_HZ), recorded_loud(part.array)), start_ns=START_NS
        )
        for part in parts()
    ]
    fusion = make_fusion(site(), updates=False)
    for array in ("north", "south"):
        fusion.set_answers(array, True)
    outputs: list[Output] = []
    for now_ns, batch in paced_messages(*make_pipelines(site(), loud), UnpacedClock()):
        outputs += fusion.step(batch, now_ns)
    events = [output for output in outputs if isinstance(output, Event)]
    assert events
    assert all(
        event.estimate is not None and event.estimate.sound_confidence >= SURE_WITHOUT_BACKFILL for event in events
    )
    assert not [output for output in outputs if isinstance(output, BackfillRequest)]


@cache
def recorded_loud(array: str) -> Any:
    return render(scene(SOUNDS), site().array(array).microphones_m, seed=3 + len(array))


def test_number_of_requested_frames_is_bounded() -> None:
    allowance = Allowance()
    burst = round(RECENT_S / FRAME_S)
    assert allowance.take(burst, 0)
    assert not allowance.take(1, 0)
    assert allowance.take(round(100 * SHARE), 100)
    assert not allowance.take(round(100 * SHARE), 150)
    assert allowance.refused == 2
    assert allowance.take(burst, 10**6)
    assert not allowance.take(burst, 10**6 + 1)


def test_nearest_silent_arrays_come_first() -> None:
    def at(x_m: float) -> ArraySpec:
        return ArraySpec(f"{x_m:g}", np.array([[x_m, 0.0, 0.0], [x_m + 0.1, 0.0, 0.0]]), (100.0, 6000.0))

    silent = [at(x_m) for x_m in (30.0, 5.0, 9.0, 1.0, 2.0, 40.0)]
    assert [spec.name for spec in nearest(silent, [at(0.0), at(29.0)])] == ["30", "1", "2", "5"]
    assert MOST_REQUESTED_ARRAYS == 4


def test_frames_that_were_not_requested_change_nothing() -> None:
    fusion = make_fusion(site(), updates=False)
    samples = np.random.default_rng(0).standard_normal((4, 800)).astype(np.float32)
    frame_index = START_NS // FRAME_NS
    stray = Frame("south", 0, frame_index, START_NS, float(RATE_HZ), samples, 0.01, True, requested=True)
    assert fusion.step([stray], START_NS) == []
    assert fusion.closed is None
    assert fusion.status(START_NS)[1].counters["frames"] == 0


@pytest.mark.parametrize("speed", [4.0, None])
def test_session_played_to_a_server_gives_the_same_events(speed: float | None) -> None:
    """At four times real time, and as fast as it goes: longer than what a node remembers, or it could not forget."""
    times = 1 if speed else 4
    played = parts(times=times)
    assert speed or played[0].recording.duration_s > 2 * RECENT_S
    outputs = offline.run(site(), played, UnpacedClock())
    expected = [output for output in outputs if isinstance(output, Event)]
    assert [event.estimate and event.estimate.arrays for event in expected] == [("north", "south")] * SOUNDS * times
    with running_server(site_of({**NODES, "server.bind": "tcp://127.0.0.1:*"})) as server:
        pace = PacedClock(START_NS, speed) if speed else UnpacedClock(START_NS)
        send_session(site(), server.endpoint, played, pace, SystemClock(), "run-1", lambda: False)
        server.wait_idle()
        with urllib.request.urlopen(f"{server.url}/api/v1/events") as answer:
            found = json.load(answer)["events"][::-1]
    assert [event["id"] for event in found] == [event.id for event in expected]
    for event, other in zip(found, expected, strict=True):
        assert other.estimate is not None
        assert event["arrays"] == ["north", "south"]
        np.testing.assert_allclose(event["position_m"], other.estimate.position_m, atol=1e-4)


def test_event_that_became_final_while_frames_were_awaited_is_not_reported_again() -> None:
    """A node stood still: its sound comes after the early pass has requested frames, and before they come."""
    loud = [
        replace(
            part, recording=MemoryRecording(part.array, float(RATE_HZ), recorded_loud(part.array)), start_ns=START_NS
        )
        for part in parts()
    ]
    settling = make_two_pass_fusion(site(), ("north", "south"), live=True)
    for name in ("north", "south"):
        settling.greet(name, None, START_NS, answers=True)
    held: list[Message] | None = []
    asked = False
    told: list[Output | FinalResults] = []
    for now_ns, batch in paced_messages(*make_pipelines(site(), loud), UnpacedClock()):
        if held is not None:
            held += [message for message in batch if message.array == "south"]
            batch = [message for message in batch if message.array == "north"]
            if asked:
                batch, held = [*batch, *held], None
        new = settling.step(batch, now_ns)
        asked = asked or any(isinstance(output, BackfillRequest) for output in new)
        told += [output for output in new if isinstance(output, Event | FinalResults)]
    assert asked
    assert isinstance(told[0], FinalResults)
    assert [event.heard_by for event in settled(told)] == [("north", "south")] * SOUNDS
    assert not [output for output in told if isinstance(output, Event)]
