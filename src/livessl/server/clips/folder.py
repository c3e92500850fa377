"""The folder of clips: for each event a folder with its recordings and one JSON file about them.

A clip is written into a folder of another name first, so that a killed server leaves no half of one.
"""

from __future__ import annotations

import logging
import os
import re
import shutil
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import orjson

from livessl.errors import RunError

ABOUT: Final = "clip.json"
"""File about a clip's recordings."""

SUFFIXES: Final = (".flac", ".wav")
"""Ends of the names of recordings."""

PARTIAL: Final = ".partial-"
"""Beginning of the name of a folder that is being written or deleted."""

_SAFE: Final = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9._-]{0,199}")
_ZEROS: Final = bytes(1 << 16)
_log = logging.getLogger(__name__)

About = dict[str, Any]


class ClipsError(RunError):
    """The folder of clips cannot be used."""


@dataclass(frozen=True, slots=True)
class _Entry:
    """The properties of a clip that retention needs."""

    start_ns: int
    nbytes: int
    keep: bool


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
            folders = [folder for folder in self._path.iterdir() if _SAFE.fullmatch(folder.name)]
            return sorted(folder.name for folder in folders if (folder / ABOUT).is_file())
        except OSError as error:
            raise ClipsError(f"{self._path}: expected a folder of clips: {error.strerror or error}; name it") from error

    def about(self, event_id: str) -> About | None:
        """Return what `clip.json` says of an event's clip, whatever that is; None if it has none."""
        if not _SAFE.fullmatch(event_id):
            return None
        try:
            return _parsed((self._path / event_id / ABOUT).read_bytes())
        except OSError:
            return None

    def complete(self, event_id: str) -> About | None:
        """Return what is known of an event's clip; None if it has none, or one that another program has changed."""
        about = self.about(event_id)
        return about if about is not None and _is_complete(about) else None

    def file(self, event_id: str, name: str) -> Path | None:
        """Return the path of one of a clip's recordings; None if there is none of that name."""
        about = self.complete(event_id)
        if about is None or name not in {each["name"] for each in about["files"]}:
            return None
        path = self._path / event_id / name
        return path if path.is_file() else None


