"""Exit codes of the commands (0, 1, 2, 130), and what Ctrl-C, SIGTERM and SIGHUP do."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Final

OK: Final = 0
FAILED: Final = 1
WRONG_USE: Final = 2
INTERRUPTED: Final = 130


@contextmanager
def sigterm_as_ctrl_c() -> Iterator[None]:
    """Make SIGTERM raise `KeyboardInterrupt`, as Ctrl-C does."""
    previous = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, previous)


@contextmanager
def stop_on_signal() -> Iterator[threading.Event]:
    """Make Ctrl-C and SIGTERM set the event that this yields and do nothing else; loops check it to end in order."""
    stop = threading.Event()
    numbers = (signal.SIGINT, signal.SIGTERM)
    previous = [signal.signal(number, lambda *_: stop.set()) for number in numbers]
    try:
        yield stop
    finally:
        for number, handler in zip(numbers, previous, strict=True):
            signal.signal(number, handler)


@contextmanager
def on_hang_up(work: Callable[[], None]) -> Iterator[None]:
    """Call `work` at SIGHUP, which would end the process otherwise; it may interrupt anything, itself included."""
    previous = signal.signal(signal.SIGHUP, lambda *_: work())
    try:
        yield
    finally:
        signal.signal(signal.SIGHUP, previous)
