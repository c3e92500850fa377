"""What a command may write over: files that it has made itself, and nothing else."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Final

from livessl.errors import UseError

PICTURE_HEAD: Final = 1024
"""Number of bytes at the beginning of a PNG in which its program is named."""


def refuse_foreign(
    option: str, paths: Iterable[Path], is_own: Callable[[Path], bool], site: Path | None = None
) -> None:
    """Raise an error if a command would write over a file that it has not made; call it before anything is computed.

    Parameters
    ----------
    option : str
        Option that names the file or its folder, with its value.
    paths : iterable of Path
        Files that the command will write.
    is_own : callable
        Returns whether an existing file was made by the command.
    site : Path or None
        The site file given, which is never written over, whoever has made it.

    Raises
    ------
    UseError
        Names the first such file.
    """
    for path in paths:
        if not os.path.lexists(path):
            continue
        if site is not None and _is_same(path, site):
            raise UseError(f"{option}: {path} is the file given as --site and would be lost; name another place")
        if not path.is_file() or not is_own(path):
            raise UseError(
                f"{option}: expected a new or an empty place, got {path}, which this command has not made and would "
                "write over; name another one"
            )


def is_own_picture(path: Path) -> bool:
    """Return whether a file is a PNG that livessl has drawn."""
    with path.open("rb") as file:
        head = file.read(PICTURE_HEAD)
    return head.startswith(b"\x89PNG") and b"Software\0livessl" in head


def is_own_json(path: Path, keys: frozenset[str]) -> bool:
    """Return whether a file holds a JSON object with these keys."""
    try:
        found = json.loads(path.read_bytes())
    except (ValueError, RecursionError):
        return False
    return isinstance(found, dict) and keys <= found.keys()


def _is_same(path: Path, other: Path) -> bool:
    try:
        return path.samefile(other)
    except OSError:
        return False
