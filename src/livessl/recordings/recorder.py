"""Recording of sessions for replay: one file for each array and each gapless segment, with its start time."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Final, Literal

import numpy as np
import soundfile

from livessl.clock import Clock
from livessl.core.stream.timeline import Timeline
from livessl.core.types import Block
from livessl.recordings.assign import AssignedRecording
from livessl.recordings.recording import paced_blocks
from livessl.recordings.session import Piece, piece, write_session
from livessl.site.models import Site

FLAC_MAX_CHANNELS: Final = 8
"""Most channels of a FLAC file, by its format."""

Format = Literal["flac", "wav"]
_WRITTEN: Final = {"flac": ("FLAC", "PCM_24"), "wav": ("RF64", "FLOAT")}
"""Container and sample format of each kind, as libsndfile names them. RF64 is WAV without its limit of 4 GiB, which
16 channels reach in 23 minutes at 48 kHz."""


@dataclass(slots=True)
class _Open:
    file: soundfile.SoundFile
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
        directory.mkdir(parents=True, exist_ok=True)

    def __enter__(self) -> Recorder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._close_segment()

    @property
    def recorded(self) -> bool:
        """True if any sound has been recorded."""
        return bool(self._pieces)

    def push(self, block: Block) -> None:
        """Write a block."""
        if block.samples.shape[1] == 0:
            return
        if block.overflow or block.first_index != self._next_index:
            self._close_segment()
            self._open_segment(block)
        self._timeline.update(block.first_index, block.stamp_ns)
        for item in self._open:
            item.file.write(block.samples[self._channels[item.array]].T)
        self._next_index = block.first_index + int(block.samples.shape[1])

    def _open_segment(self, first: Block) -> None:
        """Begin new files and write the session with provisional start times, so that a crash loses none."""
        self._timeline = Timeline(self._rate_hz)
        for array, channels in self._channels.items():
            kind = "wav" if len(channels) > FLAC_MAX_CHANNELS else self._kind
            name = f"{array}-{self._segment:03d}.{kind}"
            container, subtype = _WRITTEN[kind]
            file = soundfile.SoundFile(
                self._directory / name,
                "w",
                samplerate=round(self._rate_hz),
                channels=len(channels),
                format=container,
                subtype=subtype,
            )
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
        self._open.clear()
        write_session(self._directory, self._site, self._pieces)


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
