"""What fusion says while a sound lasts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from fusion_steps import START, Scripted, fusion_of, node, now_ns, only_event, play, state_of
from livessl.core.locate.estimator import Localization, Sound
from livessl.core.stream.fusion import Fusion, Role
from livessl.core.types import (
    Candidate,
    Event,
    Status,
    Track,
    TrackState,
    Update,
    Window,
)


def test_updates_come_only_while_there_is_sound() -> None:
    scripted = Scripted()
    arrivals = node("north", range(10, 20), range(120)) + node("south", range(14, 20), range(120))
    fusion = fusion_of(scripted, updates=True)
    said = play(fusion, arrivals, 120)
    updates = [(when, output) for when, output in said if isinstance(output, Update)]
    assert [when for when, _ in updates] == [12, 14, 16, 18, 20]  # every 0.1 s, as the interval ends
    assert {update.event_id for _, update in updates} == {f"site-{(START + 10) * 50}"}
    assert [update.estimate.arrays for _, update in updates] == [("north",)] * 2 + [("north", "south")] * 3
    # windows of 0.2 s, their middle 0.1 s ago; before the sound there is nothing to use
    assert [update.estimate.time_ns for _, update in updates] == [now_ns(when - 2) for when, _ in updates]
    assert [update.complete_ns for _, update in updates] == [now_ns(when) for when, _ in updates]
    assert [call["north"] for call in scripted.calls[:-1]] == [[40], [80], [80], [80], [80]]
    windows = [(when, output) for when, output in said if isinstance(output, Window)]
    assert [(when, window.time_ns) for when, window in windows] == [(w, u.estimate.time_ns) for w, u in updates]
    assert [len(window.evidence) for _, window in windows] == [1, 1, 2, 2, 2]
    assert fusion.power_maps(windows[-1][1]).fused.max() == 2.0
    tracks = [(when, output) for when, output in said if isinstance(output, Track)]
    assert [track.state for _, track in tracks] == [TrackState.NEW] + [TrackState.UPDATE] * 4 + [TrackState.END]
    assert tracks[-1][0] == 20 - 2 + 60 + 1  # three seconds after the last estimate


class Undecided(Scripted):
    """An estimator that cannot tell two places apart."""

    def locate(self, sounds: Mapping[str, Sound]) -> Localization:
        found = super().locate(sounds)
        mirror_m = found.position_m + np.array([0.0, 0.0, 1.0])
        candidates = (Candidate(found.position_m, 0.5), Candidate(mirror_m, 0.5))
        return replace(found, candidates=candidates, ambiguity="all microphones lie in one plane")


def test_estimates_with_candidates_are_directions_and_start_no_track() -> None:
    arrivals = node("north", range(10, 20), range(120)) + node("south", range(10, 20), range(120))
    said = play(fusion_of(Undecided(), updates=True), arrivals, 120)
    event = only_event(said)
    assert event.status is Status.DIRECTION_ONLY
    assert event.reason == "all microphones lie in one plane"
    updates = [output for _, output in said if isinstance(output, Update)]
    assert updates
    answers: list[Event | Update] = [event, *updates]
    for answer in answers:
        assert answer.status is Status.DIRECTION_ONLY
        assert answer.estimate is not None
        assert [each.probability for each in answer.estimate.candidates] == [0.5, 0.5]
    assert not [output for _, output in said if isinstance(output, Track)]


def test_live_fusion_that_is_behind_locates_only_the_newest_window() -> None:
    arrivals = node("north", range(10, 20), range(30)) + node("south", range(10, 20), range(30))
    site = Fusion(state_of(), Role(newest_only=True))
    said = play(site, arrivals, 16)  # in step: nothing is left out
    assert len([output for _, output in said if isinstance(output, Update)]) == 3
    assert site.updates.left_out == 0
    behind = Fusion(state_of(), Role(newest_only=True))
    told = behind.step(
        [message for when, message in sorted(arrivals, key=lambda arrival: arrival[0]) if when <= 17], now_ns(17)
    )
    assert [output.complete_ns for output in told if isinstance(output, Update)] == [now_ns(16)]
    assert behind.updates.left_out == 2


def test_events_only_role_gives_no_updates() -> None:
    arrivals = node("north", range(10, 20), range(40))
    said = play(fusion_of(updates=False), arrivals, 40)
    assert [type(output) for _, output in said] == [Event]
