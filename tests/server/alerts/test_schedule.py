"""Times of the week at which a rule may alert."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from zoneinfo import ZoneInfo

import pytest
from hypothesis import given
from hypothesis import strategies as st

from livessl.server.alerts.schedule import is_open
from livessl.site.alert_models import DAYS, ScheduleSpan

ZONE = "Europe/Berlin"


def ns(text: str, zone: str = ZONE) -> int:
    return round(datetime.fromisoformat(text).replace(tzinfo=ZoneInfo(zone)).timestamp()) * 10**9


NIGHTS = (ScheduleSpan(days=("fri",), begin="22:00", end="06:30"),)


@pytest.mark.parametrize(
    ("time", "expected"),
    [
        ("2026-11-27T21:59", False),  # a Friday
        ("2026-11-27T22:00", True),
        ("2026-11-28T06:29", True),
        ("2026-11-28T06:30", False),
        ("2026-11-27T05:00", False),  # the night of Thursday
        ("2026-11-28T23:00", False),
    ],
)
def test_span_over_midnight_belongs_to_the_day_on_which_it_begins(time: str, expected: bool) -> None:
    assert is_open(NIGHTS, ns(time), ZONE) is expected


def test_wall_clock_of_the_zone_counts_in_summer_and_in_winter() -> None:
    office = (ScheduleSpan(begin="08:00", end="09:00"),)
    assert is_open(office, ns("2026-07-01T06:30", "UTC"), ZONE)
    assert is_open(office, ns("2026-12-01T07:30", "UTC"), ZONE)
    assert not is_open(office, ns("2026-12-01T06:30", "UTC"), ZONE)


def test_no_span_is_always_and_several_add_up() -> None:
    assert is_open((), ns("2026-11-27T12:00"), ZONE)
    both = (ScheduleSpan(begin="08:00", end="09:00"), ScheduleSpan(begin="20:00", end="24:00"))
    assert [is_open(both, ns(f"2026-11-27T{hour}:30"), ZONE) for hour in ("08", "12", "23")] == [True, False, True]


def clock(minutes: int) -> str:
    return f"{minutes // 60:02d}:{minutes % 60:02d}"


@given(
    begin=st.integers(0, 1439),
    length=st.integers(1, 1439),
    days=st.sets(st.sampled_from(DAYS), min_size=1),
    minute=st.integers(0, 7 * 1440 - 1),
)
def test_open_for_its_length_from_the_begin_of_each_of_its_days(
    begin: int, length: int, days: set[str], minute: int
) -> None:
    end = (begin + length) % 1440
    span = ScheduleSpan(days=tuple(days), begin=clock(begin), end=clock(end or 1440))
    monday = datetime(2026, 11, 23, tzinfo=UTC)
    now_ns = round((monday + timedelta(minutes=minute)).timestamp()) * 10**9
    starts = [1440 * (DAYS.index(day) + 7 * week) + begin for day in days for week in (-1, 0)]
    assert is_open([span], now_ns, "UTC") is any(start <= minute < start + length for start in starts)
