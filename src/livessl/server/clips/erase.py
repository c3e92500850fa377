"""Overwrites the content of files before they are deleted, and writes files through to the disk."""

from __future__ import annotations

import logging
import os
import shutil
import threading
from pathlib import Path
from typing import Final

PARTIAL: Final = ".partial-"
"""Beginning of the name of a folder that is being written or deleted."""

_ZEROS: Final = bytes(1 << 16)
_log = logging.getLogger(__name__)


class Wastebasket:
    """Folders of clips that were deleted, and wait to be erased. Every thread may call it.

    Parameters
    ----------
    path : Path
        Folder of all clips.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._lock = threading.Lock()  # is never held while waiting for another lock

    def place_of(self, event_id: str) -> Path:
        """Return the folder to which the clip of an event is renamed when it is deleted, until it is erased."""
        return self._path / f"{PARTIAL}going-{event_id}"

    def erase(self, folder: Path) -> None:
        """Erase a folder; calls from several threads run one after another.

        Raises
        ------
        OSError
            If a file cannot be deleted.
        """
        with self._lock:
            erase(folder)

    def empty(self) -> None:
        """Try again to erase the folders that could not be erased when they were deleted.

        Raises
        ------
        OSError
            If any cannot be erased. All others are tried, and the last error is raised.
        """
        failed: OSError | None = None
        for folder in self._path.glob(f"{PARTIAL}going-*"):
            try:
                self.erase(folder)
            except OSError as error:
                failed = error
        if failed is not None:
            raise failed


def write_through(path: Path, data: bytes) -> None:
    """Write a file and wait until the disk has it (fsync), so that a rename after it is safe if the power fails.

    Raises
    ------
    OSError
        If the disk does not take it.
    """
    with path.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def erase(folder: Path) -> None:
    """Overwrite the files of a folder, or a single file, with zeros and delete it; on some disks copies remain.

    A file that cannot be overwritten is deleted nevertheless.

    Raises
    ------
    OSError
        If a file cannot be deleted.
    """
    if not folder.exists():
        return
    for path in (folder, *folder.rglob("*")):
        try:
            if path.is_file() and not path.is_symlink():
                overwrite(path)
        except OSError as error:
            _log.warning(
                "%s: deleted without being overwritten: %s; its sound may still be readable on the disk; "
                "overwrite the free space if that matters",
                path,
                error.strerror or error,
            )
    shutil.rmtree(folder) if folder.is_dir() else folder.unlink()


def overwrite(path: Path) -> None:
    """Overwrite a file with zeros.

    Raises
    ------
    OSError
        If the disk does not take them.
    """
    left = path.stat().st_size
    with path.open("r+b") as file:
        while left > 0:
            left -= file.write(_ZEROS[:left])
        file.flush()
        os.fsync(file.fileno())