class ClipFolder(ClipReader):
    """All clips of a site. Every thread may call it.

    Parameters
    ----------
    path : Path
        Is made if it does not exist; only its owner may look into it.

    Raises
    ------
    ClipsError
        If it cannot be made or written.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._lock = threading.RLock()
        self._erasing = threading.Lock()  # is never held while waiting for the other lock
        self._entries: dict[str, _Entry] = {}
        try:
            path.mkdir(mode=0o700, parents=True, exist_ok=True)
            probe = path / f"{PARTIAL}probe"
            probe.touch()
            probe.unlink()
        except OSError as error:
            reason = error.strerror or str(error)
            raise ClipsError(
                f"server.clips.folder: cannot write {path}: {reason}; name a folder in which the server may write"
            ) from error

    def load(self) -> None:
        """Read what is there, and delete what a killed server has left unfinished; what fails is left, and logged."""
        try:
            folders = sorted(self._path.iterdir())
        except OSError as error:
            _log.error("%s: cannot be read: %s; correct its permissions and restart the server", self._path, error)
            return
        for folder in folders:
            try:
                self._load(folder)
            except OSError as error:
                _log.warning(
                    "%s: cannot be read or deleted: %s; correct its permissions or delete it",
                    folder,
                    error.strerror or error,
                )
            except (KeyError, TypeError, ValueError) as error:
                _log.warning(
                    "%s: expected a complete %s, got an unknown one (%r); delete the folder", folder, ABOUT, error
                )

    def _load(self, folder: Path) -> None:
        if folder.name.startswith(PARTIAL):
            self._finish(folder)
        elif folder.is_dir():
            if not (folder / ABOUT).exists() or not _SAFE.fullmatch(folder.name):
                _log.warning("%s: expected a clip with %s, got none; it is left alone", folder, ABOUT)
                return
            with self._lock:  # an operator may delete it meanwhile
                about = _parsed((folder / ABOUT).read_bytes())
                if about is not None:
                    self._note(folder.name, about)
                    return
            _log.warning("%s: %s is empty or damaged; the folder is deleted", folder, ABOUT)
            going = self._path / f"{PARTIAL}going-{folder.name}"
            self._finish(going)
            folder.rename(going)
            self._finish(going)

    @property
    def nbytes(self) -> int:
        """Bytes of all recordings."""
        with self._lock:
            return sum(entry.nbytes for entry in self._entries.values())

    @property
    def count(self) -> int:
        """Number of events with a clip."""
        return len(self._entries)

    @property
    def kept(self) -> int:
        """Number of clips that are kept for ever."""
        with self._lock:
            return sum(entry.keep for entry in self._entries.values())

    @property
    def kept_bytes(self) -> int:
        """Bytes of the clips that are kept for ever."""
        with self._lock:
            return sum(entry.nbytes for entry in self._entries.values() if entry.keep)

    def put(self, event_id: str, write: Callable[[Path], Mapping[str, Any]]) -> About:
        """Store a clip in place of an earlier one of the same event, which stays kept for ever if it was.

        Parameters
        ----------
        event_id : str
        write : callable
            Writes the recordings into a folder and returns what to say of them: `start_ns` and `files` with `name` and
            `bytes` at least.

        Raises
        ------
        OSError
            If the disk does not take it; nothing is left of it then.
        ValueError
            If the id cannot be the name of a folder.
        """
        if not _SAFE.fullmatch(event_id):
            raise ValueError(f"clip: expected an event id of letters, digits, '.', '_' or '-', got {event_id!r}")
        partial = self._path / f"{PARTIAL}{event_id}"
        _erase(partial)
        try:
            partial.mkdir(mode=0o700)
            about = {**write(partial), "keep": False}
            with self._lock:
                earlier = self.about(event_id)
                about["keep"] = earlier is not None and bool(earlier.get("keep"))
                _write_through(partial / ABOUT, orjson.dumps(about))
                going = self._set_aside(event_id)
                partial.rename(self._path / event_id)
                self._note(event_id, about)
        except BaseException:
            with suppress(OSError):
                _erase(partial)
            raise
        if going is not None:
            self._finish(going)
        return about

    def keep(self, event_id: str, keep: bool) -> bool:
        """Keep a clip for ever, or no longer; return False if there is none.

        Raises
        ------
        OSError
            If the disk does not take it.
        """
        with self._lock:
            about = self.complete(event_id)
            if about is None:
                return False
            path = self._path / event_id / ABOUT
            fresh = path.with_name(f"{PARTIAL}{ABOUT}")
            _write_through(fresh, orjson.dumps({**about, "keep": keep}))
            fresh.replace(path)
            self._note(event_id, {**about, "keep": keep})
            return True

    def delete(self, event_id: str) -> bool:
        """Overwrite and delete an event's clip; return False if there is none.

        Raises
        ------
        OSError
            If a file cannot be deleted.
        """
        going = self._set_aside(event_id)
        if going is not None:
            self._finish(going)
        return going is not None

    def erase_left(self) -> None:
        """Try again to erase the clips that could not be erased when they were deleted.

        Raises
        ------
        OSError
            If one of them cannot be erased; the others are.
        """
        failed: OSError | None = None
        for going in self._path.glob(f"{PARTIAL}going-*"):
            try:
                self._finish(going)
            except OSError as error:
                failed = error
        if failed is not None:
            raise failed

    def expire(self, before_ns: int | None, most_bytes: int) -> int:
        """Delete clips of events that began before a time, and the oldest ones beyond a number of bytes.

        Clips that are kept for ever stay. Clips whose folders somebody has removed do not count any more. Return the
        number of clips that were deleted.

        Raises
        ------
        OSError
            If a file cannot be deleted; the other clips are.
        """
        with self._lock:
            self._forget_removed()
            excess = self.nbytes - most_bytes
            oldest_first = sorted(self._entries.items(), key=lambda item: item[1].start_ns)
        gone, failed = 0, None
        for event_id, entry in oldest_first:
            is_old = before_ns is not None and entry.start_ns < before_ns
            if not entry.keep and (is_old or excess > 0):
                try:
                    going = self._set_aside(event_id, entry)
                    if going is None:  # it was kept, replaced or deleted meanwhile
                        continue
                    excess -= entry.nbytes
                    gone += 1
                    self._finish(going)
                except OSError as error:
                    failed = error
        if failed is not None:
            raise failed
        return gone

    def _set_aside(self, event_id: str, expected: _Entry | None = None) -> Path | None:
        """Make a clip disappear at once by renaming its folder; return the folder, which is yet to be erased.

        None if there is no clip, or not the expected one.
        """
        with self._lock:
            if self.about(event_id) is None or (expected is not None and self._entries.get(event_id) != expected):
                return None
            going = self._path / f"{PARTIAL}going-{event_id}"
            self._finish(going)
            (self._path / event_id).rename(going)
            self._entries.pop(event_id, None)
            return going

    def _forget_removed(self) -> None:
        """Forget the clips whose folders are gone; the lock is held, so that none of them is just being replaced."""
        there = {folder.name for folder in os.scandir(self._path)}
        for event_id in self._entries.keys() - there:
            del self._entries[event_id]

    def _finish(self, going: Path) -> None:
        """Erase a folder that was set aside; two threads may do so at once."""
        with self._erasing:
            _erase(going)

    def _note(self, event_id: str, about: Mapping[str, Any]) -> None:
        nbytes = sum(int(each["bytes"]) for each in about["files"])
        with self._lock:
            self._entries[event_id] = _Entry(int(about["start_ns"]), nbytes, bool(about["keep"]))


def _parsed(data: bytes) -> About | None:
    """Return the content of the file about a clip; None if it is empty or damaged."""
    try:
        about = orjson.loads(data)
    except orjson.JSONDecodeError:
        return None
    return about if isinstance(about, dict) else None


def _is_complete(about: About) -> bool:
    """Return whether the file about a clip says what the server needs of it."""
    try:
        int(about["start_ns"])
        names = [str(each["name"]) for each in about["files"] if int(each["bytes"]) >= 0]
    except (KeyError, TypeError, ValueError, OverflowError):
        return False
    known = isinstance(about.get("keep"), bool) and isinstance(about.get("position_m"), list | None)
    return known and all(Path(name).suffix in SUFFIXES for name in names)


def _write_through(path: Path, data: bytes) -> None:
    """Write a file to the disk itself, so that its content is there before a rename, even if the power fails."""
    with path.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def _erase(folder: Path) -> None:
    """Overwrite a folder's files with zeros and delete it; on some disks and file systems copies remain.

    A file that cannot be overwritten is deleted nevertheless.
    """
    if not folder.exists():
        return
    for path in folder.rglob("*"):
        try:
            if path.is_file() and not path.is_symlink():
                _overwrite(path)
        except OSError as error:
            _log.warning(
                "%s: deleted without being overwritten: %s; its sound may remain on the disk, check the disk",
                path,
                error.strerror or error,
            )
    shutil.rmtree(folder) if folder.is_dir() else folder.unlink()


def _overwrite(path: Path) -> None:
    left = path.stat().st_size
    with path.open("r+b") as file:
        while left > 0:
            left -= file.write(_ZEROS[:left])
        file.flush()
        os.fsync(file.fileno())
