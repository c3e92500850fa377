"""Remembers why events have no clip, over a restart, too: a line for each in a file beside the clips."""

from __future__ import annotations

import logging
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
        self._lock = threading.Lock()
        self._known: OrderedDict[str, MissingClip] = OrderedDict()
        self._unsaved: list[MissingClip] = []
        self._lines = 0

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
        """Read what an earlier server has noted; lines that cannot be read are left out.

        Raises
        ------
        OSError
            If the file cannot be read.
        """
        if not self._path.exists():
            return
        lines = self._path.read_bytes().splitlines()
        self._lines = len(lines)
        with self._lock:
            newer, self._known = self._known, OrderedDict()
            for line in lines:
                try:
                    self._put(MissingClip.model_validate_json(line))
                except ValidationError:  # the end of a line that was being written when the power failed
                    _log.debug("%s: left out a line that cannot be read", self._path)
            for known in newer.values():
                self._put(known)

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
        with self._path.open("ab") as file:
            file.write(b"".join(map(_line, unsaved)))
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
        with self._lock:
            old = [event_id for event_id, line in self._known.items() if line.start_ns < before_ns]
            for event_id in old:
                del self._known[event_id]
            self._unsaved = [line for line in self._unsaved if line.start_ns >= before_ns]
        if old and self._path.exists():
            self._rewrite()

    def _rewrite(self) -> None:
        with self._lock:
            lines = [_line(line) for line in self._known.values()]
            self._unsaved.clear()
        fresh = self._path.with_suffix(".new")
        write_through(fresh, b"".join(lines))
        overwrite(self._path)
        fresh.replace(self._path)
        self._lines = len(lines)

    def _put(self, line: MissingClip) -> None:
        self._known.pop(line.event_id, None)
        self._known[line.event_id] = line
        while len(self._known) > MOST:
            self._known.popitem(last=False)


def _line(missing: MissingClip) -> bytes:
    return orjson.dumps(missing.model_dump(mode="json")) + b"\n"
