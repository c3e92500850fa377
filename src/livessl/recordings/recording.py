"""Recordings, read as if a device delivered them: files, arrays in memory, and combinations of them."""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Protocol

import numpy as np
import soundfile

from livessl.clock import Clock
from livessl.core.types import MAX_SAMPLE, Block, Float32Array
from livessl.errors import DeviceError

BLOCK_S: Final = 0.02
"""Length of the blocks that recordings are read in: as an audio interface would deliver them."""

_SCAN_SAMPLES: Final = 1 << 18


class Recording(Protocol):
    """Sound with a beginning and an end, read as fast as wanted."""

    @property
    def name(self) -> str:
        """What to call it in messages."""
        ...

    @property
    def sample_rate_hz(self) -> float:
        """Samples a second."""
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
        """The recording from its beginning, as if that had been at site time `start_ns`: ideal stamps."""
        ...


class WavRecording:
    """A WAV or FLAC file, in any sample format that libsndfile reads.

    Parameters
    ----------
    path : Path
        The file.

    Raises
    ------
    DeviceError
        Where it cannot be read, is empty, silent throughout, or holds NaN or samples beyond `MAX_SAMPLE`.
    """

    def __init__(self, path: Path) -> None:
        self.name = str(path)
        self._path = path
        with self._open() as file:
            self.sample_rate_hz = float(file.samplerate)
            self.channels = int(file.channels)
            self.duration_s = file.frames / file.samplerate
            self._check(file)

    def blocks(self, start_ns: int) -> Iterator[Block]:
        """Blocks of `BLOCK_S`; (channels, n) each."""
        with self._open() as file:
            yield from _blocks(
                file.blocks(round(BLOCK_S * self.sample_rate_hz), dtype="float32", always_2d=True),
                self.sample_rate_hz,
                start_ns,
            )

    def _open(self) -> soundfile.SoundFile:
        try:
            return soundfile.SoundFile(self._path)
        except (soundfile.LibsndfileError, OSError, TypeError) as error:
            reason = getattr(error, "error_string", None) or getattr(error, "strerror", None) or str(error)
            reason = reason if self._path.exists() else "no such file"
            raise DeviceError(f"{self._path}: expected a WAV or FLAC file, cannot read it: {reason}") from error

    def _check(self, file: soundfile.SoundFile) -> None:
        if file.frames == 0:
            raise DeviceError(f"{self.name}: expected sound, got a file of zero length; record it again")
        may_hold_anything = file.subtype in ("FLOAT", "DOUBLE")
        silent, position = True, 0
        for samples in file.blocks(_SCAN_SAMPLES, dtype="float32", always_2d=True):
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
            if not silent and not may_hold_anything:
                return
        if silent:
            raise DeviceError(f"{self.name}: expected sound, got all-zero samples; was the right input recorded?")


@dataclass(frozen=True)
class ArrayRecording:
    """Sound in memory, such as a simulated scene's."""

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
        """Blocks of `BLOCK_S`; (channels, n) each."""
        n = round(BLOCK_S * self.sample_rate_hz)
        pieces = (self.samples[:, first : first + n].T for first in range(0, self.samples.shape[1], n))
        yield from _blocks(pieces, self.sample_rate_hz, start_ns)


@dataclass(frozen=True)
class Placed:
    """A recording and when it begins, in site time."""

    recording: Recording
    start_ns: int


def merged(placed: Sequence[Placed]) -> Iterator[tuple[int, int, Block]]:
    """Blocks of several recordings in the order in which devices would deliver them.

    Yields
    ------
    end_ns : int
        Site time at which the block is complete.
    line : int
        Index into `placed`.
    block : Block
    """

    def with_end(line: int, item: Placed) -> Iterator[tuple[int, int, Block]]:
        for block in item.recording.blocks(item.start_ns):
            length_ns = round(int(block.samples.shape[1]) / item.recording.sample_rate_hz * 1e9)
            yield block.stamp_ns + length_ns, line, block

    return heapq.merge(*(with_end(k, item) for k, item in enumerate(placed)), key=lambda entry: entry[:2])


