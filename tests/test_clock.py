"""Instants as text, and the waiting of clocks."""

from __future__ import annotations

import contextlib
import time
from datetime import UTC, datetime, timedelta

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from livessl.clock import LONGEST_SLEEP_S, PacedClock, SystemClock, UnpacedClock, utc_ns, utc_text

NS = 1_000_000_000


def test_text_of_an_instant() -> None:
    assert utc_text(0) == "1970-01-01T00:00:00.000000Z"
    assert utc_text(1_769_860_800_050_000_000) == "2026-01-31T12:00:00.050000Z"


@pytest.mark.parametrize(
    "text",
    [
        "2026-01-31T12:00:00Z",
        "2026-01-31T12:00:00+00:00",
        "2026-01-31T13:00:00+01:00",
        "2026-01-31T07:30:00.000-04:30",
        "2026-01-31 12:00:00Z",
    ],
)
def test_instant_of_a_text(text: str) -> None:
    assert utc_ns(text) == 1_769_860_800 * NS


@pytest.mark.parametrize("text", ["", "now", "2026-01-31", "2026-01-31T12:00:00", "2026-13-01T00:00:00Z", "12:00Z"])
def test_text_that_is_not_an_instant_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="expected RFC 3339 with an offset") as caught:
        utc_ns(text)
    assert repr(text) in str(caught.value)


@given(st.text())
@settings(deadline=None)
def test_any_text_is_an_instant_or_a_value_error(text: str) -> None:
    with contextlib.suppress(ValueError):
        utc_ns(text)


@given(st.datetimes(min_value=datetime(1970, 1, 1), max_value=datetime(2262, 1, 1)))  # noqa: DTZ001 - bounds are naive
@settings(deadline=None)
def test_instants_survive_the_text_form_to_the_microsecond(moment: datetime) -> None:
    microseconds = (moment.replace(tzinfo=UTC) - datetime(1970, 1, 1, tzinfo=UTC)) // timedelta(microseconds=1)
    assert utc_ns(utc_text(microseconds * 1000)) == microseconds * 1000
    assert utc_text(microseconds * 1000 + 999) == utc_text(microseconds * 1000)  # rounded down, never into the future


def test_system_clock_is_utc_and_waits() -> None:
    clock = SystemClock()
    assert abs(clock.now_ns() - datetime.now(UTC).timestamp() * 1e9) < 1e9
    until_ns = clock.now_ns() + 20_000_000
    assert clock.sleep_until_ns(until_ns)
    assert clock.now_ns() >= until_ns


@pytest.mark.parametrize("clock", [SystemClock(), PacedClock(100 * NS), UnpacedClock(100 * NS)])
def test_past_times_return_at_once(clock: SystemClock | PacedClock | UnpacedClock) -> None:
    assert clock.sleep_until_ns(clock.now_ns() - NS)


def test_paced_clock_runs_at_its_speed() -> None:
    began = time.monotonic_ns()
    clock = PacedClock(100 * NS, speed=1000.0)
    assert clock.sleep_until_ns(140 * NS)
    assert clock.now_ns() >= 140 * NS
    took_ns = time.monotonic_ns() - began
    # 40 s at a thousand times the speed are 40 ms; it may oversleep, never wake too early
    assert 40_000_000 <= took_ns < 40 * NS


@pytest.mark.parametrize("speed", [0.0, -1.0, float("nan")])
def test_paced_clock_refuses_a_speed_that_is_not_positive(speed: float) -> None:
    with pytest.raises(ValueError, match="expected > 0"):
        PacedClock(0, speed)


def test_unpaced_clock_jumps_and_never_goes_back() -> None:
    clock = UnpacedClock(5)
    assert clock.now_ns() == 5
    assert clock.sleep_until_ns(10 * NS)
    assert clock.sleep_until_ns(9 * NS)
    assert clock.now_ns() == 10 * NS


@pytest.mark.parametrize("clock", [SystemClock(), PacedClock(0, speed=3600.0)])
def test_single_sleeps_are_short(clock: SystemClock | PacedClock) -> None:
    """A caller that waits for an hour can thus be stopped within a moment."""
    began = time.monotonic()
    assert not clock.sleep_until_ns(clock.now_ns() + 3600 * NS)
    assert LONGEST_SLEEP_S <= time.monotonic() - began < 60.0
