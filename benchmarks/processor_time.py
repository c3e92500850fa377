"""Processor time and memory of processes, as Linux counts them."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path


def processor_s(root: int) -> float:
    """Return the processor time so far, in seconds, of a process and of all that it has started.

    Those that have ended count once their parent has taken note of that.
    """
    parents, times = {}, {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            fields = (folder / "stat").read_text(encoding="utf-8").rpartition(")")[2].split()
        except OSError:  # it has just ended
            continue
        parents[int(folder.name)] = int(fields[1])
        times[int(folder.name)] = sum(int(field) for field in fields[11:15]) / os.sysconf("SC_CLK_TCK")
    family, more = set(), {root}
    while more:
        family |= more
        more = {process for process, parent in parents.items() if parent in more} - family
    return sum(times.get(process, 0.0) for process in family)


def running_ns(root: int) -> dict[int, int]:
    """Return the processor time so far, in nanoseconds, of a process and of its children, each by its process id.

    It is counted to the nanosecond, so that the cost of a single request can be measured, unlike by `processor_s`.
    """
    children = Path(f"/proc/{root}/task/{root}/children").read_text(encoding="utf-8").split()
    found = {}
    for pid in (root, *map(int, children)):
        found[pid] = 0
        for task in Path(f"/proc/{pid}/task").glob("*/schedstat"):
            with suppress(OSError):  # it has just ended
                found[pid] += int(task.read_text(encoding="utf-8").split()[0])
    return found


def memory_mb(process: int, field: str = "VmRSS") -> float:
    """Return the memory of a process now, or with `VmHWM` the most that it has had, in MB."""
    status = Path(f"/proc/{process}/status").read_text(encoding="utf-8")
    return next(int(line.split()[1]) / 1000 for line in status.splitlines() if line.startswith(f"{field}:"))
