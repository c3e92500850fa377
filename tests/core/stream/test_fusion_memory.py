"""Fusion for ever: memory is bounded, and each frame is correlated once."""

from __future__ import annotations

import pickle
import weakref
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from free_field import RATE_HZ
from fusion_steps import (
    NORTH,
    NOTHING,
    SOURCE_M,
    START,
    Arrivals,
    FrontEnd,
    Scripted,
    events_of,
    frame,
    fusion_of,
    mark,
    node,
    now_ns,
    play,
    state_of,
    status_of,
)
from livessl.core.correlate.onset_gcc import OnsetGCC, summed
from livessl.core.locate.estimator import Localization, Sound
from livessl.core.stream.array_health import ArrayHealth, ArrayState
from livessl.core.stream.array_stream import ArrayStream
from livessl.core.stream.evidence import KEPT_ARRAYS, RELEASE_FRAMES
from livessl.core.stream.fusion import EVENTS_ONLY, Fusion, Role
from livessl.core.types import (
    Event,
    Evidence,
    Float32Array,
    Frame,
    Message,
    Output,
    Status,
    Track,
    Update,
)


@pytest.mark.parametrize("arrays", [("north",), ("north", "south")])
def test_memory_does_not_grow(arrays: tuple[str, ...]) -> None:
    """Hours of quiet with a sound now and then: what is held is the last second's, whatever came before."""
    scripted = Scripted()
    fusion = fusion_of(scripted, max_event_s=1.0)
    held: list[weakref.ref[Float32Array]] = []
    sizes = []
    for frame_index in range(12_000):
        loud = frame_index % 100 < 45
        for array in arrays:
            message: Message = frame(array, frame_index) if loud else mark(array, frame_index)
            if isinstance(message, Frame):
                held.append(weakref.ref(message.samples))
            fusion.step([message], now_ns(frame_index + 1))
        if frame_index % 2000 == 1999:
            scripted.calls.clear()
            sizes.append(len(pickle.dumps(fusion)))
            held = [reference for reference in held if reference() is not None]
            # an event of 20 frames, and 9 for pre-roll and window before it
            assert len(held) <= len(arrays) * (20 + 9 + 2)
    assert max(sizes[1:]) <= sizes[0] + 200  # counters get longer


class Gauge:
    """Stands for a front end: it says of each frame how loud it was."""

    sample_rate_hz = RATE_HZ

    def push(self, samples: Float32Array, *, quiet: bool) -> OnsetGCC:
        assert samples.size
        return OnsetGCC(np.zeros((1, 1), np.float32), np.full(4, np.abs(samples).max(), np.float64))

    def reset(self) -> None:
        raise AssertionError("all frames are there")


class Gauged(Scripted):
    """Listens."""

    def onset_front_end(self, array: str, sample_rate_hz: float) -> Any:
        return Gauge()

    def locate(self, sounds: Mapping[str, Sound]) -> Localization:
        self.calls.append({name: [piece.shape[1] for piece in sound.segments] for name, sound in sounds.items()})
        heard = tuple(Evidence(spec, NOTHING) for spec in MANY if spec.name in sounds)
        return Localization(SOURCE_M.copy(), 0.01 * np.eye(3), 0.5, heard)


MANY = [replace(NORTH, name=f"a{k:02d}") for k in range(KEPT_ARRAYS + 6)]


@pytest.mark.parametrize("order", [1, -1])
def test_of_many_arrays_only_those_with_strong_onsets_keep_samples(order: int) -> None:
    """The correlations of the other arrays stay: these arrays detect the event and contribute to it."""
    gauged = Gauged()
    fusion = Fusion(state_of(gauged, MANY), EVENTS_ONLY)
    held: dict[str, list[weakref.ref[Float32Array]]] = {spec.name: [] for spec in MANY}
    most = dict.fromkeys(held, 0)
    events: list[Output] = []
    for frame_index in range(100):
        for rank, spec in enumerate(MANY[::order]):
            message: Message = mark(spec.name, frame_index)
            if frame_index < 90:
                samples = np.full((4, 20), 1e-3 * (1 + rank), np.float32)
                message = frame(
                    spec.name, frame_index, frame_index >= 10, 1e-2 if frame_index >= 10 else 1e-7, samples=samples
                )
                held[spec.name].append(weakref.ref(message.samples))
            events += fusion.step([message], now_ns(frame_index + 1))
            del message
        for name, references in held.items():
            held[name] = [reference for reference in references if reference() is not None]
            most[name] = max(most[name], len(held[name]))
    (event,) = [output for output in events if isinstance(output, Event)]
    assert set(event.heard_by) == set(most)
    assert {c.array: c.active_s for c in event.contributions} == dict.fromkeys(most, 4.0)  # 80 frames
    let_go = {spec.name for spec in MANY[::order][:6]}
    for name, pieces in gauged.calls[-1].items():
        assert (sum(pieces) < 20 * 20) if name in let_go else (pieces == [80 * 20]), name
        # windows and a hang-over, and what has come since the last look; else all of it with the run-up
        assert (most[name] <= 10 + RELEASE_FRAMES + 9) if name in let_go else (most[name] >= 88), name


