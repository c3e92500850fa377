"""Decides the order in which a node sends (live sound, requested frames, backlog), and what awaits acknowledgement.

How much a node keeps is limited in `spool`.

A frame is in one of these places, and always in the spool until the server needs it no more:

- live: it waits to be sent, before everything else;
- backlog: it was cut while the server was away or the connection too slow, and is sent in the bandwidth that is left;
- sent: it was handed over, and the server has not acknowledged it yet.

Marks describe the present state of an array, so while the server is away only the newest of each array waits.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Final

from livessl import wire
from livessl.capture.spool import Kept, Spool, SpoolError
from livessl.core.types import Frame, Mark, Message

BACKLOG_FRAMES: Final = 16
"""Most frames of the backlog that are sent and not yet acknowledged. Live sound may have to wait behind them: 0.25 s at
3 MB/s."""

BACKLOG_TIMEOUT_NS: Final = 2_000_000_000
"""Longest wait for an acknowledgement of the backlog, in ns. Frames that are not acknowledged by then are taken to have
arrived, or not to be wanted, and further ones are sent."""

LATE_NS: Final = 5_000_000_000
"""Time, in ns, after which live sound that waits to be sent joins the backlog, so that newer sound can go first."""

MAX_REQUESTED: Final = 500
"""Most requested frames that wait to be sent: those of two arrays for 12.5 s. Older ones would come too late to matter
and are dropped."""

_log = logging.getLogger(__name__)

Send = Callable[[bytes], bool]
"""Hands bytes over to a socket; returns False if there is no room."""


class Outbox:
    """Queues of live sound, backlog and requested frames, and the frames that the server has not acknowledged.

    Parameters
    ----------
    spool : Spool
        Store of the frames. Frames that are already in the spool are the first backlog.
    on_sent : callable or None
        Called with the array and the frame index of every frame that was sent.

    Attributes
    ----------
    dropped : int
        Number of frames that were lost before the server received them.
    settled : int or None
        Frame index before which the server needs no frames, by its last acknowledgement.
    """

    def __init__(self, spool: Spool, on_sent: Callable[[str, int], None] | None = None) -> None:
        self._on_sent = on_sent
        self.dropped = 0
        self.settled: int | None = None
        self._with_sections = False
        self._spool = spool
        self._newest_marks: dict[str, Mark] = {}  # while the server is away
        self._live: deque[tuple[int, Kept | Mark]] = deque()  # with the time at which each was queued
        self._live_sent: deque[Kept] = deque()
        self._backlog = deque(spool.frames())
        self._backlog_sent: deque[Kept] = deque()
        self._backlog_sent_ns = 0
        self._requested: deque[Message] = deque(maxlen=MAX_REQUESTED)
        self._received: Mapping[str, int] = {}

    @property
    def pending(self) -> int:
        """Number of messages that the server has not acknowledged."""
        sent = len(self._live_sent) + len(self._backlog_sent)
        return len(self._live) + len(self._newest_marks) + len(self._backlog) + sent

    @property
    def has_live(self) -> bool:
        """True if live sound waits to be sent."""
        return bool(self._live)

    @property
    def has_backlog(self) -> bool:
        """True if a part of the backlog waits to be sent."""
        return bool(self._backlog)

    def is_late(self, now_ns: int) -> bool:
        """Return True if live sound has waited for `LATE_NS`."""
        return bool(self._live) and now_ns - self._live[0][0] >= LATE_NS

    def backlog_spans(self) -> dict[str, tuple[int, int]]:
        """Return for each array of the backlog the frame index of its first frame, and the one after its last frame."""
        spans: dict[str, tuple[int, int]] = {}
        for kept in (*self._backlog_sent, *self._backlog):
            spans[kept.array] = (spans.get(kept.array, (kept.frame_index, 0))[0], kept.frame_index + 1)
        return spans

    def add(self, message: Message, now_ns: int, *, connected: bool) -> None:
        """Queue a message as live sound; while not connected, frames join the backlog and older marks are replaced."""
        if isinstance(message, Frame):
            self._add_frame(message, now_ns, connected=connected)
        elif connected:
            self._live.append((now_ns, message))
        else:
            self._newest_marks[message.array] = message

    def send_sections(self, allowed: bool) -> None:
        """Send marks with their sections from now on, or without them to a server that would refuse the marks."""
        self._with_sections = allowed

    def add_requested(self, messages: Iterable[Message]) -> None:
        """Queue the answer to a backfill request. It bypasses the spool, and is not sent again if it is lost."""
        self._requested.extend(messages)

    def acknowledge(self, received: Mapping[str, int], settled: int | None) -> None:
        """Forget frames that the server has received; release frames that it no longer needs from the spool."""
        self._received, self.settled = received, settled
        for array, last in received.items():
            if settled is not None:
                self._spool.forget(array, min(settled, last + 1))
        self._live_sent = deque(kept for kept in self._live_sent if not self._is_received(kept))
        self._backlog_sent = deque(kept for kept in self._backlog_sent if not self._is_received(kept))

    def reconnected(self, arrays: Collection[str]) -> None:
        """Replace the backlog by all frames of `arrays` that the server has not received, in order of time."""
        frames = [kept for kept in self._spool.frames() if kept.array in arrays]
        self._backlog = deque(kept for kept in frames if not self._is_received(kept))

    def disconnected(self) -> None:
        """Replace the backlog by all frames in the spool, because frames in transit may be lost."""
        self._received = {}
        self._keep_newest_marks(self._live)
        for queue in (self._live, self._live_sent, self._backlog_sent, self._requested):
            queue.clear()
        self._backlog = deque(self._spool.frames())

    def demote_live(self) -> None:
        """Move live sound to the end of the backlog."""
        waiting, self._live = self._live, deque()
        self._backlog.extend(message for _, message in waiting if isinstance(message, Kept))
        self._keep_newest_marks(waiting)

    def queue_marks(self, now_ns: int) -> None:
        """Queue the newest marks, which waited for the server, as live messages."""
        self._live.extend((now_ns, mark) for mark in self._newest_marks.values())
        self._newest_marks.clear()

    def send(self, send: Send, now_ns: int) -> bool:
        """Send live sound first, then requested frames, then the backlog; return False if `send` accepts no more."""
        while self._live:
            first = self._live[0][1]
            if not self._send_one(first, send):
                return False
            self._live.popleft()
            if isinstance(first, Kept):
                self._live_sent.append(first)
        while self._requested:
            if not send(wire.encode(self._requested[0])):
                return False
            self._note_sent(self._requested.popleft())
        if self._backlog_sent and now_ns - self._backlog_sent_ns >= BACKLOG_TIMEOUT_NS:
            self._backlog_sent.clear()
        while self._backlog and len(self._backlog_sent) < BACKLOG_FRAMES:
            if not self._send_one(self._backlog[0], send):
                return False
            self._backlog_sent.append(self._backlog.popleft())
            self._backlog_sent_ns = now_ns
        return True

    def _send_one(self, message: Kept | Mark, send: Send) -> bool:
        """Send a message; return True if it was sent, or can no longer be read."""
        if isinstance(message, Mark):
            mark = replace(message, lost_frames=message.lost_frames + self.dropped)
            return send(
                wire.encode(mark if self._with_sections else replace(mark, levels=(), drift_error_ppm=None, host=None))
            )
        try:
            data = self._spool.read(message)
        except SpoolError as error:
            _log.error("%s", error)
            self.dropped += 1
            return True
        if not send(data):
            return False
        self._note_sent(message)
        return True

    def _note_sent(self, message: Kept | Message) -> None:
        if self._on_sent is not None and not isinstance(message, Mark):
            self._on_sent(message.array, message.frame_index)

    def _add_frame(self, frame: Frame, now_ns: int, *, connected: bool) -> None:
        kept, removed = self._spool.append(frame)
        if connected:
            self._live.append((now_ns, kept))
        else:
            self._backlog.append(kept)
        self._newest_marks.pop(frame.array, None)  # a mark before the frame is out of date
        if removed:
            self._drop(removed)

    def _drop(self, removed: Sequence[Kept]) -> None:
        """Remove frames for which the spool had no space from all queues; count those the server never received."""
        lost = [kept for kept in removed if not self._is_received(kept)]
        self._live = deque(waiting for waiting in self._live if waiting[1] not in lost)
        for kept in lost:
            for queue in (self._backlog, self._backlog_sent, self._live_sent):
                if kept in queue:
                    queue.remove(kept)
        if lost and not self.dropped:
            _log.warning("the spool is full and drops its oldest frames; start the server, or raise spool.max_mb")
        self.dropped += len(lost)

    def _is_received(self, kept: Kept) -> bool:
        return kept.array in self._received and kept.frame_index <= self._received[kept.array]

    def _keep_newest_marks(self, waiting: Iterable[tuple[int, Kept | Mark]]) -> None:
        """Keep the last mark of each array, unless a frame follows it, which makes the mark obsolete."""
        newest: dict[str, Mark] = {}
        for _, message in waiting:
            if isinstance(message, Mark):
                newest[message.array] = message
            else:
                newest.pop(message.array, None)
        self._newest_marks.update(newest)
