"""Serializes events, updates, tracks and arrays as JSON: rounding, API version. `schema/values.py` describes it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np
import orjson

from livessl.clock import utc_text
from livessl.core.stream.activity import ActivityParameters
from livessl.core.stream.array_health import ArrayStatus
from livessl.core.types import FRAME_S, Contribution, Estimate, Event, Track, Update
from livessl.server.zones.zone_map import ZoneMap, fixed_zones
from livessl.site.models import Site

API_VERSION: Final = 1

JsonObject = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Stages:
    """Consecutive stages between the end of a sound and its answer, in seconds.

    Parameters
    ----------
    waited : float
        Wait for the quiet that ends an event; 0 for an update.
    sent : float
        Time until the node had sent the last message that the answer needs, by the node's clock.
    received : float
        Time until the server had received that message; the difference of two clocks unless both are on one machine.
    located : float
        Time until the answer was computed, by the server's clock.
    """

    waited: float
    sent: float
    received: float
    located: float

    @property
    def ours(self) -> float:
        """Time, in seconds, that livessl itself takes: all stages but the wait for quiet."""
        return self.sent + self.received + self.located

    @property
    def total(self) -> float:
        """Time from the end of the sound to the answer, in seconds."""
        return self.waited + self.ours


class Messages:
    """Turns the core's values into the API's objects.

    Parameters
    ----------
    site : Site
    origin_ns : int
        Site time at which `start_s` is 0: the beginning of the recording or of the live run, in nanoseconds.
    utc : bool
        Whether site time is UTC. It is not if a recording does not say when it was made; `time_utc` is null then.
    zones : callable or None
        Returns the zones that are in force; None for those of the site.
    """

    def __init__(self, site: Site, origin_ns: int, *, utc: bool, zones: Callable[[], ZoneMap] | None = None) -> None:
        self._zones = fixed_zones(site) if zones is None else zones
        self._origin_ns = origin_ns
        self._utc = utc

    def event(self, event: Event, stages: Stages | None = None, replaces: Sequence[str] = ()) -> JsonObject:
        """Encode an event, with the ids of the early ones that it replaces."""
        position, covariance, confidence, arrays = where(event.estimate)
        zones = self._zones()
        holding = zones.holding(position)
        inside = {} if position is None else zones.memberships(position, covariance)
        excluding = zones.excluding(holding, inside)
        return {
            "kind": "event",
            "id": event.id,
            **self._when(event.start_ns),
            "duration_s": round(event.duration_s, 6),
            "position_m": position,
            "covariance_m2": covariance,
            "confidence": confidence,
            "arrays": arrays,
            "method": event.method,
            "status": str(event.status),
            "reason": event.reason,
            "heard_by": list(event.heard_by),
            "level_dbfs": dbfs(event.power),
            "contributions": [_contribution(c) for c in event.contributions],
            "zones": holding,
            "membership": [{"name": name, "probability": round(value, 4)} for name, value in inside.items()],
            "excluded": bool(excluding),
            "excluded_by": excluding,
            "late_frames": event.late_frames,
            "latency_s": round(event.latency_s if stages is None else stages.total, 4),
            "latency_stages_s": _stages(stages),
            "late": event.late,
            "replaces": list(replaces),
            "source": event.source,
            "candidates": candidates(event.estimate),
        }

    def update(self, update: Update, stages: Stages | None = None) -> JsonObject:
        """Encode the preliminary position of a sound that still lasts."""
        position, covariance, confidence, arrays = where(update.estimate)
        return {
            "kind": "update",
            "event_id": update.event_id,
            **self._when(update.estimate.time_ns),
            "end_utc": utc_text(update.complete_ns) if self._utc else None,
            "position_m": position,
            "covariance_m2": covariance,
            "confidence": confidence,
            "arrays": arrays,
            "status": str(update.status),
            "contributions": [_contribution(c) for c in update.contributions],
            "others": [self._other(other) for other in update.others],
            "candidates": candidates(update.estimate),
            "zones": self._zones().holding(position),
            "level_dbfs": dbfs(update.power),
            "latency_s": None if stages is None else round(stages.total, 4),
            "latency_stages_s": _stages(stages),
        }

    def _other(self, estimate: Estimate) -> JsonObject:
        position, covariance, confidence, _ = where(estimate)
        return {
            "position_m": position,
            "covariance_m2": covariance,
            "confidence": confidence,
            "zones": self._zones().holding(position),
        }

    def track(self, track: Track) -> JsonObject:
        """Encode the state of a track."""
        position = _metres(track.position_m)
        return {
            "kind": "track",
            "id": track.id,
            "state": str(track.state),
            **self._when(track.time_ns),
            "position_m": position,
            "velocity_m_s": _metres(track.velocity_m_s),
            "covariance_m2": [_square_metres(row) for row in track.covariance_m2],
            "zones": self._zones().holding(position),
        }

    def _when(self, time_ns: int) -> JsonObject:
        return {
            "time_utc": utc_text(time_ns) if self._utc else None,
            "start_s": round((time_ns - self._origin_ns) / 1e9, 6),
        }


def where(
    estimate: Estimate | None,
) -> tuple[list[float] | None, list[list[float]] | None, float, list[str]]:
    """Position, covariance, confidence and arrays of an estimate, rounded as they are published."""
    if estimate is None:
        return None, None, 0.0, []
    covariance = [_square_metres(row) for row in estimate.covariance_m2]
    return _metres(estimate.position_m), covariance, round(estimate.confidence, 4), list(estimate.arrays)


def answer(event: Event) -> JsonObject:
    """Encode where an event was located, and how, as a `LocationAnswer` of `livessl.schema.relocation`."""
    position, covariance, confidence, arrays = where(event.estimate)
    return {
        "method": event.method,
        "status": str(event.status),
        "reason": event.reason,
        "position_m": position,
        "covariance_m2": covariance,
        "std_m": std_m(covariance),
        "confidence": confidence,
        "arrays": arrays,
        "candidates": candidates(event.estimate),
    }


def std_m(covariance_m2: list[list[float]] | None) -> float | None:
    """Standard deviation, in metres, along the axis of largest uncertainty; None without a covariance."""
    if covariance_m2 is None:
        return None
    return round(float(np.sqrt(max(0.0, np.linalg.eigvalsh(covariance_m2)[-1]))), 4)


def candidates(estimate: Estimate | None) -> list[JsonObject]:
    """Places that explain a sound about equally well, as they are published."""
    found = () if estimate is None else estimate.candidates
    return [{"position_m": _metres(each.position_m), "probability": round(each.probability, 4)} for each in found]


def array_status(status: ArrayStatus, node: str | None, activity: ActivityParameters) -> JsonObject:
    """Encode the state of an array that `node` captures, with the threshold of its activity detection."""
    noise = status.noise_power
    return {
        "name": status.name,
        "state": str(status.state),
        "reason": status.reason,
        "node": node,
        "active": status.active,
        "age_s": None if status.age_s is None else round(status.age_s, 3),
        "level_dbfs": dbfs(status.power),
        "noise_floor_dbfs": dbfs(noise),
        "activity_threshold_dbfs": None if noise is None else dbfs(activity.least_power(noise)),
        "channel_levels_dbfs": [dbfs(power) for power in status.channel_power],
        "sample_rate_hz": status.sample_rate_hz,
        "drift_ppm": None if status.drift_ppm is None else round(status.drift_ppm, 2),
        "clock": None if status.clock is None else str(status.clock),
        "agreement": {"agreed": status.agreed, "disagreed": status.disagreed},
        "clock_offset": _clock_offset(status),
        "counters": dict(status.counters),
    }


def _clock_offset(status: ArrayStatus) -> JsonObject | None:
    offset = status.clock_offset
    if offset is None:
        return None
    return {
        "offset_s": round(offset.offset_s, 4),
        "std_s": round(offset.std_s, 4),
        "sounds": offset.sounds,
        "reference": offset.reference,
        "corrected_s": round(status.corrected_frames * FRAME_S, 2),
    }


def json_text(message: JsonObject) -> str:
    """The message as JSON, without white space."""
    return orjson.dumps(message).decode()


def dbfs(power: float | None) -> float | None:
    """Level in dB of a power in full scale squared; None for None and for digital silence, which has no level."""
    return round(10.0 * math.log10(power), 1) if power else None


def _contribution(contribution: Contribution) -> JsonObject:
    return {
        "array": contribution.array,
        "active_s": round(contribution.active_s, 3),
        "level_dbfs": dbfs(contribution.power),
        "azimuth_deg": round(contribution.azimuth_deg, 2),
        "elevation_deg": round(contribution.elevation_deg, 2),
        "distance_m": round(contribution.distance_m, 3),
        "agrees": contribution.agrees,
        "off_deg": None if contribution.off_deg is None else round(contribution.off_deg, 1),
        "asked": contribution.asked,
    }


def _stages(stages: Stages | None) -> JsonObject | None:
    return None if stages is None else {name: round(value, 4) for name, value in asdict(stages).items()}


def _metres(values: Any) -> list[float]:
    return [round(float(value), 4) for value in values]


def _square_metres(values: Any) -> list[float]:
    return [float(f"{float(value):.6g}") for value in values]
