"""Collects what one run of the device process did (beats, blocks, output); `device_watch` judges it."""

from __future__ import annotations

from typing import Final

from livessl.capture.device_process import DeviceProcess
from livessl.capture.device_report import Report
from livessl.capture.device_watch import Seen
from livessl.capture.native_output import NativeOutput
from livessl.clock import Clock
from livessl.core.types import Block

WAIT_S: Final = 0.25
"""Longest wait of the iterator, in seconds, so that the caller can serve its network link in between."""

OUTPUT_S: Final = 0.2
"""Shortest interval, in seconds, at which the output of native libraries is read. At most 64 kB are read at one time,
so that a library that prints endlessly has to wait."""

FLOOD_BYTES: Final = 32768
"""Output of native libraries in one interval, in bytes, that counts as a flood: 160 kB per second."""


class DeviceRun:
    """Observes one run of the process, from its start to its end.

    Parameters
    ----------
    process : DeviceProcess
    clock : Clock
        Clock for waits and for the interval at which output is read.

    Attributes
    ----------
    report : Report or None
        The latest report of the process; None before the first one.
    delivers : bool
        True once the process has delivered a block.
    """

    def __init__(self, process: DeviceProcess, clock: Clock) -> None:
        self.process = process
        self.report: Report | None = None
        self.delivers = False
        self._clock = clock
        self._idle_s = self._silent_s = 0.0
        self._beats = self._last_beats = process.beats
        self._flagged = self._last_flagged = process.flagged
        self._unflagged_s = 0.0
        self._overruns = self._counted_flagged = 0
        self._floods = 0
        self._output_ns = clock.monotonic_ns()

    def wait(self) -> None:
        """Wait for a block or a report. Time in which the node itself did not run does not count for the process."""
        begun_ns = self._clock.monotonic_ns()
        self.process.wait(WAIT_S)
        waited_s = min(WAIT_S, (self._clock.monotonic_ns() - begun_ns) / 1e9)
        self._idle_s += waited_s
        beats = self.process.beats
        self._silent_s = self._silent_s + waited_s if beats == self._last_beats else 0.0
        self._last_beats = beats
        flagged = self.process.flagged
        self._unflagged_s = self._unflagged_s + waited_s if flagged == self._last_flagged else 0.0
        self._last_flagged = flagged

    def block(self) -> Block | None:
        """Return the next block; None if there is none."""
        block = self.process.block()
        if block is not None:
            self.delivers = True
            self._floods = 0
            self._restart_idle()
        return block

    def new_reports(self) -> list[Report]:
        """Return new reports."""
        reports = self.process.reports()
        if reports:
            self.report = reports[-1]
            self._restart_idle()
        return reports

    def new_overruns(self) -> int:
        """Return the number of blocks, since the last call, for which the ring had no space."""
        before, self._overruns = self._overruns, self.process.overruns
        return self._overruns - before

    def new_flagged(self) -> int:
        """Return the number of blocks that the driver flagged since the last call."""
        before, self._counted_flagged = self._counted_flagged, self.process.flagged
        return self._counted_flagged - before

    def read_output(self, output: NativeOutput) -> None:
        """Read a limited amount of the output of native libraries."""
        now_ns = self._clock.monotonic_ns()
        if now_ns - self._output_ns < OUTPUT_S * 1e9:
            return
        self._output_ns = now_ns
        printed = self.process.output()
        output.feed(printed, now_ns)
        self._floods = self._floods + 1 if len(printed) >= FLOOD_BYTES else 0

    def seen(self, *, delivered_before: bool) -> Seen:
        """Return the node's observations of the process."""
        return Seen(
            self.report,
            delivered=self.delivers,
            delivered_before=delivered_before,
            idle_s=self._idle_s,
            beats=self._last_beats - self._beats,
            silent_s=self._silent_s,
            flagged=self._last_flagged - self._flagged,
            unflagged_s=self._unflagged_s,
            floods=self._floods,
            exit_code=None if self.process.waiting else self.process.exit_code,
        )

    def _restart_idle(self) -> None:
        self._idle_s = 0.0
        self._beats = self._last_beats
        self._flagged = self._last_flagged
