"""`livessl bench --live`: a server under many arrays and clients; its losses, latency, processor time and memory."""

from __future__ import annotations

import json
import multiprocessing
import os
import subprocess
import tempfile
import urllib.request
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final

import numpy as np

from livessl.clock import Clock
from livessl.lab import processes
from livessl.lab.bench import load
from livessl.lab.bench.listeners import Received, listen
from livessl.lab.processes import NotStartedError
from livessl.server.api.encode import JsonObject
from livessl.server.compiling import COMPILE
from livessl.site.load import parse_site

READY_NS: Final = 120_000_000_000
"""Longest time, in nanoseconds, until a server has computed its tables and receives every array."""

SETTLE_NS: Final = 8_000_000_000
"""Time, in nanoseconds, that a ready server gets to work off the backlog of its start."""

SAMPLE_NS: Final = 1_000_000_000
"""Time, in nanoseconds, between two readings of processor time and memory."""

PERCENTILES: Final = (50, 95, 99, 100)
LOST: Final = ("late", "rejected", "lost_frames", "sequence_gaps")
"""An array's counters of frames that were late or lost."""

Serve = Callable[[Path], Any]
"""Starts a server with a site file, as a process."""


@dataclass(frozen=True, slots=True)
class Demand:
    """The load on a server.

    Parameters
    ----------
    arrays, clients, watchers : int
        Numbers of arrays that send sound, of subscribers to events and updates, and of watchers of the fused map.
    seconds : float
        Measured time, after a warm-up.
    spacing_m : float
        Spacing of the grid that is searched.
    rt60_s : float
        Reverberation time of the simulated room; 0 is anechoic.
    spin : bool
        Whether a foreign process keeps each core busy meanwhile.
    """

    arrays: int
    clients: int
    seconds: float
    watchers: int = 0
    spacing_m: float = 0.1
    rt60_s: float = 0.3
    spin: bool = False


@dataclass(frozen=True, slots=True)
class Outcome:
    """The measurement of a server under load.

    Parameters
    ----------
    demand : Demand
    cores : int
        Cores of the machine, shared by server, load and clients.
    frames_sent, frames_dropped : int
        Frames that the load sent from the beginning on, and those of them that never reached the server.
    frames_received : int
        Frames that the server counted.
    lost : dict of str to int
        In the measured time: the server's counters of frames without use, and messages that clients missed.
    updates_due, updates : int, float
        Updates that were due in the measured time, and how many a client received on average.
    events : float
        Mean number of events that a client received, from the warm-up on.
    latency_ms : dict of str to float
        Time from the end of a window to a client, percentiles over all updates and clients.
    stages_ms : dict of str to dict of str to float
        Percentiles of each stage, and of `load`: how late the load itself was; the stage `sent` includes it.
    pictures : int
        Number of maps that all watchers received.
    cpu_percent : float
        Mean use of the server over the measured time, in percent of one core.
    rss_mb : tuple of float
        Resident memory of the server at the beginning of the measured time, at its end, and at most, in megabytes.
    shed : dict of str to int
        What the server shed in the measured time: `updates`, and `frames` whose sound was not used; and `level`, that
        of shedding at the end.
    """

    demand: Demand
    cores: int
    frames_sent: int
    frames_dropped: int
    frames_received: int
    lost: dict[str, int]
    updates_due: int
    updates: float
    events: float
    latency_ms: dict[str, float]
    stages_ms: dict[str, dict[str, float]]
    pictures: int
    cpu_percent: float
    rss_mb: tuple[float, float, float]
    shed: dict[str, int]

    @property
    def nothing_dropped(self) -> bool:
        """True if every frame was used and every client received every message."""
        lost = self.frames_dropped or any(self.lost.values()) or any(self.shed.values())
        return not lost and self.updates >= self.updates_due

    def json(self) -> JsonObject:
        """Return the outcome as an object for JSON."""
        return {**asdict(self), "nothing_dropped": self.nothing_dropped}


def serve(site_file: Path) -> Any:
    """Start the server by its command, with kernels that are compiled: otherwise those on NumPy would be measured."""
    subprocess.run(COMPILE, check=True)  # noqa: S603 - this package
    return processes.start("serve", "--site", str(site_file))


