"""Decides when a track enters or leaves a zone or loiters there, with hysteresis."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

from livessl.clock import utc_text
from livessl.core.types import Track, TrackState
from livessl.schema.zones import Change
from livessl.server.zones.zone_map import ZoneMap

ENTER: Final = 0.7
"""Least probability that a track is in a zone at which the track enters the zone."""

LEAVE: Final = 0.3
"""Probability that a track is in a zone below which the track leaves it. Between `LEAVE` and `ENTER` nothing
changes."""

MAX_CHANGES: Final = 1000
"""Largest number of changes that are kept for later requests: about 500 kB."""

NS_PER_S: Final = 1_000_000_000


@dataclass(slots=True)
class _Stay:
    """The stay of a track in a zone: its begin, its probability, and whether the track has loitered."""

    since_ns: int
    probability: float
    loitered: bool = False


class Presence:
    """Follows the tracks of a run through the zones. Only the fusion thread calls it; every thread may read `changes`.

    Parameters
    ----------
    zones : callable
        Returns the zones that are in force.
    publish : callable
        Called with the message of each change and its site time in nanoseconds.
    """

    def __init__(self, zones: Callable[[], ZoneMap], publish: Callable[[dict[str, Any], int], None]) -> None:
        self._zones = zones
        self._publish = publish
        self._stays: dict[int, dict[str, _Stay]] = {}
        self._last: dict[int, tuple[int, dict[str, Any]]] = {}
        self.changes: deque[dict[str, Any]] = deque(maxlen=MAX_CHANGES)
        """The last changes, oldest first."""

    def take(self, track: Track, message: dict[str, Any]) -> None:
        """Take in the new state of a track, and the message that describes it."""
        if track.state is TrackState.END:
            self._end(track.id)
            return
        self._last[track.id] = track.time_ns, message
        zones, stays = self._zones(), self._stays.setdefault(track.id, {})
        found = self._probabilities(zones, track, stays)
        for name in [name for name in stays if name not in zones.zones or found[name] < LEAVE]:
            self._report(Change.LEAVE, name, track.id, stays.pop(name), found.get(name, 0.0))
        for name, probability in found.items():
            if name not in stays and probability >= ENTER:
                stays[name] = _Stay(track.time_ns, probability)
                self._report(Change.ENTER, name, track.id, stays[name], probability)
        for name, stay in stays.items():
            stay.probability = found[name]
            loiter_s = zones.zones[name].loiter_s
            if loiter_s is not None and not stay.loitered and track.time_ns - stay.since_ns >= loiter_s * NS_PER_S:
                stay.loitered = True
                self._report(Change.LOITER, name, track.id, stay, found[name])

    def end_all(self) -> None:
        """End every track, because a run has ended."""
        for track in list(self._last):
            self._end(track)

    def _probabilities(self, zones: ZoneMap, track: Track, stays: dict[str, _Stay]) -> dict[str, float]:
        """Return the probability of each zone; a track in an excluded zone counts as being in no other zone."""
        found = zones.memberships(track.position_m, track.covariance_m2)
        holding = zones.holding([float(value) for value in track.position_m])
        if zones.excluding(holding, found):
            return dict.fromkeys((name for name in stays if name in zones.zones), 0.0)
        counting = {name: found.get(name, 0.0) for name, zone in zones.zones.items() if not zone.exclude}
        return {**dict.fromkeys((name for name in stays if name in zones.zones), 0.0), **counting}

    def _end(self, track: int) -> None:
        for name, stay in self._stays.pop(track, {}).items():
            self._report(Change.LEAVE, name, track, stay, stay.probability)
        self._last.pop(track, None)

    def _report(self, change: Change, zone: str, track: int, stay: _Stay, probability: float) -> None:
        time_ns, message = self._last[track]
        is_utc = message["time_utc"] is not None
        report = {
            "kind": "zone",
            "change": str(change),
            "zone": zone,
            "track_id": track,
            "time_utc": message["time_utc"],
            "start_s": message["start_s"],
            "since_utc": utc_text(stay.since_ns) if is_utc else None,
            "stay_s": round((time_ns - stay.since_ns) / NS_PER_S, 3),
            "position_m": message["position_m"],
            "probability": round(probability, 4),
            "zones": [zone],
        }
        self.changes.append(report)
        self._publish(report, time_ns)
