"""Refuses to overwrite files that a command has not made itself (plans, pictures, reports)."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Final

from livessl.errors import UseError

PICTURE_HEAD: Final = 1024
"""Number of bytes at the beginning of a PNG in which its program is named."""

NO_PICTURE: Final = "which does not say that livessl has drawn it"
"""Relative clause about a file for which `is_own_picture` returns False."""

_EARLIER_DENSITY: Final = b"pHYs" + 2 * (4331).to_bytes(4, "big") + b"\1"
"""110 dots per inch in a PNG: pictures of livessl 0.1 and 0.2 name matplotlib, whose own default is 100, and this."""


def refuse_foreign(
    option: str, paths: Iterable[Path], is_own: Callable[[Path], bool], site: Path | None = None, foreign: str = ""
) -> None:
    """Raise an error if a command would write over what may not be its own; call it before anything is computed.

    Files without content pass: nothing of them can be lost.

    Parameters
    ----------
    option : str
        Option that names the file or its folder, with its value.
    paths : iterable of Path
        Files that the command will write.
    is_own : callable
        Returns whether an existing file is recognizably the command's own.
    site : Path or None
        The site file given, which is never written over, whoever has made it.
    foreign : str
        Relative clause about a file that is not its own; it must be true of a half-written one, too.

    Raises
    ------
    UseError
        Names the first such file.
    """
    for path in paths:
        if not os.path.lexists(path):
            continue
        if site is not None and _is_same(path, site):
            raise UseError(f"{option}: {path} is the site file and would be lost; name another place")
        if not path.is_file() or not (path.stat().st_size == 0 or is_own(path)):
            what = f"{foreign} and" if foreign else "which"
            raise UseError(
                f"{option}: expected a new or an empty place, got {path}, {what} would be written over; name another "
                "one, or remove the file"
            )


def is_own_picture(path: Path) -> bool:
    """Return whether a file is a PNG that livessl has drawn."""
    with path.open("rb") as file:
        head = file.read(PICTURE_HEAD)
    earlier = b"Software\0Matplotlib" in head and _EARLIER_DENSITY in head
    return head.startswith(b"\x89PNG") and (b"Software\0livessl" in head or earlier)


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
