"""Buffers a node's frames, in memory or in files, until the server needs them no more; drops the oldest if it is full.

The limits of size and age are `SpoolConfig` in `site/node_models.py`; the order of sending is decided in `outbox`.

On disk, the spool is a folder of segments, which are only appended to. A segment is a magic number followed by records:
length and CRC-32 of a message, little-endian, and the message as it goes over the wire. A record that was half written
when the node was killed ends its segment. A segment is deleted when none of its frames is needed any more.
"""

from __future__ import annotations

import heapq
import logging
import os
import struct
import zlib
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from livessl import wire
from livessl.core.types import FRAME_NS, Frame
from livessl.errors import RunError

MEMORY_BYTES: Final = 64 * 1024 * 1024
"""Limit, in bytes, of frames that are kept in memory, if there is no folder or its disk is full: about 30 s of six
arrays."""

SEGMENT_BYTES: Final = 4 * 1024 * 1024
"""Size of a segment in bytes, a few seconds of sound. Whole segments are deleted, so a restarted node sends at most one
segment twice."""

_MAGIC: Final = b"LSSLspl1"
_RECORD: Final = struct.Struct("<II")

_log = logging.getLogger(__name__)


class SpoolError(RunError):
    """A folder of the spool, or a file in it, that cannot be used."""


@dataclass(slots=True, eq=False)
class Kept:
    """One frame of the spool: in memory with its `data`, or in a segment."""

    array: str
    frame_index: int
    size: int
    data: bytes | None
    segment: int = 0
    offset: int = 0


