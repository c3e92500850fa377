"""An audio interface as an iterator of blocks, through a process of its own that is watched, killed and restarted.

PortAudio's thread may loop for ever, hang, or print without end when a device is unplugged, and nothing within the
same process can stop it. The node therefore never loads the library (see `device_main`).
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator
from types import TracebackType
from typing import Final

import numpy as np

from livessl.capture.device_process import DamageError, DeviceProcess
from livessl.capture.device_report import DeviceState, Report, Wanted
from livessl.capture.device_watch import Seen, judge
from livessl.capture.gap_watch import HARDWARE, SOUND_SERVER, GapWatch
from livessl.capture.native_output import NativeOutput
from livessl.clock import Clock
from livessl.core.types import Block
from livessl.errors import DeviceError
from livessl.site.node_models import SoundDeviceConfig

WAIT_S: Final = 0.25
"""Longest wait of the iterator, in seconds, so that the caller can serve its network link in between."""

FIRST_REPORT_S: Final = 2.0
"""Longest wait for the first report when the device is entered, in seconds."""

RESTART_S: Final = 1.0
"""Shortest interval between two starts of the process, in seconds; it doubles, up to `MAX_RESTART_S`, while the process
ends before its first report."""

MAX_RESTART_S: Final = 8.0

QUEUE_S: Final = 2.0
"""Sound that the ring holds, in seconds: far more than any pause of a healthy caller."""

OUTPUT_S: Final = 0.2
"""Shortest interval between two looks at the output of native libraries, in seconds. Each look reads at most 64 kB, so
that a library that prints without end waits."""

FLOOD_BYTES: Final = 32768
"""Output of native libraries between two looks, in bytes, that counts as a flood: 160 kB in a second."""

LAG_SHOWN_NS: Final = 5_000_000_000
"""Time in ns for which a loss in the ring stays the problem of the device."""

HELD_NS: Final = 50_000_000
"""Interval, in ns, at which a process that was killed and does not end is looked at."""

_log = logging.getLogger(__name__)


class SoundDevice:
    """An audio interface, found by name; a context manager that opens it and an iterator of its blocks.

    Each step waits at most 0.25 s and then yields a block without samples. If the device is absent or disappears, the
    iterator yields empty blocks and sets `problem`; the device is opened as soon as it is there. The first block after
    that has `overflow` set, and sample indices continue.

    Parameters
    ----------
    config : SoundDeviceConfig
        Name, rate, block length and latency.
    channels : int
        Number of channels to record: the highest channel that any array uses.
    clock : Clock
        For deadlines, and stamps of empty blocks.
    start : callable
        Starts the process that owns the device.

    Attributes
    ----------
    name : str
        Name in the site file.
    sample_rate_hz : float
        Nominal sampling rate, Hz.
    channels : int
        Channels of each block.
    problem : str or None
        The present problem in words; None if there is none.
    overruns : int
        Blocks that were lost because this process did not read them in time.
    starts : int
        Number of times that the process was started.
    unflagged_gaps : int
        Gaps that no driver flagged.
    lost_blocks : int
        Blocks that were lost because this machine did not keep up: those that its driver flagged, those that this
        process did not read in time, and one for each gap without a flag.
    through_sound_server : bool
        Whether its samples come through a sound server or plug-in, as far as it is known.
    interruptions : int
        Number of times that the device had delivered and was then opened again: it was unplugged, stopped or failed.
    """

    def __init__(
        self,
        config: SoundDeviceConfig,
        channels: int,
        clock: Clock,
        start: Callable[[Wanted], DeviceProcess] = DeviceProcess,
    ) -> None:
        self.name = config.name
        self.sample_rate_hz = config.sample_rate_hz
        self.channels = channels
        self.problem: str | None = None
        self.overruns = 0
        self.starts = 0
        self.unflagged_gaps = 0
        self.lost_blocks = 0
        self.interruptions = 0
        self.through_sound_server = False
        self._block_s = config.block_s
        self._wanted = wanted_device(config, channels)
        self._clock = clock
        self._start = start
        self._output = NativeOutput()
        self._gaps = GapWatch(config.sample_rate_hz, config.block_s, SOUND_SERVER)
        self._run: _Run | None = None
        self._former: DeviceProcess | None = None
        self._failures = 0
        self._start_ns = clock.monotonic_ns()
        self._lag_ns: int | None = None
        self._delivered = False
        self._reported = False
        self._realtime_logged = False
        self._lost = False
        self._base_index = self._handed_index = 0
        self._entered = False

    def __enter__(self) -> SoundDevice:
        """Start the device's process, and wait up to 2 s for its report.

        Raises
        ------
        DeviceError
            If waiting would not help: PortAudio is not installed, the name matches several devices, or the device
            has too few channels or does not offer the sampling rate. If the report takes longer than 2 s, iteration
            raises it.
        """
        self._entered = True
        self._begin()
        deadline_ns = self._clock.monotonic_ns() + round(FIRST_REPORT_S * 1e9)
        while not self._reported and self._run is not None and self._clock.monotonic_ns() < deadline_ns:
            self._run.wait()
            try:
                self._look_after(self._run)
            except DamageError as error:
                self._damaged(self._run, error)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._entered = False
        self._end(kill=False)
        self._output.summarize()

    def __iter__(self) -> Iterator[Block]:
        return self

    def __next__(self) -> Block:
        """Return the next block, or one without samples after 0.25 s.

        Raises
        ------
        StopIteration
            Outside the `with` block.
        DeviceError
            If waiting for the device would not help, and this was not known when it was entered.
        """
        if not self._entered:
            raise StopIteration
        run = self._run
        if run is None:
            self._wait_to_begin()
        else:
            block = self._step(run)
            if block is not None:
                return block
        nothing = np.empty((self.channels, 0), dtype=np.float32)
        return Block(self._handed_index, nothing, self._clock.now_ns())

    @property
    def has_cause(self) -> bool:
        """True once the device's process has reported, or has failed: `problem` then names the cause of silence."""
        return self._reported or self.starts > 1

    def _handed(self, block: Block) -> Block:
        """Return a block of the process as one of the device: indices continue after a restart, gaps are marked."""
        first_index = self._base_index + block.first_index
        overflow = block.overflow or self._lost
        if overflow:
            self._gaps.restart()
        gap_ns = self._gaps.push(first_index, block.stamp_ns)
        if gap_ns:
            overflow = True
            self.unflagged_gaps += 1
            self.lost_blocks += 1
            _log.warning(
                "%.0f ms of sound of device %r are missing without a flag of its driver; %d such gaps so far",
                gap_ns / 1e6,
                self.name,
                self.unflagged_gaps,
            )
        self._lost, self._delivered, self._failures = False, True, 0
        self._handed_index = first_index + block.samples.shape[1]
        return Block(first_index, block.samples, block.stamp_ns, overflow)

    def _step(self, run: _Run) -> Block | None:
        """Wait for the process; return its next block, if there is one, as one of the device."""
        run.wait()
        handed = None
        try:
            block = run.block()
            if block is not None:
                handed = self._handed(block)  # before the end of the process marks what comes after it as a gap
            self._look_after(run)
        except DamageError as error:
            self._damaged(run, error)
        return handed

    def _damaged(self, run: _Run, error: DamageError) -> None:
        self.problem = f"the process that reads device {self.name!r} is damaged ({error}); it was started again"
        self._give_up(run)

    def _look_after(self, run: _Run) -> None:
        """Take note of reports and output of the process; end it if it does not work."""
        for report in run.new_reports():
            if report.state is DeviceState.UNSUITABLE and not self._reported:
                self._leave()
                raise DeviceError(report.message)
            self._reported = True
            if report.state is DeviceState.OPEN:
                self.through_sound_server = not report.hardware
                rule = HARDWARE if report.hardware else SOUND_SERVER
                self._gaps = GapWatch(self.sample_rate_hz, self._block_s, rule)
                self._log_realtime(report.not_realtime)
        run.read_output(self._output)
        verdict = judge(self.name, self._block_s, run.seen(delivered_before=self._delivered))
        if verdict is not None:
            self.problem = verdict.problem
            run.process.wait(0.0)  # it may have published something just before its end
            if verdict.over and not run.process.waiting:
                self._give_up(run)
        elif run.delivers:
            self.problem = self._lag(run)

    def _log_realtime(self, refused: str) -> None:
        """Log once that the device's process competes with other programs for the processor."""
        if refused and not self._realtime_logged:
            self._realtime_logged = True
            _log.info(
                "the process that reads device %r was refused %s; a busy machine may lose sound. "
                "deploy/livessl-node@.service grants both (LimitRTPRIO, LimitMEMLOCK)",
                self.name,
                refused,
            )

    def _lag(self, run: _Run) -> str | None:
        """Return a problem while blocks were lost lately because this process did not read them in time."""
        self._count_overruns(run)
        now_ns = self._clock.monotonic_ns()
        if self._lag_ns is None or now_ns - self._lag_ns > LAG_SHOWN_NS:
            return None
        return (
            f"this machine lags: {self.overruns} blocks of device {self.name!r} were lost because the node did not "
            "read them in time; stop other programs"
        )

    def _count_overruns(self, run: _Run) -> None:
        self.lost_blocks += run.new_flagged()
        lost = run.new_overruns()
        self.lost_blocks += lost
        if lost:
            self.overruns += lost
            self._lag_ns = self._clock.monotonic_ns()
            _log.warning("%d blocks of device %r were lost: this node did not read them in time", lost, self.name)

    def _give_up(self, run: _Run) -> None:
        self._failures = 0 if run.report is not None else self._failures + 1
        self.interruptions += run.delivers
        self._end(kill=True)

    def _leave(self) -> None:
        self._entered = False
        self._end(kill=True)

    def _begin(self) -> None:
        self._start_ns = self._clock.monotonic_ns()
        self.starts += 1
        self._base_index = self._handed_index
        try:
            self._run = _Run(self._start(self._wanted), self._clock)
        except OSError as error:
            self._failures += 1
            self.problem = (
                f"the process that reads device {self.name!r} cannot be started: {error.strerror}; trying again"
            )

    def _wait_to_begin(self) -> None:
        """Start the process again as soon as `RESTART_S` has passed since its last start, and the former has ended.

        A process that the kernel holds in a driver keeps the device busy, although it was killed.
        """
        interval_s = min(MAX_RESTART_S, RESTART_S * 2.0**self._failures)
        missing_ns = self._start_ns + round(interval_s * 1e9) - self._clock.monotonic_ns()
        if self._former is not None and self._former.exit_code is None:
            missing_ns = max(missing_ns, HELD_NS)
            self.problem = (
                f"device {self.name!r} is held by this node's former process (process {self._former.pid}), which was "
                "killed and does not end, because the kernel waits for the driver; unplug the interface, or restart "
                "the machine; waiting for it"
            )
        if missing_ns > 0:
            self._clock.sleep_until_ns(self._clock.now_ns() + missing_ns)
        else:
            self._begin()

    def _end(self, *, kill: bool) -> None:
        run, self._run = self._run, None
        if run is not None:
            self._count_overruns(run)
            self._output.feed(run.process.end(kill=kill), self._clock.monotonic_ns())
            self._former = run.process
            self._lost = self._lost or self._delivered


