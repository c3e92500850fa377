"""Decides when a device hangs, stalls or floods the log, and words that problem. It reads no clock.

The time limits are here; `sound_device` restarts the device's process, and `portaudio` words why a device does not
open.
"""

from __future__ import annotations

import signal
from dataclasses import dataclass
from typing import Final

from livessl.capture.device_report import DeviceState, Report
from livessl.capture.realtime import LONGEST_S

START_NOTICE_S: Final = 1.5
"""Time, in seconds, without a first report after which the problem mentions that there is none."""

START_S: Final = 15.0
"""Time, in seconds, that the process may take until its first report; slow machines load the library for seconds."""

STALLED_S: Final = 1.0
"""Time, in seconds, without a block after which a stream that has delivered before counts as stalled."""

FIRST_BLOCK_S: Final = 1.5
"""Time, in seconds, within which an opened device must deliver its first block."""

FIRST_BLOCK_OF_SERVER_S: Final = 4.0
"""Time, in seconds, within which an opened sound server must deliver its first block; it may take 2 s to begin."""

HUNG_S: Final = 2.0
"""Time, in seconds, without a sign of life after which a process with an open stream is killed."""

SCAN_S: Final = 5.0
"""Time, in seconds, without a sign of life after which a process that searches for the device is killed. A scan of all
devices gives no sign of life and may take a second."""

LAGGING_S: Final = 5.0
"""Time, in seconds, without a block after which a stream counts as stalled even if the machine is too busy to run
it."""

FLOODS: Final = 3
"""Number of consecutive intervals with a flood of native output after which the library counts as looping."""

BEATS_PER_S: Final = 10
"""Number of signs of life per second of a process that the machine lets run."""


@dataclass(frozen=True, slots=True)
class Seen:
    """Observations of the process by the node.

    Parameters
    ----------
    report : Report or None
        Last report of the process.
    delivered : bool
        Whether this run has delivered a block.
    delivered_before : bool
        Whether an earlier run has delivered a block.
    idle_s : float
        Time since the last block, or since the last report if it is later, in seconds.
    beats : int
        Number of signs of life in the idle time.
    silent_s : float
        Time since the last sign of life, in seconds.
    flagged : int
        Number of blocks in the idle time that were dropped because the driver flagged a loss in them.
    unflagged_s : float
        Time since the last flagged block, in seconds.
    floods : int
        Number of consecutive intervals with a flood of output.
    exit_code : int or None
        Exit code of the process; None while it runs.
    """

    report: Report | None
    delivered: bool = False
    delivered_before: bool = False
    idle_s: float = 0.0
    beats: int = 0
    silent_s: float = 0.0
    flagged: int = 0
    unflagged_s: float = 0.0
    floods: int = 0
    exit_code: int | None = None


@dataclass(frozen=True, slots=True)
class Verdict:
    """A problem of the device.

    Parameters
    ----------
    problem : str
        The problem in words.
    over : bool
        Whether the process has to be ended and started again.
    """

    problem: str
    over: bool = False


def judge(name: str, block_s: float, seen: Seen) -> Verdict | None:
    """Return the problem of a device; None if there is none.

    Parameters
    ----------
    name : str
        Name of the device.
    block_s : float
        Length of a block, in seconds.
    seen : Seen
    """
    state = None if seen.report is None else seen.report.state
    if seen.exit_code is not None:
        return Verdict(_ended(name, state, seen.exit_code), over=True)
    if seen.floods >= FLOODS:
        return Verdict(f"the sound library of device {name!r} prints without end; it was started again", over=True)
    if seen.report is None:
        if seen.silent_s >= START_S:
            return Verdict(f"the sound library of device {name!r} does not start; it was started again", over=True)
        if seen.silent_s >= START_NOTICE_S:
            return Verdict(f"the sound library has not opened device {name!r} yet; waiting for it")
        return None
    if state is DeviceState.STOPPED:
        return Verdict(_ended(name, state, 0), over=True)
    if state is DeviceState.OPEN:
        return _judge_stream(name, block_s, seen, is_hardware=seen.report.hardware)
    if seen.silent_s >= SCAN_S:
        return Verdict(f"the sound library of device {name!r} hangs; it was started again", over=True)
    if state is DeviceState.ABSENT and (seen.delivered or seen.delivered_before):
        return Verdict(f"device {name!r} was unplugged; waiting for it")
    return Verdict(seen.report.message)


def _judge_stream(name: str, block_s: float, seen: Seen, *, is_hardware: bool) -> Verdict | None:
    """Return the problem of an open stream."""
    first_s = FIRST_BLOCK_S if is_hardware else FIRST_BLOCK_OF_SERVER_S
    if seen.idle_s < block_s + (STALLED_S if seen.delivered else first_s):
        return None
    if seen.flagged and seen.unflagged_s < STALLED_S:
        return Verdict(
            f"device {name!r} loses sound in every block: this machine is too busy; stop other programs, or set "
            "device.latency_s to a longer time"
        )
    if 2 * seen.beats >= BEATS_PER_S * seen.idle_s:
        what = "stopped delivering sound" if seen.delivered else "is open but delivers no sound"
        return Verdict(f"device {name!r} {what}; opening it again", over=True)
    if seen.silent_s >= HUNG_S:
        return Verdict(f"the sound library of device {name!r} hangs; it was started again", over=True)
    return Verdict(
        f"this machine lags: the process that reads device {name!r} got only {seen.beats} of "
        f"{BEATS_PER_S * seen.idle_s:.0f} turns in {seen.idle_s:.1f} s; stop other programs",
        over=seen.idle_s >= LAGGING_S,
    )


def _ended(name: str, state: DeviceState | None, exit_code: int) -> str:
    if state is DeviceState.STOPPED:
        return f"device {name!r} has stopped; was it unplugged? Waiting for it"
    if exit_code == -signal.SIGXCPU:
        return (
            f"the sound library of device {name!r} ran for {LONGEST_S} s without a pause, so the kernel ended its "
            "process before it could take the machine; it was started again"
        )
    how = f"by signal {-exit_code}" if exit_code < 0 else f"with code {exit_code}"
    return f"the process that reads device {name!r} ended {how}; it was started again"
