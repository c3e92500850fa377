"""State of an array: what its messages, its clock, its node and the operator make of it, in this order."""

from __future__ import annotations

from livessl.core.stream.array_health import LOST_NS, ArrayHealth, ArrayState, NodeReport
from livessl.core.stream.clock_offsets import ClockOffset
from livessl.core.types import FRAME_S

NOW_NS = 10**18
NODE_IS_THERE = "its node is there, but no sound comes from its device"


def state_of(
    age_ns: int | None = 0, node: NodeReport | None = None, *, fault: str = "", offset_s: float | None = None
) -> tuple[ArrayState, str | None]:
    health = ArrayHealth(4)
    if fault:
        health.note(NOW_NS, fault)
    offset = None if offset_s is None else ClockOffset(offset_s, 0.001, 9, "server")
    return health.state(NOW_NS, age_ns=age_ns, has_left=False, votes=(), clock_offset=offset, node=node or NodeReport())


def test_array_whose_messages_come_is_healthy() -> None:
    assert state_of() == (ArrayState.HEALTHY, None)
    assert state_of(None) == (ArrayState.STARTING, "no message yet")
    assert state_of(LOST_NS) == (ArrayState.LOST, "no message for 1.5 s")


def test_clock_offset_of_more_than_a_frame_degrades_a_healthy_array() -> None:
    assert state_of(offset_s=0.9 * FRAME_S) == (ArrayState.HEALTHY, None)
    state, reason = state_of(offset_s=1.1 * FRAME_S)
    assert state is ArrayState.DEGRADED
    assert reason is not None
    assert state_of(fault="torn", offset_s=1.1 * FRAME_S) == (ArrayState.DEGRADED, "torn")


def test_problem_of_the_device_is_the_reason_whatever_the_state() -> None:
    unplugged = NodeReport(problem="unplugged")
    assert state_of(0, unplugged) == (ArrayState.DEGRADED, "unplugged")
    assert state_of(0, unplugged, fault="torn") == (ArrayState.DEGRADED, "unplugged")
    assert state_of(None, unplugged) == (ArrayState.STARTING, "unplugged")
    assert state_of(LOST_NS, unplugged) == (ArrayState.LOST, "unplugged")


def test_lost_array_is_quiet_while_its_node_is_live() -> None:
    assert state_of(LOST_NS, NodeReport(is_live=True)) == (ArrayState.QUIET, NODE_IS_THERE)
    assert state_of(LOST_NS, NodeReport("unplugged", is_live=True)) == (ArrayState.QUIET, "unplugged")
    assert state_of(0, NodeReport(is_live=True)) == (ArrayState.HEALTHY, None)


def test_disabled_array_names_the_state_that_it_has_otherwise() -> None:
    disabled = "an operator has disabled it, and its sound is not used; otherwise "
    assert state_of(0, NodeReport(is_disabled=True)) == (ArrayState.DISABLED, f"{disabled}healthy")
    assert state_of(LOST_NS, NodeReport(is_live=True, is_disabled=True)) == (
        ArrayState.DISABLED,
        f"{disabled}quiet: {NODE_IS_THERE}",
    )