class Spool:
    """The frames of each array in order of time. Beyond the limits, the oldest frames are removed.

    Segments are written to the operating system but not forced to the disk. They survive a crash of the process, but
    not a power failure.

    Parameters
    ----------
    directory : Path or None
        Folder of the segments; None keeps the frames in memory.
    max_bytes : int
        Largest number of bytes of all messages together.
    max_age_s : float
        Frames that are older than the newest by more than this are removed.
    encode : callable
        Returns a frame as it goes over the wire.

    Raises
    ------
    SpoolError
        If the folder cannot be used.
    """

    def __init__(
        self,
        directory: Path | None = None,
        max_bytes: int = MEMORY_BYTES,
        max_age_s: float = float("inf"),
        encode: Callable[[Frame], bytes] = wire.encode,
    ) -> None:
        self._directory = directory
        self._encode = encode
        self._max_bytes = max_bytes
        self._max_age_frames = max_age_s * 1e9 / FRAME_NS
        self._kept: dict[str, deque[Kept]] = {}
        self._needed: Counter[int] = Counter()  # number of needed frames in each segment
        self._segment = 0
        self._file: int | None = None
        self._written = self._bytes = self._bytes_in_memory = 0
        self._disk_fails = False
        self.torn = 0
        if directory is not None:
            try:
                directory.mkdir(parents=True, exist_ok=True)
                for path in sorted(directory.glob("*.spool")):
                    self._recover(path)
            except OSError as error:
                raise SpoolError(
                    f"spool.directory: cannot use {directory}: {error.strerror}; name a writable folder, or null"
                ) from error

    def __len__(self) -> int:
        return sum(map(len, self._kept.values()))

    def frames(self) -> list[Kept]:
        """Return all frames, in order of time."""
        return list(heapq.merge(*self._kept.values(), key=lambda kept: kept.frame_index))

    def append(self, frame: Frame) -> tuple[Kept, list[Kept]]:
        """Add a frame; return it as it is kept, and the frames that were removed.

        Kept frames of this array with the same or a later time are removed: then the clock was set back.
        """
        removed = self._clear_from(frame)
        data = self._encode(frame)
        kept = self._on_disk(frame, data) or Kept(frame.array, frame.frame_index, len(data), data)
        self._add(kept)
        while self._has_too_much(frame.frame_index):
            oldest = min((frames for frames in self._kept.values() if frames), key=lambda frames: frames[0].frame_index)
            removed.append(self._release(oldest.popleft()))
        return kept, removed

    def read(self, kept: Kept) -> bytes:
        """Return the message of a frame.

        Raises
        ------
        SpoolError
            If its segment cannot be read, or has been changed.
        """
        if kept.data is not None:
            return kept.data
        path = self._path(kept.segment)
        try:
            with path.open("rb") as file:
                file.seek(kept.offset)
                data = _record(file.read(_RECORD.size + kept.size), 0)
        except OSError as error:
            raise SpoolError(f"{path}: cannot be read: {error.strerror}; does anything else use the spool?") from error
        if data is None:
            raise SpoolError(f"{path}: its frame at byte {kept.offset} has changed; does anything else use the spool?")
        return data

    def forget(self, array: str, before: int) -> None:
        """Release the frames of an array before this frame index."""
        frames = self._kept.get(array)
        while frames and frames[0].frame_index < before:
            self._release(frames.popleft())

    def close(self) -> None:
        """Close the open segment; frames on disk stay there."""
        if self._file is not None:
            os.close(self._file)
            self._file = None
            self._tidy(self._segment)

    def _clear_from(self, frame: Frame) -> list[Kept]:
        frames = self._kept.setdefault(frame.array, deque())
        removed = []
        while frames and frames[-1].frame_index >= frame.frame_index:
            removed.append(self._release(frames.pop()))
        return removed

    def _has_too_much(self, newest: int) -> bool:
        oldest = min(frames[0].frame_index for frames in self._kept.values() if frames)
        too_old = newest - oldest > self._max_age_frames
        return too_old or self._bytes > self._max_bytes or self._bytes_in_memory > MEMORY_BYTES

    def _add(self, kept: Kept) -> None:
        self._kept[kept.array].append(kept)
        self._bytes += kept.size
        if kept.data is None:
            self._needed[kept.segment] += 1
        else:
            self._bytes_in_memory += kept.size

    def _release(self, kept: Kept) -> Kept:
        self._bytes -= kept.size
        if kept.data is not None:
            self._bytes_in_memory -= kept.size
            return kept
        self._needed[kept.segment] -= 1
        if kept.segment != self._segment or self._file is None:
            self._tidy(kept.segment)
        return kept

    def _tidy(self, segment: int) -> None:
        if self._needed[segment] == 0:
            del self._needed[segment]
            self._path(segment).unlink(missing_ok=True)

    def _path(self, segment: int) -> Path:
        assert self._directory is not None
        return self._directory / f"{segment:012d}.spool"

    def _on_disk(self, frame: Frame, data: bytes) -> Kept | None:
        """Write a frame to the newest segment; return None if there is no folder, or its disk is full or fails."""
        if self._directory is None:
            return None
        record = _RECORD.pack(len(data), zlib.crc32(data)) + data
        try:
            if self._file is None or self._written + len(record) > SEGMENT_BYTES:
                self._next_segment()
            assert self._file is not None
            if os.write(self._file, record) != len(record):
                raise OSError(0, "only part of a frame was written")
        except OSError as error:
            if not self._disk_fails:
                _log.error(
                    "spool %s: %s; frames are kept in memory now; free space on its disk",
                    self._directory,
                    error.strerror,
                )
            self._disk_fails = True
            self.close()  # a torn record ends the segment: the next frame begins a new one
            return None
        offset, self._written = self._written, self._written + len(record)
        return Kept(frame.array, frame.frame_index, len(data), None, self._segment, offset)

    def _next_segment(self) -> None:
        self.close()
        self._segment += 1
        self._file = os.open(self._path(self._segment), os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        if os.write(self._file, _MAGIC) != len(_MAGIC):
            raise OSError(0, "only part of a segment's head was written")
        self._written = len(_MAGIC)

    def _recover(self, path: Path) -> None:
        """Add the frames of an earlier run's segment, up to a torn record."""
        if not path.stem.isdigit():
            return
        self._segment = int(path.stem)
        content = path.read_bytes()
        offset = len(_MAGIC) if content.startswith(_MAGIC) else len(content)
        self._needed[self._segment] += 1  # keeps the segment while it is read
        while (data := _record(content, offset)) is not None and (frame := _frame(data)) is not None:
            self._clear_from(frame)
            self._add(Kept(frame.array, frame.frame_index, len(data), None, self._segment, offset))
            offset += _RECORD.size + len(data)
        self._needed[self._segment] -= 1
        self.torn += offset != len(content)
        self._tidy(self._segment)


def _record(content: bytes, offset: int) -> bytes | None:
    """Return the message of the record at `offset`; None if there is no whole record."""
    if len(content) - offset < _RECORD.size:
        return None
    length, checksum = _RECORD.unpack_from(content, offset)
    data = content[offset + _RECORD.size : offset + _RECORD.size + length]
    return data if len(data) == length and zlib.crc32(data) == checksum else None


def _frame(data: bytes) -> Frame | None:
    """Return the frame that a message holds; None if it is not a frame of this version."""
    try:
        message = wire.decode(data)
    except wire.WireError:
        return None
    return message if isinstance(message, Frame) else None
