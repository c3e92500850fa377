"""Through the whole pipeline: an array that receives only its own noise neither moves nor confirms a position."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from livessl import offline
from livessl.clock import UnpacedClock
from livessl.core.stream.final_pass import FinalResults
from livessl.core.types import BackfillRequest, Event, Message, Output, Status
from livessl.recordings.assign import AssignedRecording, make_pipelines
from livessl.recordings.play import paced_messages
from livessl.recordings.recording import MemoryRecording
from livessl.simulation.scene import render
from livessl.site.build.fusion import make_two_pass_fusion
from livessl.site.models import Site
from small_site import RATE_HZ, scene, site_of

START_NS = 1_767_225_600_000_000_000
SOUNDS = 3


@cache
def site(least: int = 1) -> Site:
    nodes = {
        name: {"device": {"name": "x", "sample_rate_hz": RATE_HZ}, "arrays": {array: [1, 2, 3, 4]}}
        for name, array in (("a", "north"), ("b", "south"))
    }
    return site_of({"nodes": nodes, "fusion": {"min_arrays": least}})


@cache
def north() -> Any:
    return render(scene(SOUNDS), site().array("north").microphones_m, seed=1)


def parts(rms: float, seed: int) -> list[AssignedRecording]:
    """The scene at north, noise at south."""
    mute = (rms * np.random.default_rng(seed).standard_normal(north().shape)).astype(np.float32)
    samples = {"north": north(), "south": mute}
    return [
        AssignedRecording(name, MemoryRecording(name, float(RATE_HZ), samples[name]), START_NS, (1, 2, 3, 4))
        for name in samples
    ]


def events(rms: float, seed: int, least: int = 1) -> list[Event]:
    outputs = offline.run(site(least), parts(rms, seed), UnpacedClock())
    return [output for output in outputs if isinstance(output, Event)]


@pytest.mark.parametrize(("rms", "seed"), [(0.0, 1), (3e-5, 2), (3e-5, 3), (1e-3, 4)])
def test_one_array_alone_gives_a_direction(rms: float, seed: int) -> None:
    found = events(rms, seed)
    assert len(found) == SOUNDS
    for event in found:
        assert event.status is Status.DIRECTION_ONLY
        assert event.estimate is not None
        assert event.estimate.arrays == ("north",)
        assert [part.array for part in event.contributions] == ["north"]


@pytest.mark.parametrize("rms", [0.0, 3e-5])
def test_only_arrays_that_contribute_count_for_min_arrays(rms: float) -> None:
    found = events(rms, 5, least=2)
    assert [event.status for event in found] == [Status.REFUSED] * SOUNDS
    for event in found:
        assert event.heard_by == ("north",)
        assert event.reason is not None
        assert "min_arrays is 2" in event.reason


def test_frames_that_carry_no_evidence_do_not_count_as_help() -> None:
    lines, inputs = make_pipelines(site(), parts(1e-4, 7))
    fusion = make_two_pass_fusion(site(), ("north", "south"), live=True)
    for name in ("north", "south"):
        fusion.greet(name, None, START_NS, answers=True)
    final: list[Output | FinalResults] = []
    answers: list[Message] = []
    for now_ns, batch in paced_messages(lines, inputs, UnpacedClock()):
        new = fusion.step([*batch, *answers], now_ns)
        requests = [output for output in new if isinstance(output, BackfillRequest)]
        answers = [message for request in requests for line in lines for message in line.backfill(request)]
        final += new
    final += fusion.flush(START_NS + 60_000_000_000)
    assert fusion.asked["south"] == SOUNDS
    assert fusion.helped == {"north": 0, "south": 0}
    results = [event for output in final if isinstance(output, FinalResults) for event in output.events]
    assert [event.status for event in results] == [Status.DIRECTION_ONLY] * SOUNDS


def test_a_sound_of_one_array_is_refused_where_two_are_wanted_and_says_which_one_it_was() -> None:
    loud = replace(scene(SOUNDS), noise_dbfs=-60.0)
    samples = render(loud, site().array("north").microphones_m, seed=2)
    recordings = parts(1e-4, 9)
    recordings[0] = replace(recordings[0], recording=MemoryRecording("north", float(RATE_HZ), samples))
    outputs = offline.run(site(2), recordings, UnpacedClock())
    reasons = {output.reason for output in outputs if isinstance(output, Event)}
    assert reasons == {"only 'north' carried evidence of it; fusion.min_arrays is 2"}
