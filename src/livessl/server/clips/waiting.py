"""Events that wait for their clips, in the order in which they came."""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass

from livessl.core.stream.clock_offsets import ClockOffsets
from livessl.core.types import FRAME_S, Event


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
    """A queue of events. Every thread may call it; the thread of the clips alone takes them away."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._jobs: deque[Job] = deque()

    def __len__(self) -> int:
        return len(self._jobs)

    def __contains__(self, event_id: str) -> bool:
        with self._lock:
            return any(job.event.id == event_id for job in self._jobs)

    def put(self, job: Job) -> None:
        """Let an event wait."""
        with self._lock:
            self._jobs.append(job)

    def due(self, now_ns: int) -> Job | None:
        """Return the first event if its time has come; it still waits."""
        with self._lock:
            job = self._jobs[0] if self._jobs else None
        return None if job is None or job.due_ns > now_ns else job

    def done(self) -> None:
        """Take the first event away; until then it counts as waiting."""
        with self._lock:
            self._jobs.popleft()