class _Run:
    """One run of the process, and what the node sees of it."""

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
        """Wait for something new. Time in which this process did not run is not counted as the other's."""
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
        """Return the number of blocks that the ring had no room for since the last call."""
        before, self._overruns = self._overruns, self.process.overruns
        return self._overruns - before

    def new_flagged(self) -> int:
        """Return the number of blocks that the driver flagged since the last call."""
        before, self._counted_flagged = self._counted_flagged, self.process.flagged
        return self._counted_flagged - before

    def read_output(self, output: NativeOutput) -> None:
        """Read a limited amount of what native libraries print."""
        now_ns = self._clock.monotonic_ns()
        if now_ns - self._output_ns < OUTPUT_S * 1e9:
            return
        self._output_ns = now_ns
        printed = self.process.output()
        output.feed(printed, now_ns)
        self._floods = self._floods + 1 if len(printed) >= FLOOD_BYTES else 0

    def seen(self, *, delivered_before: bool) -> Seen:
        """Return what the node sees of the process."""
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


def wanted_device(config: SoundDeviceConfig, channels: int) -> Wanted:
    """Return what the process that owns the device is told of it."""
    block_samples = max(1, round(config.block_s * config.sample_rate_hz))
    slots = max(2, math.ceil(QUEUE_S * config.sample_rate_hz / block_samples)) + 1
    return Wanted(
        name=config.name,
        channels=channels,
        sample_rate_hz=config.sample_rate_hz,
        block_samples=block_samples,
        latency_s=config.latency_s,
        slots=slots,
        serial=config.serial,
        usb_port=config.usb_port,
    )
