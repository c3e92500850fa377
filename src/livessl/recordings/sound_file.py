"""Opens, reads and writes WAV and FLAC files (the list of formats); reads damaged ones as far as they go.

Errors of libsndfile end here: they become a `DeviceError` or an `OSError` with a sentence for the user.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Final, Literal, Self

import numpy as np
import soundfile

from livessl.core.types import Float32Array
from livessl.errors import DeviceError
from livessl.recordings.headers import STREAMINFO_END, Repair, apply_repair, find_repair, flac_header

FLAC_MAX_CHANNELS: Final = 8
"""Most channels of a FLAC file, by its format."""

Format = Literal["flac", "wav"]

_WRITTEN: Final = {"flac": ("FLAC", "PCM_24"), "wav": ("RF64", "FLOAT")}
"""Container and sample format of each kind, as libsndfile names them. RF64 is WAV without its limit of 4 GiB, which
16 channels reach in 23 minutes at 48 kHz."""

_HEADER_S: Final = 1.0
"""Interval, in seconds of sound, at which the length in the header is brought up to date."""


_READ_SAMPLES: Final = 4096
"""Samples of each channel that are read at a time, so that damage is found to a fraction of a second."""


class SoundFile:
    """A WAV or FLAC file that is open for reading; use it as a context manager.

    Parameters
    ----------
    path : Path

    Attributes
    ----------
    sample_rate_hz, channels, frames : int
        `frames` is the number of complete samples of each channel.
    may_hold_anything : bool
        True if the file's sample format can hold NaN, infinity, and values beyond full scale.
    note : str or None
        Sentence about the fault of the file and how much of it is read; None for a good file.

    Raises
    ------
    DeviceError
        If the file is not a sound file, or cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._overlay: _Overlay | None = None
        try:
            if path.exists() and not path.is_file():
                raise _unreadable(path, "it is a folder" if path.is_dir() else "it is not a file on a disk")
            repair = find_repair(path)
            if repair is not None:
                self._overlay = _Overlay(path, repair)
            self._file = soundfile.SoundFile(self._overlay or path)
        except (soundfile.SoundFileError, OSError, TypeError, ValueError) as error:
            if self._overlay is not None:
                self._overlay.close()
            if isinstance(error, FileNotFoundError):
                raise _unreadable(path, "no such file") from error
            reason = getattr(error, "error_string", None) or getattr(error, "strerror", None) or str(error)
            raise _unreadable(path, reason) from error
        self.sample_rate_hz = int(self._file.samplerate)
        self.channels = int(self._file.channels)
        self.frames = int(self._file.frames) if repair is None else repair.frames
        self.may_hold_anything = self._file.subtype in ("FLOAT", "DOUBLE")
        self.note = None if repair is None else self._note(repair)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()
        if self._overlay is not None:
            self._overlay.close()

    def pieces(self, length: int, frames: int) -> Iterator[Float32Array]:
        """Yield the first `frames` samples in pieces (n, channels) of `length` samples; the last may be shorter.

        Raises
        ------
        DeviceError
            If the file is damaged.
        """
        at_once = length * max(1, _READ_SAMPLES // length)
        for first in range(0, frames, at_once):
            count = min(at_once, frames - first)
            try:
                several = self._read(first, count)
            except DeviceError as damage:  # what comes before it is read piece by piece
                try:
                    self._file.seek(first)
                except soundfile.SoundFileError:
                    raise damage from damage.__cause__
                for begin in range(first, first + count, length):
                    yield self._read(begin, min(length, frames - begin))
                raise
            for begin in range(0, count, length):
                yield several[begin : begin + length]

    def _read(self, first: int, count: int) -> Float32Array:
        """Read the next samples (count, channels); `first` is the number of the first one in the file."""
        piece = np.empty((count, self.channels), dtype=np.float32)
        for at in range(0, count, _READ_SAMPLES):
            part = piece[at : at + _READ_SAMPLES]
            try:
                got = len(self._file.read(out=part))
            except soundfile.SoundFileError as error:
                raise self._damaged(first + at, getattr(error, "error_string", str(error))) from error
            if got < len(part):
                raise self._damaged(first + at + got, "it ends there")
        return piece

    def _note(self, repair: Repair) -> str:
        return f"{self._path}: {repair.fault}; {repair.frames / self.sample_rate_hz:.2f} s of sound were found and read"

    def _damaged(self, at: int, reason: str) -> DeviceError:
        at_s, end_s = at / self.sample_rate_hz, self.frames / self.sample_rate_hz
        return DeviceError(
            f"{self._path}: expected {end_s:.2f} s of sound, cannot read it beyond {at_s:.2f} s: "
            f"{reason.removeprefix('Error : ').strip().rstrip('.')}; the file is damaged, copy or record it again"
        )


def _unreadable(path: Path, reason: str) -> DeviceError:
    return DeviceError(f"{path}: expected a WAV or FLAC file, cannot read it: {reason.strip()}")


class _Overlay(io.RawIOBase):
    """A file as it would be if it were repaired."""

    def __init__(self, path: Path, repair: Repair) -> None:
        self._file: BinaryIO = path.open("rb")
        self._header = repair.header
        self._end = repair.end
        self._at = 0

    def seekable(self) -> bool:
        return True

    def readable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        base = {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: self._end}[whence]
        self._at = max(base + offset, 0)
        return self._at

    def tell(self) -> int:
        return self._at

    def readinto(self, buffer: Any) -> int:
        view = memoryview(buffer)
        wanted = max(min(len(view), self._end - self._at), 0)
        got = self._header[self._at : self._at + wanted]
        if len(got) < wanted:
            self._file.seek(self._at + len(got))
            got += self._file.read(wanted - len(got))
        view[: len(got)] = got
        self._at += len(got)
        return len(got)

    def close(self) -> None:
        self._file.close()
        super().close()


class SoundWriter:
    """A FLAC or WAV file that is being written, and can be read at any moment.

    The length in its header is brought up to date every second, so that a killed process leaves a valid sound file.

    Parameters
    ----------
    path : Path
    sample_rate_hz, channels : int
    kind : {"flac", "wav"}
        24-bit FLAC, or float RF64.

    Raises
    ------
    OSError
        If the file cannot be created.
    """

    def __init__(self, path: Path, sample_rate_hz: int, channels: int, kind: Format) -> None:
        self._path = path
        self._kind = kind
        self._step = round(_HEADER_S * sample_rate_hz)
        self._announced = 0
        self.frames = 0
        """Number of samples of each channel that were written."""
        container, subtype = _WRITTEN[kind]
        self._disk = _Disk(path)
        try:
            self._file = soundfile.SoundFile(
                self._disk, "w", samplerate=sample_rate_hz, channels=channels, format=container, subtype=subtype
            )
        except soundfile.SoundFileError as error:
            self._disk.close()
            raise self._disk.error or OSError(str(error)) from error

    def write(self, samples: Float32Array) -> None:
        """Write samples (channels, n).

        Raises
        ------
        OSError
            If the disk does not take them.
        """
        try:
            self._file.write(np.ascontiguousarray(samples.T))
        except (soundfile.SoundFileError, AssertionError) as error:  # it asserts that all samples were taken
            raise self._disk.error or OSError(str(error)) from error
        if self._disk.error is not None:
            raise self._disk.error
        before, self.frames = self.frames, self.frames + int(samples.shape[1])
        if self.frames // self._step > before // self._step:
            self._update_header()

    def close(self) -> None:
        """Finish the file.

        Raises
        ------
        OSError
            If the disk does not take its end; call `rescue` then.
        """
        try:
            self._file.close()
        except soundfile.SoundFileError as error:
            raise self._disk.error or OSError(str(error)) from error
        finally:
            self._disk.close()
        if self._disk.error is not None:
            raise self._disk.error

    def rescue(self) -> float:
        """Close the file after an error and make it readable; return how many seconds of sound it holds."""
        with suppress(OSError):
            self.close()
        with suppress(OSError):
            repair = find_repair(self._path)
            if repair is not None:
                apply_repair(self._path, repair)
        try:
            with SoundFile(self._path) as file:
                return file.frames / file.sample_rate_hz
        except DeviceError:
            return 0.0

    def _update_header(self) -> None:
        """Write the present length into the header, through another descriptor, so that the writer's position stays."""
        if self._kind == "wav":
            repair = find_repair(self._path)
            header = repair.header if repair is not None else b""
        else:  # the encoder holds back less than a second, so a length a second ago is on the disk
            with self._path.open("rb") as file:
                header = flac_header(file.read(STREAMINFO_END), self._announced)
            self._announced = self.frames
        with self._path.open("r+b") as file:
            file.write(header)


class _Disk(io.FileIO):
    """A new file that keeps the error of a write: an exception cannot pass through libsndfile."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, "w+")
        self.error: OSError | None = None

    def write(self, data: Any) -> int:
        try:
            written = super().write(data)
            if written < len(data):  # the next write raises the reason
                written += super().write(data[written:])
        except OSError as error:
            self.error = self.error or error
            return 0
        return written
