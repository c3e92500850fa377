"""Faults of an audio interface, made on a virtual one through the installed PortAudio, and what a node costs.

`python benchmarks/interface.py faults --repeats 5` measures how soon a node reports each fault and has sound again,
`losses --minutes 60 --spinning 2` counts lost samples, `resources` measures memory and processor time of a node, and
`stamps` how even the stamps are. The virtual interface is livessl.lab.virtual_interface; it needs gcc and
libasound2-dev. The results are in docs/reliability.md.
"""

from __future__ import annotations

import argparse
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np

sys.path[:0] = [str(Path(__file__).parents[1] / "tests")]

from livessl.capture.device_process import DeviceProcess
from livessl.capture.gap_watch import HARDWARE, SOUND_SERVER, GapRule
from livessl.capture.sound_device import SoundDevice
from livessl.clock import SystemClock
from livessl.core.types import FRAME_NS, Frame, Mark
from livessl.server.receiver import Receiver
from livessl.site.node_models import SoundDeviceConfig
from small_site import Changes, site_of, started, write_site
from sound_server import VirtualCard
from virtual_interface import COUNTED, Interface, Interfaces, counts_of

PATIENCE_S: Final = 60.0


class Node:
    """A node as a process on virtual interfaces, and a server's receiver.

    Parameters
    ----------
    folder : Path
        An empty folder.
    channels : int
        Channels that are recorded: 8 or 18.
    """

    def __init__(self, folder: Path, channels: int = 8) -> None:
        (folder / "cards").mkdir()
        self.interfaces = Interfaces(folder / "cards")
        self.umc = self.interfaces.add(ppm=40.0)
        self._changes: Changes = {"nodes.lab-pc.device.sample_rate_hz": 48000}
        if channels > 8:
            self._changes["nodes.lab-pc.arrays.south"] = [5, 6, 7, channels]
        self.receiver = Receiver(site_of(self._changes), SystemClock())
        self._folder = folder
        self._last_ns = 0

    @contextmanager
    def running(self) -> Iterator[subprocess.Popen[str]]:
        """Run receiver and node until the context ends."""
        self.receiver.start()
        site = write_site(self._folder, {**self._changes, "nodes.lab-pc.server": self.receiver.endpoint})
        command = (sys.executable, "-m", "livessl", "capture", "--site", site, "--node", "lab-pc")
        try:
            with (
                (self._folder / "log").open("w") as log,
                started(*command, env=self.interfaces.environment, stderr=log) as process,
            ):
                self.wait(lambda: self.has_sound_after(1), "sound")
                yield process
        finally:
            self.receiver.stop()

    def has_sound_after(self, time_ns: int) -> bool:
        """Return True if sound from after a time has arrived."""
        for item in self.receiver.take(1000, 0.0):
            if isinstance(item, Frame | Mark):
                self._last_ns = max(self._last_ns, item.frame_index * FRAME_NS)
        return self._last_ns >= time_ns

    def problem(self) -> str:
        """Return what the server knows of a problem; empty if there is none."""
        self.has_sound_after(0)
        return self.receiver.ingest.problem_of("south") or ""

    def wait(self, condition: Callable[[], object], what: str) -> float:
        """Return how many seconds it takes until a condition holds."""
        begun = time.monotonic()
        while not condition():
            if time.monotonic() - begun > PATIENCE_S:
                raise SystemExit(f"waited {PATIENCE_S:g} s in vain: {what}; the problem is {self.problem()!r}")
            time.sleep(0.005)
        return time.monotonic() - begun


Fault = tuple[Callable[[Node], None], str, Callable[[Node], None]]


def _control(word: str) -> Callable[[Node], None]:
    return lambda node: node.umc.control(word)


def _unplug(node: Node) -> None:
    node.interfaces.unplug(node.umc)


def _plug(node: Node) -> None:
    node.interfaces.plug(node.umc)


FAULTS: Final[dict[str, Fault]] = {
    "unplugged, and plugged in again": (_unplug, "was unplugged", _plug),
    "stalls: delivers nothing, without an error": (_control("stall"), "stopped delivering sound", _control("back")),
    "the library's thread hangs in the driver": (_control("loop"), "stopped delivering sound", _control("back")),
}
"""What is done to the interface, words of the message, and how it is undone."""


def fault_times(node: Node, fault: Fault) -> tuple[float, float, float]:
    """Return the seconds until a problem is reported, until it has the right words, and from the return to sound."""
    begin, words, end = fault
    begin(node)
    first_s = node.wait(lambda: node.problem() != "", "a problem")
    right_s = first_s + node.wait(lambda: words in node.problem(), words)
    end(node)
    back_ns = time.time_ns()
    again_s = node.wait(lambda: node.has_sound_after(back_ns), "sound")
    node.wait(lambda: node.problem() == "", "the end of the problem")
    return first_s, right_s, again_s


