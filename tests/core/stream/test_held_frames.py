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


def push_sound(held: HeldFrames, first: int, clearest: list[str]) -> None:
    """Ten frames of every array, two of them of the run-up; `clearest` are nearest to the sound."""
    for frame_index in range(first, first + 10):
        for array in ARRAYS:
            loud = 1e-2 if array in clearest else 1e-5
            held.push(frame(array, frame_index, loud if frame_index >= first + 2 else 1e-7), frame_index, 0)


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
    for frame_index in range(1000, 1100):
        held.push(frame("a0", frame_index, 1e-2), frame_index, 0)
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


def frames_at(held: HeldFrames, frame_indices: range, arrays: list[str], power: float) -> None:
    for frame_index in frame_indices:
        for array in arrays:
            held.push(frame(array, frame_index, power), frame_index, 0)


def test_arrays_that_stay_are_the_same_when_samples_are_dropped_again() -> None:
    """Others become clearer while the sound goes on; nobody has the beginning of it then but those that were kept."""
    held = HeldFrames(hold_bytes=20 * len(ARRAYS) * FRAME_BYTES)
    for first, clearest in ((100, ARRAYS[:CLEAREST_ARRAYS]), (120, ARRAYS[CLEAREST_ARRAYS:])):
        frames_at(held, range(first, first + 20), clearest, 1e-1)
        frames_at(held, range(first, first + 20), [a for a in ARRAYS if a not in clearest], 1e-4)
        assert held.expire(0, None)
    frames = held.pop_until(200)
    assert {f.frame_index for f in frames if f.samples.size and f.array in ARRAYS[:CLEAREST_ARRAYS]} == set(
        range(100, 140)
    )


def test_array_that_becomes_clearer_is_kept_besides_the_first_ones() -> None:
    held = HeldFrames(hold_bytes=2 * 20 * len(ARRAYS) * FRAME_BYTES)
    frames_at(held, range(98, 100), ARRAYS, 1e-7)
    louder = ARRAYS[CLEAREST_ARRAYS : CLEAREST_ARRAYS + 1]
    for first, clearest, power in ((100, ARRAYS[:CLEAREST_ARRAYS], 1e-2), (120, louder, 1e-1)):
        frames_at(held, range(first, first + 20), clearest, power)
        frames_at(held, range(first, first + 20), [a for a in ARRAYS if a not in clearest], 1e-4)
    assert held.expire(0, None)
    assert with_samples(held.pop_until(200)) == set(ARRAYS[: CLEAREST_ARRAYS + 1])


def test_without_a_quiet_frame_the_most_powerful_arrays_are_the_clearest() -> None:
    held = HeldFrames(hold_bytes=20 * len(ARRAYS) * FRAME_BYTES)
    frames_at(held, range(100, 120), ARRAYS[:CLEAREST_ARRAYS], 1e-5)
    frames_at(held, range(100, 120), ARRAYS[CLEAREST_ARRAYS:], 1e-2)
    assert held.expire(0, None)
    assert with_samples(held.pop_until(200)) == set(ARRAYS[CLEAREST_ARRAYS:])


def test_nothing_is_given_up_that_has_not_come() -> None:
    held = HeldFrames(hold_bytes=5 * FRAME_BYTES)
    frames_at(held, range(1000, 1010), ["a0"], 1e-2)
    held.expire(0, 990)
    assert held.forced_until == 1009


def test_samples_go_before_anything_is_given_up() -> None:
    """In small steps, in which samples would not be due to be dropped yet."""
    held = HeldFrames(hold_bytes=100 * FRAME_BYTES)
    for frame_index in range(1000, 1012):  # of four arrays, some 50 frames are left with samples
        frames_at(held, range(frame_index, frame_index + 1), ARRAYS, 1e-4)
        frames_at(held, range(frame_index, frame_index + 1), ["a8", "a9", "a10"], 1e-2)
        held.expire(0, 990)
    assert held.forced_until is None
    assert held.nbytes <= 100 * FRAME_BYTES
