"""Logs what native libraries (ALSA, PortAudio) print: each distinct message once, counted and limited in number."""

from __future__ import annotations

import logging
import re
from typing import Final

MOST_MESSAGES: Final = 50
"""Most distinct messages that are logged and counted; further ones are only counted together."""

LONGEST: Final = 300
"""Longest message that is logged, in characters."""

SUMMARY_NS: Final = 60_000_000_000
"""Shortest interval between two logged counts, in ns."""

_NUMBER: Final = re.compile(r"0x[0-9a-fA-F]+|\d+")
_log = logging.getLogger(__name__)


class NativeOutput:
    """The messages of the libraries that drive a device.

    Messages that differ by numbers only are the same message.
    """

    def __init__(self) -> None:
        self.lines = 0
        self._known: set[str] = set()
        self._repeated: dict[str, int] = {}
        self._rest = b""
        self._summary_ns: int | None = None

    def feed(self, data: bytes, now_ns: int) -> None:
        """Take in output; `now_ns` is of the monotonic clock."""
        *lines, rest = (self._rest + data).split(b"\n")
        self._rest = rest[-4 * LONGEST :]
        for line in lines:
            self._line(line.decode("utf-8", "replace").strip())
        if self._summary_ns is None:
            self._summary_ns = now_ns
        if self._repeated and now_ns - self._summary_ns >= SUMMARY_NS:
            self._summary_ns = now_ns
            self.summarize()

    def summarize(self) -> None:
        """Log how often messages were repeated since the last summary."""
        for message, count in self._repeated.items():
            _log.info("sound library, %d times more: %s", count, message)
        self._repeated.clear()

    def _line(self, line: str) -> None:
        if not line:
            return
        self.lines += 1
        message = line[:LONGEST]
        kind = _NUMBER.sub("#", message)
        if kind not in self._known and len(self._known) < MOST_MESSAGES:
            self._known.add(kind)
            _log.info("sound library: %s", message)
            return
        if kind not in self._known:
            kind = "other messages"
        self._repeated[kind] = self._repeated.get(kind, 0) + 1
