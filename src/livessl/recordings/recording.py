"""Recordings that are read in blocks: sound files, samples in memory, loops, and several files as one."""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Protocol

import numpy as np

from livessl.clock import Clock
from livessl.core.types import MAX_SAMPLE, Block, Float32Array
from livessl.errors import DeviceError
from livessl.recordings.sound_file import SoundFile

BLOCK_S: Final = 0.02
"""Length of a recording's blocks in seconds: the default of an audio interface, `device.block_s`."""

RATES_HZ: Final = (100.0, 1e6)
"""Lowest and highest sampling rate of a file, in hertz: no recorder has others, and a damaged header has any."""

_SCAN_SAMPLES: Final = 1 << 18
"""Samples of each channel that are checked at a time, so that a long file does not fill the memory."""


class EmptyFileError(DeviceError):
    """A sound file without a single sample."""


class Recording(Protocol):
    """Multichannel sound of a finite or infinite length, read in blocks as fast as the reader wants."""

    @property
    def name(self) -> str:
        """The name that messages use, such as the path of its file."""
        ...

    @property
    def sample_rate_hz(self) -> float:
        """Sampling rate in Hz."""
        ...

    @property
    def channels(self) -> int:
        """Number of channels."""
        ...

    @property
    def duration_s(self) -> float:
        """Length in seconds."""
        ...

    def blocks(self, start_ns: int) -> Iterator[Block]:
        """Yield the recording from its beginning with ideal time stamps from `start_ns` on, in site time."""
        ...


class FileRecording:
    """A WAV or FLAC file, in any sample format that libsndfile reads.

    A file that was cut, or whose header was never finished, is read as far as it is complete, and `note` is set.

    Parameters
    ----------
    path : Path
        The file.

    Raises
    ------
    DeviceError
        If the file cannot be read, is empty, is all zero, holds NaN or samples beyond `MAX_SAMPLE`, or has a sampling
        rate outside `RATES_HZ`.
    """

    def __init__(self, path: Path) -> None:
        self.name = str(path)
        self._path = path
        with SoundFile(path) as file:
            self.sample_rate_hz = float(file.sample_rate_hz)
            self.channels = file.channels
            self.frames = file.frames
            self.note = file.note
            low, high = RATES_HZ
            if not low <= self.sample_rate_hz <= high:
                raise DeviceError(
                    f"{path}: expected a sampling rate from {low:g} to {high:,.0f} Hz, got {self.sample_rate_hz:g} Hz; "
                    "export it again, or correct its header"
                )
            self._check(file)

    @property
    def duration_s(self) -> float:
        """Length in seconds."""
        return self.frames / self.sample_rate_hz

    def cut(self, frames: int) -> None:
        """Read no more than the first `frames` samples of each channel."""
        self.frames = min(self.frames, frames)

    def blocks(self, start_ns: int) -> Iterator[Block]:
        """Yield blocks of `BLOCK_S`, (channels, n) each; `start_ns` is the site time of the first sample."""
        with SoundFile(self._path) as file:
            yield from _blocks(
                file.pieces(_block_length(self.sample_rate_hz), self.frames), self.sample_rate_hz, start_ns
            )

    def _check(self, file: SoundFile) -> None:
        if file.frames == 0:
            raise EmptyFileError(f"{self.name}: expected sound, got a file of zero length; record it again")
        silent, position = True, 0
        for samples in file.pieces(_SCAN_SAMPLES, file.frames):
            if not np.isfinite(samples).all():
                bad, channel = np.argwhere(~np.isfinite(samples))[0]
                raise DeviceError(
                    f"{self.name}: expected finite samples, got NaN or infinity at sample {position + bad} of "
                    f"channel {channel + 1}; export it again"
                )
            if np.abs(samples).max() > MAX_SAMPLE:
                bad, channel = np.argwhere(np.abs(samples) > MAX_SAMPLE)[0]
                raise DeviceError(
                    f"{self.name}: expected samples around 1 at full scale, got {samples[bad, channel]:g} at sample "
                    f"{position + bad} of channel {channel + 1}; export it again"
                )
            silent = silent and not samples.any()
            position += len(samples)
            if not silent and not file.may_hold_anything:
                return
        if silent:
            raise DeviceError(f"{self.name}: expected sound, got all-zero samples; was the right input recorded?")


@dataclass(frozen=True)
class MemoryRecording:
    """Sound in memory, such as a simulated scene.

    Parameters
    ----------
    name : str
        The name that messages use.
    sample_rate_hz : float
    samples : ndarray (channels, n)
        float32 in [-1, 1).
    """

    name: str
    sample_rate_hz: float
    samples: Float32Array

    @property
    def channels(self) -> int:
        """Number of channels."""
        return len(self.samples)

    @property
    def duration_s(self) -> float:
        """Length in seconds."""
        return float(self.samples.shape[1] / self.sample_rate_hz)

    def blocks(self, start_ns: int) -> Iterator[Block]:
        """Yield blocks of `BLOCK_S`, (channels, n) each; `start_ns` is the site time of the first sample."""
        n = _block_length(self.sample_rate_hz)
        pieces = (self.samples[:, first : first + n].T for first in range(0, self.samples.shape[1], n))
        yield from _blocks(pieces, self.sample_rate_hz, start_ns)


@dataclass(frozen=True)
class TimedRecording:
    """A recording and the site time at which it begins."""

    recording: Recording
    start_ns: int


