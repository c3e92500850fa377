"""The device protocol: what a capture node needs of an audio device, whichever library drives it."""

from __future__ import annotations

from collections.abc import Iterator
from types import TracebackType
from typing import Protocol, Self

from livessl.core.types import Block


class Device(Protocol):
    """A running source of sound: a context manager, and an iterator of blocks while it is entered."""

    name: str
    sample_rate_hz: float
    channels: int

    @property
    def problem(self) -> str | None:
        """What is wrong with it now, in words."""
        ...

    def __enter__(self) -> Self: ...
    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None, /
    ) -> None: ...
    def __iter__(self) -> Iterator[Block]: ...
