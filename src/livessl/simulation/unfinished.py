"""The folder in which a simulated session is written until it is complete, and what killed runs have left of theirs.

The kernel holds a lock on the folder for as long as the process that writes it lives. An unlocked folder of that name
is therefore one that nothing writes any more.
"""

from __future__ import annotations

import fcntl
import logging
import os
import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

PREFIX: Final = "unfinished-simulation-"
_NAME: Final = re.compile(PREFIX + "[a-z0-9_]{8}")
"""A name that `TemporaryDirectory` gives a folder with that prefix."""

_log = logging.getLogger(__name__)


@contextmanager
def unfinished_folder(directory: Path, is_own: Callable[[str], bool]) -> Iterator[Path]:
    """Make a folder that is removed at the end of the context, and remove those that killed runs have left beside it.

    Folders stay where the file system cannot lock them.

    Parameters
    ----------
    directory : Path
        Folder of the new one.
    is_own : callable
        Returns whether a simulation writes a file of that name; a folder with any other file is left alone.

    Raises
    ------
    OSError
        If a folder cannot be made in `directory`.
    """
    with ExitStack() as held:
        with _locked(directory, wait=True) as can_lock:  # no other run sees the new folder before it is locked
            if can_lock:
                _remove_leftovers(directory, is_own)
            made = TemporaryDirectory(prefix=PREFIX, dir=directory)
            held.enter_context(_locked(Path(made.name)))
        yield Path(held.enter_context(made))


@contextmanager
def _locked(folder: Path, *, wait: bool = False) -> Iterator[bool]:
    """Lock a folder, unless another process has it or the file system has no locks; yield whether it is locked."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except OSError as error:
            _log.debug("%s: not locked: %s", folder, error)
            yield False
        else:
            yield True
    finally:
        os.close(descriptor)


def _remove_leftovers(directory: Path, is_own: Callable[[str], bool]) -> None:
    for folder in directory.iterdir():
        if not _NAME.fullmatch(folder.name) or folder.is_symlink() or not folder.is_dir():
            continue
        try:
            with _locked(folder) as is_left:
                if is_left and all(path.is_file() and is_own(path.name) for path in folder.iterdir()):
                    shutil.rmtree(folder)
                    _log.info("removed %s, which a simulation that was killed has left", folder)
        except OSError as error:
            _log.warning("%s: what a killed simulation has left cannot be removed: %s", folder, error)
