"""Remembers why events have no clip, also after a restart (`missing.jsonl`)."""

from __future__ import annotations

import logging
import os
import threading
from collections import OrderedDict
from pathlib import Path
from typing import Final

import orjson
from pydantic import ValidationError

from livessl.schema.clips import MissingClip, MissingReason
from livessl.server.clips.erase import overwrite, write_through

FILE: Final = "missing.jsonl"
"""Name of the file in the folder of the clips."""

MOST: Final = 20_000
"""Most events that are remembered, 2 MB of lines; the ones that were noted first are forgotten first."""

_log = logging.getLogger(__name__)


class MissingClips:
    """Events without a clip, and why. Every thread may call it; only the thread of the clips `save` and `load`.

    Parameters
    ----------
    folder : Path
        Folder of the clips.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / FILE
        self._fresh = self._path.with_suffix(".new")
        self._old = self._path.with_suffix(".old")
        self._lock = threading.Lock()
        self._known: OrderedDict[str, MissingClip] = OrderedDict()
        self._unsaved: list[MissingClip] = []
        self._lines = 0
        self._left_ns: int | None = None  # the earliest event of which only the file says something
        self._is_loaded = False

    def why(self, event_id: str) -> MissingReason | None:
        """Return why an event has no clip; None if that is not known."""
        with self._lock:
            found = self._known.get(event_id)
        return None if found is None else found.reason

    def note(self, event_id: str, start_ns: int, reason: MissingReason) -> None:
        """Note why an event has no clip; writes nothing yet, so that the fusion thread may call it."""
        line = MissingClip(event_id=event_id, start_ns=start_ns, reason=reason)
        with self._lock:
            self._put(line)
            self._unsaved.append(line)
            del self._unsaved[:-MOST]

    def load(self) -> None:
        """Read what an earlier server has noted, unless it has been read; lines that cannot be read are dropped.

        Raises
        ------
        OSError
            If the file cannot be read.
        """
        if self._is_loaded:
            return
        self._recover()
        lines = self._path.read_bytes().splitlines() if self._path.exists() else []
        unreadable = 0
        with self._lock:
            newer, self._known = self._known, OrderedDict()
            for line in lines:
                try:
                    self._put(MissingClip.model_validate_json(line))
                except ValidationError:  # the end of a line that was being written when the power failed
                    unreadable += 1
                    self._left_ns = 0
            for known in newer.values():
                self._put(known)
        self._lines = len(lines)
        self._is_loaded = True
        if unreadable:
            _log.warning(
                "%s: dropped %d lines that cannot be read; it is not known any more why those events have no clip",
                self._path,
                unreadable,
            )

    def save(self) -> None:
        """Write what was noted.

        Raises
        ------
        OSError
            If the disk does not take it; it is written the next time.
        """
        with self._lock:
            unsaved = list(self._unsaved)
        if not unsaved:
            return
        self.load()
        with self._path.open("a+b") as file:
            end = file.seek(0, os.SEEK_END)
            file.seek(max(end - 1, 0))
            torn = file.read(1) not in {b"", b"\n"}  # the power failed, or the disk was full
            file.write(b"\n" * torn + b"".join(map(_line, unsaved)))
        self._lines += len(unsaved)
        with self._lock:
            del self._unsaved[: len(unsaved)]
        if self._lines > 2 * MOST:
            self._rewrite()

    def expire(self, before_ns: int | None) -> None:
        """Forget events that began before a time, and overwrite what the file says of them.

        Raises
        ------
        OSError
            If the disk does not take it.
        """
        if before_ns is None:
            return
        self.load()
        with self._lock:
            old = [line for line in self._known.values() if line.start_ns < before_ns]
            for line in old:
                self._drop(line)
            self._unsaved = [line for line in self._unsaved if line.start_ns >= before_ns]
            is_left = self._left_ns is not None and self._left_ns < before_ns
        if is_left and self._path.exists():
            self._rewrite()

    def _rewrite(self) -> None:
        """Replace the file by what is known, and overwrite the old one; if this is killed, `_recover` ends it."""
        self._recover()
        with self._lock:
            lines = [_line(line) for line in self._known.values()]
            saved, self._left_ns = len(self._unsaved), None
        try:
            write_through(self._fresh, b"".join(lines))
            self._path.replace(self._old)
            self._fresh.replace(self._path)
            _erase(self._old)
        except OSError:
            with self._lock:
                self._left_ns = 0  # so that it is tried again
            raise
        self._lines = len(lines)
        with self._lock:
            del self._unsaved[:saved]

    def _recover(self) -> None:
        """End the replacement of the file that a killed server has begun."""
        if self._fresh.exists() and not self._path.exists():  # it was complete before the old one was moved away
            self._fresh.replace(self._path)
        for left in (self._fresh, self._old):
            _erase(left)

    def _put(self, line: MissingClip) -> None:
        self._known.pop(line.event_id, None)
        self._known[line.event_id] = line
        while len(self._known) > MOST:
            self._drop(next(iter(self._known.values())))

    def _drop(self, line: MissingClip) -> None:
        """Forget a line that the file may still have."""
        del self._known[line.event_id]
        self._left_ns = line.start_ns if self._left_ns is None else min(self._left_ns, line.start_ns)


def _erase(path: Path) -> None:
    """Overwrite and delete a file, if there is one."""
    if path.exists():
        overwrite(path)
        path.unlink()


def _line(missing: MissingClip) -> bytes:
    return orjson.dumps(missing.model_dump(mode="json")) + b"\n"