def measure(
    demand: Demand, clock: Clock, *, start: Serve = serve, progress: Callable[[int, int], None] | None = None
) -> Outcome:
    """Run a server under load and measure what its clients receive.

    Raises
    ------
    NotStartedError
        If the server does not start, or does not receive all arrays.
    """
    endpoint = f"tcp://127.0.0.1:{processes.free_port()}"
    text = load.site_text(demand.arrays, demand.spacing_m, endpoint, port := processes.free_port())
    url, site = f"http://127.0.0.1:{port}", parse_site(text)
    with ExitStack() as running:
        directory = Path(running.enter_context(tempfile.TemporaryDirectory(prefix="livessl-bench-")))
        (directory / "site.yaml").write_text(text, encoding="utf-8")
        sounding = running.enter_context(_child(load.play, text, endpoint, demand.rt60_s))
        server = start(directory / "site.yaml")
        running.callback(processes.end, [server])
        processes.wait_until_ready(url, [server], clock)
        sounding.recv()
        if demand.spin:
            for _ in range(os.cpu_count() or 1):
                running.enter_context(_child(_spin))
        sounding.send("begin")
        _wait_until_all_are_received(url, clock)
        listening = running.enter_context(_child(listen, url, demand.clients, demand.watchers))
        listening.recv()
        from_ns = clock.now_ns() + SETTLE_NS
        until_ns = from_ns + round(demand.seconds * 1e9)
        listening.send((from_ns, until_ns))
        while not clock.sleep_until_ns(from_ns):
            pass
        before, load_before = _counters(url), _load(url)
        usage = list(_sampled(server.pid, from_ns, until_ns, clock, progress))
        received: Received = listening.recv()
        load_after = _load(url)
        sounding.send("end")
        report: load.Report = sounding.recv()
        after = _final_counters(url, report.sent - report.dropped, clock)
    due = len(load.windows_ns(site, from_ns, until_ns))
    lost = {name: after[name] - before[name] for name in LOST}
    shed = {
        "updates": load_after["updates_shed"] - load_before["updates_shed"],
        "frames": after["shed"] - before["shed"],
        "level": load_after["level"],
    }
    return _outcome(demand, report, after["frames"], lost, received, usage, due, shed)


def _final_counters(url: str, frames: int, clock: Clock) -> dict[str, int]:
    """Return the counters once the server has processed that many frames, or has had `SETTLE_NS` for it."""
    deadline_ns = clock.monotonic_ns() + SETTLE_NS
    while (counters := _counters(url))["frames"] < frames and clock.monotonic_ns() < deadline_ns:
        clock.sleep_until_ns(clock.now_ns() + processes.POLL_NS)
    return counters


def table(outcome: Outcome) -> str:
    """Return the outcome as a table."""
    demand, lost = outcome.demand, {name: count for name, count in outcome.lost.items() if count}
    names = [f"p{p}" if p < 100 else "max" for p in PERCENTILES]
    lines = [
        f"{demand.arrays} arrays, {demand.clients} clients, {demand.watchers} watching the map, "
        f"{demand.seconds:g} s, grid {demand.spacing_m:g} m, {outcome.cores} cores"
        + (", a foreign process spinning on each" if demand.spin else ""),
        f"frames     {outcome.frames_sent} sent, {outcome.frames_received} received, {outcome.frames_dropped} dropped"
        + "".join(f", {count} {name}" for name, count in lost.items()),
        *([f"shed       {shed}"] if (shed := _words(outcome.shed)) else []),
        f"updates    {outcome.updates:.1f} of {outcome.updates_due} per client; {outcome.events:g} events",
        f"server     {outcome.cpu_percent:.0f} % of a core; "
        "{:.0f} MB resident at the beginning, {:.0f} at the end, {:.0f} at most".format(*outcome.rss_mb),
        f"latency from the end of a window, ms {''.join(f'{name:>9}' for name in names)}",
        *(
            f"  {stage:<35}{''.join(f'{values[name]:9.1f}' for name in names)}"
            for stage, values in {**outcome.stages_ms, "capture to client": outcome.latency_ms}.items()
        ),
        "nothing was dropped" if outcome.nothing_dropped else "the load is more than the machine can carry",
    ]
    return "\n".join(lines)


def _words(shed: dict[str, int]) -> str:
    """Return what was shed as text; empty if nothing was."""
    each = [f"{shed['updates']} updates", f"the sound of {shed['frames']} frames", f"level {shed['level']} at the end"]
    return ", ".join(each) if any(shed.values()) else ""


