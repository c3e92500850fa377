"""Faults in the nodes' reports are found while they last, whatever their size, and no sound set-up has any."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from hypothesis import given, settings
from hypothesis import strategies as st

from livessl.core.commission.channels import MOST_CLIPPED, MOST_CONSTANT, NOISY_DB
from livessl.core.commission.finding import Finding, Severity
from livessl.core.commission.report_watch import BEGINS, ENDS, MOST_LOST, RECENT_S, STEADY, ReportWatch
from livessl.core.types import ChannelLevel, HostState

GOOD = ChannelLevel(-40.0, -50.0, 0, 0.0001, None, None, -70.0, 1.0)
FAULTY = {
    "dc": lambda size: replace(GOOD, mean=(MOST_CONSTANT * size)),
    "hum": lambda size: replace(GOOD, hum_hz=50.0, hum_dbfs=-70.0 * size / 10.0),
    "noisy": lambda size: replace(GOOD, noise_over_db=NOISY_DB * size),
}
NODES = {"north": "a", "south": "b"}
SYNCHRONIZED = HostState(True, "chrony", "ntp.example", 0.002, machine="m1")


class Desk:
    """A watch that gets a report of four channels a second."""

    def __init__(self) -> None:
        self.watch = ReportWatch()
        self.time_s = 0.0

    def take(self, channel: int, level: ChannelLevel, times: int = 1, array: str = "north") -> None:
        for _ in range(times):
            self.time_s += 1.0
            levels = [GOOD] * 4
            levels[channel - 1] = level
            self.watch.take(array, levels, None, self.time_s)

    def found(self) -> list[tuple[str, str | None, int | None]]:
        return [(one.fault, one.array, one.channel) for one in self.findings()]

    def findings(self) -> list[Finding]:
        return self.watch.findings(NODES, self.time_s)


@settings(max_examples=15, deadline=None)
@given(fault=st.sampled_from(sorted(FAULTY)), channel=st.integers(1, 4), size=st.floats(1.01, 9.9))
def test_lasting_fault_is_found_on_its_channel_until_it_ends(fault: str, channel: int, size: float) -> None:
    desk = Desk()
    desk.take(channel, FAULTY[fault](size), BEGINS - 1)
    assert desk.found() == []
    desk.take(channel, FAULTY[fault](size), STEADY)
    assert desk.found() == [(fault, "north", channel)]
    [finding] = desk.findings()
    assert finding.severity is Severity.WARNING
    assert finding.message.startswith(f"channel {channel} of 'north' ")
    desk.take(channel, GOOD, STEADY - ENDS - 1)
    assert desk.found() == [(fault, "north", channel)]
    desk.take(channel, GOOD)
    assert desk.found() == []


@given(st.lists(st.sampled_from(sorted(FAULTY)), min_size=1, max_size=BEGINS - 1))
@settings(max_examples=20, deadline=None)
def test_passing_fault_is_not_found(faults: Iterable[str]) -> None:
    """A tone, a knock at the table, a hand at the plugs."""
    desk = Desk()
    for fault in faults:
        desk.take(2, FAULTY[fault](3.0))
        assert desk.found() == []


def test_fault_just_below_its_limit_is_not_found() -> None:
    desk = Desk()
    for size in (0.99, -0.99):
        desk.take(1, FAULTY["dc"](size), 2 * STEADY)
    desk.take(3, FAULTY["noisy"](0.99), 2 * STEADY)
    assert desk.found() == []


@settings(max_examples=15, deadline=None)
@given(before=st.integers(0, 10**6), clipped=st.integers(MOST_CLIPPED + 1, 10**6), channel=st.integers(1, 4))
def test_clipping_is_found_for_a_minute(before: int, clipped: int, channel: int) -> None:
    desk = Desk()
    desk.take(channel, replace(GOOD, clipped=before))
    assert desk.found() == []
    desk.take(channel, replace(GOOD, clipped=before + clipped))
    assert desk.found() == [("clipping", "north", channel)]
    assert f"clips: {clipped} samples" in desk.findings()[0].message
    desk.take(channel, replace(GOOD, clipped=before + clipped), round(RECENT_S) + 1)
    assert desk.found() == []


def test_some_clipped_samples_in_many_minutes_are_no_fault() -> None:
    desk = Desk()
    for minute in range(5):
        desk.take(1, replace(GOOD, clipped=minute * MOST_CLIPPED), round(RECENT_S) + 1)
        assert desk.found() == []


def test_node_that_starts_again_counts_anew() -> None:
    desk = Desk()
    desk.take(1, replace(GOOD, clipped=5000), 3)
    desk.take(1, replace(GOOD, clipped=3))
    assert desk.found() == []
    desk.take(1, replace(GOOD, clipped=4 + MOST_CLIPPED))
    assert desk.found() == [("clipping", "north", 1)]


def test_array_that_says_nothing_any_more_has_no_findings() -> None:
    desk = Desk()
    desk.take(1, FAULTY["hum"](1.0), STEADY)
    assert desk.found() == [("hum", "north", 1)]
    desk.time_s += RECENT_S + 1.0
    assert desk.found() == []


def machines(**hosts: HostState | None) -> list[tuple[str, str]]:
    """Return code and message of the findings of two nodes with such machines."""
    watch = ReportWatch()
    for time_s in (1.0, 2.0):
        for array, host in hosts.items():
            watch.take(array, [GOOD] * 4, host, time_s)
    return [(one.fault, one.message) for one in watch.findings(NODES, 2.0)]


def test_clock_that_follows_no_other_is_found_where_machines_differ() -> None:
    alone = replace(SYNCHRONIZED, synchronized=False, machine="m2")
    [(fault, message)] = machines(north=SYNCHRONIZED, south=alone)
    assert fault == "ntp"
    assert message.startswith("node 'b': its machine's clock is not synchronized")
    assert machines(north=SYNCHRONIZED, south=replace(alone, synchronized=True)) == []
    assert machines(north=SYNCHRONIZED, south=replace(alone, synchronized=None)) == []
    assert machines(north=SYNCHRONIZED, south=None) == []
    same = replace(alone, machine="m1")
    assert machines(north=replace(same), south=same) == []  # nodes on one machine agree by themselves
    assert machines(south=alone) == []


@settings(max_examples=20, deadline=None)
@given(lost=st.integers(0, 50), before=st.integers(0, 1000))
def test_machine_that_does_not_keep_up_is_found(lost: int, before: int) -> None:
    watch = ReportWatch()
    for time_s, count in ((1.0, before), (2.0, before + lost)):
        watch.take("north", [GOOD] * 4, replace(SYNCHRONIZED, lost_blocks=count, load=2.5), time_s)
    found = watch.findings(NODES, 2.0)
    assert [one.fault for one in found] == (["cpu"] if lost > MOST_LOST else [])
    for one in found:
        assert f"node 'a': its machine does not keep up: {lost} blocks of sound lost" in one.message
        assert "its load is 2.5 per processor" in one.message
        assert "device.latency_s" in one.cure
