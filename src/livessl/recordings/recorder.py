"""Records sessions for replay: a file for each array and gapless segment; ends in order when the disk is full."""

from __future__ import annotations

import errno
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Final

import numpy as np

from livessl.clock import Clock
from livessl.core.stream.timeline import Timeline
from livessl.core.types import Block
from livessl.errors import RunError
from livessl.recordings.assign import AssignedRecording
from livessl.recordings.recording import paced_blocks
from livessl.recordings.session import Piece, piece, write_session
from livessl.recordings.sound_file import FLAC_MAX_CHANNELS, Format, SoundWriter
from livessl.site.models import Site


class RecordingError(RunError):
    """A recording that had to end because its sound could not be stored."""


_FULL: Final = ("the disk is full", "free some space")
_FAILURES: Final = {
    errno.ENOSPC: _FULL,
    errno.EDQUOT: _FULL,
    errno.EFBIG: (
        "a file has reached the largest size allowed (4 GiB on FAT disks, or `ulimit -f`)",
        "raise the limit",
    ),
}
"""Reason and cure by the number of the system's error."""


@dataclass(slots=True)
class _Open:
    file: SoundWriter
    array: str
    name: str
    first_index: int
    piece: int
    """Index into the list of pieces."""


class Recorder:
    """Writes a device's blocks to a session; a gap begins new files.

    Parameters
    ----------
    directory : Path
        An empty or new folder.
    site : Site
    channels : mapping of array name to channels
        Device channels from 1.
    sample_rate_hz : float
    kind : {"flac", "wav"}
        24-bit FLAC, or float WAV. Arrays of more than eight microphones are always WAV, which FLAC cannot hold.
    pieces : list of Piece or None
        Pieces of the session so far; recorders that write one session share this list.
    """

    def __init__(
        self,
        directory: Path,
        site: Site,
        channels: Mapping[str, Sequence[int]],
        sample_rate_hz: float,
        kind: Format = "flac",
        pieces: list[Piece] | None = None,
    ) -> None:
        self._directory = directory
        self._site = site
        self._channels = {name: np.array(numbers) - 1 for name, numbers in channels.items()}
        self._rate_hz = sample_rate_hz
        self._kind = kind
        self._timeline = Timeline(sample_rate_hz)
        self._open: list[_Open] = []
        self._pieces: list[Piece] = [] if pieces is None else pieces
        self._next_index: int | None = None
        self._segment = 0
        self._kept_s = 0.0
        directory.mkdir(parents=True, exist_ok=True)

    def __enter__(self) -> Recorder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self._close_segment()
        except OSError as failure:
            self._rescue()
            if error is None:
                raise self._ended(failure) from failure

    @property
    def recorded(self) -> bool:
        """True if any sound has been recorded."""
        return bool(self._pieces)

    def push(self, block: Block) -> None:
        """Write a block.

        Raises
        ------
        RecordingError
            If the disk is full, or fails: what is recorded so far is kept and can be read.
        """
        if block.samples.shape[1] == 0:
            return
        try:
            if block.overflow or block.first_index != self._next_index:
                self._close_segment()
                self._open_segment(block)
            self._timeline.update(block.first_index, block.stamp_ns)
            for item in self._open:
                item.file.write(block.samples[self._channels[item.array]])
        except OSError as error:
            self._rescue()
            raise self._ended(error) from error
        self._next_index = block.first_index + int(block.samples.shape[1])

    def _open_segment(self, first: Block) -> None:
        """Begin new files and write the session with provisional start times, so that a crash loses none."""
        self._timeline = Timeline(self._rate_hz)
        for array, channels in self._channels.items():
            kind = "wav" if len(channels) > FLAC_MAX_CHANNELS else self._kind
            name = f"{array}-{self._segment:03d}.{kind}"
            file = SoundWriter(self._directory / name, round(self._rate_hz), len(channels), kind)
            self._open.append(_Open(file, array, name, first.first_index, len(self._pieces)))
            self._pieces.append(piece(array, name, first.stamp_ns))
        self._segment += 1
        write_session(self._directory, self._site, self._pieces)

    def _close_segment(self) -> None:
        """Finish the open files and write the session with a start time fitted to all of their stamps."""
        if not self._open:
            return
        for item in self._open:
            item.file.close()
            self._pieces[item.piece] = piece(item.array, item.name, self._timeline.time_ns(item.first_index))
        self._kept_s += min(item.file.frames for item in self._open) / self._rate_hz
        self._open.clear()
        write_session(self._directory, self._site, self._pieces)

    def _rescue(self) -> None:
        """Close the open files after an error and make them readable; the session on disk lists them already."""
        if self._open:
            self._kept_s += min([item.file.rescue() for item in self._open])
        self._open.clear()

    def _ended(self, error: OSError) -> RecordingError:
        reason, cure = _FAILURES.get(error.errno or 0, ((error.strerror or str(error)).lower(), "correct that"))
        kept = f"the {self._kept_s:.1f} s before are kept and can be replayed" if self._kept_s else "nothing is kept"
        return RecordingError(
            f"{self._directory}: {reason}, so recording ended; {kept}; {cure}, or record to another disk"
        )


def record_playback(
    directory: Path,
    site: Site,
    recordings: Sequence[AssignedRecording],
    clock: Clock,
    over: Callable[[], bool],
    kind: Format = "flac",
) -> bool:
    """Record recordings that are played in place of a device, at the pace of `clock`, to their end or until `over()`.

    Returns
    -------
    bool
        True if any sound was recorded.
    """
    pieces: list[Piece] = []
    recorders = [
        Recorder(directory, site, {item.array: item.channels}, item.recording.sample_rate_hz, kind, pieces)
        for item in recordings
    ]
    with ExitStack() as stack:
        for recorder in recorders:
            stack.enter_context(recorder)
        for _, index, block in paced_blocks([item.timed for item in recordings], clock):
            recorders[index].push(block)
            if over():
                break
    return bool(pieces)
