"""Encoded messages have the promised fields and types, and are JSON that any parser accepts."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from livessl.core.stream.activity import ActivityParameters
from livessl.core.stream.array_health import ArrayState, ArrayStatus
from livessl.core.stream.clock_offsets import ClockOffset
from livessl.core.types import Candidate, ClockState, Contribution, Estimate, Event, Status, Track, TrackState, Update
from livessl.server.api.encode import JsonObject, Messages, Stages, array_status, dbfs
from small_site import site_of

ORIGIN_NS = 1_767_225_600_000_000_000
ESTIMATE = Estimate(
    time_ns=ORIGIN_NS + 1_250_000_000,
    position_m=np.array([0.51234567, 0.7, 1.1]),
    covariance_m2=np.diag([0.01, 0.02, 0.03]) + 1e-9,
    confidence=0.612345,
    arrays=("north", "south"),
)
EVENT = Event(
    id="small-1767225601000",
    start_ns=ORIGIN_NS + 1_000_000_000,
    end_ns=ORIGIN_NS + 1_500_000_000,
    status=Status.LOCATED,
    reason=None,
    estimate=ESTIMATE,
    power=0.01,
    method="srp-phat",
    contributions=(Contribution("north", 0.45, 0.01, 12.345, -6.789, 2.5),),
    heard_by=("north", "south"),
    late_frames=2,
    latency_s=0.31234567,
)
UPDATE = Update("small-1", Status.DIRECTION_ONLY, ESTIMATE, 0.001, EVENT.contributions, ORIGIN_NS + 1_350_000_000)
TRACK = Track(3, TrackState.NEW, ORIGIN_NS, np.array([0.5, 0.5, 1.0]), np.array([0.1, 0.0, -0.2]), np.eye(3) * 0.01)

PROMISED: dict[str, type | tuple[type, ...]] = {
    "kind": str,
    "id": str,
    "time_utc": (str, type(None)),
    "start_s": float,
    "duration_s": float,
    "position_m": (list, type(None)),
    "covariance_m2": (list, type(None)),
    "confidence": float,
    "arrays": list,
    "method": str,
    "status": str,
    "reason": (str, type(None)),
}
"""The promised fields of an event, and their types."""


def strict_json(message: JsonObject) -> Any:
    """Encode and parse a message by JSON without NaN."""
    return json.loads(json.dumps(message, allow_nan=False))


def messages(*, utc: bool = True) -> Messages:
    return Messages(site_of(), ORIGIN_NS, utc=utc)


@pytest.mark.parametrize("status", list(Status))
def test_event_has_the_promised_fields(status: Status) -> None:
    event = replace(EVENT, status=status, reason=None if status is Status.LOCATED else "why")
    encoded = messages().event(event)
    for name, kind in PROMISED.items():
        assert isinstance(encoded[name], kind), name
    assert list(encoded)[: len(PROMISED)] == list(PROMISED)
    assert encoded["kind"] == "event"
    assert encoded["status"] == status.value
    assert 0 <= encoded["confidence"] <= 1
    assert strict_json(encoded) == encoded


def test_event_holds_time_and_place() -> None:
    encoded = messages().event(EVENT)
    assert encoded["time_utc"] == "2026-01-01T00:00:01.000000Z"
    assert (encoded["start_s"], encoded["duration_s"]) == (1.0, 0.5)
    assert encoded["position_m"] == [0.5123, 0.7, 1.1]
    assert np.shape(encoded["covariance_m2"]) == (3, 3)
    assert [encoded["covariance_m2"][k][k] for k in range(3)] == pytest.approx([0.01, 0.02, 0.03], rel=1e-5)
    assert encoded["confidence"] == 0.6123
    assert encoded["arrays"] == encoded["heard_by"] == ["north", "south"]
    assert encoded["zones"] == ["door"]
    assert encoded["level_dbfs"] == -20.0
    assert (encoded["late_frames"], encoded["latency_s"]) == (2, 0.3123)
    assert encoded["contributions"] == [
        {
            "array": "north",
            "active_s": 0.45,
            "level_dbfs": -20.0,
            "azimuth_deg": 12.35,
            "elevation_deg": -6.79,
            "distance_m": 2.5,
            "agrees": None,
            "off_deg": None,
            "asked": False,
        }
    ]


def test_candidates_are_listed_with_their_probabilities() -> None:
    candidates = (Candidate(np.array([0.51234567, 0.7, 1.1]), 0.50001), Candidate(np.array([0.5, 0.7, 1.9]), 0.49999))
    ambiguous = replace(ESTIMATE, candidates=candidates)
    listed = [
        {"position_m": [0.5123, 0.7, 1.1], "probability": 0.5},
        {"position_m": [0.5, 0.7, 1.9], "probability": 0.5},
    ]
    assert messages().event(replace(EVENT, estimate=ambiguous))["candidates"] == listed
    assert messages().update(replace(UPDATE, estimate=ambiguous))["candidates"] == listed
    assert messages().event(EVENT)["candidates"] == messages().update(UPDATE)["candidates"] == []
    assert messages().event(replace(EVENT, estimate=None))["candidates"] == []


def test_time_is_null_where_it_is_not_utc() -> None:
    for encoded in (messages(utc=False).event(EVENT), messages(utc=False).track(TRACK)):
        assert encoded["time_utc"] is None
        assert encoded["start_s"] == (1.0 if encoded["kind"] == "event" else 0.0)


def test_refused_event_has_no_position() -> None:
    refused = replace(EVENT, status=Status.REFUSED, reason="heard by 1 of at least 2 arrays", estimate=None)
    encoded = messages().event(replace(refused, contributions=(), heard_by=("north",)))
    assert encoded["position_m"] is None
    assert encoded["covariance_m2"] is None
    assert encoded["confidence"] == 0.0
    assert encoded["arrays"] == []
    assert encoded["zones"] == []
    assert encoded["heard_by"] == ["north"]
    assert encoded["reason"] == "heard by 1 of at least 2 arrays"
    assert set(encoded) == set(messages().event(EVENT))
    assert strict_json(encoded) == encoded


def test_update() -> None:
    encoded = messages().update(UPDATE)
    assert encoded["kind"] == "update"
    assert encoded["event_id"] == "small-1"
    assert encoded["status"] == "direction-only"
    assert [contribution["array"] for contribution in encoded["contributions"]] == ["north"]
    assert (encoded["time_utc"], encoded["start_s"]) == ("2026-01-01T00:00:01.250000Z", 1.25)
    assert encoded["end_utc"] == "2026-01-01T00:00:01.350000Z"
    assert encoded["position_m"] == [0.5123, 0.7, 1.1]
    assert encoded["level_dbfs"] == -30.0
    assert encoded["latency_s"] is encoded["latency_stages_s"] is None  # unknown, as in a replay
    assert encoded["zones"] == ["door"]
    assert strict_json(encoded) == encoded


def test_latency_by_stages() -> None:
    stages = Stages(waited=0.3, sent=0.0123, received=-0.0004, located=0.00567)
    encoded = {"waited": 0.3, "sent": 0.0123, "received": -0.0004, "located": 0.0057}
    for message in (messages().event(EVENT, stages), messages().update(UPDATE, stages)):
        assert message["latency_stages_s"] == encoded
        assert message["latency_s"] == 0.3176  # the sum of the stages replaces the estimate in the event


@pytest.mark.parametrize("state", list(TrackState))
def test_track(state: TrackState) -> None:
    encoded = messages().track(replace(TRACK, state=state))
    assert (encoded["kind"], encoded["id"], encoded["state"]) == ("track", 3, state.value)
    assert encoded["position_m"] == [0.5, 0.5, 1.0]
    assert encoded["velocity_m_s"] == [0.1, 0.0, -0.2]
    assert strict_json(encoded) == encoded


def status_of(**changes: Any) -> ArrayStatus:
    values: dict[str, Any] = {
        "name": "north",
        "state": ArrayState.HEALTHY,
        "reason": None,
        "active": True,
        "age_s": 0.01234,
        "power": 0.001,
        "noise_power": 1e-6,
        "channel_power": (0.001, 0.0),
        "sample_rate_hz": 16000.0,
        "drift_ppm": 12.3456,
        "clock": ClockState.LOCKED,
        "counters": {"frames": 3},
    }
    return ArrayStatus(**(values | changes))


def test_array_status() -> None:
    encoded = array_status(status_of(), "lab-pc", ActivityParameters())
    assert encoded == {
        "name": "north",
        "state": "healthy",
        "reason": None,
        "node": "lab-pc",
        "active": True,
        "age_s": 0.012,
        "level_dbfs": -30.0,
        "noise_floor_dbfs": -60.0,
        "activity_threshold_dbfs": -54.0,
        "channel_levels_dbfs": [-30.0, None],
        "sample_rate_hz": 16000.0,
        "drift_ppm": 12.35,
        "clock": "locked",
        "agreement": {"agreed": 0, "disagreed": 0},
        "clock_offset": None,
        "counters": {"frames": 3},
    }
    assert strict_json(encoded) == encoded


def test_clock_offset_of_an_array() -> None:
    offset = ClockOffset(-0.13764, 0.00123, 7, "lab-pc")
    encoded = array_status(status_of(clock_offset=offset, corrected_frames=-3), "door-pc", ActivityParameters())
    assert encoded["clock_offset"] == {
        "offset_s": -0.1376,
        "std_s": 0.0012,
        "sounds": 7,
        "reference": "lab-pc",
        "corrected_s": -0.15,
    }


@pytest.mark.parametrize(
    ("noise_power", "activity", "threshold_dbfs"),
    [
        (1e-6, ActivityParameters(floor_factor=4.0), -54.0),
        (1e-6, ActivityParameters(floor_factor=100.0), -40.0),
        (1e-6, ActivityParameters(min_power=1e-3), -30.0),
        (0.0, ActivityParameters(), -90.0),
        (None, ActivityParameters(), None),
    ],
    ids=["default factor", "larger factor", "least level above the noise", "digital silence", "noise unknown"],
)
def test_activity_threshold_of_an_array(
    noise_power: float | None, activity: ActivityParameters, threshold_dbfs: float | None
) -> None:
    reported = array_status(status_of(noise_power=noise_power), "lab-pc", activity)
    assert reported["activity_threshold_dbfs"] == threshold_dbfs


def test_array_before_its_first_message_has_nulls() -> None:
    unknown = dict.fromkeys(("age_s", "power", "noise_power", "sample_rate_hz", "drift_ppm", "clock"))
    encoded = array_status(
        status_of(state=ArrayState.STARTING, channel_power=(), **unknown), None, ActivityParameters()
    )
    assert encoded["channel_levels_dbfs"] == []
    unknown_fields = (
        "node",
        "age_s",
        "level_dbfs",
        "noise_floor_dbfs",
        "activity_threshold_dbfs",
        "sample_rate_hz",
        "drift_ppm",
        "clock",
    )
    for name in unknown_fields:
        assert encoded[name] is None, name
    assert strict_json(encoded) == encoded


@pytest.mark.parametrize(
    ("power", "level"), [(None, None), (0.0, None), (1.0, 0.0), (0.5, -3.0), (1e-9, -90.0), (5e-324, -3233.1)]
)
def test_level(power: float | None, level: float | None) -> None:
    assert dbfs(power) == level