def _outcome(
    demand: Demand,
    report: load.Report,
    frames_received: int,
    lost: dict[str, int],
    received: Received,
    usage: Sequence[tuple[int, float, float]],
    due: int,
    shed: dict[str, int],
) -> Outcome:
    (first_ns, first_s, first_mb), *_, (last_ns, last_s, last_mb) = usage
    stages = {"load": report.lateness_s, **received.stages_s}
    return Outcome(
        demand=demand,
        cores=os.cpu_count() or 1,
        frames_sent=report.sent,
        frames_dropped=report.dropped,
        frames_received=frames_received,
        lost={**lost, "missed": received.gaps},
        updates_due=due,
        updates=received.updates / max(1, demand.clients),
        events=received.events / max(1, demand.clients),
        latency_ms=_percentiles_ms(received.latencies_s),
        stages_ms={name: _percentiles_ms(values) for name, values in stages.items()},
        pictures=received.pictures,
        cpu_percent=100.0 * (last_s - first_s) / ((last_ns - first_ns) / 1e9),
        rss_mb=(first_mb, last_mb, max(mb for _, _, mb in usage)),
        shed=shed,
    )


def _percentiles_ms(values_s: Sequence[float]) -> dict[str, float]:
    values = np.percentile(values_s, PERCENTILES) if len(values_s) else np.full(len(PERCENTILES), np.nan)
    return {f"p{p}" if p < 100 else "max": round(1e3 * float(v), 2) for p, v in zip(PERCENTILES, values, strict=True)}


def _sampled(
    pid: int, from_ns: int, until_ns: int, clock: Clock, progress: Callable[[int, int], None] | None
) -> Iterator[tuple[int, float, float]]:
    """Yield (time in ns, processor time in s, resident memory in MB) in regular steps over the measured time."""
    steps = max(1, round((until_ns - from_ns) / SAMPLE_NS))
    for step in range(steps + 1):
        while not clock.sleep_until_ns(from_ns + step * (until_ns - from_ns) // steps):
            pass
        yield clock.monotonic_ns(), *_usage(pid)
        if progress is not None:
            progress(step, steps)


def _wait_until_all_are_received(url: str, clock: Clock) -> None:
    deadline_ns = clock.monotonic_ns() + READY_NS
    while any(array["state"] != "healthy" for array in _arrays(url)):
        if clock.monotonic_ns() > deadline_ns:
            raise NotStartedError(f"the server did not receive every array within {READY_NS / 1e9:.0f} s")
        clock.sleep_until_ns(clock.now_ns() + processes.POLL_NS)


def _usage(pid: int) -> tuple[float, float]:
    """Return a process's processor time in seconds and resident memory in megabytes, from /proc (see proc(5))."""
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    resident = int(Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1])
    ticks = int(fields[11]) + int(fields[12])
    return ticks / os.sysconf("SC_CLK_TCK"), resident * os.sysconf("SC_PAGE_SIZE") / 1e6


@contextmanager
def _child(work: Callable[..., None], *arguments: Any) -> Iterator[Connection]:
    """Run `work(*arguments, connection)` in a process that ends with the context; yield our end of the connection."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=work, args=(*arguments, theirs), daemon=True)
    process.start()
    theirs.close()
    try:
        yield ours
    finally:
        process.join(timeout=1.0)
        if process.is_alive():
            process.terminate()
            process.join()
        process.close()
        ours.close()


def _spin(parent: Connection) -> None:
    """Keep a core busy until the parent sends something or ends."""
    while not parent.poll():
        for _ in range(100_000):
            pass


def _counters(url: str) -> dict[str, int]:
    """Return the sums of the arrays' counters."""
    total: Counter[str] = Counter()
    for array in _arrays(url):
        total.update(array["counters"])
    return total


def _load(url: str) -> JsonObject:
    """Return the figures of the server's load."""
    with urllib.request.urlopen(f"{url}/api/v1/health", timeout=60.0) as response:  # noqa: S310 - our own http address
        return dict(json.load(response)["load"])


def _arrays(url: str) -> list[JsonObject]:
    with urllib.request.urlopen(f"{url}/api/v1/arrays", timeout=60.0) as response:  # noqa: S310 - an http address of our own
        return list(json.load(response)["arrays"])
