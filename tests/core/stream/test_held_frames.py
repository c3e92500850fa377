"""Frames that wait for the final pass: what goes when memory gets short."""

from __future__ import annotations

import numpy as np
import pytest

from livessl.core.stream.held_frames import CLEAREST_ARRAYS, FORCED_FRAMES, HEADER_BYTES, HeldFrames
from livessl.core.types import FRAME_NS, Frame

SAMPLES = 100
FRAME_BYTES = HEADER_BYTES + 4 * SAMPLES * 4
ARRAYS = [f"a{k}" for k in range(8)]


def frame(array: str, frame_index: int, power: float = 1e-7) -> Frame:
    samples = np.ones((4, SAMPLES), np.float32)
    return Frame(array, frame_index, frame_index, frame_index * FRAME_NS, 16000.0, samples, power, power > 1e-6)


def push(held: HeldFrames, frame_indices: range, arrays: list[str], power: float) -> None:
    for frame_index in frame_indices:
        for array in arrays:
            held.push(frame(array, frame_index, power), frame_index, 0)


def push_sound(held: HeldFrames, first: int, clearest: list[str]) -> None:
    """Ten frames of every array, two of them of the run-up; `clearest` are nearest to the sound."""
    push(held, range(first, first + 2), ARRAYS, 1e-7)
    push(held, range(first + 2, first + 10), clearest, 1e-2)
    push(held, range(first + 2, first + 10), [array for array in ARRAYS if array not in clearest], 1e-5)


def with_samples(frames: list[Frame]) -> set[str]:
    return {frame.array for frame in frames if frame.samples.size}


def test_samples_of_the_clearest_arrays_of_each_sound_stay() -> None:
    held = HeldFrames(hold_bytes=round(20 * len(ARRAYS) * FRAME_BYTES))
    push_sound(held, 100, ARRAYS[:CLEAREST_ARRAYS])
    push_sound(held, 130, ARRAYS[-CLEAREST_ARRAYS:])
    before = held.nbytes
    dropped = held.expire(0, None)
    assert dropped == dict.fromkeys(ARRAYS, 10)  # each in one of the sounds
    assert held.nbytes == before - sum(dropped.values()) * 4 * SAMPLES * 4
    assert held.forced_until is None
    first, second = held.pop_until(120), held.pop_until(200)
    assert (len(first), len(second)) == (80, 80)  # no frame is lost
    assert with_samples(first) == set(ARRAYS[:CLEAREST_ARRAYS])
    assert with_samples(second) == set(ARRAYS[-CLEAREST_ARRAYS:])
    assert held.nbytes == 0


@pytest.mark.parametrize("shedding", [False, True])
def test_nothing_goes_while_there_is_room(shedding: bool) -> None:
    held = HeldFrames(hold_bytes=(4 if shedding else 1) * 2 * 10 * len(ARRAYS) * FRAME_BYTES)
    push_sound(held, 100, ARRAYS[:1])
    assert not held.expire(0, None, shedding=shedding)
    assert len(with_samples(held.pop_until(200))) == len(ARRAYS)


def test_arrays_are_no_longer_awaited_when_samples_are_not_enough() -> None:
    held = HeldFrames(hold_bytes=30 * FRAME_BYTES)
    push(held, range(1000, 1100), ["a0"], 1e-2)
    held.expire(0, 990)
    assert held.forced_until == 1000 + FORCED_FRAMES
    held.expire(0, 990)  # the final pass has not gone that far yet
    assert held.forced_until == 1000 + FORCED_FRAMES
    held.pop_until(1000 + FORCED_FRAMES)
    held.expire(0, 1000 + FORCED_FRAMES)
    assert held.forced_until == 1000 + 2 * FORCED_FRAMES + 1


def test_samples_are_dropped_anew_only_after_more_have_come() -> None:
    held = HeldFrames(hold_bytes=10 * len(ARRAYS) * FRAME_BYTES)
    push_sound(held, 100, ARRAYS[:2])
    assert held.expire(0, None)
    held.push(frame("a7", 109, 1e-5), 109, 0)
    assert not held.expire(0, None)
    push_sound(held, 130, ARRAYS[:2])
    assert held.expire(0, None)


def test_arrays_that_stay_are_the_same_when_samples_are_dropped_again() -> None:
    """Others become clearer while the sound goes on, but only the first ones still have samples of its beginning."""
    held = HeldFrames(hold_bytes=20 * len(ARRAYS) * FRAME_BYTES)
    for first, clearest in ((100, ARRAYS[:CLEAREST_ARRAYS]), (120, ARRAYS[CLEAREST_ARRAYS:])):
        push(held, range(first, first + 20), clearest, 1e-1)
        push(held, range(first, first + 20), [a for a in ARRAYS if a not in clearest], 1e-4)
        assert held.expire(0, None)
    frames = held.pop_until(200)
    assert {f.frame_index for f in frames if f.samples.size and f.array in ARRAYS[:CLEAREST_ARRAYS]} == set(
        range(100, 140)
    )


