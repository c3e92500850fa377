"""Errors that stand in the way of clips (disk, folder, detector), for the log and for `GET health`."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from enum import Enum

_log = logging.getLogger(__name__)


class Subject(Enum):
    """The operations that can fail, each with the text that begins its errors. A success clears its own error alone."""

    DETECTING = ("server.clips, privacy: no-speech", "detect")
    MAKING = ("server.clips", "make")
    STORING = ("server.clips.folder", "store")
    DELETING = ("server.clips.folder", "delete")
    ERASING = ("server.clips.folder", "erase")
    READING_REASONS = ("missing.jsonl in server.clips.folder", "read")
    SAVING_REASONS = ("missing.jsonl in server.clips.folder", "save")
    EXPIRING_REASONS = ("missing.jsonl in server.clips.folder", "expire")

    @property
    def place(self) -> str:
        """The key of the site file or the file that is concerned."""
        return self.value[0]


class Trouble:
    """The last error of each subject; only the first of several in a row is logged. Every thread may call it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._texts: dict[Subject, str] = {}

    @property
    def texts(self) -> list[str]:
        """The errors as sentences."""
        with self._lock:
            return list(self._texts.values())

    def report(self, subject: Subject, what: str) -> None:
        """Note an error."""
        text = f"{subject.place}: {what}"
        with self._lock:
            is_new = subject not in self._texts
            self._texts[subject] = text
        if is_new:
            _log.error("%s", text)

    def report_of(self, subject: Subject, what: str, act: Callable[[], None]) -> None:
        """Do something with files; note an error of the disk, and note when it has gone."""
        try:
            act()
        except OSError as error:
            self.report(subject, f"{what}: {error.strerror or error}; correct that")
        else:
            self.clear(subject)

    def clear(self, *subjects: Subject) -> None:
        """Note that operations have succeeded again."""
        with self._lock:
            for subject in subjects:
                self._texts.pop(subject, None)
