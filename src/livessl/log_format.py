"""Formats log lines as plain text or as one JSON object per line (`LIVESSL_LOG`), and logs uncaught errors."""

from __future__ import annotations

import json
import logging
import os
import sys
import threading
from enum import StrEnum
from types import TracebackType
from typing import Any, Final

from livessl.clock import utc_text
from livessl.errors import UseError

VARIABLE: Final = "LIVESSL_LOG"
"""Environment variable that sets the form of the log lines. Processes that a command starts inherit it."""

TEXT_FORMAT: Final = "livessl: %(message)s"


class LogForm(StrEnum):
    """Form of the log lines."""

    TEXT = "text"
    JSON = "json"


class JsonFormatter(logging.Formatter):
    """Formats a log record as one line of JSON.

    Every line has `time_utc` (RFC 3339), `level`, `logger`, `message`, `command`, `process` (the process id) and
    `thread`. The record of an exception also has `exception` (the type of the exception) and `traceback`.

    Parameters
    ----------
    command : str
        Name of the livessl command that this process runs.
    """

    def __init__(self, command: str) -> None:
        super().__init__()
        self._command = command

    def format(self, record: logging.LogRecord) -> str:
        """Return a record as JSON."""
        found: dict[str, Any] = {
            "time_utc": utc_text(round(record.created * 1e6) * 1000),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
            "command": self._command,
            "process": record.process,
            "thread": record.threadName,
        }
        if record.exc_info and record.exc_info[0] is not None:
            found["exception"] = record.exc_info[0].__name__
            found["traceback"] = self.formatException(record.exc_info)
        return json.dumps(found)  # in ASCII, because some other characters end a line for some readers


def log_form() -> LogForm:
    """Return the form of log lines that the environment variable names; text by default.

    Raises
    ------
    UseError
        If the variable names an unknown form.
    """
    wanted = os.environ.get(VARIABLE, "") or LogForm.TEXT
    try:
        return LogForm(wanted)
    except ValueError:
        raise UseError(f"{VARIABLE}: expected {' or '.join(LogForm)}, got {wanted!r}; correct it or unset it") from None


def set_up_logging(command: str, form: LogForm, *, verbose: bool = False) -> None:
    """Write the log of this process to stderr.

    Parameters
    ----------
    command : str
        Name of the livessl command, which JSON lines contain.
    form : LogForm
    verbose : bool
        Also log debug messages.
    """
    level = logging.DEBUG if verbose else logging.INFO
    if not verbose:
        logging.getLogger("alembic").setLevel(logging.WARNING)  # it logs a dozen lines about each new database
    if form is LogForm.TEXT:
        logging.basicConfig(level=level, format=TEXT_FORMAT, stream=sys.stderr)
        return
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonFormatter(command))
    logging.basicConfig(level=level, handlers=[handler])
    logging.captureWarnings(True)
    sys.excepthook = _log_uncaught
    threading.excepthook = _log_thread_failure


def is_json_log() -> bool:
    """Return whether this process writes its log as JSON."""
    return any(isinstance(handler.formatter, JsonFormatter) for handler in logging.getLogger().handlers)


def _log_uncaught(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    logging.getLogger("livessl").critical("unexpected error: %s", error, exc_info=(kind, error, trace))


def _log_thread_failure(failed: threading.ExceptHookArgs) -> None:
    name = "a thread" if failed.thread is None else f"thread {failed.thread.name!r}"
    error = failed.exc_value if failed.exc_value is not None else failed.exc_type()
    logging.getLogger("livessl").critical(
        "%s has failed: %s", name, error, exc_info=(failed.exc_type, error, failed.exc_traceback)
    )
