"""The protocol of audio devices: blocks, the present problem, and lost blocks. `sound_device` implements it."""

from __future__ import annotations

from collections.abc import Iterator
from types import TracebackType
from typing import Protocol, Self

from livessl.core.types import Block


class Device(Protocol):
    """An audio device: a context manager that opens it, and an iterator of its blocks while it is open."""

    name: str
    sample_rate_hz: float
    channels: int

    @property
    def problem(self) -> str | None:
        """The present problem of the device, in words; None if there is none."""
        ...

    @property
    def lost_blocks(self) -> int:
        """Blocks that were lost since the start because this machine did not keep up."""
        ...

    @property
    def through_sound_server(self) -> bool:
        """True if samples come through a sound server or plug-in, whose times do not show the device's clock."""
        ...

    def __enter__(self) -> Self: ...
    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None, /
    ) -> None: ...
    def __iter__(self) -> Iterator[Block]: ...