def busy_times(node: Node) -> tuple[float, float, float]:
    """Return the same for an interface that another program holds when it is plugged in again."""
    _unplug(node)
    node.wait(lambda: "was unplugged" in node.problem(), "a problem")
    with node.umc.held():
        _plug(node)
        right_s = node.wait(lambda: "is busy" in node.problem(), "is busy")
    back_ns = time.time_ns()
    again_s = node.wait(lambda: node.has_sound_after(back_ns), "sound")
    return right_s, right_s, again_s


def faults(repeats: int) -> None:
    """Print how soon each fault is reported, and how soon there is sound again."""
    rows: list[tuple[str, list[tuple[float, float, float]]]] = []
    with tempfile.TemporaryDirectory() as folder:
        node = Node(Path(folder))
        with node.running():
            rows += [(name, [fault_times(node, fault) for _ in range(repeats)]) for name, fault in FAULTS.items()]
            rows.append(("busy when plugged in again", [busy_times(node) for _ in range(repeats)]))
    print("| fault | reported after | with the right words after | sound after its end |")
    print("|---|---|---|---|")
    for name, times in rows:
        print(f"| {name} | " + " | ".join(_spread(column) for column in zip(*times, strict=True)) + " |")
    for name, seconds in endings(repeats).items():
        print(f"{name}: {_spread(seconds)}")
    for name, (seconds, words) in refusals(repeats).items():
        print(f"{name}: {_spread(seconds)}: {words}")


def _spread(seconds: Any) -> str:
    return f"{statistics.median(seconds):.2f} s, at most {max(seconds):.2f}"


def endings(repeats: int) -> dict[str, list[float]]:
    """Return the seconds after which a node has ended."""
    states: dict[str, Callable[[Node], None]] = {
        "ended by SIGTERM while there is sound": _control("back"),
        "ended by SIGTERM while unplugged": _unplug,
        "ended by SIGTERM while the library hangs": _control("loop"),
    }
    times: dict[str, list[float]] = {name: [] for name in (*states, "device's process gone after SIGKILL of the node")}
    for _ in range(repeats):
        for name, begin in states.items():
            with tempfile.TemporaryDirectory() as folder:
                node = Node(Path(folder))
                with node.running() as process:
                    begin(node)
                    process.terminate()
                    times[name].append(node.wait(lambda: process.poll() is not None, "the end"))
        with tempfile.TemporaryDirectory() as folder:
            node = Node(Path(folder))
            with node.running() as process:
                gone = _killed(node, process.pid)
                times["device's process gone after SIGKILL of the node"].append(gone)
    return times


def _killed(node: Node, pid: int) -> float:
    """Kill a node; return the seconds after which its device's process is gone."""
    [child] = _children(pid)
    os.kill(pid, signal.SIGKILL)
    return node.wait(lambda: not _is_alive(child), "the end")


def refusals(repeats: int) -> dict[str, tuple[list[float], str]]:
    """Return the seconds after which a node with an unsuitable interface has ended, and its words."""
    wrong: dict[str, Changes] = {
        "wrong rate": {"nodes.lab-pc.device.sample_rate_hz": 22050},
        "too few channels": {"nodes.lab-pc.arrays.south": [5, 6, 7, 19]},
    }
    done: dict[str, tuple[list[float], str]] = {}
    for name, changes in wrong.items():
        seconds, words = [], ""
        for _ in range(repeats):
            with tempfile.TemporaryDirectory() as folder:
                interfaces = Interfaces(Path(folder))
                interfaces.add()
                site = write_site(Path(folder), changes)
                command = [sys.executable, "-m", "livessl", "capture", "--site", str(site), "--node", "lab-pc"]
                begun = time.monotonic()
                ended = subprocess.run(command, env=interfaces.environment, capture_output=True, text=True, check=False)
                seconds.append(time.monotonic() - begun)
                words = ended.stderr.strip().splitlines()[-1]
                if ended.returncode != 2:
                    raise SystemExit(f"{name}: expected exit code 2, got {ended.returncode}: {ended.stderr}")
        done[name] = (seconds, words)
    return done


def losses(minutes: float, channels: int, rate_hz: int, spinning: int) -> None:
    """Count the samples that an interface delivers and that do not arrive, while other processes spin."""
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        interfaces = Interfaces(Path(folder))
        interface: Interface = interfaces.add(channels=channels, ppm=-60.0)
        for _ in range(spinning):
            stack.enter_context(started(sys.executable, "-c", "while True: pass"))
        device = SoundDevice(
            SoundDeviceConfig(name=interface.name, sample_rate_hz=rate_hz),
            channels,
            SystemClock(),
            lambda wanted: DeviceProcess(wanted, environment=interfaces.environment),
        )
        samples, flagged, unflagged, gaps, expected = 0, 0, 0, 0, None
        end = time.monotonic() + 60.0 * minutes
        for block in stack.enter_context(device):
            if block.samples.shape[1]:
                counts = counts_of(block.samples)[0]
                within = int(((np.diff(counts) - 1) % COUNTED).sum())
                before = 0 if expected is None else int((counts[0] - expected) % COUNTED)
                gaps += block.overflow
                flagged += before if block.overflow else 0
                unflagged += within + (0 if block.overflow else before)
                expected = counts[-1] + 1
                samples += len(counts)
            if time.monotonic() > end:
                break
        print(
            f"{samples} samples of {channels} channels at {rate_hz} Hz, {spinning} processes spinning: "
            f"{flagged} lost in {gaps} gaps that are flagged, {unflagged} lost without a flag, "
            f"{device.losses.overruns} blocks lost between the processes, {device.starts - 1} restarts"
        )
        if unflagged:
            raise SystemExit(1)


