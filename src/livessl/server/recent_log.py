"""Keeps the last log lines of a server in memory, for `GET log` and support bundles."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final, NamedTuple

KEPT_LINES: Final = 1000
"""Largest number of lines that are kept: days of a server without faults, and the beginning of most faults."""

MAX_LINE: Final = 2000
"""Longest message that is kept, in characters, so that the lines take at most 10 MB. The middle of longer messages is
cut, because the end of a traceback names the error."""


class Line(NamedTuple):
    """One line of the log: time in nanoseconds since the epoch, level in lower case, logger, and message."""

    time_ns: int
    level: str
    logger: str
    message: str


class RecentLog(logging.Handler):
    """Keeps the last lines of all loggers while it is attached; every thread may read them."""

    def __init__(self) -> None:
        super().__init__(logging.INFO)
        self._lines: deque[Line] = deque(maxlen=KEPT_LINES)

    def emit(self, record: logging.LogRecord) -> None:
        """Keep a record; one that cannot be formatted is handled as the handlers of the standard library do."""
        try:
            message = record.getMessage()
            if record.exc_info and record.exc_info[0] is not None:
                message += f"\n{logging.Formatter().formatException(record.exc_info)}"
            time_ns = round(record.created * 1e6) * 1000
            self._lines.append(Line(time_ns, record.levelname.lower(), record.name, _shortened(message)))
        except Exception:  # noqa: BLE001 - a log line must not end what logs it
            self.handleError(record)

    def lines(self, most: int = KEPT_LINES) -> list[Line]:
        """Return the newest lines, the oldest of them first."""
        self.acquire()  # a deque must not change while it is copied
        try:
            return list(self._lines)[-most:]
        finally:
            self.release()

    @contextmanager
    def attached(self) -> Iterator[None]:
        """Keep lines during a context."""
        root = logging.getLogger()
        root.addHandler(self)
        try:
            yield
        finally:
            root.removeHandler(self)


def _shortened(message: str) -> str:
    """Return the beginning and end of a long message, with the number of characters that were cut."""
    if len(message) <= MAX_LINE:
        return message
    note = f"\n… {len(message) - MAX_LINE + 100} characters are left out …\n"
    begin = (MAX_LINE - 100) // 2
    return message[:begin] + note + message[begin - MAX_LINE + 100 :]
