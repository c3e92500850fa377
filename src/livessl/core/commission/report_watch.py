"""Finds faults in nodes' reports: clipping, hum, noise, lost blocks, an unsynchronized clock, an overloaded machine."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from livessl.core.commission.channels import CLIPPING_CURE, MOST_CLIPPED, steady_faults
from livessl.core.commission.finding import Finding, Severity
from livessl.core.types import ChannelLevel, HostState

REPORTED: Final = frozenset({"clipping", "cpu", "dc", "hum", "noisy", "ntp"})
"""Codes of the faults that are found in reports."""

STEADY: Final = 10
"""Number of latest reports, one per second, that decide about a constant, hum and noise."""

BEGINS: Final = 8
ENDS: Final = 2
"""Number of the latest `STEADY` reports with a fault from which it is reported, and number down to which it stays
reported. The difference prevents a fault at the limit from alternating."""

RECENT_S: Final = 60.0
"""Time, in seconds, for which clipping and lost blocks stay reported, and after which a silent node is ignored."""

MOST_LOST: Final = 2
"""Largest number of blocks lost in `RECENT_S` that is not reported."""


@dataclass(frozen=True, slots=True)
class _Report:
    time_s: float
    levels: tuple[ChannelLevel, ...]
    host: HostState | None


class _Array:
    """The latest reports of one array."""

    def __init__(self) -> None:
        self.recent: deque[_Report] = deque()
        self.steady: set[tuple[str, int]] = set()
        self._shown: deque[dict[tuple[str, int], Finding]] = deque(maxlen=STEADY)

    def take(self, array: str, report: _Report) -> None:
        if self.recent and self._begins_anew(report):
            self.recent.clear()
            self._shown.clear()
        self.recent.append(report)
        while self.recent[0].time_s < report.time_s - RECENT_S:
            self.recent.popleft()
        found = [
            fault
            for index, of in enumerate(report.levels)
            for fault in steady_faults(array, index, of.mean, of.hum_hz, of.hum_dbfs, of.noise_over_db)
        ]
        self._shown.append({(fault.fault, fault.channel or 0): fault for fault in found})
        counts = {key: sum(key in shown for shown in self._shown) for shown in self._shown for key in shown}
        self.steady = {key for key, count in counts.items() if count >= BEGINS or (count > ENDS and key in self.steady)}

    def steady_findings(self) -> Iterator[Finding]:
        """Yield the lasting faults, each with its newest figures."""
        for key in sorted(self.steady):
            yield next(shown[key] for shown in reversed(self._shown) if key in shown)

    def clipping(self, array: str) -> Iterator[Finding]:
        """Yield the channels with clipped samples in the last minute."""
        first, last = self.recent[0].levels, self.recent[-1].levels
        for index, (before, now) in enumerate(zip(first, last, strict=True)):
            clipped = now.clipped - before.clipped
            if clipped > MOST_CLIPPED:
                what = f"channel {index + 1} of {array!r} clips: {clipped} samples in the last minute"
                yield Finding("clipping", array, index + 1, Severity.WARNING, 0.95, what, CLIPPING_CURE)

    def lost_blocks(self) -> int:
        """Return the number of blocks that the node lost in the last minute because its machine did not keep up."""
        counts = [report.host.lost_blocks for report in self.recent if report.host is not None]
        return counts[-1] - counts[0] if counts else 0

    def _begins_anew(self, report: _Report) -> bool:
        """Return whether the node has started again, so that its counts have begun anew, or its channels changed."""
        last = self.recent[-1]
        if len(last.levels) != len(report.levels):
            return True
        counts = any(now.clipped < then.clipped for now, then in zip(report.levels, last.levels, strict=True))
        hosts = report.host is not None and last.host is not None and report.host.lost_blocks < last.host.lost_blocks
        return counts or hosts


class ReportWatch:
    """Keeps the reports of the last minute, and finds faults in them."""

    def __init__(self) -> None:
        self._arrays: dict[str, _Array] = {}

    def take(self, array: str, levels: Sequence[ChannelLevel], host: HostState | None, time_s: float) -> None:
        """Take in a report.

        Parameters
        ----------
        array : str
        levels : sequence of ChannelLevel
            Levels of its channels.
        host : HostState or None
            State of the node's machine.
        time_s : float
            Time at which the report was received, seconds of any monotonic clock.
        """
        self._arrays.setdefault(array, _Array()).take(array, _Report(time_s, tuple(levels), host))

    def findings(self, nodes: Mapping[str, str | None], time_s: float) -> list[Finding]:
        """Return the present faults.

        Parameters
        ----------
        nodes : mapping of array to node
            The node of each array in the site file; None for an array without a node.
        time_s : float
            Present time, as in `take`.
        """
        known = {
            name: of
            for name, of in self._arrays.items()
            if name in nodes and of.recent and time_s - of.recent[-1].time_s <= RECENT_S
        }
        found = [
            finding for name, of in sorted(known.items()) for finding in (*of.clipping(name), *of.steady_findings())
        ]
        hosts = {nodes[name] or name: of.recent[-1].host for name, of in known.items()}
        lost = {nodes[name] or name: of.lost_blocks() for name, of in known.items()}
        return [*found, *_of_machines(hosts, lost)]


def _of_machines(hosts: Mapping[str, HostState | None], lost: Mapping[str, int]) -> Iterator[Finding]:
    """Yield the faults of the nodes' machines: machines that do not keep up, and clocks that are not synchronized.

    If all nodes are on one machine, their times agree even if its clock is not synchronized.
    """
    for node, count in sorted(lost.items()):
        if count > MOST_LOST:
            host = hosts[node]
            load = "" if host is None or host.load is None else f"; its load is {host.load:.1f} per processor"
            what = f"node {node!r}: its machine does not keep up: {count} blocks of sound lost in the last minute{load}"
            cure = (
                "stop other programs on it, set device.latency_s to a longer time, or start the node by "
                "deploy/livessl-node@.service, which grants real-time scheduling"
            )
            yield Finding("cpu", None, None, Severity.WARNING, 0.95, what, cure)
    machines = {host.machine or node for node, host in hosts.items() if host is not None}
    if len(machines) < 2:
        return
    for node, host in sorted(hosts.items()):
        if host is not None and host.synchronized is False:
            what = f"node {node!r}: its machine's clock is not synchronized, and the clocks of several nodes must agree"
            cure = (
                "switch a time service on, such as chrony, or `timedatectl set-ntp true`, and let it reach a server; "
                "where there is no network, let one machine serve the others"
            )
            yield Finding("ntp", None, None, Severity.WARNING, 0.95, what, cure)