def resources(seconds: float) -> None:
    """Print the memory and processor time of a node and of its device's process."""
    print("| channels recorded | process | memory of its own | processor |")
    print("|---|---|---|---|")
    for channels in (8, 18):
        with tempfile.TemporaryDirectory() as folder:
            node = Node(Path(folder), channels)
            with node.running() as process:
                named = {"node": process.pid, "device": _children(process.pid)[0]}
                time.sleep(3.0)
                before = {name: _cpu_s(pid) for name, pid in named.items()}
                begun = time.monotonic()
                while time.monotonic() - begun < seconds:
                    node.has_sound_after(0)
                    time.sleep(0.05)
                for name, pid in named.items():
                    share = (_cpu_s(pid) - before[name]) / (time.monotonic() - begun)
                    print(f"| {channels} | {name} | {_own_mb(pid):.1f} MB | {100 * share:.1f} % |")


def stamps(seconds: float, spinning: int) -> None:
    """Print by how much the earliest stamps of two windows differ, with gaps in neither: see `capture/gap_watch.py`."""
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        for _ in range(spinning):
            stack.enter_context(started(sys.executable, "-c", "while True: pass"))
        interfaces = Interfaces(Path(folder))
        interfaces.add(ppm=100.0)
        with tempfile.TemporaryDirectory() as home:
            card = VirtualCard(Path(home))
            stack.callback(card.close)
            card.plug_in()
            card.play(
                np.random.default_rng(0).normal(0.0, 0.1, (round(2 * seconds + 60) * 48000, 4)).astype(np.float32)
            )
            for name, environment, rule in (
                ("UMC1820", interfaces.environment, HARDWARE),
                ("virtual", card.environment, SOUND_SERVER),
            ):
                rises = _rises(name, environment, seconds, rule)
                print(f"{name}: {max(rises) / 1e6:.2f} ms at most, 99 % below {np.percentile(rises, 99) / 1e6:.2f} ms")


def _rises(name: str, environment: dict[str, str], seconds: float, rule: GapRule) -> list[int]:
    """Return, for each block, the difference of the earliest stamps in ns."""
    config = SoundDeviceConfig(name=name)
    recent, before = round(rule.recent_s / config.block_s), round(rule.before_s / config.block_s)
    late: list[int] = []
    with SoundDevice(config, 4, SystemClock(), lambda wanted: DeviceProcess(wanted, environment=environment)) as device:
        for block in device:
            if block.samples.shape[1]:
                late.append(block.stamp_ns - round(block.first_index / config.sample_rate_hz * 1e9))
            if len(late) * config.block_s >= seconds:
                break
    return [min(late[k : k + recent]) - min(late[k - before : k]) for k in range(before, len(late) - recent)]


def _children(pid: int) -> list[int]:
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def _is_alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def _cpu_s(pid: int) -> float:
    """Return the processor time of a process, in seconds."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _own_mb(pid: int) -> float:
    """Return the proportional set size of a process: shared pages count by the number of their users."""
    for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines():
        if line.startswith("Pss:"):
            return int(line.split()[1]) / 1e3
    raise SystemExit("this kernel does not report the proportional set size")


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description="Faults of an audio interface, on a virtual one.")
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("faults").add_argument("--repeats", type=int, default=5)
    lost = commands.add_parser("losses")
    lost.add_argument("--minutes", type=float, default=60.0)
    lost.add_argument("--channels", type=int, default=18)
    lost.add_argument("--sample-rate", type=int, default=48000)
    lost.add_argument("--spinning", type=int, default=2)
    commands.add_parser("resources").add_argument("--seconds", type=float, default=20.0)
    jitter = commands.add_parser("stamps")
    jitter.add_argument("--seconds", type=float, default=20.0)
    jitter.add_argument("--spinning", type=int, default=2)
    given = parser.parse_args()
    if given.command == "faults":
        faults(given.repeats)
    elif given.command == "losses":
        losses(given.minutes, given.channels, given.sample_rate, given.spinning)
    elif given.command == "stamps":
        stamps(given.seconds, given.spinning)
    else:
        resources(given.seconds)


if __name__ == "__main__":
    main()
