"""Nodes whose clocks are behind the server's, from the delays of their messages."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from livessl.capture.node import capture_recordings
from livessl.clock import SystemClock
from livessl.core.types import FRAME_NS
from livessl.server import node_clocks
from livessl.server.node_clocks import MOST_BEHIND_S, WINDOW_NS, NodeClocks
from small_site import running_server, scene_recordings, site_of, wait_until

STEP_NS = 50_000_000
START_NS = 1_767_225_600_000_000_000


def behind_s(clock_s: float, delays_s: list[float]) -> float | None:
    """What is known of a clock that is behind, after messages with these delays of the network."""
    clocks = NodeClocks()
    sent_ns = [START_NS + k * STEP_NS for k in range(len(delays_s))]
    received_ns = [sent + round(delay_s * 1e9) for sent, delay_s in zip(sent_ns, delays_s, strict=True)]
    for received, sent in sorted(zip(received_ns, sent_ns, strict=True)):
        clocks.note("north", sent - round(clock_s * 1e9), received)
    return clocks.behind_s("north")


@given(clock_s=st.floats(-3.0, 20.0), seed=st.integers(0, 1000), slow_s=st.floats(0.0, 3.0))
def test_the_least_delay_tells_the_clock(clock_s: float, seed: int, slow_s: float) -> None:
    """Messages may wait for seconds, as long as one of each window does not."""
    rng = np.random.default_rng(seed)
    count = 3 * WINDOW_NS // STEP_NS
    delays_s = np.where(rng.random(count) < 0.9, 0.001 + slow_s * rng.random(count), 0.001)
    delays_s[:: WINDOW_NS // STEP_NS // 3] = 0.001
    found_s = behind_s(clock_s, delays_s.tolist())
    if clock_s < MOST_BEHIND_S - 0.01:
        assert found_s is None
    if clock_s > MOST_BEHIND_S:
        assert found_s is not None
        assert abs(found_s - clock_s) < 0.01


def test_nothing_is_said_before_a_window_has_passed_or_without_stamps() -> None:
    assert behind_s(2.0, [0.001] * 20) is None
    clocks = NodeClocks()
    for k in range(300):
        clocks.note("north", 0, START_NS + k * STEP_NS)
    assert clocks.behind_s("north") is None
    assert clocks.behind_s("south") is None


class ClockBehind(SystemClock):
    """A clock that is 2 s behind."""

    def now_ns(self) -> int:
        return super().now_ns() - 2_000_000_000

    def sleep_until_ns(self, time_ns: int) -> bool:
        return super().sleep_until_ns(time_ns + 2_000_000_000)


def test_a_node_that_sends_by_a_clock_that_is_behind_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(node_clocks, "WINDOW_NS", 500_000_000)
    clock = ClockBehind()
    reasons: set[str] = set()
    with running_server(site_of()) as server:

        def stop() -> bool:
            reasons.update(str(array["reason"]) for array in server.parts.array_states.describe())
            return any("clock is 2." in reason for reason in reasons)

        start_ns = (clock.now_ns() // FRAME_NS + 5) * FRAME_NS
        node = site_of({"nodes.lab-pc.server": server.endpoint})
        capture_recordings(node, "lab-pc", scene_recordings(start_ns), clock, "run-1", stop)
        wait_until(stop, f"the clock among the reasons, got {reasons}")
