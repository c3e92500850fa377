"""The last error of the folder of the clips, for the log and for `GET health`."""

from __future__ import annotations

import logging
from collections.abc import Callable

_log = logging.getLogger(__name__)


class Trouble:
    """The last error that stands in the way of clips; only the first of several in a row is logged."""

    def __init__(self) -> None:
        self._text: str | None = None

    @property
    def texts(self) -> list[str]:
        """The error as a sentence; none if there is none."""
        return [] if self._text is None else [self._text]

    def report(self, what: str) -> None:
        """Note an error."""
        text = f"server.clips.folder: {what}"
        if self._text is None:
            _log.error("%s", text)
        self._text = text

    def report_of(self, what: str, act: Callable[[], None]) -> None:
        """Do something with files; note an error of the disk."""
        try:
            act()
        except OSError as error:
            self.report(f"{what}: {error.strerror or error}; correct that")

    def clear(self) -> None:
        """Note that clips are written again."""
        self._text = None
