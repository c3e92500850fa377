"""Opens the sound files of one command, each once, and refuses a channel that serves two arrays."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final

from livessl.errors import DeviceError
from livessl.recordings.recording import FileRecording, Recording, StackedRecording

_log = logging.getLogger(__name__)

_SAME_END_S: Final = 1.0
"""Largest difference, in seconds, between the lengths of files of one device that are cut to the shortest: a recorder
that is killed has written more of one than of another."""


class OpenFiles:
    """Recordings of files, with notes on what is not as expected and yet can be used.

    Attributes
    ----------
    notes : list of str
        One sentence each; `log_notes` passes them on.
    """

    def __init__(self) -> None:
        self.notes: list[str] = []
        self._opened: dict[Path, FileRecording] = {}
        self._users: dict[tuple[Path, int], str] = {}

    def open(self, path: Path) -> FileRecording:
        """Return the recording of a file.

        Raises
        ------
        DeviceError
            If it cannot be used.
        """
        if path not in self._opened:
            recording = self._opened[path] = FileRecording(path)
            if recording.note is not None:
                self.notes.append(recording.note)
        return self._opened[path]

    def stacked(self, array: str, paths: Sequence[Path]) -> Recording:
        """Return one recording of an array's files: the channels of the first, then of the second, ….

        Raises
        ------
        DeviceError
            One line for each file that cannot be used, or does not fit the first.
        """
        twice = next((path for path in paths if paths.count(path) > 1), None)
        if twice is not None:
            raise DeviceError(f"{twice}: expected each file of array {array!r} once, got it twice; remove one")
        found, faults = [], []
        for path in paths:
            try:
                found.append(self.open(path))
            except DeviceError as error:
                faults.append(str(error))
        if any(recording.note for recording in found):
            self._cut_to_shortest(found)
        for recording in found[1:]:
            first = found[0]
            for got, expected, unit in (
                (recording.sample_rate_hz, first.sample_rate_hz, "Hz"),
                (recording.frames, first.frames, "samples"),
            ):
                if got != expected:
                    faults.append(
                        f"{recording.name}: expected {expected:g} {unit} as in {first.name}, also of array {array!r}, "
                        f"got {got:g} {unit}; export all files of an array together"
                    )
        if faults:
            raise DeviceError("\n".join(faults))
        return found[0] if len(found) == 1 else StackedRecording(tuple(found))

    def use(self, array: str, paths: Sequence[Path], channels: Sequence[int]) -> None:
        """Note that an array uses channels of its files, which count on from one file to the next.

        Raises
        ------
        DeviceError
            If another array uses one of them.
        """
        places = [(path.resolve(), number + 1) for path in paths for number in range(self.open(path).channels)]
        used = [places[channel - 1] for channel in channels]
        shared = [(place, self._users[place]) for place in used if self._users.get(place, array) != array]
        if shared:
            (path, _), other = shared[0]
            numbers = ", ".join(str(number) for (where, number), user in shared if (where, user) == (path, other))
            given = next(name for name in paths if name.resolve() == path)
            raise DeviceError(
                f"{given}: expected each channel to serve one array, got {numbers} for {other!r} and {array!r}; name "
                f"each array's channels with --channels {array}=… or in the site file (nodes.NAME.arrays), or give "
                "each array a file of its own"
            )
        self._users |= dict.fromkeys(used, array)

    def match_ends(self, files: Iterable[tuple[Path, int]]) -> None:
        """Cut files (path, start in ns) of one folder and start to the shortest, if they end almost together."""
        together: dict[tuple[Path, int], list[FileRecording]] = {}
        for path, start_ns in files:
            if path in self._opened:
                together.setdefault((path.parent, start_ns), []).append(self._opened[path])
        for recordings in together.values():
            self._cut_to_shortest(recordings)

    def log_notes(self) -> None:
        """Log the notes, each once."""
        for note in dict.fromkeys(self.notes):
            _log.warning("%s", note)
        self.notes.clear()

    def _cut_to_shortest(self, recordings: Sequence[FileRecording]) -> None:
        shortest = min(recordings, key=lambda recording: recording.frames)
        rate_hz = shortest.sample_rate_hz
        excess = [recording.frames - shortest.frames for recording in recordings]
        if {recording.sample_rate_hz for recording in recordings} != {rate_hz} or max(excess) >= _SAME_END_S * rate_hz:
            return
        for recording, more in zip(recordings, excess, strict=True):
            if more:
                recording.cut(shortest.frames)
                unused = f"its last {more / rate_hz:.3f} s are not used, because {shortest.name} ends before"
                self.notes.append(f"{recording.name}: {unused}")