def test_array_that_becomes_clearer_is_kept_besides_the_first_ones() -> None:
    held = HeldFrames(hold_bytes=2 * 20 * len(ARRAYS) * FRAME_BYTES)
    push(held, range(98, 100), ARRAYS, 1e-7)
    louder = ARRAYS[CLEAREST_ARRAYS : CLEAREST_ARRAYS + 1]
    for first, clearest, power in ((100, ARRAYS[:CLEAREST_ARRAYS], 1e-2), (120, louder, 1e-1)):
        push(held, range(first, first + 20), clearest, power)
        push(held, range(first, first + 20), [a for a in ARRAYS if a not in clearest], 1e-4)
    assert held.expire(0, None)
    assert with_samples(held.pop_until(200)) == set(ARRAYS[: CLEAREST_ARRAYS + 1])


def test_without_a_quiet_frame_the_most_powerful_arrays_are_the_clearest() -> None:
    held = HeldFrames(hold_bytes=20 * len(ARRAYS) * FRAME_BYTES)
    push(held, range(100, 120), ARRAYS[:CLEAREST_ARRAYS], 1e-5)
    push(held, range(100, 120), ARRAYS[CLEAREST_ARRAYS:], 1e-2)
    assert held.expire(0, None)
    assert with_samples(held.pop_until(200)) == set(ARRAYS[CLEAREST_ARRAYS:])


def test_nothing_is_given_up_that_has_not_come() -> None:
    held = HeldFrames(hold_bytes=5 * FRAME_BYTES)
    push(held, range(1000, 1010), ["a0"], 1e-2)
    held.expire(0, 990)
    assert held.forced_until == 1009


def test_samples_go_before_anything_is_given_up() -> None:
    """In small steps, in which samples would not be due to be dropped yet."""
    held = HeldFrames(hold_bytes=100 * FRAME_BYTES)
    for frame_index in range(1000, 1012):  # of four arrays, some 50 frames are left with samples
        push(held, range(frame_index, frame_index + 1), ARRAYS, 1e-4)
        push(held, range(frame_index, frame_index + 1), ["a8", "a9", "a10"], 1e-2)
        held.expire(0, 990)
    assert held.forced_until is None
    assert held.nbytes <= 100 * FRAME_BYTES


@pytest.mark.parametrize("frames_ahead", [-3, 3])
@pytest.mark.parametrize("corrected", [ARRAYS, ARRAYS[-CLEAREST_ARRAYS:]], ids=["all arrays", "the clearest"])
def test_correction_of_clocks_leaves_every_frame_its_choice_of_arrays(frames_ahead: int, corrected: list[str]) -> None:
    """Two sounds so close that the frames of one then have frame indices of the other."""
    held = HeldFrames(hold_bytes=2 * 10 * len(ARRAYS) * FRAME_BYTES)
    push_sound(held, 100, ARRAYS[:CLEAREST_ARRAYS])
    push_sound(held, 112, ARRAYS[-CLEAREST_ARRAYS:])
    assert held.expire(0, None)
    held.reindex(lambda array: frames_ahead if array in corrected else 0)
    push_sound(held, 200, ARRAYS[:1])
    assert held.expire(0, None)
    kept = {(f.array, f.frame_index) for f in held.pop_until(150) if f.samples.size}
    first, second = range(100, 110), range(112, 122)
    assert kept == {(array, k) for array in ARRAYS[:CLEAREST_ARRAYS] for k in first} | {
        (array, k) for array in ARRAYS[-CLEAREST_ARRAYS:] for k in second
    }


def test_new_sound_is_not_thinned_by_a_choice_that_was_made_before_a_correction() -> None:
    held = HeldFrames(hold_bytes=2 * 10 * len(ARRAYS) * FRAME_BYTES)
    push_sound(held, 100, ARRAYS[:CLEAREST_ARRAYS])
    push_sound(held, 112, ARRAYS[:CLEAREST_ARRAYS])
    assert held.expire(0, None)
    held.reindex(lambda _: 20)
    push_sound(held, 112, ARRAYS[-CLEAREST_ARRAYS:])
    push_sound(held, 124, ARRAYS[-CLEAREST_ARRAYS:])
    assert held.expire(0, None)
    held.pop_until(111)
    assert with_samples(held.pop_until(150)) == set(ARRAYS[-CLEAREST_ARRAYS:])


def test_frame_is_overdue_by_its_corrected_frame_index() -> None:
    held = HeldFrames(hold_ns=1000)
    push(held, range(100, 101), ["a0"], 1e-2)
    held.reindex(lambda _: -3)
    held.expire(0, 101)  # the final pass has not come to the frame, which is that of 103 now
    held.expire(2000, 101)
    assert held.overdue_until == 103
