"""Through the whole pipeline: arrays with copied, shared or inverted channels are named and not used."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest

from livessl import offline
from livessl.clock import UnpacedClock
from livessl.core.stream.array_health import ArrayState, ArrayStatus
from livessl.core.stream.final_pass import FinalResults
from livessl.core.types import Event, Status
from livessl.recordings.assign import AssignedRecording, make_pipelines
from livessl.recordings.play import paced_messages
from livessl.recordings.recording import MemoryRecording
from livessl.simulation.scene import render
from livessl.site.build.fusion import make_two_pass_fusion
from small_site import RATE_HZ, scene, site_of

START_NS = 1_767_225_600_000_000_000
SOUNDS = 4

COPIES = "channels 1 and 3 are the same signal; channels 2 and 4 are the same signal"
INVERTED = "channel 2 is inverted against the others"
SHARED = "its channels 1, 2, 3 and 4 are the same signal as channels 1, 2, 3 and 4 of 'south'"


@cache
def received(array: str) -> Any:
    return render(scene(SOUNDS), site_of().array(array).microphones_m, seed=1 + len(array))


def faulty(kind: str) -> dict[str, Any]:
    north, south = received("north"), received("south")
    match kind:
        case "copies":
            return {"north": north[[0, 1, 0, 1]], "south": south}
        case "one microphone":
            return {"north": north[[2, 2, 2, 2]], "south": south}
        case "inverted":
            return {"north": north * np.array([[1], [-1], [1], [1]], dtype=np.float32), "south": south}
        case "both":
            return {"north": north[[0, 1, 0, 1]], "south": south[[0, 1, 1, 0]]}
    return {"north": south, "south": south}


def parts(kind: str) -> list[AssignedRecording]:
    return [
        AssignedRecording(name, MemoryRecording(name, float(RATE_HZ), samples), START_NS, (1, 2, 3, 4))
        for name, samples in faulty(kind).items()
    ]


def live(kind: str) -> tuple[list[Event], dict[str, ArrayStatus]]:
    lines, inputs = make_pipelines(site_of(), parts(kind))
    fusion = make_two_pass_fusion(site_of(), ("north", "south"), live=True)
    events: list[Event] = []
    now_ns = START_NS
    for now_ns, batch in paced_messages(lines, inputs, UnpacedClock()):
        for output in fusion.step(batch, now_ns):
            events += output.events if isinstance(output, FinalResults) else []
    statuses = {status.name: status for status in fusion.status(now_ns)}
    for output in fusion.flush(now_ns):
        events += output.events if isinstance(output, FinalResults) else []
    return events, statuses


@pytest.mark.parametrize(
    ("kind", "words"),
    [("copies", COPIES), ("one microphone", "channels 1, 2, 3 and 4 are the same signal"), ("inverted", INVERTED)],
)
def test_sounds_are_located_without_a_faulty_array_and_the_reason_names_the_channels(kind: str, words: str) -> None:
    outputs = offline.run(site_of(), parts(kind), UnpacedClock())
    events = [output for output in outputs if isinstance(output, Event)]
    assert len(events) == SOUNDS
    for event in events:
        assert event.status is Status.DIRECTION_ONLY
        assert event.estimate is not None
        assert event.estimate.arrays == ("south",)
        assert event.heard_by == ("north", "south")
        assert event.reason is not None
        assert f"'north' is not used: {words}" in event.reason


@pytest.mark.parametrize("kind", ["both", "shared"])
def test_sounds_are_refused_with_the_cause_where_every_array_is_faulty(kind: str) -> None:
    outputs = offline.run(site_of(), parts(kind), UnpacedClock())
    events = [output for output in outputs if isinstance(output, Event)]
    assert len(events) == SOUNDS
    for event in events:
        assert event.status is Status.REFUSED
        assert event.reason is not None
        assert f"'north' is not used: {COPIES if kind == 'both' else SHARED}" in event.reason
        assert "'south' is not used: " in event.reason


@pytest.mark.parametrize(("kind", "words"), [("copies", COPIES), ("inverted", INVERTED), ("shared", SHARED)])
def test_the_state_of_the_array_says_why_it_is_not_used(kind: str, words: str) -> None:
    events, statuses = live(kind)
    assert len(events) == SOUNDS
    assert all(event.estimate is None or "north" not in event.estimate.arrays for event in events)
    north = statuses["north"]
    assert north.state is ArrayState.DEGRADED
    assert north.reason is not None
    assert north.reason.startswith(f"not used: {words}")
    assert (statuses["south"].state is ArrayState.DEGRADED) == (kind == "shared")
