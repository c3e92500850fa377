"""Gives a library's pages back to the system when it has done its work: they are in its file, if anybody wants them."""

from __future__ import annotations

import ctypes
from pathlib import Path
from typing import Final

_MAPPINGS: Final = Path("/proc/self/smaps")
_DONTNEED: Final = 4  # MADV_DONTNEED of madvise(2)


def unmap_unused(library: str) -> None:
    """Let this process no longer hold what it has read of a shared library's file; it is read again where it is used.

    Pages that differ from the file, as relocation makes them, stay. Where the system tells nothing of its mappings, as
    Linux does in proc(5), all stays as it is.

    Parameters
    ----------
    library : str
        Name of its file.
    """
    if not _MAPPINGS.exists():
        return
    madvise = ctypes.CDLL(None, use_errno=True).madvise
    madvise.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int]
    for first, last in _unchanged(_MAPPINGS.read_text(encoding="utf-8"), library):
        madvise(first, last - first, _DONTNEED)  # advice: where it is not taken the pages stay, and nothing is lost


def _unchanged(mappings: str, library: str) -> list[tuple[int, int]]:
    """First address and the one after the last of a library's mappings that are as in its file, and read only."""
    found: list[tuple[int, int]] = []
    ours, span = False, (0, 0)
    for line in mappings.splitlines():
        name, *fields = line.split(maxsplit=5)
        if not name.endswith(":"):
            low, _, high = name.partition("-")
            span = int(low, 16), int(high, 16)
            ours = len(fields) == 5 and Path(fields[4]).name == library and "w" not in fields[0]
        elif ours and name in ("Private_Dirty:", "Anonymous:") and fields[0] != "0":
            ours = False
        elif ours and name == "VmFlags:":
            found.append(span)
    return found
