"""The ring of the newest frames: bounded, and without duplicates."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from livessl.core.types import FRAME_NS
from livessl.server.clips.ring import FrameRing
from small_site import frame, mark

SIZE = frame().samples.nbytes
numbers = st.lists(st.tuples(st.sampled_from(["north", "south"]), st.integers(0, 40)), max_size=60)


@given(came=numbers, room=st.integers(1, 30))
def test_memory_is_bounded_and_the_newest_frames_are_kept(came: list[tuple[str, int]], room: int) -> None:
    ring, held = FrameRing(room * SIZE), []
    for array, number in came:
        ring.take([frame(number, number, array)], None)
        if (array, number) not in held:
            held.append((array, number))
        held = held[-room:]
        assert ring.nbytes == len(held) * SIZE <= room * SIZE
    for name in ("north", "south"):
        found = [each.frame_index for each in ring.between(name, 0, 10**18)]
        assert found == sorted(number for array, number in held if array == name)


def test_frames_before_a_time_are_dropped_and_not_counted_as_a_loss() -> None:
    ring = FrameRing()
    ring.take([frame(n, n) for n in range(10)], None)
    ring.take([mark(11, 11)], 4 * FRAME_NS)
    assert [each.frame_index for each in ring.between("north", 0, 10**18)] == [4, 5, 6, 7, 8, 9]
    assert (ring.dropped, ring.nbytes) == (0, 6 * SIZE)
    assert [each.frame_index for each in ring.between("north", 5 * FRAME_NS, 7 * FRAME_NS)] == [5, 6]
    assert ring.between("nobody", 0, 10**18) == []


def test_frames_that_were_dropped_for_room_are_counted() -> None:
    ring = FrameRing(3 * SIZE)
    ring.take([frame(n, n) for n in range(5)], None)
    assert ring.dropped == 2


def test_frame_without_samples_leaves_room_for_the_same_with_samples() -> None:
    ring, whole = FrameRing(), frame(1, 7)
    ring.take([whole.without_samples(), whole, whole], None)
    assert ring.between("north", 0, 10**18) == [whole]
    assert ring.nbytes == SIZE
