"""Delivers the blocks of an audio interface from a process of its own, which it kills and restarts when it hangs.

How long it waits before a restart is decided here; that a device hangs is decided in `device_watch`.

PortAudio's thread may loop or print endlessly, or hang, when a device is unplugged, and nothing within the
same process can stop it. The node therefore never loads the library (see `device_main`).
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from types import TracebackType
from typing import Final

import numpy as np

from livessl.capture.device_process import DamageError, DeviceProcess
from livessl.capture.device_report import DeviceState, Wanted
from livessl.capture.device_run import DeviceRun
from livessl.capture.device_watch import judge
from livessl.capture.loss_count import LossCount
from livessl.capture.native_output import NativeOutput
from livessl.clock import Clock
from livessl.core.types import Block
from livessl.errors import DeviceError
from livessl.site.node_models import SoundDeviceConfig

FIRST_REPORT_S: Final = 2.0
"""Longest wait, in seconds, for the first report when the device is opened."""

RESTART_S: Final = 1.0
"""Shortest interval between two starts of the process, in seconds; it doubles, up to `MAX_RESTART_S`, while the process
ends before its first report."""

MAX_RESTART_S: Final = 8.0

QUEUE_S: Final = 2.0
"""Length of the sound that the ring holds, in seconds: far longer than any pause of a working caller."""

HELD_NS: Final = 50_000_000
"""Interval, in nanoseconds, at which it is checked whether a killed process has ended."""

_log = logging.getLogger(__name__)


class SoundDevice:
    """An audio interface, found by name; a context manager that opens it and an iterator of its blocks.

    Each step waits at most 0.25 s and then yields a block without samples. If the device is absent or disappears, the
    iterator yields empty blocks and sets `problem`; the device is opened as soon as it is available. The first block
    after that has `overflow` set, and sample indices continue.

    Parameters
    ----------
    config : SoundDeviceConfig
        Name, rate, block length and latency.
    channels : int
        Number of channels to record: the highest channel that any array uses.
    clock : Clock
        Clock for deadlines and for the stamps of empty blocks.
    start : callable
        Starts the process that owns the device.

    Attributes
    ----------
    name : str
        Name of the device in the site file.
    sample_rate_hz : float
        Nominal sampling rate, Hz.
    channels : int
        Channels of each block.
    problem : str or None
        The present problem in words; None without a problem.
    losses : LossCount
        The blocks that were lost because this machine did not keep up, by kind.
    starts : int
        Number of times that the process was started.
    through_sound_server : bool
        Whether its samples come through a sound server or plug-in, as far as it is known.
    interruptions : int
        Number of times that a device which had delivered blocks was opened again, because it was unplugged, stopped or
        failed.
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
        self.losses = LossCount(config.name, config.sample_rate_hz, config.block_s, clock)
        self.starts = 0
        self.interruptions = 0
        self.through_sound_server = False
        self._block_s = config.block_s
        self._wanted = wanted_device(config, channels)
        self._clock = clock
        self._start = start
        self._output = NativeOutput()
        self._run: DeviceRun | None = None
        self._former: DeviceProcess | None = None
        self._failures = 0
        self._start_ns = clock.monotonic_ns()
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
    def lost_blocks(self) -> int:
        """Blocks that were lost since the start because this machine did not keep up."""
        return self.losses.lost_blocks

    @property
    def has_cause(self) -> bool:
        """True once the device's process has reported, or has failed; `problem` then names the cause of silence."""
        return self._reported or self.starts > 1

    def _handed(self, block: Block) -> Block:
        """Return a block of the process as one of the device: indices continue after a restart, gaps are flagged."""
        first_index = self._base_index + block.first_index
        handed = Block(first_index, block.samples, block.stamp_ns, block.overflow or self._lost)
        if self.losses.is_after_gap(handed):
            handed = replace(handed, overflow=True)
        self._lost, self._delivered, self._failures = False, True, 0
        self._handed_index = first_index + block.samples.shape[1]
        return handed

    def _step(self, run: DeviceRun) -> Block | None:
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

    def _damaged(self, run: DeviceRun, error: DamageError) -> None:
        self.problem = f"the process that reads device {self.name!r} is damaged ({error}); it was started again"
        self._give_up(run)

    def _look_after(self, run: DeviceRun) -> None:
        """Read the reports and the output of the process; end the process if it does not work."""
        for report in run.new_reports():
            if report.state is DeviceState.UNSUITABLE and not self._reported:
                self._leave()
                raise DeviceError(report.message)
            self._reported = True
            if report.state is DeviceState.OPEN:
                self.through_sound_server = not report.hardware
                self.losses.begin(hardware=report.hardware)
                self._log_realtime(report.not_realtime)
        run.read_output(self._output)
        verdict = judge(self.name, self._block_s, run.seen(delivered_before=self._delivered))
        if verdict is not None:
            self.problem = verdict.problem
            run.process.wait(0.0)  # it may have published something just before its end
            if verdict.over and not run.process.waiting:
                self._give_up(run)
        elif run.delivers:
            self.losses.add(run.new_flagged(), run.new_overruns())
            self.problem = self.losses.problem

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

    def _give_up(self, run: DeviceRun) -> None:
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
            self._run = DeviceRun(self._start(self._wanted), self._clock)
        except OSError as error:
            self._failures += 1
            self.problem = (
                f"the process that reads device {self.name!r} cannot be started: {error.strerror}; trying again"
            )

    def _wait_to_begin(self) -> None:
        """Start the process again when `RESTART_S` has passed since its last start, and the former process has ended.

        A killed process that still hangs in a driver of the kernel keeps the device busy.
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
            self.losses.add(run.new_flagged(), run.new_overruns())
            self._output.feed(run.process.end(kill=kill), self._clock.monotonic_ns())
            self._former = run.process
            self._lost = self._lost or self._delivered


def wanted_device(config: SoundDeviceConfig, channels: int) -> Wanted:
    """Return the settings for the process that owns the device."""
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