def played(placed: Sequence[Placed], clock: Clock) -> Iterator[tuple[int, int, Block]]:
    """`merged`, each block not before it would be complete: an ideal schedule, so that lateness never adds up.

    As long as there is nothing to hear, empty blocks come instead.
    """
    for end_ns, line, block in merged(placed):
        while not clock.sleep_until_ns(end_ns):
            yield clock.now_ns(), line, Block(block.first_index, block.samples[:, :0], block.stamp_ns)
        yield end_ns, line, block


@dataclass(frozen=True)
class Looped:
    """A recording again and again, without a gap."""

    once: Recording
    duration_s: float = float("inf")

    @property
    def name(self) -> str:
        """The recording's."""
        return self.once.name

    @property
    def sample_rate_hz(self) -> float:
        """The recording's."""
        return self.once.sample_rate_hz

    @property
    def channels(self) -> int:
        """The recording's."""
        return self.once.channels

    def blocks(self, start_ns: int) -> Iterator[Block]:
        """Blocks without end."""
        index = 0
        while True:
            for block in self.once.blocks(start_ns):
                yield Block(index, block.samples, start_ns + round(index / self.sample_rate_hz * 1e9))
                index += int(block.samples.shape[1])


@dataclass(frozen=True)
class Spliced:
    """Stretches of one array's sound with gaps between them, as one recording: its sample index jumps at a gap."""

    stretches: tuple[Placed, ...]

    @property
    def name(self) -> str:
        """The first stretch's."""
        return self.stretches[0].recording.name

    @property
    def sample_rate_hz(self) -> float:
        """The first stretch's."""
        return self.stretches[0].recording.sample_rate_hz

    @property
    def channels(self) -> int:
        """The first stretch's."""
        return self.stretches[0].recording.channels

    @property
    def duration_s(self) -> float:
        """From the first sample to the last."""
        last = self.stretches[-1]
        return (last.start_ns - self.stretches[0].start_ns) / 1e9 + last.recording.duration_s

    def blocks(self, start_ns: int) -> Iterator[Block]:
        """Blocks of every stretch at its own time, the first one's being `start_ns`."""
        for stretch in self.stretches:
            offset_ns = stretch.start_ns - self.stretches[0].start_ns
            skipped = round(offset_ns * self.sample_rate_hz / 1e9)
            for block in stretch.recording.blocks(start_ns + offset_ns):
                yield Block(block.first_index + skipped, block.samples, block.stamp_ns)


@dataclass(frozen=True)
class Stacked:
    """Recordings that one device made at one time, side by side: all channels of the first, then the second's, …."""

    recordings: tuple[Recording, ...]

    @property
    def name(self) -> str:
        """All their names."""
        return " + ".join(recording.name for recording in self.recordings)

    @property
    def sample_rate_hz(self) -> float:
        """The first one's."""
        return self.recordings[0].sample_rate_hz

    @property
    def channels(self) -> int:
        """Number of all channels."""
        return sum(recording.channels for recording in self.recordings)

    @property
    def duration_s(self) -> float:
        """The first one's."""
        return self.recordings[0].duration_s

    def blocks(self, start_ns: int) -> Iterator[Block]:
        """Blocks of all channels.

        Raises
        ------
        DeviceError
            Where the recordings do not run together to the sample.
        """
        for blocks in zip(*(recording.blocks(start_ns) for recording in self.recordings), strict=True):
            first = blocks[0]
            if len({(block.first_index, block.samples.shape[1]) for block in blocks}) > 1:
                at_s = (min(block.stamp_ns for block in blocks) - start_ns) / 1e9
                raise DeviceError(
                    f"{self.name}: expected recordings that run together to the sample, got a gap or an end in one of "
                    f"them only, {at_s:.3f} s after they begin; record them through one device"
                )
            yield Block(first.first_index, np.concatenate([block.samples for block in blocks]), first.stamp_ns)


def _blocks(pieces: Iterable[Float32Array], rate_hz: float, start_ns: int) -> Iterator[Block]:
    """Blocks with ideal stamps from (n, channels) pieces."""
    index = 0
    for piece in pieces:
        stamp_ns = start_ns + round(index / rate_hz * 1e9)
        yield Block(index, np.ascontiguousarray(piece.T, dtype=np.float32), stamp_ns)
        index += len(piece)
