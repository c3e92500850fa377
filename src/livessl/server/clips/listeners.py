"""Passes live sound of single microphones to people who listen. Nothing is stored."""

from __future__ import annotations

import asyncio
import struct
from collections import deque
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from typing import Final, NamedTuple

import numpy as np

from livessl.core.types import Frame, Message

HEADER: Final = struct.Struct("<qdI")
"""Head of each binary message: time of the first sample in nanoseconds since the epoch, by the array's own clock
(int64), sampling rate in hertz (float64), and messages left out just before it (uint32)."""

MOST_QUEUED: Final = 40
"""Most frames that wait for a client, two seconds; beyond it the oldest are left out and counted."""

MOST_LISTENERS: Final = 8
"""Most clients that listen at once; the fusion thread converts each frame for each of them."""

FULL_SCALE: Final = 32767.0
"""Number that stands for a sample of 1."""


class Listener:
    """One client's queue. The fusion thread fills it by way of the client's event loop, where it is emptied.

    Parameters
    ----------
    array : str
    channel : int
        From 1, in the order of the array's microphones.
    loop : AbstractEventLoop
    """

    def __init__(self, array: str, channel: int, loop: asyncio.AbstractEventLoop) -> None:
        self.array = array
        self._channel = channel
        self._loop = loop
        self._queue: deque[_Piece] = deque()
        self._news = asyncio.Event()
        self._left_out = 0

    def take(self, frame: Frame) -> None:
        """Take in a frame of the array; on the fusion thread."""
        if self._channel <= len(frame.samples) and frame.samples.shape[1]:
            scaled = np.clip(frame.samples[self._channel - 1], -1.0, 1.0) * np.float32(FULL_SCALE)
            piece = _Piece(frame.time_ns, frame.sample_rate_hz, np.round(scaled).astype("<i2").tobytes())
            with suppress(RuntimeError):  # the loop has just been closed
                self._loop.call_soon_threadsafe(self._put, piece)

    async def next(self) -> bytes:
        """Return the next message: `HEADER`, and then the samples as int16, little-endian."""
        while not self._queue:
            self._news.clear()
            await self._news.wait()
        piece, left_out = self._queue.popleft(), self._left_out
        self._left_out = 0
        return HEADER.pack(piece.time_ns, piece.sample_rate_hz, left_out) + piece.samples

    def _put(self, piece: _Piece) -> None:
        if len(self._queue) >= MOST_QUEUED:
            self._queue.popleft()
            self._left_out += 1
        self._queue.append(piece)
        self._news.set()


class _Piece(NamedTuple):
    time_ns: int
    sample_rate_hz: float
    samples: bytes


class Listeners:
    """Everybody who listens. The fusion thread calls `take`, the event loop `listening`."""

    def __init__(self) -> None:
        self._open: tuple[Listener, ...] = ()  # replaced, never changed: the fusion thread reads it

    @property
    def count(self) -> int:
        """Number of clients that listen."""
        return len(self._open)

    def take(self, messages: Iterable[Message], settled: int | None) -> None:  # noqa: ARG002 - of `SoundTaker`
        """Pass on frames, in the order in which they come; frames that were requested later are left out."""
        listeners = self._open
        if not listeners:
            return
        for message in messages:
            if isinstance(message, Frame) and not message.requested:
                for listener in listeners:
                    if listener.array == message.array:
                        listener.take(message)

    @contextmanager
    def listening(self, array: str, channel: int) -> Iterator[Listener]:
        """Register a client while it listens; within its event loop.

        Raises
        ------
        ValueError
            If `MOST_LISTENERS` listen already.
        """
        if self.count >= MOST_LISTENERS:
            raise ValueError(f"listen: {self.count} clients listen already, and no more may; try again later")
        listener = Listener(array, channel, asyncio.get_running_loop())
        self._open = (*self._open, listener)
        try:
            yield listener
        finally:
            self._open = tuple(other for other in self._open if other is not listener)
