"""Stores and deletes clips, each a folder with recordings and `clip.json`; `service` sets the limits.

A clip is written into a folder of another name first, so that a killed server leaves no half of one.
"""

from __future__ import annotations

import logging
import os
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import orjson

from livessl.server.clips.erase import PARTIAL, Wastebasket, erase, write_through
from livessl.server.clips.index import ClipIndex, Entry, Figures
from livessl.server.clips.reader import ABOUT, SAFE, Clip, ClipReader, ClipsError, UnreadableClipError, parsed

_log = logging.getLogger(__name__)


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
        self._index = ClipIndex()  # is changed with the lock held
        self._wastebasket = Wastebasket(path)
        _make(path)

    def load(self) -> None:
        """Read what is there, and delete what a killed server has left unfinished; what fails is left, and logged.

        Unreadable clips count with the size of their files and the time of `clip.json`. Those that say that they are
        not kept for ever are deleted for their age or to stay below `max_bytes`; where that is unknown, they stay.
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
                with self._lock:
                    self._index.put_refused_by_disk(folder.name)
                _log.warning(
                    "%s: cannot be read or deleted: %s; correct its permissions or delete it",
                    folder,
                    error.strerror or error,
                )

    def _load(self, folder: Path) -> None:
        if folder.name.startswith(PARTIAL):
            self._wastebasket.erase(folder)
        elif folder.is_dir():
            with self._lock:  # an operator may delete it meanwhile
                if self.has(folder.name):
                    self._index.put(folder.name, self._entry(folder))
                    return
            _log.warning("%s: expected a clip with %s, got none; it is left alone", folder, ABOUT)

    def _entry(self, folder: Path) -> Entry:
        keep: bool | None = None
        try:
            if clip := self.read(folder.name):
                return Entry.of(clip)
        except UnreadableClipError as error:
            keep = error.keep
        sizes = [path.stat().st_size for path in folder.iterdir()]
        return Entry((folder / ABOUT).stat().st_mtime_ns, sum(sizes), keep)

    def read(self, event_id: str) -> Clip | None:
        """Return an event's clip as `ClipReader` does; one that is unreadable is counted, and logged once.

        A clip that could not be read before counts from now on as it says itself.
        """
        try:
            clip = super().read(event_id)
        except UnreadableClipError as error:
            with self._lock:
                is_new = self._index.put_unreadable(event_id, error)
            if is_new:
                _log.warning("server.clips.folder: %s", error)
            raise
        if self._index.is_outdated(event_id, clip is not None):
            with self._lock:
                clip = super().read(event_id)  # it may have been kept, replaced or deleted just before
                self._index.put_read(event_id, clip)
        return clip

    @property
    def figures(self) -> Figures:
        """Number and size of the clips now."""
        with self._lock:
            return self._index.figures

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
        erase(partial)
        try:
            partial.mkdir(mode=0o700)
            about = dict(write(partial))
            with self._lock:
                clip = _written(
                    partial / ABOUT, event_id, self._path / event_id, about | {"keep": self._is_kept(event_id)}
                )
                going = self._set_aside(event_id)
                partial.rename(clip.path)
                self._index.put(event_id, Entry.of(clip))
        except BaseException:
            with suppress(OSError):
                erase(partial)
            raise
        if going is not None:
            self._wastebasket.erase(going)
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
            clip = _written(fresh, event_id, clip.path, {**clip.content, "keep": keep})
            fresh.replace(clip.path / ABOUT)
            self._index.put(event_id, Entry.of(clip))
            return True

    def _is_kept(self, event_id: str) -> bool:
        try:
            clip = self.read(event_id)
        except UnreadableClipError as error:
            entry = self._index.get(event_id)
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
            self._wastebasket.erase(going)
        return going is not None

    def erase_left(self) -> None:
        """Try again to erase the clips that could not be erased when they were deleted.

        Raises
        ------
        OSError
            If any cannot be erased. All others are tried, and the last error is raised.
        """
        self._wastebasket.empty()

    def expire(self, before_ns: int | None, most_bytes: int) -> int:
        """Delete clips of events that began before a time, and then more of them beyond a number of bytes.

        There the clips of refused events go first, and the oldest first.
        Clips that are kept for ever stay, and unreadable ones of which that cannot be known. Those that the disk has
        refused are read again first. Clips whose folders were removed by other programs do not count any more. Return
        the number of clips that were deleted.

        Raises
        ------
        OSError
            If a file cannot be deleted; the other clips are.
        """
        self._try_again()
        gone, failed = 0, None
        with self._lock:  # so that no folder is just being replaced
            self._index.forget_all_but({folder.name for folder in os.scandir(self._path)})
            too_old = self._index.expired(before_ns)
        for event_id, entry in too_old:
            deleted, error = self._delete_expected(event_id, entry)
            gone, failed = gone + deleted, error or failed
        with self._lock:
            excess, for_room = self._index.figures.nbytes - most_bytes, self._index.by_room()
        for event_id, entry in for_room:
            if excess <= 0:
                break
            deleted, error = self._delete_expected(event_id, entry)
            excess -= entry.nbytes if deleted else 0
            gone, failed = gone + deleted, error or failed
        if failed is not None:
            raise failed
        return gone

    def _delete_expected(self, event_id: str, entry: Entry) -> tuple[bool, OSError | None]:
        """Delete a clip unless it was kept, replaced or deleted meanwhile; return whether it is gone, and what failed.

        A clip that is gone and could not be erased is erased later.
        """
        going = None
        try:
            going = self._set_aside(event_id, entry)
            if going is not None:
                self._wastebasket.erase(going)
        except OSError as error:
            return going is not None, error
        return going is not None, None

    def _set_aside(self, event_id: str, expected: Entry | None = None) -> Path | None:
        """Make a clip disappear at once by renaming its folder; return the folder, which is yet to be erased.

        None if there is no clip, or not the expected one.
        """
        with self._lock:
            if not self.has(event_id) or (expected is not None and self._index.get(event_id) != expected):
                return None
            going = self._wastebasket.place_of(event_id)
            self._wastebasket.erase(going)
            (self._path / event_id).rename(going)
            self._index.forget(event_id)
            return going

    def _try_again(self) -> None:
        """Read the clips again that the disk has refused; what fails still has been logged, and is left alone."""
        for event_id in self._index.unread:
            with suppress(OSError, UnreadableClipError):
                self.read(event_id)


def _make(path: Path) -> None:
    """Make the folder of all clips, and see whether it can be written.

    Raises
    ------
    ClipsError
    """
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


def _written(path: Path, event_id: str, folder: Path, about: Mapping[str, Any]) -> Clip:
    """Write the file about a clip through to the disk, if it can be read again."""
    data = orjson.dumps(about)
    clip = parsed(event_id, folder, data)
    write_through(path, data)
    return clip
