"""Queues events that wait for their clips, refused ones last."""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass

from livessl.core.stream.clock_offsets import ClockOffsets
from livessl.core.types import FRAME_S, Event, Status


@dataclass(frozen=True, slots=True)
class Ahead:
    """The time by which an array's clock is ahead, and the whole frames of it by which the fusion corrects indices."""

    ns: int
    frames: int

    @classmethod
    def of(cls, clock_offsets: ClockOffsets, array: str) -> Ahead:
        """Return what is known of an array's clock."""
        frames = clock_offsets.frames_ahead(array)
        return cls(round(1e9 * (frames * FRAME_S + clock_offsets.rest_s(array))), frames)


@dataclass(frozen=True, slots=True)
class Job:
    """An event that waits for its clip until a monotonic time, and how far each array's clock is ahead."""

    event: Event
    due_ns: int
    ahead: dict[str, Ahead]


class WaitingEvents:
    """Two queues of events: refused ones come last. Every thread may call it; that of the clips alone takes them away.

    The fusion releases frames after some time. A refused event in front of a located one could delay it until then.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._first: deque[Job] = deque()
        self._refused: deque[Job] = deque()

    def __len__(self) -> int:
        return len(self._first) + len(self._refused)

    def __contains__(self, event_id: str) -> bool:
        with self._lock:
            return any(job.event.id == event_id for jobs in (self._first, self._refused) for job in jobs)

    def put(self, job: Job) -> None:
        """Let an event wait."""
        with self._lock:
            self._queue_of(job).append(job)

    def due(self, now_ns: int) -> Job | None:
        """Return the next event whose time has come, refused ones last; it still waits."""
        with self._lock:
            for jobs in (self._first, self._refused):
                if jobs and jobs[0].due_ns <= now_ns:
                    return jobs[0]
        return None

    def done(self, job: Job) -> None:
        """Take an event away that `due` has returned; until then it counts as waiting."""
        with self._lock:
            self._queue_of(job).popleft()

    def _queue_of(self, job: Job) -> deque[Job]:
        return self._refused if job.event.status is Status.REFUSED else self._first
