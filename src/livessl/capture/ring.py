"""A ring of audio blocks in shared memory, from the device's process (writer) to the node (reader).

It is read and written without numpy, because the writer's process loads as little as possible.

A block is published by the counter of an eventfd, not by a flag in the memory: system calls order memory accesses on
every processor, plain stores do not. The reader's position returns through the memory. One slot always stays free, so
that a position that becomes visible early does no harm. All counters are 32-bit words, which processors store at once.
"""

from __future__ import annotations

import fcntl
import mmap
import os
import struct
from dataclasses import dataclass
from typing import Final

_READ, _OVERRUNS, _FLAGGED, _BEATS = range(4)
"""Words of the ring's header: blocks read, blocks lost because the ring was full, blocks dropped because the driver
flagged them, and turns of the device process's main loop."""

_HEADER_BYTES: Final = 64
_STANDARD_ERROR: Final = 2
_WORD: Final = 1 << 32
_LABEL: Final = struct.Struct("=qqqq")
"""Label of a slot: index of the first sample, number of samples, time of the first sample in ns, loss before it."""


@dataclass(frozen=True, slots=True)
class RingShape:
    """Size of a ring.

    Parameters
    ----------
    channels : int
    block_samples : int
        Most samples per channel of one block.
    slots : int
        Number of blocks; one of them always stays free.
    """

    channels: int
    block_samples: int
    slots: int

    @property
    def slot_bytes(self) -> int:
        """Bytes of one slot: its label and float32 samples."""
        return _LABEL.size + 4 * self.channels * self.block_samples

    @property
    def bytes(self) -> int:
        """Bytes of the whole ring."""
        return _HEADER_BYTES + self.slots * self.slot_bytes


@dataclass(frozen=True, slots=True)
class Slot:
    """One block in the ring.

    Parameters
    ----------
    first_index : int
        Index of the first sample since the writer began; it also counts samples that were lost in a known number.
    count : int
        Samples per channel.
    time_ns : int
        Site time of the first sample's conversion, ns since the epoch.
    lost : bool
        Whether samples, of unknown number, were lost just before this block.
    samples : memoryview
        (count, channels) float32, valid until the slot is released.
    """

    first_index: int
    count: int
    time_ns: int
    lost: bool
    samples: memoryview


def beyond_standard(fd: int) -> int:
    """Return a file descriptor for the same file that is none of the three standard streams; close the former one.

    In a process that was started without standard streams, new files get their numbers. A child process would have its
    own standard streams in the place of such a file.
    """
    if fd > _STANDARD_ERROR:
        return fd
    try:
        return fcntl.fcntl(fd, fcntl.F_DUPFD_CLOEXEC, _STANDARD_ERROR + 1)
    finally:
        os.close(fd)


class _Ring:
    def __init__(self, memory_fd: int, published_fd: int, shape: RingShape) -> None:
        self._published_fd = published_fd
        self._shape = shape
        self._map = mmap.mmap(memory_fd, shape.bytes)
        self._bytes = memoryview(self._map)
        self._words = self._bytes[:_HEADER_BYTES].cast("I")

    def _offset(self, number: int) -> int:
        return _HEADER_BYTES + number % self._shape.slots * self._shape.slot_bytes


class RingWriter(_Ring):
    """The writing end. No method waits or allocates memory beyond small integers.

    Parameters
    ----------
    memory_fd : int
        The shared memory, of `shape.bytes` bytes, zero at first.
    published_fd : int
        An eventfd that counts published blocks.
    shape : RingShape
    """

    def __init__(self, memory_fd: int, published_fd: int, shape: RingShape) -> None:
        super().__init__(memory_fd, published_fd, shape)
        self._written = 0

    def write(self, first_index: int, samples: bytes | memoryview, count: int, time_ns: int, *, lost: bool) -> bool:
        """Publish a block of (count, channels) float32; return False, and count that, if the ring is full."""
        if (self._written - self._words[_READ]) % _WORD >= self._shape.slots - 1:
            self._words[_OVERRUNS] += 1
            return False
        offset = self._offset(self._written)
        _LABEL.pack_into(self._map, offset, first_index, count, time_ns, lost)
        begin = offset + _LABEL.size
        self._bytes[begin : begin + 4 * self._shape.channels * count] = samples
        self._written += 1
        os.eventfd_write(self._published_fd, 1)
        return True

    def count_flagged(self) -> None:
        """Count a block that is dropped because the driver flagged a loss in it."""
        self._words[_FLAGGED] += 1

    def beat(self) -> None:
        """Count a turn of the main loop, as a sign of life."""
        self._words[_BEATS] = (self._words[_BEATS] + 1) % _WORD


class RingReader(_Ring):
    """The reading end, which creates the ring.

    Parameters
    ----------
    shape : RingShape

    Attributes
    ----------
    memory_fd, published_fd : int
        What the writer needs; `published_fd` is readable while blocks wait that `receive` has not counted yet.
    waiting : int
        Number of published blocks that were not released yet.
    """

    def __init__(self, shape: RingShape) -> None:
        self.memory_fd = beyond_standard(os.memfd_create("livessl-ring"))
        os.ftruncate(self.memory_fd, shape.bytes)
        self.published_fd = beyond_standard(os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC))
        super().__init__(self.memory_fd, self.published_fd, shape)
        self.waiting = 0
        self._read = 0

    @property
    def overruns(self) -> int:
        """Number of blocks lost because the ring was full."""
        return self._words[_OVERRUNS]

    @property
    def flagged(self) -> int:
        """Number of blocks dropped because the driver flagged a loss in them."""
        return self._words[_FLAGGED]

    @property
    def beats(self) -> int:
        """Turns of the writer's main loop."""
        return self._words[_BEATS]

    def receive(self) -> None:
        """Count the blocks that were published since the last call."""
        try:
            self.waiting += os.eventfd_read(self.published_fd)
        except BlockingIOError:
            return

    def first(self) -> Slot:
        """Return the oldest waiting block; only call this while `waiting` is above 0.

        Raises
        ------
        ValueError
            If the writer has damaged the block's label.
        """
        offset = self._offset(self._read)
        first_index, count, time_ns, lost = _LABEL.unpack_from(self._map, offset)
        if not 0 < count <= self._shape.block_samples:
            raise ValueError(f"ring: expected 1 to {self._shape.block_samples} samples in a block, got {count}")
        begin = offset + _LABEL.size
        samples = self._bytes[begin : begin + 4 * self._shape.channels * count]
        return Slot(first_index, count, time_ns, bool(lost), samples)

    def release(self) -> None:
        """Give the oldest waiting block's slot back to the writer."""
        self.waiting -= 1
        self._read += 1
        self._words[_READ] = self._read % _WORD

    def close(self) -> None:
        """Close the reading end; views of its samples must be gone. Closing twice is harmless."""
        if not self._map.closed:
            self._words.release()
            self._bytes.release()
            self._map.close()
            os.close(self.memory_fd)
            os.close(self.published_fd)
