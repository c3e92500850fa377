"""Reads from a clip the data for locating its event again, and words why an event cannot be located again.

`reader.py` has checked the fields of `clip.json` that every use of a clip needs. The fields that are needed only to
locate an event again are checked here.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import soundfile

from livessl.core.types import FRAME_NS, Float32Array, FloatArray, Frame, Uncertainty
from livessl.errors import RunError
from livessl.server.clips.cut import CutFrame
from livessl.server.clips.reader import ABOUT, Clip, ClipReader, UnreadableClipError

MOST_BYTES: Final = 256_000_000
"""Most bytes of decoded samples that a server holds to locate one event again. A sound of 60 s, the largest
`max_event_s` allowed, at 48 kHz from five arrays of four microphones takes 230 MB. A server that runs out of memory
loses live sound."""

MOST_DISTANCE_S: Final = 3600.0
"""Largest difference, in seconds, between the start of the event and a frame of its clip. The fusion steps through all
frame indices between the first and the last, so a damaged index could keep it busy for ever."""

# Limits of the numbers in a clip, at least as wide as those of a site file. The length of a correlation
# grows with an array's size and its sampling rate, so a damaged number could fill the memory.

_SPEEDS_M_S: Final = (100.0, 2000.0)
"""Lowest and highest speed of sound, m/s."""

_RATES_HZ: Final = (100.0, 1e6)
"""Lowest and highest sampling rate, Hz."""

_MOST_M: Final = 1000.0
"""Largest coordinate of a microphone, metres."""

_MOST_UNCERTAINTY: Final = 100.0
"""Largest value of each uncertainty, in its own unit."""

_UNREADABLE: Final = (AttributeError, KeyError, OverflowError, TypeError, ValueError)
"""Errors that Python raises when the arrays and frames of a clip are read and have another form than expected."""


class RelocationError(RunError):
    """An event cannot be located again, for a reason that its text gives."""


class NoClipError(RelocationError):
    """The event has no recordings."""


@dataclass(frozen=True, slots=True)
class StoredArray:
    """One array of a clip.

    Parameters
    ----------
    name : str
    file : str
        Name of its recording.
    microphones_m : (K, 3) float64
        Positions with which the event was located, metres.
    uncertainty : Uncertainty
    time_ns : int
        Site time of the recording's first sample, in nanoseconds.
    sample_rate_hz : float
    rows : tuple of CutFrame
        Its frames, in order.
    """

    name: str
    file: str
    microphones_m: FloatArray
    uncertainty: Uncertainty
    time_ns: int
    sample_rate_hz: float
    rows: tuple[CutFrame, ...]

    @property
    def nbytes(self) -> int:
        """Bytes of the decoded samples: those of the recording or of all frames, whichever are more.

        Frames of a damaged clip may overlap, and hold more samples than the recording.
        """
        held = max(self.length, sum(row.length for row in self.rows))
        return held * len(self.microphones_m) * np.dtype(np.float32).itemsize

    @property
    def length(self) -> int:
        """Number of samples of each channel up to the end of the last frame."""
        return max((row.begin + row.length for row in self.rows), default=0)


@dataclass(frozen=True, slots=True)
class StoredSound:
    """The sound of an event, as its clip describes it.

    Parameters
    ----------
    clip : Clip
        The clip itself.
    duration_s : float
    c_m_s : float
        Speed of sound with which the event was located, m/s.
    answer : mapping
        The event as it was located, as the API encodes it; it has at least `method`, `status`, `confidence` and
        `position_m`.
    arrays : tuple of StoredArray
    """

    clip: Clip
    duration_s: float
    c_m_s: float
    answer: Mapping[str, Any]
    arrays: tuple[StoredArray, ...]

    @property
    def event_id(self) -> str:
        """Id of the event."""
        return self.clip.event_id

    @property
    def start_ns(self) -> int:
        """Start of the event, nanoseconds since the epoch."""
        return self.clip.start_ns


def is_relocatable(clip: Clip) -> bool:
    """Return whether a clip describes its frames, which are needed to locate its event again; older clips do not."""
    return bool(clip.content.get("arrays"))


def stored_clip(folder: ClipReader, event_id: str) -> Clip:
    """Return an event's clip.

    Raises
    ------
    NoClipError
        If the event has no recordings.
    RelocationError
        If the clip is unreadable.
    """
    try:
        clip = folder.read(event_id)
    except UnreadableClipError as error:
        raise RelocationError(str(error)) from error
    if clip is None:
        raise NoClipError(f"event {event_id!r} has no recordings; it cannot be located again without its sound")
    return clip


def stored_sound(clip: Clip) -> StoredSound:
    """Return the description of an event's sound in its clip; reads no file.

    Raises
    ------
    RelocationError
        If the clip was made by an earlier release, which did not describe frames, or if a field is missing or has
        another form than expected, as in a damaged clip or one of a later release.
    """
    if not is_relocatable(clip):
        raise RelocationError(
            f"the recordings of {clip.event_id!r} are of an earlier release, which did not store where frames begin; "
            "locate them with `livessl locate --site SITE --wav ARRAY=FILE`"
        )
    try:
        return _parsed(clip)
    except _UNREADABLE as error:
        what = f"{error} is missing" if isinstance(error, KeyError) else str(error)
        raise RelocationError(str(UnreadableClipError(clip.event_id, what))) from error


def check_memory(sound: StoredSound, most_bytes: int) -> None:
    """Refuse a sound whose decoded samples take more than a number of bytes; reads no recording.

    Raises
    ------
    RelocationError
        If they take more.
    """
    nbytes = sum(array.nbytes for array in sound.arrays)
    if nbytes > most_bytes:
        raise RelocationError(
            f"the recordings of {sound.event_id!r} are too large for a running server: expected at most "
            f"{most_bytes / 1e6:.0f} MB of decoded samples, got {math.ceil(nbytes / 1e6)} MB; locate the event with "
            "`livessl relocate`, on a machine with the memory"
        )


def stored_frames(sound: StoredSound, array: StoredArray) -> list[Frame]:
    """Return the frames of one array of a clip.

    Raises
    ------
    NoClipError
        If the recording has been deleted meanwhile.
    RelocationError
        If it cannot be read, or if it has other channels or fewer samples than `clip.json` states.
    """
    event_id, path = sound.event_id, sound.clip.file(array.file)
    if path is None:
        raise NoClipError(f"event {event_id!r}: its recording {array.file!r} is gone; it cannot be located again")
    try:
        samples = _samples(path, array)
    except (OSError, soundfile.SoundFileError, ValueError) as error:
        raise RelocationError(
            f"event {event_id!r}: {array.file} cannot be read: {error}; restore the file from a copy, or delete the "
            "recordings of this event"
        ) from error
    frames = []
    for number, row in enumerate(array.rows, 1):
        piece = np.ascontiguousarray(samples[:, row.begin : row.begin + row.length])
        at_ns = array.time_ns + round(1e9 * row.begin / array.sample_rate_hz)
        sequence = 0 if row.requested else number
        frames.append(
            Frame(
                array.name,
                sequence,
                row.frame_index,
                at_ns,
                array.sample_rate_hz,
                piece,
                row.power,
                row.active,
                row.requested,
            )
        )
    return frames


def _samples(path: Path, array: StoredArray) -> Float32Array:
    """Return the samples (channels, n) of a recording up to the end of its last frame, and not more.

    Raises
    ------
    OSError, soundfile.SoundFileError, ValueError
        If it cannot be read, or has other channels or fewer samples than its frames.
    """
    channels = len(array.microphones_m)
    with soundfile.SoundFile(path) as file:
        if file.channels != channels:
            raise ValueError(f"expected {channels} channels, as {ABOUT} says, got {file.channels}")
        samples = file.read(array.length, dtype="float32", always_2d=True)
    if len(samples) < array.length:
        raise ValueError(f"expected {array.length} samples, as {ABOUT} says, got {len(samples)}")
    found: Float32Array = samples.T
    return found


def _parsed(clip: Clip) -> StoredSound:
    """Return the content of a `clip.json`; raises one of `_UNREADABLE` if something is missing or has another form."""
    about = clip.content
    files = {str(each["array"]): each["name"] for each in clip.files if each["kind"] == "array"}
    arrays = about["arrays"]
    found = StoredSound(
        clip,
        _positive("duration_s", about["duration_s"]),
        _within("c_m_s", about["c_m_s"], _SPEEDS_M_S),
        _answer(about["answer"]),
        tuple(_array(str(name), known, files[name]) for name, known in arrays.items()),
    )
    for array in found.arrays:
        for row in array.rows:
            off_s = (row.frame_index * FRAME_NS - found.start_ns) / 1e9
            if abs(off_s) > MOST_DISTANCE_S:
                raise ValueError(
                    f"arrays.{array.name}.frames: expected frames within {MOST_DISTANCE_S:.0f} s of the event, "
                    f"got one {off_s:.0f} s from it"
                )
    return found


def _answer(answer: Mapping[str, Any]) -> Mapping[str, Any]:
    if not isinstance(answer["method"], str) or not isinstance(answer["status"], str):
        raise TypeError(f"answer: expected a method and a status as texts, got {answer!r}")
    position_m = answer["position_m"]
    numbers = [answer["confidence"], *([] if position_m is None else position_m)]
    if not all(isinstance(number, int | float) for number in numbers):
        raise TypeError(f"answer: expected a confidence and a position as numbers, got {numbers!r}")
    if position_m is not None:
        _x, _y, _z = position_m
    return answer


def _array(name: str, known: Mapping[str, Any], file: str) -> StoredArray:
    microphones_m = np.array(known["microphones_m"], dtype=np.float64)
    if microphones_m.shape[1:] != (3,) or not (np.abs(microphones_m) <= _MOST_M).all():
        raise ValueError(f"arrays.{name}.microphones_m: expected positions (K, 3), got {known['microphones_m']!r}")
    uncertainty = Uncertainty(**known["uncertainty"])
    for what, value in known["uncertainty"].items():
        _within(f"arrays.{name}.uncertainty.{what}", value, (0.0, _MOST_UNCERTAINTY))
    return StoredArray(
        name,
        file,
        microphones_m,
        uncertainty,
        int(known["time_ns"]),
        _within(f"arrays.{name}.sample_rate_hz", known["sample_rate_hz"], _RATES_HZ),
        tuple(_row(name, row) for row in known["frames"]),
    )


def _row(name: str, row: Sequence[Any]) -> CutFrame:
    index, begin, length, power, active, requested = row
    found = CutFrame(int(index), int(begin), int(length), float(power), bool(active), bool(requested))
    if found.begin < 0 or found.length <= 0:
        raise ValueError(f"arrays.{name}.frames: expected a start of 0 or more and a length above 0, got {row!r}")
    return found


def _within(what: str, value: Any, limits: tuple[float, float]) -> float:
    low, high = limits
    if not isinstance(value, int | float) or not low <= value <= high:
        raise ValueError(f"{what}: expected a number from {low:g} to {high:g}, got {value!r}")
    return float(value)


def _positive(what: str, value: Any) -> float:
    number = float(value)
    if not number > 0.0:
        raise ValueError(f"{what}: expected a number above 0, got {value!r}")
    return number
