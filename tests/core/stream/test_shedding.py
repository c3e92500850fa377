"""What the fusion gives up while the server is overloaded, and what it does not."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fusion_steps import NORTH, NOTHING, SOURCE_M, START, Scripted, frame, mark, now_ns, state_of, told
from livessl.core.correlate.onset_gcc import OnsetGCC
from livessl.core.locate.estimator import Localization, Sound
from livessl.core.stream.final_pass import FinalResults, TwoPassFusion
from livessl.core.stream.fusion import Fusion, Role
from livessl.core.stream.load_policy import LEVELS, Relief
from livessl.core.stream.site_state import MOST_CORRELATED
from livessl.core.stream.verdict import NO_SOUND
from livessl.core.types import Event, Evidence, Float32Array, Frame, Message, Output, Status, Update

ARRAYS = [replace(NORTH, name=f"a{k:02d}") for k in range(MOST_CORRELATED + 8)]


class Counting(Scripted):
    """An estimator that counts the frames that it correlates, and keeps what it is given."""

    def __init__(self) -> None:
        super().__init__()
        self.correlated: dict[str, int] = dict.fromkeys((spec.name for spec in ARRAYS), 0)
        self.given: list[dict[str, tuple[float, ...]]] = []
        self.looked_again: list[set[bool]] = []

    def onset_front_end(self, array: str, sample_rate_hz: float) -> FrontEnd:  # type: ignore[override]
        return FrontEnd(self, array, sample_rate_hz)

    def locate(self, sounds: Mapping[str, Sound]) -> Localization:
        self.given.append({name: tuple(onset.weight for onset in sound.onsets) for name, sound in sounds.items()})
        self.looked_again.append({sound.second_looks for sound in sounds.values()})
        heard = tuple(Evidence(spec, NOTHING) for spec in ARRAYS if spec.name in sounds)
        return Localization(SOURCE_M.copy(), 0.01 * np.eye(3), 0.9, heard, outliers={})


class FrontEnd:
    """Its value for a frame depends on all frames since the beginning of the run."""

    def __init__(self, counting: Counting, array: str, sample_rate_hz: float) -> None:
        self.sample_rate_hz = sample_rate_hz
        self._counting, self._array, self._sum = counting, array, 0.0

    def reset(self) -> None:
        self._sum = 0.0

    def push(self, samples: Float32Array, *, quiet: bool) -> OnsetGCC:
        self._counting.correlated[self._array] += 1
        self._sum = 0.5 * self._sum + float(samples.sum()) + quiet
        return OnsetGCC(np.zeros((6, 3), np.float32), np.full(4, self._sum))


def sound(active: set[int], until: int, clearest: int = 0, count: int = len(ARRAYS)) -> list[list[Message]]:
    """The messages of each frame index. The arrays are clearest in order from `clearest` on, cyclically."""
    steps = []
    for frame_index in range(until):
        step: list[Message] = []
        for k, spec in enumerate(ARRAYS[:count]):
            rank = (k - clearest) % count
            if any(frame_index - back in active for back in range(-4, 7)):
                power = 1e-7 if frame_index not in active else 0.1 * 0.8**rank
                samples = np.full((4, 20), 0.1 + 1e-3 * (frame_index % 7) + 1e-4 * k, np.float32)
                step.append(frame(spec.name, frame_index, frame_index in active, power, samples=samples))
            else:
                step.append(mark(spec.name, frame_index))
        steps.append(step)
    return steps


def run(fusion: Fusion | TwoPassFusion, steps: list[list[Message]]) -> list[Output]:
    outputs: list[Output] = []
    for now, step in enumerate(steps, 1):
        for output in fusion.step(step, now_ns(now)):
            outputs += output.events if isinstance(output, FinalResults) else [output]
    return outputs


def fusion_with(counting: Counting, relief: Relief, count: int = len(ARRAYS), **parameters: float) -> Fusion:
    state = state_of(counting, ARRAYS[:count], **parameters)
    state.relieve(relief)
    return Fusion(state, Role())


def events(outputs: list[Output]) -> list[Event]:
    return [output for output in outputs if isinstance(output, Event)]


@settings(max_examples=5, deadline=None)
@given(most=st.integers(1, 12), clearest=st.integers(0, 19))
def test_an_event_is_located_from_the_clearest_arrays_and_names_all_that_detected_it(most: int, clearest: int) -> None:
    counting = Counting()
    outputs = run(fusion_with(counting, Relief(arrays=most), 20), sound(set(range(10, 30)), 50, clearest, 20))
    (event,) = events(outputs)
    names = {ARRAYS[(clearest + rank) % 20].name for rank in range(most)}
    assert set(counting.given[-1]) == names
    assert {name for name, frames in counting.correlated.items() if frames} == names
    assert event.heard_by == tuple(spec.name for spec in ARRAYS[:20])
    assert {c.array for c in event.contributions} == set(event.heard_by)
    assert all(c.agrees is None for c in event.contributions if c.array not in names)


def test_beyond_a_number_of_arrays_the_least_clear_are_not_correlated_even_without_load() -> None:
    counting = Counting()
    (event,) = events(run(fusion_with(counting, LEVELS[0]), sound(set(range(10, 30)), 50, clearest=3)))
    assert len(event.heard_by) == len(ARRAYS)
    correlated = {name for name, frames in counting.correlated.items() if frames}
    assert correlated == {ARRAYS[(3 + rank) % len(ARRAYS)].name for rank in range(MOST_CORRELATED)}


def test_the_least_number_of_arrays_is_never_shed() -> None:
    counting = Counting()
    (event,) = events(run(fusion_with(counting, Relief(arrays=2), 20, min_arrays=5), sound({10, 11, 12}, 30, 0, 20)))
    assert event.status is Status.LOCATED
    assert len(counting.given[-1]) == 5


@pytest.mark.parametrize("relief", [LEVELS[0], LEVELS[1], *LEVELS[2:5], Relief(second_looks=False)])
def test_windows_and_events_allow_second_looks_unless_these_are_shed(relief: Relief) -> None:
    counting = Counting()
    state = state_of(counting, ARRAYS[:4])
    state.relieve(relief)
    outputs = run(TwoPassFusion(state, [spec.name for spec in ARRAYS[:4]]), sound(set(range(10, 40)), 60, 0, 4))
    assert {type(output) for output in outputs} >= {Update, Event}
    assert counting.looked_again
    assert all(allowed == {relief.second_looks} for allowed in counting.looked_again)


@pytest.mark.parametrize("every", [1, 2, 5, None])
def test_of_the_updates_of_a_sound_some_are_left_out(every: int | None) -> None:
    fusion = fusion_with(Counting(), Relief(update_every=every), 4)
    outputs = run(fusion, sound(set(range(10, 50)), 70, 0, 4))
    updates = sum(isinstance(output, Update) for output in outputs)
    assert updates == (0 if every is None else 20 // every)
    assert fusion.updates.shed == 20 - updates
    assert len(events(outputs)) == 1


@settings(max_examples=8, deadline=None)
@given(pauses=st.sets(st.integers(11, 38)))
def test_quiet_frames_that_are_postponed_change_no_event(pauses: set[int]) -> None:
    """Correlated as they come, or only once sound follows: events and evidence are the same."""
    steps = sound(set(range(10, 40)) - pauses, 60, 0, 4)
    told_, given_, correlated = [], [], []
    for ahead in (True, False):
        counting = Counting()
        told_.append(told(run(fusion_with(counting, Relief(ahead=ahead), 4), steps)))
        given_.append(counting.given)
        correlated.append(sum(counting.correlated.values()))
    assert told_[0] == told_[1]
    assert given_[0] == given_[1]
    assert correlated[1] < correlated[0]


def test_the_choice_may_change_while_the_sound_goes_on() -> None:
    """The level rises in the middle of an event, and falls again: the event is reported once, from what there is."""
    counting = Counting()
    state = state_of(counting, ARRAYS)
    fusion = TwoPassFusion(state, [spec.name for spec in ARRAYS])
    outputs: list[Output] = []
    for now, step in enumerate(sound(set(range(10, 90)), 110), 1):
        state.relieve(Relief(arrays=4) if 30 <= now < 60 else LEVELS[0])
        for output in fusion.step(step, now_ns(now)):
            outputs += output.events if isinstance(output, FinalResults) else [output]
    (event,) = events(outputs)
    assert event.status is Status.LOCATED
    assert set(event.heard_by) == {spec.name for spec in ARRAYS}
    assert event.start_ns == (START + 10) * 50_000_000


def test_frames_without_samples_take_part_in_the_activity_only() -> None:
    counting = Counting()
    steps = sound(set(range(10, 30)), 50, 0, 6)
    bare = [
        [replace(m, samples=m.samples[:, :0].copy()) if m.array > "a02" and isinstance(m, Frame) else m for m in step]
        for step in steps
    ]
    (event,) = events(run(fusion_with(counting, LEVELS[0], 6), bare))
    assert event.heard_by == tuple(spec.name for spec in ARRAYS[:6])
    assert set(counting.given[-1]) == {"a00", "a01", "a02"}


def test_a_sound_of_which_no_samples_are_left_is_refused_and_not_forgotten() -> None:
    steps = sound(set(range(10, 30)), 50, 0, 3)
    bare = [
        [replace(m, samples=m.samples[:, :0].copy()) if isinstance(m, Frame) else m for m in step] for step in steps
    ]
    (event,) = events(run(fusion_with(Counting(), LEVELS[0], 3), bare))
    assert (event.status, event.reason) == (Status.REFUSED, NO_SOUND)
    assert len(event.heard_by) == 3