def test_released_samples_do_not_depend_on_the_order_of_arrival() -> None:
    """One by one, in another order, or all at once, as a recording's: the same pieces are left of every array."""
    loudness = np.random.default_rng(1).uniform(0.5, 1.0, (len(MANY), 90)).astype(np.float32)
    frames: list[Message] = [
        frame(spec.name, frame_index, frame_index >= 10, samples=np.full((4, 20), loudness[k, frame_index], np.float32))
        for frame_index in range(90)
        for k, spec in enumerate(MANY)
    ]
    quiet: list[Message] = [mark(spec.name, frame_index) for frame_index in range(90, 100) for spec in MANY]
    left = []
    for steps in (
        [[message] for message in frames + quiet],
        [[message] for message in sorted(frames + quiet, key=lambda m: (m.frame_index, -int(m.array[1:])))],
        [frames + quiet],
    ):
        gauged = Gauged()
        fusion = Fusion(state_of(gauged, MANY), EVENTS_ONLY)
        said = [output for step in steps for output in fusion.step(step, now_ns(step[-1].frame_index - START + 1))]
        assert sum(isinstance(output, Event) for output in said) == 1
        left.append(gauged.calls[-1])
    assert left[0] == left[1] == left[2]
    assert len({sum(pieces) for pieces in left[0].values()}) > 2  # some went early, some late, some not at all


class Correlating(Scripted):
    """An estimator with a front end for every frame."""

    def __init__(self, refused: str | None = None) -> None:
        super().__init__()
        self.heard: list[tuple[int, bool] | None] = []
        self.sums: list[tuple[float, float]] = []
        self.refused = refused

    def onset_front_end(self, array: str, sample_rate_hz: float) -> Any:
        assert (array, sample_rate_hz) == ("north", RATE_HZ)
        self.heard.append(None)  # a new one, that has heard nothing
        return FrontEnd(self.heard)

    def locate(self, sounds: Mapping[str, Sound]) -> Localization:
        onsets = summed(sounds["north"].onsets)
        self.sums.append((float(onsets.lags.sum()), onsets.weight))
        return replace(super().locate(sounds), refused=self.refused)


def numbered(frame_index: int, active: bool) -> Frame:
    return frame(
        "north", frame_index, active, 1e-2 if active else 1e-7, samples=np.full((4, 20), frame_index, np.float32)
    )


def test_each_frame_of_an_event_is_correlated_once_and_in_order() -> None:
    estimator = Correlating()
    arrivals: Arrivals = [(k + 1.0, numbered(k, 12 <= k < 15)) for k in range(4, 40) if k != 13]
    events = events_of(play(fusion_of(estimator, updates=True), arrivals, 60))
    before = [(k, True) for k in range(4, 12)]  # 0.4 s of pre-roll
    after = [(k, True) for k in range(15, 21)]
    assert estimator.heard == [None, *before, (12, False), None, (14, False), *after]
    assert len(events) == 1
    assert estimator.sums[-1] == (sum(range(4, 13)) + 14, 10.0)  # up to the last active one


def test_late_frames_are_correlated_in_their_place() -> None:
    on_time, late = Correlating(), Correlating()
    arrivals: Arrivals = [(k + 1.0, numbered(k, 12 <= k < 18)) for k in range(4, 40)]
    events_of(play(fusion_of(on_time), arrivals, 60))
    held = [(21.0 if frame.frame_index == START + 13 else when, frame) for when, frame in arrivals]
    (event,) = (event for _, event in events_of(play(fusion_of(late), held, 60)))
    assert event.late_frames == 1
    assert late.sums == on_time.sums
    assert late.heard.count(None) > 1  # it had been missing at first
    assert on_time.heard.count(None) == 1


