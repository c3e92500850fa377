"""Keeps the last report of each array's node: levels of channels, state of its machine."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import dataclass

from livessl.core.commission.finding import Finding
from livessl.core.commission.report_watch import RECENT_S, ReportWatch
from livessl.core.types import ChannelLevel, HostState, Mark


@dataclass(frozen=True, slots=True)
class NodeFigures:
    """A report.

    Parameters
    ----------
    levels : tuple of ChannelLevel
        Level of each channel.
    drift_error_ppm : float or None
        Error that the drift may have, parts per million; None if it is not known.
    host : HostState or None
        State of the node's machine; None if it does not report it.
    received_ns : int
        When it was received, nanoseconds by the monotonic clock.
    """

    levels: tuple[ChannelLevel, ...]
    drift_error_ppm: float | None
    host: HostState | None
    received_ns: int


class NodeReports:
    """Keeps the reports that marks carry. Every thread may call its methods."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._last: dict[str, NodeFigures] = {}
        self._watch = ReportWatch()
        self._first_ns: int | None = None

    def note(self, mark: Mark, now_ns: int) -> None:
        """Take in a mark; most carry no report."""
        if not mark.levels:
            return
        with self._lock:
            self._first_ns = now_ns if self._first_ns is None else self._first_ns
            self._last[mark.array] = NodeFigures(mark.levels, mark.drift_error_ppm, mark.host, now_ns)
            self._watch.take(mark.array, mark.levels, mark.host, now_ns / 1e9)

    def of(self, array: str) -> NodeFigures | None:
        """Return an array's last report; None if there is none."""
        return self._last.get(array)

    def findings(self, nodes: Mapping[str, str | None], now_ns: int) -> list[Finding]:
        """Return what is wrong by the reports: see `ReportWatch.findings`."""
        with self._lock:
            return self._watch.findings(nodes, now_ns / 1e9)

    def are_complete(self, now_ns: int) -> bool:
        """Return whether reports have come for so long that a fault which they do not show has ended."""
        with self._lock:
            return self._first_ns is not None and now_ns - self._first_ns >= RECENT_S * 1e9

    def forget(self) -> None:
        """Forget all reports: those of another run are about another set-up."""
        with self._lock:
            self._last, self._first_ns = {}, None
            self._watch = ReportWatch()
