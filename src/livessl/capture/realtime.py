"""Requests real-time priority and locked memory for the process that owns a device, where the system permits it."""

from __future__ import annotations

import ctypes
import os
import resource
from typing import Final

PRIORITY: Final = 10
"""Real-time priority, above all ordinary programs and below the kernel's interrupt threads, which have 50."""

LONGEST_S: Final = 1
"""Longest processor time, in seconds, of a real-time thread without a blocking call (RLIMIT_RTTIME). The kernel ends a
process that takes more, so a library that loops cannot take the machine."""

_LOCK_CURRENT, _LOCK_FUTURE, _LOCK_ON_FAULT = 1, 2, 4
"""Flags of mlockall. Pages are locked when they are first used, so locking takes no memory."""


def request_realtime() -> str:
    """Request real-time scheduling for this thread and those that it starts, and lock the memory.

    Memory is locked only if there is no limit for it, because under a limit later allocations would fail.

    Returns
    -------
    str
        Why it was refused; empty if it was granted.
    """
    try:
        resource.setrlimit(resource.RLIMIT_RTTIME, _limits_us())
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(PRIORITY))
    except (OSError, ValueError) as error:
        return f"real-time scheduling: {getattr(error, 'strerror', None) or error}"
    if resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] != resource.RLIM_INFINITY:
        return "locked memory: its size is limited"
    library = ctypes.CDLL(None, use_errno=True)
    if library.mlockall(_LOCK_CURRENT | _LOCK_FUTURE | _LOCK_ON_FAULT) != 0:
        return f"locked memory: {os.strerror(ctypes.get_errno())}"
    return ""


def _limits_us() -> tuple[int, int]:
    """Return the soft and the hard limit of processor time, in microseconds, within what the system permits."""
    _, most = resource.getrlimit(resource.RLIMIT_RTTIME)
    soft, hard = LONGEST_S * 1_000_000, 2 * LONGEST_S * 1_000_000  # beyond the hard limit the kernel kills at once
    return (soft, hard) if most == resource.RLIM_INFINITY else (min(soft, most), min(hard, most))