def test_two_passes_correlate_each_frame_once() -> None:
    """Each pass uses the correlations of the other while both have the same frames, and then makes its own."""
    arrivals: Arrivals = [(k + 1.0, numbered(k, 12 <= k < 18)) for k in range(4, 40)]
    alone, both = Correlating(), Correlating()
    play(fusion_of(alone), arrivals, 60)
    shared = state_of(both)
    for fusion in (Fusion(shared, EVENTS_ONLY), Fusion(shared, EVENTS_ONLY)):
        play(fusion, arrivals, 60)
    assert both.heard == alone.heard
    assert both.sums == 2 * alone.sums

    partly = Correlating()
    shared = state_of(partly)
    first, second = Fusion(shared, EVENTS_ONLY), Fusion(shared, EVENTS_ONLY)
    play(first, [arrival for arrival in arrivals if arrival[1].frame_index != START + 16], 60)
    play(second, arrivals, 60)
    assert partly.sums[-1] == alone.sums[-1]


@pytest.mark.parametrize("pause", [5, 7, 9])
def test_correlating_ahead_changes_no_result(pause: int) -> None:
    """A pre-roll that is known to begin at the end of the last sound has been correlated when the next one comes."""
    again = range(18 + pause, 24 + pause)
    arrivals: Arrivals = [(k + 1.0, numbered(k, 12 <= k < 18 or k in again)) for k in range(4, 50)]
    told, heard_at_once = [], []
    for newest_only in (False, True):
        estimator = Correlating()
        fusion = Fusion(state_of(estimator), Role(updates=False, newest_only=newest_only))
        until = [arrival for arrival in arrivals if arrival[1].frame_index < START + again.start]
        play(fusion, until, again.start)
        before = len(estimator.heard)
        fusion.step([numbered(again.start, True)], now_ns(again.start + 1.0))
        heard_at_once.append(len(estimator.heard) - before)
        play(
            fusion,
            [arrival for arrival in arrivals if arrival[1].frame_index > START + again.start],
            70,
            again.start + 2,
        )
        told.append(estimator.sums)
    assert told[0] == told[1]
    assert heard_at_once[0] == {5: 1, 7: 9, 9: 10}[pause]
    assert heard_at_once[1] == {5: 1, 7: 1, 9: 10}[pause]


def test_memory_of_a_sound_without_end_is_bounded() -> None:
    fusion = fusion_of(Correlating(), max_event_s=1.0)
    held: list[weakref.ref[Float32Array]] = []
    most = 0
    for k in range(4, 200):
        message = numbered(k, k >= 12)
        held.append(weakref.ref(message.samples))
        fusion.step([message], now_ns(k + 1))
        del message
        held = [reference for reference in held if reference() is not None]
        most = max(most, len(held))
    assert 20 <= most < 60  # a second of sound, and what windows and pre-rolls reach back to


def test_correlations_are_pruned_with_their_frames() -> None:
    stream = ArrayStream(NORTH, ArrayHealth(4))
    for k in range(10):
        stream.add(numbered(k, True))
        stream.correlations.onsets[START + k] = OnsetGCC(np.zeros((1, 1), np.float32), np.ones(1))
    stream.prune(START + 7)
    assert list(stream.frames) == list(stream.correlations.onsets) == [START + k for k in (7, 8, 9)]


@pytest.mark.parametrize("refused", [None, "too unsure"])
def test_refused_location_gives_no_position_and_no_track(refused: str | None) -> None:
    estimator = Scripted()
    place = estimator.locate
    estimator.locate = lambda sounds: replace(place(sounds), refused=refused)  # type: ignore[method-assign]
    arrivals = node("north", range(12, 30), range(60)) + node("south", range(12, 30), range(60))
    said = [output for _, output in play(fusion_of(estimator, updates=True), arrivals, 70)]
    (event,) = (output for output in said if isinstance(output, Event))
    expected = Status.LOCATED if refused is None else Status.REFUSED
    assert (event.status, event.reason, event.estimate is None) == (expected, refused, refused is not None)
    assert {output.status for output in said if isinstance(output, Update)} == {expected}
    assert any(isinstance(output, Track) for output in said) == (refused is None)


def test_microphone_that_dies_during_a_sound_is_reported() -> None:
    """No mark comes during a sound, but the samples of its frames show the same."""
    fusion = fusion_of()
    samples = np.full((4, 20), 0.1, np.float32)
    samples[2] = 0.0
    arrivals: Arrivals = [(k + 1.0, frame("north", k, samples=samples.copy())) for k in range(30)]
    play(fusion, arrivals, 19)
    assert status_of(fusion, "north", 20).state is ArrayState.HEALTHY
    play(fusion, arrivals[20:], 30, start=20)
    status = status_of(fusion, "north", 30)
    assert status.state is ArrayState.DEGRADED
    assert status.reason == "microphone [3] is dead: all-zero samples; check cable, gain and channel numbers"
