"""Mode and site time: the clock's when live, the recording's in a replay, and when a replay has ended."""

from __future__ import annotations

import pytest

from livessl.core.types import FRAME_NS
from livessl.server.site_time import REPLAY_SILENT_NS, SiteTime
from small_site import mark

NOW_NS = 1_767_225_600_000_000_000


class HandClock:
    """Site time and monotonic time that a test moves separately."""

    def __init__(self) -> None:
        self.time_ns = NOW_NS
        self.pace_ns = 0

    def now_ns(self) -> int:
        return self.time_ns

    def monotonic_ns(self) -> int:
        return self.pace_ns

    def sleep_until_ns(self, time_ns: int) -> bool:
        raise AssertionError("nothing here waits")


@pytest.fixture
def clock() -> HandClock:
    return HandClock()


@pytest.fixture
def site_time(clock: HandClock) -> SiteTime:
    return SiteTime(clock)


def test_live_time_is_the_clocks(site_time: SiteTime, clock: HandClock) -> None:
    assert (site_time.mode, site_time.is_replay, site_time.now_ns()) == ("live", False, NOW_NS)
    clock.time_ns += 5
    site_time.advance([mark(frame_index=1000)])
    assert site_time.now_ns() == NOW_NS + 5
    assert site_time.started_ns == NOW_NS


def test_replayed_time_is_the_end_of_the_newest_frame_and_stays_there(site_time: SiteTime) -> None:
    site_time.begin_replay()
    assert (site_time.mode, site_time.now_ns()) == ("replay", 0)
    site_time.advance([mark(frame_index=1000), mark(frame_index=998)])
    assert site_time.now_ns() == 1001 * FRAME_NS
    site_time.advance([mark(frame_index=999)])
    site_time.advance([])
    assert site_time.now_ns() == 1001 * FRAME_NS
    site_time.end_replay()
    assert (site_time.mode, site_time.now_ns(), site_time.replay_is_running) == ("replay", 1001 * FRAME_NS, False)
    site_time.begin_live()
    assert (site_time.mode, site_time.now_ns()) == ("live", NOW_NS)


def test_next_replay_begins_anew(site_time: SiteTime) -> None:
    site_time.begin_replay()
    site_time.advance([mark(frame_index=1000)])
    site_time.begin_replay()
    assert site_time.now_ns() == 0


def test_replay_is_silent_by_the_monotonic_clock(site_time: SiteTime, clock: HandClock) -> None:
    site_time.begin_replay()
    clock.time_ns += 10 * REPLAY_SILENT_NS  # somebody has set the clock
    assert not site_time.replay_is_silent()
    clock.pace_ns += REPLAY_SILENT_NS
    assert not site_time.replay_is_silent()
    clock.pace_ns += 1
    assert site_time.replay_is_silent()
    site_time.note_sound()
    assert not site_time.replay_is_silent()
    clock.pace_ns += REPLAY_SILENT_NS + 1
    site_time.end_replay()
    assert not site_time.replay_is_silent()


def test_uptime_is_of_the_monotonic_clock(site_time: SiteTime, clock: HandClock) -> None:
    clock.time_ns = 0
    clock.pace_ns += 2_500_000_000
    assert site_time.uptime_s() == 2.5
