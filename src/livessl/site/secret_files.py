"""Writes and reads files with secrets, and refuses those that other users can read (permissions)."""

from __future__ import annotations

import os
import re
from contextlib import suppress
from pathlib import Path
from typing import Final

from livessl.errors import ConfigError, Fault

NAME: Final = re.compile(r"[A-Za-z0-9._-]{1,64}")
"""Names of nodes and of tokens."""

KEY: Final = re.compile(r"[0-9a-f]{64}")
"""32 bytes in hexadecimal: a key, or the SHA-256 of a token."""


def read_secret(path: Path, cure: str) -> str:
    """Return the text of a file that only its owner can use.

    Parameters
    ----------
    path : Path
    cure : str
        End of the error message where there is no such file.

    Raises
    ------
    ConfigError
        If the file cannot be read, or others can use it.
    """
    try:
        mode = path.stat().st_mode & 0o777
        if mode & 0o077:
            raise fault(path, f"expected a file that only its owner can use, got mode {mode:o}; chmod 600 it")
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "not a text file"
        raise fault(path, f"cannot be read: {reason}; {cure}") from error


def write_whole(path: Path, text: str, mode: int) -> None:
    """Write a whole file or nothing; it has its final `mode` from its creation on.

    When this returns, the file is on the disk: neither a kill nor a power failure brings the former one back.
    """
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    part = path.with_name(path.name + ".part")
    part.unlink(missing_ok=True)
    with os.fdopen(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "w", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    part.replace(path)
    with suppress(OSError):  # the file is in place; some network file systems cannot do more for its name
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def check_name(name: str) -> None:
    """Raise ConfigError unless `name` can name a node or a token."""
    if not NAME.fullmatch(name):
        raise ConfigError([Fault(repr(name), "expected a name of 1 to 64 letters, digits, '.', '_' or '-'")])


def fault(path: Path, what: str) -> ConfigError:
    """Return the error for one fault of one file."""
    return ConfigError([Fault(str(path), what)])
