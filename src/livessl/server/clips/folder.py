"""Stores and deletes clips, each a folder of recordings with one JSON file; `service` sets the limits of age and bytes.

A clip is written into a folder of another name first, so that a killed server leaves no half of one.
"""

from __future__ import annotations

import logging
import os
import shutil
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import orjson

from livessl.server.clips.reader import (
    ABOUT,
    SAFE,
    Clip,
    ClipDiskError,
    ClipReader,
    ClipsError,
    UnreadableClipError,
    parsed,
)

PARTIAL: Final = ".partial-"
"""Beginning of the name of a folder that is being written or deleted."""

_ZEROS: Final = bytes(1 << 16)
_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class _Entry:
    """The properties of a clip that decide its retention; `keep` is None while it is unknown."""

    start_ns: int
    nbytes: int
    keep: bool | None

    @property
    def stays(self) -> bool:
        """True if the clip is deleted neither by age nor for space: it is kept for ever, or may be."""
        return self.keep is not False


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
        self._unreadable: dict[str, str] = {}  # reasons
        self._unread: set[str] = set()  # clips that the disk has refused, and are tried again
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
        """Read what is there, and delete what a killed server has left unfinished; what fails is left, and logged.

        Unreadable clips count with the size of their files and the time of `clip.json`. Age and room delete those that
        say that they are not kept for ever; where that is unknown, they stay.
        """
        try:
            folders = sorted(self._path.iterdir())
        except OSError as error:
            _log.error("%s: cannot be read: %s; correct its permissions and restart the server", self._path, error)
            return
        for folder in folders:
            try:
                self._load(folder)
            except OSError as error:
                self._unread.add(folder.name)
                _log.warning(
                    "%s: cannot be read or deleted: %s; correct its permissions or delete it",
                    folder,
                    error.strerror or error,
                )

    def _load(self, folder: Path) -> None:
        if folder.name.startswith(PARTIAL):
            self._finish(folder)
        elif folder.is_dir():
            with self._lock:  # an operator may delete it meanwhile
                if self.has(folder.name):
                    self._entries[folder.name] = self._entry(folder)
                    return
            _log.warning("%s: expected a clip with %s, got none; it is left alone", folder, ABOUT)

    def _entry(self, folder: Path) -> _Entry:
        keep: bool | None = None
        try:
            if clip := self.read(folder.name):
                return _entry_of(clip)
        except UnreadableClipError as error:
            keep = error.keep
        sizes = [path.stat().st_size for path in folder.iterdir()]
        return _Entry((folder / ABOUT).stat().st_mtime_ns, sum(sizes), keep)

    def read(self, event_id: str) -> Clip | None:
        """Return an event's clip as `ClipReader` does; one that is unreadable is counted, and logged once.

        A clip that could not be read before counts from now on as it says itself.
        """
        try:
            clip = super().read(event_id)
        except UnreadableClipError as error:
            with self._lock:
                is_known = self._unreadable.get(event_id) == str(error)
                self._unreadable[event_id] = str(error)
                self._note_unreadable(event_id, error)
            if not is_known:
                _log.warning("server.clips.folder: %s", error)
            raise
        if event_id in self._unreadable or (clip is not None and event_id not in self._entries):
            with self._lock:
                clip = super().read(event_id)  # it may have been kept, replaced or deleted just before
                self._unreadable.pop(event_id, None)
                self._unread.discard(event_id)
                if clip is not None:
                    self._entries[event_id] = _entry_of(clip)
        return clip

    def _note_unreadable(self, event_id: str, error: UnreadableClipError) -> None:
        """Note whether to try again, and what is known of whether the clip is kept; the lock is held."""
        if isinstance(error, ClipDiskError):
            self._unread.add(event_id)
            return
        self._unread.discard(event_id)
        entry = self._entries.get(event_id)
        if entry is not None and entry.keep is None:
            self._entries[event_id] = replace(entry, keep=error.keep)

    @property
    def unreadable(self) -> int:
        """Number of clips that could not be read when they were last needed."""
        return len(self._unreadable)

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
            return sum(entry.keep is True for entry in self._entries.values())

    @property
    def kept_bytes(self) -> int:
        """Bytes of the clips that neither age nor room deletes: they are kept for ever, or may be."""
        with self._lock:
            return sum(entry.nbytes for entry in self._entries.values() if entry.stays)

    def put(self, event_id: str, write: Callable[[Path], Mapping[str, Any]]) -> Clip:
        """Store a clip in place of an earlier one of the same event; it is kept for ever if that one was, or may be.

        Parameters
        ----------
        event_id : str
        write : callable
            Writes the recordings into a folder and returns what to say of them, as `ClipHead` describes it, but for
            `keep`; more is stored, too.

        Raises
        ------
        OSError
            If the disk does not take it; nothing is left of it then.
        UnreadableClipError
            If what is to be said of them has another form.
        ValueError
            If the id cannot be the name of a folder.
        """
        if not SAFE.fullmatch(event_id):
            raise ValueError(f"clip: expected an event id of letters, digits, '.', '_' or '-', got {event_id!r}")
        partial = self._path / f"{PARTIAL}{event_id}"
        _erase(partial)
        try:
            partial.mkdir(mode=0o700)
            about = dict(write(partial))
            with self._lock:
                clip = self._written(partial / ABOUT, event_id, about | {"keep": self._is_kept(event_id)})
                going = self._set_aside(event_id)
                partial.rename(clip.path)
                self._entries[event_id] = _entry_of(clip)
        except BaseException:
            with suppress(OSError):
                _erase(partial)
            raise
        if going is not None:
            self._finish(going)
        return clip

    def keep(self, event_id: str, keep: bool) -> bool:
        """Keep a clip for ever, or no longer; return False if there is none.

        Raises
        ------
        OSError
            If the disk does not take it.
        UnreadableClipError
        """
        with self._lock:
            clip = self.read(event_id)
            if clip is None:
                return False
            fresh = clip.path / f"{PARTIAL}{ABOUT}"
            clip = self._written(fresh, event_id, {**clip.content, "keep": keep})
            fresh.replace(clip.path / ABOUT)
            self._entries[event_id] = _entry_of(clip)
            return True

    def _written(self, path: Path, event_id: str, about: Mapping[str, Any]) -> Clip:
        """Write the file about a clip through to the disk, if it can be read again."""
        data = orjson.dumps(about)
        clip = parsed(event_id, self._path / event_id, data)
        _write_through(path, data)
        return clip

    def _is_kept(self, event_id: str) -> bool:
        try:
            clip = self.read(event_id)
        except UnreadableClipError as error:
            entry = self._entries.get(event_id)
            said = {error.keep, None if entry is None else entry.keep}
            return True in said or False not in said
        return clip is not None and clip.keep

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

        Clips that are kept for ever stay, and unreadable ones of which that cannot be known. Those that the disk has
        refused are read again first. Clips whose folders somebody has removed do not count any more. Return the number
        of clips that were deleted.

        Raises
        ------
        OSError
            If a file cannot be deleted; the other clips are.
        """
        self._try_again()
        with self._lock:
            self._forget_removed()
            excess = self.nbytes - most_bytes
            oldest_first = sorted(self._entries.items(), key=lambda item: item[1].start_ns)
        gone, failed = 0, None
        for event_id, entry in oldest_first:
            is_old = before_ns is not None and entry.start_ns < before_ns
            if not entry.stays and (is_old or excess > 0):
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
            if not self.has(event_id) or (expected is not None and self._entries.get(event_id) != expected):
                return None
            going = self._path / f"{PARTIAL}going-{event_id}"
            self._finish(going)
            (self._path / event_id).rename(going)
            self._entries.pop(event_id, None)
            self._unreadable.pop(event_id, None)
            self._unread.discard(event_id)
            return going

    def _try_again(self) -> None:
        """Read the clips again that the disk has refused; what fails still has been logged, and is left alone."""
        for event_id in sorted(self._unread):
            with suppress(OSError, UnreadableClipError):
                self.read(event_id)

    def _forget_removed(self) -> None:
        """Forget the clips whose folders are gone; the lock is held, so that none of them is just being replaced."""
        there = {folder.name for folder in os.scandir(self._path)}
        for known in (self._entries, self._unreadable):
            for event_id in known.keys() - there:
                del known[event_id]
        self._unread &= there

    def _finish(self, going: Path) -> None:
        """Erase a folder that was set aside; two threads may do so at once."""
        with self._erasing:
            _erase(going)


def _entry_of(clip: Clip) -> _Entry:
    return _Entry(clip.start_ns, clip.nbytes, clip.keep)


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
