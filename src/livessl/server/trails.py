"""Writes each track that has ended into the journal: its time, length, path and zones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

from livessl.core.types import Track, TrackState
from livessl.server.api.encode import JsonObject
from livessl.server.journal import Journal

MAX_POINTS: Final = 200
"""Largest number of points that are kept for a track. At this number, every second point is dropped."""

NS_PER_S: Final = 1_000_000_000


@dataclass(slots=True)
class _Trail:
    """A live track so far."""

    start_ns: int
    start_utc: str
    end_ns: int
    end_utc: str
    updates: int = 0
    every: int = 1
    points: list[tuple[float, float, float, float]] = field(default_factory=list)
    zones: dict[str, None] = field(default_factory=dict)

    def take(self, track: Track, message: JsonObject) -> None:
        if self.updates % self.every == 0:
            since_s = round((track.time_ns - self.start_ns) / NS_PER_S, 3)
            x, y, z = message["position_m"]
            self.points.append((since_s, x, y, z))
            if len(self.points) > MAX_POINTS:
                self.points, self.every = self.points[::2], 2 * self.every
        self.updates += 1
        self.end_ns, self.end_utc = track.time_ns, message["time_utc"]
        self.zones.update(dict.fromkeys(message["zones"]))


class Trails:
    """Follows the tracks of live runs. Only the fusion thread may call it.

    Parameters
    ----------
    journal : Journal
    is_replay : callable
        Whether a replay runs; its tracks are not kept.
    """

    def __init__(self, journal: Journal, is_replay: Callable[[], bool]) -> None:
        self._journal = journal
        self._is_replay = is_replay
        self._live: dict[int, _Trail] = {}

    def take(self, track: Track, message: JsonObject) -> None:
        """Take in the new state of a track, and the message that describes it."""
        if track.state is TrackState.END:
            self._end(track.id)
        elif not self._is_replay():
            utc = message["time_utc"]
            trail = self._live.setdefault(track.id, _Trail(track.time_ns, utc, track.time_ns, utc))
            trail.take(track, message)

    def end_all(self) -> None:
        """End every track, because a run has ended."""
        for number in list(self._live):
            self._end(number)

    def _end(self, number: int) -> None:
        trail = self._live.pop(number, None)
        if trail is None:
            return
        lasted_s = round((trail.end_ns - trail.start_ns) / NS_PER_S, 3)
        through = f", through {', '.join(map(repr, trail.zones))}" if trail.zones else ""
        text = f"track {number} was followed for {lasted_s:.1f} s{through}"
        detail = {
            "track_id": number,
            "start_utc": trail.start_utc,
            "end_utc": trail.end_utc,
            "duration_s": lasted_s,
            "updates": trail.updates,
            "zones": list(trail.zones),
            "path": [list(point) for point in trail.points],
        }
        self._journal.track(number, trail.start_ns, text, detail)