def merged_blocks(recordings: Sequence[TimedRecording]) -> Iterator[tuple[int, int, Block]]:
    """Merge the blocks of several recordings in the order in which devices would deliver them.

    Yields
    ------
    end_ns : int
        Site time at which the block is complete.
    index : int
        Index into `recordings`.
    block : Block
    """

    def indexed(index: int, timed: TimedRecording) -> Iterator[tuple[int, int, Block]]:
        for end_ns, block in timed_blocks(timed):
            yield end_ns, index, block

    return heapq.merge(*(indexed(k, timed) for k, timed in enumerate(recordings)), key=lambda entry: entry[:2])


def timed_blocks(timed: TimedRecording) -> Iterator[tuple[int, Block]]:
    """Yield the blocks of a recording, each with the site time at which it is complete."""
    rate_hz = timed.recording.sample_rate_hz
    for block in timed.recording.blocks(timed.start_ns):
        yield block.stamp_ns + round(int(block.samples.shape[1]) / rate_hz * 1e9), block


def paced_blocks(recordings: Sequence[TimedRecording], clock: Clock) -> Iterator[tuple[int, int, Block]]:
    """Yield `merged_blocks`, each no earlier than it would be complete on `clock`.

    The schedule is ideal: a late block does not delay the next ones. While the next block is not yet due, empty blocks
    come in its place, so that the caller can serve its connection.
    """
    for end_ns, index, block in merged_blocks(recordings):
        while not clock.sleep_until_ns(end_ns):
            yield clock.now_ns(), index, Block(block.first_index, block.samples[:, :0], block.stamp_ns)
        yield end_ns, index, block


@dataclass(frozen=True)
class LoopedRecording:
    """A recording that is repeated without end, and without gaps between the repetitions."""

    once: Recording
    duration_s: float = float("inf")

    @property
    def name(self) -> str:
        """Name of the repeated recording."""
        return self.once.name

    @property
    def sample_rate_hz(self) -> float:
        """Sampling rate in Hz."""
        return self.once.sample_rate_hz

    @property
    def channels(self) -> int:
        """Number of channels."""
        return self.once.channels

    def blocks(self, start_ns: int) -> Iterator[Block]:
        """Yield blocks without end."""
        index = 0
        while True:
            for block in self.once.blocks(start_ns):
                yield Block(index, block.samples, start_ns + round(index / self.sample_rate_hz * 1e9))
                index += int(block.samples.shape[1])


@dataclass(frozen=True)
class SplicedRecording:
    """Segments of one array's sound with gaps between them, as one recording whose sample index jumps at each gap."""

    segments: tuple[TimedRecording, ...]

    @property
    def name(self) -> str:
        """Name of the first segment."""
        return self.segments[0].recording.name

    @property
    def sample_rate_hz(self) -> float:
        """Sampling rate in Hz."""
        return self.segments[0].recording.sample_rate_hz

    @property
    def channels(self) -> int:
        """Number of channels."""
        return self.segments[0].recording.channels

    @property
    def duration_s(self) -> float:
        """Time from the first sample to the last, in seconds, gaps included."""
        last = self.segments[-1]
        return (last.start_ns - self.segments[0].start_ns) / 1e9 + last.recording.duration_s

    def blocks(self, start_ns: int) -> Iterator[Block]:
        """Yield the blocks of each segment at its own time; the first segment begins at `start_ns`."""
        for segment in self.segments:
            offset_ns = segment.start_ns - self.segments[0].start_ns
            skipped = round(offset_ns * self.sample_rate_hz / 1e9)
            for block in segment.recording.blocks(start_ns + offset_ns):
                yield Block(block.first_index + skipped, block.samples, block.stamp_ns)


@dataclass(frozen=True)
class StackedRecording:
    """Recordings that one device made at the same time, as one: the channels of the first, then of the second, …."""

    recordings: tuple[Recording, ...]

    @property
    def name(self) -> str:
        """Names of all recordings."""
        return " + ".join(recording.name for recording in self.recordings)

    @property
    def sample_rate_hz(self) -> float:
        """Sampling rate in Hz."""
        return self.recordings[0].sample_rate_hz

    @property
    def channels(self) -> int:
        """Total number of channels."""
        return sum(recording.channels for recording in self.recordings)

    @property
    def duration_s(self) -> float:
        """Length in seconds."""
        return self.recordings[0].duration_s

    def blocks(self, start_ns: int) -> Iterator[Block]:
        """Yield blocks of all channels.

        Raises
        ------
        DeviceError
            If a gap or the end comes in some of the recordings only.
        """
        for blocks in zip(*(recording.blocks(start_ns) for recording in self.recordings), strict=True):
            first = blocks[0]
            if len({(block.first_index, block.samples.shape[1]) for block in blocks}) > 1:
                at_s = (min(block.stamp_ns for block in blocks) - start_ns) / 1e9
                raise DeviceError(
                    f"{self.name}: expected recordings whose samples match one to one, got a gap or the end in one of "
                    f"them only, {at_s:.3f} s after they begin; record them through one device"
                )
            yield Block(first.first_index, np.concatenate([block.samples for block in blocks]), first.stamp_ns)


def _block_length(rate_hz: float) -> int:
    """Return the number of samples of a block; at a few hertz, which samples in memory may have, a block has one."""
    return max(1, round(BLOCK_S * rate_hz))


def _blocks(pieces: Iterable[Float32Array], rate_hz: float, start_ns: int) -> Iterator[Block]:
    """Yield blocks with ideal time stamps from pieces (n, channels)."""
    index = 0
    for piece in pieces:
        stamp_ns = start_ns + round(index / rate_hz * 1e9)
        yield Block(index, np.ascontiguousarray(piece.T, dtype=np.float32), stamp_ns)
        index += len(piece)
