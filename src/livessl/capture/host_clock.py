"""Finds out whether this machine's clock is synchronized and how large its error is: chrony, timesyncd or kernel.

On Linux, the kernel always has a state of its clock. Programs for PTP set it as well, so it also covers clocks that are
synchronized by PTP.
"""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Final

COMMAND_S: Final = 3.0
"""Longest wait for an answer of a time service, in seconds."""

_UNSYNC: Final = 0x0040
"""Status bit of adjtimex for a clock that is not synchronized."""

_ERROR: Final = 5
"""Result of adjtimex for a clock that is not synchronized."""

_CHRONY_FIELDS: Final = 14
"""Number of fields that `chronyc -c tracking` prints."""

_CHRONY_UNSYNC: Final = ("Not synchronised", "Not synchronized")
"""Last field for a clock that is not synchronized, in the spellings of different versions."""

Command = Callable[[tuple[str, ...]], str | None]
"""A function that runs a program and returns its output; None if the program is not installed or fails."""


@dataclass(frozen=True, slots=True)
class HostClock:
    """State of the machine's clock.

    Parameters
    ----------
    synchronized, service, reference, error_s
        As in `HostState`.
    """

    synchronized: bool | None = None
    service: str = ""
    reference: str = ""
    error_s: float | None = None


class _Timex(ctypes.Structure):
    """`struct timex` of Linux."""

    _fields_ = (
        ("modes", ctypes.c_uint),
        ("offset", ctypes.c_long),
        ("freq", ctypes.c_long),
        ("maxerror", ctypes.c_long),
        ("esterror", ctypes.c_long),
        ("status", ctypes.c_int),
        ("constant", ctypes.c_long),
        ("precision", ctypes.c_long),
        ("tolerance", ctypes.c_long),
        ("time", ctypes.c_long * 2),
        ("tick", ctypes.c_long),
        ("ppsfreq", ctypes.c_long),
        ("jitter", ctypes.c_long),
        ("shift", ctypes.c_int),
        ("stabil", ctypes.c_long),
        ("jitcnt", ctypes.c_long),
        ("calcnt", ctypes.c_long),
        ("errcnt", ctypes.c_long),
        ("stbcnt", ctypes.c_long),
        ("tai", ctypes.c_int),
        ("reserved", ctypes.c_int * 11),
    )


def read_host_clock(run: Command | None = None, kernel: Callable[[], HostClock] | None = None) -> HostClock:
    """Return the state of this machine's clock from the best source that is available.

    Parameters
    ----------
    run : callable or None
        Runs the programs of time services; None runs the real ones.
    kernel : callable or None
        Returns the kernel's state of the clock; None for the real one.
    """
    run = run_command if run is None else run
    tracking = run(("chronyc", "-n", "-c", "tracking"))
    clock = None if tracking is None else from_chrony(tracking)
    if clock is not None:
        return clock
    of_kernel = (kernel_clock if kernel is None else kernel)()
    shown = run(("timedatectl", "show-timesync"))
    server = None if shown is None else _properties(shown).get("ServerName")
    return replace(of_kernel, service="systemd-timesyncd", reference=server) if server else of_kernel


def kernel_clock() -> HostClock:
    """Return the kernel's state of its clock; all fields are unknown on a system that is not Linux."""
    try:
        adjtimex = ctypes.CDLL(None, use_errno=True).adjtimex
    except (OSError, AttributeError):
        return HostClock()
    timex = _Timex()
    result = adjtimex(ctypes.byref(timex))
    return HostClock() if result < 0 else from_kernel(result, timex.status, timex.maxerror)


def from_kernel(result: int, status: int, maxerror_us: int) -> HostClock:
    """Return the state of the clock from the result of adjtimex, its status, and its greatest error in microseconds."""
    synchronized = result != _ERROR and not status & _UNSYNC
    return HostClock(synchronized, "kernel", error_s=maxerror_us / 1e6 if synchronized else None)


def from_chrony(tracking: str) -> HostClock | None:
    """Return the state of the clock from the output of `chronyc -c tracking`; None if the output cannot be read.

    The error is the sum of the present correction, half the delay to the reference clock, and its dispersion, as in RFC
    5905.
    """
    fields = tracking.strip().split(",")
    if len(fields) < _CHRONY_FIELDS:
        return None
    try:
        offset_s, delay_s, dispersion_s = (float(fields[index]) for index in (4, 10, 11))
        stratum = int(fields[2])
    except ValueError:
        return None
    synchronized = stratum > 0 and fields[13] not in _CHRONY_UNSYNC
    error_s = abs(offset_s) + delay_s / 2.0 + dispersion_s
    reference = fields[1] or fields[0]
    return HostClock(synchronized, "chrony", reference if synchronized else "", error_s if synchronized else None)


def run_command(command: tuple[str, ...]) -> str | None:
    """Run a program and return its output; None if it is not installed, fails, or takes longer than `COMMAND_S`."""
    program = shutil.which(command[0])
    if program is None:
        return None
    try:
        done = subprocess.run(  # noqa: S603  # fixed commands
            [program, *command[1:]], capture_output=True, timeout=COMMAND_S, check=True, stdin=subprocess.DEVNULL
        )
    except (subprocess.SubprocessError, OSError):
        return None
    return done.stdout.decode("utf-8", "replace")


def _properties(text: str) -> Mapping[str, str]:
    """Return the values of the lines KEY=VALUE of a text, by key."""
    return dict(line.split("=", 1) for line in text.splitlines() if "=" in line)
