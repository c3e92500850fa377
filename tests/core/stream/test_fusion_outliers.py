"""Fusion of three arrays: outliers, and arrays that are not needed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from fusion_steps import (
    EAST,
    NORTH,
    NOTHING,
    SOUTH,
    THREE,
    Arrivals,
    Scripted,
    frame,
    fusion_of,
    mark,
    play,
    sound_at,
    state_of,
    status_of,
)
from livessl.core.locate.estimator import Localization, Sound
from livessl.core.stream.array_health import ArrayState
from livessl.core.stream.fusion import EVENTS_ONLY, Fusion
from livessl.core.types import (
    Event,
    Evidence,
    Status,
)


class Voting(Scripted):
    """An estimator that finds the outliers that the test names."""

    def __init__(self) -> None:
        super().__init__()
        self.outliers: dict[str, float] = {}
        self.suspect: list[set[str]] = []

    def locate(self, sounds: Mapping[str, Sound]) -> Localization:
        self.suspect.append({name for name, sound in sounds.items() if sound.suspect})
        found = super().locate(sounds)
        evidence = tuple(Evidence(spec, NOTHING) for spec in (NORTH, SOUTH, EAST) if spec.name in sounds)
        outliers = {name: off for name, off in self.outliers.items() if name in sounds}
        return replace(found, evidence=evidence, outliers=outliers)


def test_repeated_outlier_is_named_becomes_suspect_and_is_cleared() -> None:
    estimator = Voting()
    fusion = Fusion(state_of(estimator, THREE))
    estimator.outliers = {"east": 29.6}
    for turn in range(4):
        (event,) = (output for output in sound_at(fusion, 20 * turn) if isinstance(output, Event))
        assert event.reason == "located without the outlier 'east' (30° off)"
        assert event.status is Status.LOCATED
        assert event.estimate is not None
        assert event.estimate.arrays == ("north", "south")
        assert event.heard_by == ("north", "south", "east")
        agrees = {c.array: (c.agrees, c.off_deg) for c in event.contributions}
        assert agrees == {"north": (True, None), "south": (True, None), "east": (False, 29.6)}
        status = status_of(fusion, "east", 20 * turn + 20)
        assert (status.agreed, status.disagreed) == (0, turn + 1)
        assert status.state is (ArrayState.HEALTHY if turn < 2 else ArrayState.DEGRADED)
    assert status.reason is not None
    assert "an outlier in 4 of the last 4 events, by 30°; check its pose" in status.reason
    assert status_of(fusion, "north", 80).state is ArrayState.HEALTHY
    assert estimator.suspect[-1] == {"east"}  # the fourth event
    assert "east" not in estimator.calls[-2]  # updates leave out suspect arrays, events do not
    assert "east" in estimator.calls[-1]
    estimator.outliers = {}
    for turn in range(4, 7):
        assert status_of(fusion, "east", 20 * turn).state is ArrayState.DEGRADED
        sound_at(fusion, 20 * turn)
    assert status_of(fusion, "east", 140).state is ArrayState.HEALTHY
    sound_at(fusion, 140)
    assert estimator.suspect[-1] == set()


class Choosing(Voting):
    """An estimator that needs no more than two arrays, which agree."""

    def locate(self, sounds: Mapping[str, Sound]) -> Localization:
        return replace(super().locate(sounds), unneeded={"north"}, outliers={})


def test_array_that_is_not_needed_detects_but_neither_contributes_nor_votes() -> None:
    fusion = Fusion(state_of(Choosing(), THREE))
    (event,) = (output for output in sound_at(fusion, 0) if isinstance(output, Event))
    assert event.heard_by == ("north", "south", "east")
    assert event.estimate is not None
    assert event.estimate.arrays == ("south", "east")
    assert {c.array: c.agrees for c in event.contributions} == {"north": None, "south": True, "east": True}
    assert [status_of(fusion, name, 20).agreed for name in ("north", "south", "east")] == [0, 1, 1]


def test_two_arrays_have_no_vote_and_two_passes_count_a_sound_once() -> None:
    estimator = Voting()
    shared = state_of(estimator, THREE)
    fusion = Fusion(shared)
    sound_at(fusion, 0, ("north", "south"))
    assert (status_of(fusion, "north", 20).agreed, status_of(fusion, "north", 20).disagreed) == (0, 0)
    final = Fusion(shared, EVENTS_ONLY)
    estimator.outliers = {"south": 12.0}
    sound_at(final, 20)
    sound_at(fusion, 20)  # the other pass's result of the same sound
    assert (status_of(fusion, "south", 40).agreed, status_of(fusion, "south", 40).disagreed) == (0, 1)


def test_microphone_that_receives_no_sound_is_reported() -> None:
    samples = np.random.default_rng(3).standard_normal((4, 800)).astype(np.float32)
    samples[2] *= 1e-3
    arrivals: Arrivals = [(k + 1.0, frame("north", k, samples=samples.copy())) for k in range(10)]
    arrivals += [(k + 1.0, mark("north", k)) for k in range(10, 40)]
    fusion = fusion_of()
    play(fusion, arrivals, 40)
    status = status_of(fusion, "north", 40)
    assert status.state is ArrayState.DEGRADED
    assert status.reason is not None
    assert "microphone [3] receives next to nothing of what the others receive" in status.reason
    again: Arrivals = [(k + 1.0, frame("north", k, samples=samples[[0, 1, 0, 1]])) for k in range(40, 44)]
    play(fusion, again, 44, 40)
    assert status_of(fusion, "north", 44).state is ArrayState.HEALTHY
