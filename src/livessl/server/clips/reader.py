"""Reads and checks `clip.json`, which describes the recordings of an event. No other module reads it.

All fields are checked before use, because another release may have written the file, or a disk may have damaged it.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import orjson
from pydantic import ValidationError

from livessl.errors import RunError
from livessl.schema.clips import ClipHead

ABOUT: Final = "clip.json"
"""File about a clip's recordings."""

SAFE: Final = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9._-]{0,199}")
"""Names of events that can be names of folders."""

MOST_BYTES: Final = 32_000_000
"""Largest size, in bytes, of a `clip.json` that is read: a minute, 1200 frames, of each of 64 arrays takes 5 MB."""


class ClipsError(RunError):
    """The folder of clips cannot be used."""


class UnreadableClipError(RunError):
    """An event has recordings, but `clip.json` is damaged or of another release.

    Parameters
    ----------
    event_id : str
    what : str
        What is wrong, as the middle of a sentence.
    keep : bool or None
        Whether the file says that the recordings are kept for ever; None if that cannot be known.
    """

    def __init__(self, event_id: str, what: str, keep: bool | None = None) -> None:
        super().__init__(self._text(event_id, what))
        self.keep = keep

    @staticmethod
    def _text(event_id: str, what: str) -> str:
        return (
            f"event {event_id!r}: expected a {ABOUT} that this release can read, got another one: {what}; the file "
            "is damaged or of another release. Locate the event from its recordings with `livessl locate --site SITE "
            "--wav ARRAY=FILE`, or delete the recordings"
        )


class ClipDiskError(UnreadableClipError):
    """`clip.json` cannot be read from the disk; nothing is known of its content, and another attempt may succeed."""

    @staticmethod
    def _text(event_id: str, what: str) -> str:
        return (
            f"event {event_id!r}: {ABOUT} cannot be read: {what}; correct its permissions, the disk, or the limit of "
            "open files; the recordings are left alone"
        )


@dataclass(frozen=True, slots=True)
class Clip:
    """The recordings of an event, as their file describes them.

    Parameters
    ----------
    event_id : str
    path : Path
        Folder of the recordings.
    start_ns : int
        Begin of the event, nanoseconds since the epoch.
    keep : bool
        Whether they are kept for ever.
    content : mapping
        The whole file. `position_m` and `files` have the form of `ClipHead`; the rest is not checked.
    """

    event_id: str
    path: Path
    start_ns: int
    keep: bool
    content: Mapping[str, Any]

    @property
    def files(self) -> list[dict[str, Any]]:
        """The recordings, as `ClipFile` describes them."""
        files: list[dict[str, Any]] = self.content["files"]
        return files

    @property
    def nbytes(self) -> int:
        """Size of the recordings in bytes."""
        return sum(file["bytes"] for file in self.files)

    def file(self, name: str) -> Path | None:
        """Return the path of a recording; None if there is none of that name."""
        if name not in {file["name"] for file in self.files}:
            return None
        path = self.path / name
        return path if path.is_file() else None


class ClipReader:
    """The clips in a folder, to be read only; another process may write and delete them.

    Parameters
    ----------
    path : Path
    """

    def __init__(self, path: Path) -> None:
        self._path = path

    def ids(self) -> list[str]:
        """Return the ids of the events that have a clip, in order of their names.

        Raises
        ------
        ClipsError
            If the folder cannot be read.
        """
        try:
            return sorted(folder.name for folder in self._path.iterdir() if self.has(folder.name))
        except OSError as error:
            raise ClipsError(
                f"{self._path}: expected a folder of clips: {error.strerror or error}; give the folder of the clips as "
                "the command's argument, or correct `server.clips.folder`"
            ) from error

    def has(self, event_id: str) -> bool:
        """Return whether an event has a clip, which may be unreadable."""
        return SAFE.fullmatch(event_id) is not None and (self._path / event_id / ABOUT).is_file()

    def read(self, event_id: str) -> Clip | None:
        """Return an event's clip; None if it has none.

        Raises
        ------
        UnreadableClipError
            If `clip.json` is empty, cut short, damaged or of another release.
        ClipDiskError
            If `clip.json` cannot be read from the disk.
        """
        if not SAFE.fullmatch(event_id):
            return None
        folder = self._path / event_id
        try:
            with (folder / ABOUT).open("rb") as file:
                data = file.read(MOST_BYTES + 1)
        except (FileNotFoundError, NotADirectoryError, IsADirectoryError):
            return None
        except OSError as error:
            raise ClipDiskError(event_id, error.strerror or str(error)) from error
        return parsed(event_id, folder, data)


def parsed(event_id: str, folder: Path, data: bytes) -> Clip:
    """Return the clip that the content of a `clip.json` describes.

    Raises
    ------
    UnreadableClipError
    """
    if not data:
        raise UnreadableClipError(event_id, "it is empty")
    if len(data) > MOST_BYTES:
        raise UnreadableClipError(event_id, f"it is larger than {MOST_BYTES / 1e6:.0f} MB")
    try:
        content = orjson.loads(data)
        head = ClipHead.model_validate_json(data, strict=True)
    except orjson.JSONDecodeError as error:
        raise UnreadableClipError(event_id, f"it is not JSON: {error}") from error
    except ValidationError as error:
        raise UnreadableClipError(event_id, _first_fault(error), _said_keep(content)) from error
    return Clip(event_id, folder, head.start_ns, head.keep, content)


def _said_keep(content: Any) -> bool | None:
    """Return whether a file of another form says that its recordings are kept for ever; None if it does not say."""
    keep = content.get("keep") if isinstance(content, dict) else None
    return keep if isinstance(keep, bool) else None


def _first_fault(error: ValidationError) -> str:
    """Return the first thing that is wrong, with its key."""
    fault = error.errors(include_url=False, include_context=False)[0]
    key = ".".join(map(str, fault["loc"]))
    if fault["type"] == "missing":
        return f"{key!r} is missing"
    message = f"{fault['msg'][0].lower()}{fault['msg'][1:]}, got {fault['input']!r:.80}"
    return f"{key}: {message}" if key else message
