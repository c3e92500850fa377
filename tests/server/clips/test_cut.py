"""Frames of one array become one recording: nothing is lost, moved or invented."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from livessl.core.types import FRAME_NS, FRAME_S, Frame
from livessl.server.clips.cut import cut
from small_site import RATE_HZ, frame, site_of

NORTH = site_of().array("north")
PER_FRAME = round(FRAME_S * RATE_HZ)


def frames(indices: list[int], active: set[int] = frozenset()) -> list[Frame]:  # type: ignore[assignment]
    return [frame(n, n, seed=n, active=n in active) for n in indices]


@given(indices=st.lists(st.integers(0, 40), min_size=1, max_size=20, unique=True).map(sorted))
def test_every_frame_is_at_its_time_and_the_rest_is_a_gap(indices: list[int]) -> None:
    made = cut(NORTH, frames(indices))
    assert made is not None
    first = indices[0]
    assert made.time_ns == first * FRAME_NS
    assert made.samples.shape == (4, (indices[-1] - first + 1) * PER_FRAME)
    whole = np.zeros_like(made.samples)
    known = np.zeros(whole.shape[1], dtype=np.bool_)
    for n in indices:
        span = slice((n - first) * PER_FRAME, (n - first + 1) * PER_FRAME)
        whole[:, span] = frame(n, n, seed=n).samples
        known[span] = True
    np.testing.assert_array_equal(made.samples, whole)
    np.testing.assert_array_equal(made.known, known)
    missing_s = sum(end - begin for begin, end in made.gaps_s)
    assert round(missing_s / FRAME_S) == indices[-1] - first + 1 - len(indices)


@given(
    indices=st.lists(st.integers(0, 40), min_size=1, max_size=20, unique=True).map(sorted),
    ahead=st.integers(-9, 9),
    longer=st.sets(st.integers(0, 40)),
)
def test_every_frame_can_be_taken_out_again(indices: list[int], ahead: int, longer: set[int]) -> None:
    """Also those of another length, and with a clock that is ahead by whole frames."""
    given = [
        replace(one, samples=np.concatenate([one.samples, one.samples[:, :1]], axis=1))
        if one.frame_index in longer
        else one
        for one in frames(indices, set(indices[::2]))
    ]
    made = cut(NORTH, given, ahead * FRAME_NS, ahead)
    assert made is not None
    for frame_of, placed in zip(given, made.frames, strict=True):
        taken = made.samples[:, placed.begin : placed.begin + placed.length]
        np.testing.assert_array_equal(taken, frame_of.samples)
        assert placed.frame_index == frame_of.frame_index - ahead
        assert (placed.power, placed.active, placed.requested) == (frame_of.power, frame_of.active, frame_of.requested)


def test_frames_of_another_length_are_joined_without_a_gap() -> None:
    """A device's clock that drifts makes a frame one sample longer now and then."""
    parts = frames([3, 4, 5])
    longer = replace(parts[1], samples=np.concatenate([parts[1].samples, parts[1].samples[:, :1]], axis=1))
    made = cut(NORTH, [parts[0], longer, parts[2]])
    assert made is not None
    assert (made.samples.shape[1], made.gaps_s) == (3 * PER_FRAME + 1, ())


def test_clock_that_is_ahead_is_corrected() -> None:
    made = cut(NORTH, frames([10]), offset_ns=3_000_000)
    assert made is not None
    assert made.time_ns == 10 * FRAME_NS - 3_000_000


def test_frames_that_do_not_fit_are_left_out() -> None:
    odd = [replace(frame(1, 1), sample_rate_hz=8000.0), replace(frame(2, 2), samples=frame(2, 2).samples[:2])]
    made = cut(NORTH, [*odd, frame(3, 3)])
    assert made is not None
    assert made.time_ns == 3 * FRAME_NS
    assert cut(NORTH, []) is None
    assert cut(NORTH, odd[1:]) is None


@given(begin=st.integers(4, 20), length=st.integers(1, 10), earlier=st.integers(0, 20))
def test_quiet_is_what_is_known_between_an_earlier_sound_and_this_one(begin: int, length: int, earlier: int) -> None:
    active = {*range(begin, begin + length), earlier} - set(range(begin + length, 99))
    indices = [n for n in range(begin + length + 6) if n != 2]
    made = cut(NORTH, frames(indices, active))
    assert made is not None
    sound = made.sound(begin * FRAME_NS, (begin + length) * FRAME_NS)

    def which(mask: np.ndarray[tuple[int], np.dtype[np.bool_]]) -> set[int]:
        return set((np.flatnonzero(mask) // PER_FRAME).tolist())

    before = earlier if earlier < begin - 1 and earlier != 2 else -1
    assert which(sound.quiet) == {n for n in indices if before < n < begin - 1}
    assert which(sound.sound) == set(range(begin, begin + length)) - {2}
    assert not sound.quiet[np.flatnonzero(~made.known)].any()
