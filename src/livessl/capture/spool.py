"""A node's frames, kept until the server needs them no more: bounded, in memory or in files that outlive the node.

On disk it is a folder of segments, written at their end only. A segment is a magic number and then records: length and
CRC-32 of a message, little-endian, and the message as it goes over the wire. What was half written when the node was
killed ends its segment; a segment of which nothing is needed any more is deleted.
"""

from __future__ import annotations

import heapq
import logging
import os
import struct
import zlib
from collections import Counter, deque
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from livessl import wire
from livessl.core.types import FRAME_NS, Frame
from livessl.errors import RunError

MEMORY_BYTES: Final = 64 * 1024 * 1024
"""Sound kept in memory, where there is no folder or its disk is full: half a minute of six arrays."""

SEGMENT_BYTES: Final = 4 * 1024 * 1024
"""A few seconds of sound: what is deleted at once, and what a node that starts again may send twice."""

_MAGIC: Final = b"LSSLspl1"
_RECORD: Final = struct.Struct("<II")

_log = logging.getLogger(__name__)


class SpoolError(RunError):
    """The folder, or a file in it, cannot be used."""


@dataclass(slots=True, eq=False)
class Kept:
    """One frame: in memory with its `data`, else in a segment."""

    array: str
    frame_index: int
    size: int
    data: bytes | None
    segment: int = 0
    offset: int = 0


class Spool:
    """Each array's frames in order of time; the oldest go first where there is no room.

    A segment is handed to the system as it is written, not forced to the disk: it outlives the node, not the machine.

    Parameters
    ----------
    directory : Path or None
        Where they are kept; None keeps them in memory only.
    max_bytes : int
        Of all messages together.
    max_age_s : float
        Frames that are so much older than the newest go.

    Raises
    ------
    SpoolError
        Where the folder cannot be used.
    """

    def __init__(
        self, directory: Path | None = None, max_bytes: int = MEMORY_BYTES, max_age_s: float = float("inf")
    ) -> None:
        self._directory = directory
        self._max_bytes = max_bytes
        self._max_rasters = max_age_s * 1e9 / FRAME_NS
        self._kept: dict[str, deque[Kept]] = {}
        self._needed: Counter[int] = Counter()  # frames needed of each segment
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
        """All that is kept, in order of time."""
        return list(heapq.merge(*self._kept.values(), key=lambda kept: kept.frame_index))

    def append(self, frame: Frame) -> tuple[Kept, list[Kept]]:
        """Keep a frame; what was made of it, and what had to go.

        What lies at or after it in time goes: its clock was set back, and the old time comes again.
        """
        gone = self._clear_from(frame)
        data = wire.encode(frame)
        kept = self._on_disk(frame, data) or Kept(frame.array, frame.frame_index, len(data), data)
        self._add(kept)
        while self._has_too_much(frame.frame_index):
            oldest = min((frames for frames in self._kept.values() if frames), key=lambda frames: frames[0].frame_index)
            gone.append(self._release(oldest.popleft()))
        return kept, gone

    def read(self, kept: Kept) -> bytes:
        """The message.

        Raises
        ------
        SpoolError
            Where its segment cannot be read, or does not hold any more what was written.
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
        """No frame of an array before this frame index is needed any more."""
        frames = self._kept.get(array)
        while frames and frames[0].frame_index < before:
            self._release(frames.popleft())

    def close(self) -> None:
        """Release the files; what is in them stays."""
        if self._file is not None:
            os.close(self._file)
            self._file = None
            self._tidy(self._segment)

    def _clear_from(self, frame: Frame) -> list[Kept]:
        frames = self._kept.setdefault(frame.array, deque())
        gone = []
        while frames and frames[-1].frame_index >= frame.frame_index:
            gone.append(self._release(frames.pop()))
        return gone

    def _has_too_much(self, newest: int) -> bool:
        oldest = min(frames[0].frame_index for frames in self._kept.values() if frames)
        too_old = newest - oldest > self._max_rasters
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
        """Write a frame to the newest segment; None where there is no disk, or it takes no more."""
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
                _log.error("spool %s: %s; frames are kept in memory now: free space", self._directory, error.strerror)
            self._disk_fails = True
            self.close()  # a torn record ends it: the next frame begins a new one
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
        """Take in what a segment of an earlier run holds, up to where it was torn."""
        if not path.stem.isdigit():
            return
        self._segment = int(path.stem)
        content = path.read_bytes()
        offset = len(_MAGIC) if content.startswith(_MAGIC) else len(content)
        self._needed[self._segment] += 1  # by us, while we read it
        while (data := _record(content, offset)) is not None and (frame := _frame(data)) is not None:
            self._clear_from(frame)
            self._add(Kept(frame.array, frame.frame_index, len(data), None, self._segment, offset))
            offset += _RECORD.size + len(data)
        self._needed[self._segment] -= 1
        self.torn += offset != len(content)
        self._tidy(self._segment)


def _record(content: bytes, offset: int) -> bytes | None:
    """The message of the record that begins there; None where none does."""
    if len(content) - offset < _RECORD.size:
        return None
    length, checksum = _RECORD.unpack_from(content, offset)
    data = content[offset + _RECORD.size : offset + _RECORD.size + length]
    return data if len(data) == length and zlib.crc32(data) == checksum else None


def _frame(data: bytes) -> Frame | None:
    """The frame; None where it is none of this version."""
    try:
        message = wire.decode(data)
    except wire.WireError:
        return None
    return message if isinstance(message, Frame) else None
