"""The ring in shared memory, against a queue."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from livessl.capture.ring import RingReader, RingShape, RingWriter

shapes = st.builds(RingShape, st.integers(1, 18), st.integers(1, 40), st.integers(2, 7))


@contextmanager
def ring(shape: RingShape) -> Iterator[tuple[RingWriter, RingReader]]:
    reader = RingReader(shape)
    try:
        yield RingWriter(reader.memory_fd, reader.published_fd, shape), reader
    finally:
        reader.close()


def samples(shape: RingShape, count: int, seed: int) -> np.ndarray[tuple[int, int], np.dtype[np.float32]]:
    return np.random.default_rng(seed).normal(size=(count, shape.channels)).astype(np.float32)


def label(seed: int) -> tuple[int, int, bool]:
    """Return the index, time and flag of a block: large, and any."""
    return seed * 2**40, 1_700_000_000_000_000_000 + seed, seed % 3 == 0


@given(shapes, st.data())
def test_ring_is_a_bounded_queue_that_counts_what_it_refuses(shape: RingShape, data: st.DataObject) -> None:
    expected: deque[tuple[int, int]] = deque()
    refused = 0
    with ring(shape) as (writer, reader):
        for step in range(data.draw(st.integers(0, 60))):
            if data.draw(st.booleans()):
                count = data.draw(st.integers(1, shape.block_samples))
                index, time_ns, lost = label(step)
                block = samples(shape, count, step)
                if writer.write(index, block.tobytes(), count, time_ns, lost=lost):
                    expected.append((step, count))
                else:
                    refused += 1
                    assert len(expected) == shape.slots - 1
            reader.receive()
            assert reader.waiting == len(expected)
            assert reader.overruns == refused
            reads = data.draw(st.booleans())
            if expected and reads:
                seed, count = expected.popleft()
                slot = reader.first()
                assert (slot.first_index, slot.time_ns, slot.lost) == label(seed)
                received = np.frombuffer(slot.samples, np.float32).reshape(slot.count, shape.channels).copy()
                slot.samples.release()
                assert_array_equal(received, samples(shape, count, seed))
                reader.release()


def test_counters_of_the_writer_reach_the_reader() -> None:
    with ring(RingShape(1, 1, 2)) as (writer, reader):
        for _ in range(3):
            writer.beat()
        writer.count_flagged()
        assert (reader.beats, reader.flagged, reader.overruns, reader.waiting) == (3, 1, 0, 0)


def test_damaged_label_is_refused() -> None:
    with ring(RingShape(2, 4, 3)) as (writer, reader):
        writer.write(0, bytes(8), 1, 0, lost=False)
        writer._bytes[64 + 8] = 5  # the label's number of samples
        reader.receive()
        with pytest.raises(ValueError, match="expected 1 to 4 samples in a block, got 5"):
            reader.first()
