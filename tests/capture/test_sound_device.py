"""The watch over the process that owns a device, with processes that misbehave in every way."""

from __future__ import annotations

import errno
import logging
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from livessl.capture.device_process import DeviceProcess
from livessl.capture.device_report import Wanted
from livessl.capture.sound_device import SoundDevice, wanted_device
from livessl.clock import SystemClock
from livessl.core.types import Block
from livessl.errors import DeviceError
from livessl.site.node_models import SoundDeviceConfig
from small_site import HANG_S, wait_until

PROGRAM = """
import itertools, os, signal, struct, sys, time
from livessl.capture.device_report import DeviceState, Report, Wanted
from livessl.capture.ring import RingWriter

run = int(sys.argv[1])
wanted = Wanted.from_json(sys.argv[3])
memory_fd, published_fd, report_fd = map(int, sys.argv[4].split(","))
ring = RingWriter(memory_fd, published_fd, wanted.ring)
index, lost = 0, False

def report(state, message=""):
    os.write(report_fd, (Report(DeviceState(state), message, True).to_json() + "\\n").encode())

def deliver(count, seconds=0.0):
    global index, lost
    for _ in range(count):
        values = struct.pack(f"{wanted.channels}f", *(index + k / 16 for k in range(wanted.channels)))
        ring.beat()
        block = values * wanted.block_samples
        lost = not ring.write(index, block, wanted.block_samples, time.time_ns(), lost=lost)
        index += wanted.block_samples
        time.sleep(seconds)

def beat_for_ever():
    while True:
        ring.beat()
        time.sleep(0.02)

exec(sys.argv[2])
"""
"""A process in the place of `device_main`; `run` is 1 in its first run, 2 in its second."""

DELIVER = "report('open'); deliver(10**6, 0.02)"


class Runs:
    """Starts such processes, each with the next script; the last one is repeated."""

    def __init__(self, *scripts: str) -> None:
        self.scripts = scripts
        self.started: list[DeviceProcess] = []

    def __call__(self, wanted: Wanted) -> DeviceProcess:
        run = len(self.started)
        script = self.scripts[min(run, len(self.scripts) - 1)]
        self.started.append(DeviceProcess(wanted, (sys.executable, "-c", PROGRAM, str(run + 1), script)))
        return self.started[-1]


@contextmanager
def device(*scripts: str, channels: int = 3) -> Iterator[tuple[SoundDevice, Runs]]:
    runs = Runs(*scripts)
    config = SoundDeviceConfig(name="UMC", sample_rate_hz=8000)
    with SoundDevice(config, channels, SystemClock(), runs) as entered:
        yield entered, runs
    wait_until(lambda: all(run.exit_code is not None for run in runs.started), "the end of the processes")


def blocks_until(entered: SoundDevice, over: Callable[[list[Block]], bool]) -> tuple[list[Block], list[str | None]]:
    """Return the blocks with samples and the different problems, until something has happened."""
    blocks: list[Block] = []
    problems: list[str | None] = []
    end = time.monotonic() + HANG_S
    for block in entered:
        if block.samples.shape[1]:
            blocks.append(block)
        if [entered.problem] != problems[-1:]:
            problems.append(entered.problem)
        if over(blocks):
            break
        assert time.monotonic() < end, problems
    return blocks, problems


def test_blocks_arrive_in_order_with_their_channels() -> None:
    with device("report('open'); deliver(5); beat_for_ever()") as (entered, _):
        blocks, _ = blocks_until(entered, lambda blocks: len(blocks) == 5)
    for k, block in enumerate(blocks):
        assert (block.first_index, block.overflow, block.samples.shape) == (160 * k, False, (3, 160))
        assert block.samples.flags.c_contiguous
        assert (block.samples == (160 * k + np.arange(3) / 16)[:, None]).all()
        assert abs(block.stamp_ns - time.time_ns()) < HANG_S * 1e9


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("os._exit(3)", "the process that reads device 'UMC' ended with code 3; it was started again"),
        ("os.kill(os.getpid(), 9)", "the process that reads device 'UMC' ended by signal 9; it was started again"),
        ("beat_for_ever()", "device 'UMC' stopped delivering sound; opening it again"),
        ("ring.count_flagged(); beat_for_ever()", "device 'UMC' stopped delivering sound; opening it again"),
        ("report('stopped'); time.sleep(1000)", "device 'UMC' has stopped; was it unplugged? Waiting for it"),
        ("time.sleep(1000)", "the sound library of device 'UMC' hangs; it was started again"),
        (
            "[os.write(2, b'line ' * 100 + b'\\n') for _ in itertools.count()]",
            "the sound library of device 'UMC' prints without end; it was started again",
        ),
        ("report('absent', 'not connected'); beat_for_ever()", "device 'UMC' was unplugged; waiting for it"),
    ],
)
def test_fault_is_reported_and_survived(fault: str, words: str) -> None:
    healing = "report('absent', 'not connected'); [ring.beat() or time.sleep(0.1) for _ in range(15)]; report('open'); "
    script = fault.replace("beat_for_ever()", healing + "deliver(10**6, 0.02)") if "absent" in fault else fault
    with device(f"report('open'); deliver(4, 0.02); {script}", DELIVER) as (entered, runs):
        blocks, problems = blocks_until(entered, lambda blocks: len(blocks) == 8)
        assert words in problems
        assert problems[-1] is None
        if "absent" not in fault:
            assert len(runs.started) == 2
            assert [block.first_index for block in blocks] == [160 * k for k in range(8)]
            assert [block.overflow for block in blocks] == [False] * 4 + [True] + [False] * 3


@pytest.mark.parametrize("late_s", [0.0, 0.6])
def test_blocks_before_the_end_of_the_process_are_kept_and_the_gap_comes_after_them(late_s: float) -> None:
    """Also if the node reads them only when the process has ended."""
    with device("report('open'); deliver(4); os._exit(3)", DELIVER) as (entered, _):
        time.sleep(late_s)
        blocks, _ = blocks_until(entered, lambda blocks: len(blocks) == 8)
    assert [block.first_index for block in blocks] == [160 * k for k in range(8)]
    assert [block.overflow for block in blocks] == [False] * 4 + [True] + [False] * 3


def test_a_process_that_cannot_be_started_is_tried_again() -> None:
    runs, refused = Runs(DELIVER), [OSError(errno.ENOMEM, "Cannot allocate memory")]

    def start(wanted: Wanted) -> DeviceProcess:
        if refused:
            raise refused.pop()
        return runs(wanted)

    with SoundDevice(SoundDeviceConfig(name="UMC", sample_rate_hz=8000), 3, SystemClock(), start) as entered:
        assert entered.problem is not None
        assert "cannot be started: Cannot allocate memory; trying again" in entered.problem
        blocks, problems = blocks_until(entered, lambda blocks: len(blocks) == 2)
    assert problems[-1] is None
    assert len(blocks) == 2


@pytest.mark.parametrize(
    ("damage", "what"),
    [
        (
            "ring._bytes[64 + 4 * ring._shape.slot_bytes :][8:16] = b'x' * 8; os.eventfd_write(published_fd, 1)",
            "ring: ",
        ),
        ("os.write(report_fd, b'{{}}\\n')", "report: "),
        ('os.write(report_fd, b\'{"state": "odd"}\\n\')', "report: "),
    ],
)
def test_damaged_process_is_started_again(damage: str, what: str) -> None:
    with device(f"report('open'); deliver(4, 0.02); {damage}; beat_for_ever()", DELIVER) as (entered, runs):
        _, problems = blocks_until(entered, lambda blocks: len(blocks) == 6)
        assert len(runs.started) == 2
    assert any(f"the process that reads device 'UMC' is damaged ({what}" in str(problem) for problem in problems)


def test_loss_of_processor_time_is_told_so() -> None:
    slow = "[(ring.beat(), time.sleep(0.8)) for _ in range(3)]"
    with device(f"report('open'); deliver(4); {slow}; deliver(10**6, 0.02)") as (entered, runs):
        _, problems = blocks_until(entered, lambda blocks: len(blocks) == 8)
        assert any(
            "this machine lags: the process that reads device 'UMC' got only" in str(problem) for problem in problems
        )
        assert problems[-1] is None
        assert len(runs.started) == 1


def test_blocks_that_were_not_read_in_time_are_counted_and_told(caplog: pytest.LogCaptureFixture) -> None:
    with device("report('open'); deliver(130); deliver(10**6, 0.02)") as (entered, runs):
        wait_until(lambda: runs.started[0].overruns >= 30, "overruns")
        blocks, problems = blocks_until(entered, lambda blocks: any(block.overflow for block in blocks))
        assert entered.losses.overruns >= 30
        assert [block.first_index for block in blocks[:100]] == [160 * k for k in range(100)]
        assert blocks[-1].first_index == 160 * (100 + entered.losses.overruns)
    assert entered.lost_blocks == entered.losses.overruns + entered.losses.unflagged_gaps
    assert f"this machine lags: {entered.losses.overruns} blocks of device 'UMC' were lost" in str(problems[-1])
    assert "were lost: this node did not read them in time" in caplog.text


def test_sound_lost_by_a_busy_machine_and_interruptions_are_counted_apart() -> None:
    flagged = "ring.count_flagged(); ring.count_flagged(); deliver(4, 0.02); os._exit(3)"
    with device(f"report('open'); deliver(4, 0.02); {flagged}", DELIVER) as (entered, _):
        blocks_until(entered, lambda blocks: len(blocks) == 12)
        others = entered.losses.overruns + entered.losses.unflagged_gaps  # this machine may be busy, too
        assert (entered.lost_blocks - others, entered.interruptions) == (2, 1)


def test_interface_that_stays_away_is_one_interruption() -> None:
    with device("report('open'); deliver(4, 0.02); os._exit(3)", "report('absent', 'gone'); os._exit(3)") as (
        entered,
        runs,
    ):
        blocks_until(entered, lambda _: len(runs.started) == 3)
        assert entered.interruptions == 1


class Held(DeviceProcess):
    """A process that the kernel keeps, though it was killed, while its driver does not return."""

    held = True

    @property
    def exit_code(self) -> int | None:
        return None if Held.held else super().exit_code


def test_process_that_the_kernel_holds_is_named_and_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """It still has the device open, so that a second one would find it busy."""
    monkeypatch.setattr(Held, "held", True)
    started: list[DeviceProcess] = []

    def start(wanted: Wanted) -> DeviceProcess:
        script = DELIVER if started else "report('open'); deliver(4, 0.02); os.close(report_fd); time.sleep(1000)"
        kind = DeviceProcess if started else Held
        started.append(kind(wanted, (sys.executable, "-c", PROGRAM, str(len(started) + 1), script)))
        return started[-1]

    with SoundDevice(SoundDeviceConfig(name="UMC", sample_rate_hz=8000), 3, SystemClock(), start) as entered:
        blocks_until(entered, lambda _: "is held by this node's former process" in str(entered.problem))
        assert f"(process {started[0].pid}), which was killed and does not end" in str(entered.problem)
        for _ in range(30):
            next(entered)
        assert len(started) == 1
        Held.held = False
        blocks, problems = blocks_until(entered, lambda blocks: len(blocks) == 2)
        assert len(started) == 2
        assert problems[-1] is None
        assert [block.overflow for block in blocks] == [True, False]


def test_wait_for_a_process_that_is_ending_does_not_return_at_once() -> None:
    """A process that the kernel holds in a driver has closed its reports and not ended; the node would spin."""
    wanted = wanted_device(SoundDeviceConfig(name="UMC", sample_rate_hz=8000), 3)
    script = "os.close(report_fd); time.sleep(1000)"
    process = DeviceProcess(wanted, (sys.executable, "-c", PROGRAM, "1", script))
    try:
        process.wait(HANG_S)
        begun = time.monotonic()
        process.wait(0.3)
        assert time.monotonic() - begun >= 0.25
    finally:
        process.end(kill=True)


WITHOUT_STREAMS = """
import os, sys
for number in map(int, sys.argv[3]):
    os.close(number)
from livessl.capture.device_process import DeviceProcess
from livessl.capture.sound_device import SoundDevice
from livessl.clock import SystemClock
from livessl.site.node_models import SoundDeviceConfig
command = (sys.executable, "-c", sys.argv[1], "1", "report('open'); deliver(10**6, 0.02)")
config = SoundDeviceConfig(name="UMC", sample_rate_hz=8000)
with SoundDevice(config, 3, SystemClock(), lambda wanted: DeviceProcess(wanted, command)) as device:
    blocks = 0
    for block in device:
        blocks += block.samples.shape[1] > 0
        if blocks == 3 or device.problem:
            break
with open(sys.argv[2], "w") as file:
    file.write(f"{blocks} {device.problem}")
"""


@pytest.mark.parametrize("closed", ["0", "2", "012"])
def test_device_works_in_a_process_without_standard_streams(closed: str, tmp_path: Path) -> None:
    """New files get the numbers of closed streams, and the device's process has streams of its own."""
    result = tmp_path / "result"
    subprocess.run([sys.executable, "-c", WITHOUT_STREAMS, PROGRAM, result, closed], check=True, timeout=HANG_S)
    assert result.read_text() == "3 None"


def test_unsuitable_device_is_refused_when_it_is_entered() -> None:
    runs = Runs("report('unsuitable', 'too few channels'); beat_for_ever()")
    with pytest.raises(DeviceError, match="too few channels"):
        SoundDevice(SoundDeviceConfig(name="UMC"), 3, SystemClock(), runs).__enter__()
    assert runs.started[0].exit_code is not None


def test_slow_report_of_an_unsuitable_device_is_raised_by_the_iterator() -> None:
    with device("time.sleep(2.5); report('unsuitable', 'too few channels'); beat_for_ever()") as (entered, _):
        told = []
        with pytest.raises(DeviceError, match="too few channels"):
            told = blocks_until(entered, lambda _: False)[1]
        assert told == []
        assert list(entered) == []


def test_unsuitable_device_during_a_run_is_a_problem_and_no_error() -> None:
    script = "report('absent', 'absent'); time.sleep(0.3); report('unsuitable', 'two match'); beat_for_ever()"
    with device(script) as (entered, _):
        assert entered.problem == "absent"
        blocks_until(entered, lambda _: entered.problem == "two match")


def test_process_that_fails_at_once_is_started_ever_less_often() -> None:
    begun = time.monotonic()
    with device("os._exit(1)") as (entered, runs):
        blocks_until(entered, lambda _: len(runs.started) == 3)
    assert time.monotonic() - begun >= 2.0 + 4.0 - 0.1


def test_stubborn_process_is_killed_when_the_device_is_left() -> None:
    stubborn = "[signal.signal(k, signal.SIG_IGN) for k in (1, 2, 15)]; " + DELIVER
    with device(stubborn) as (entered, _):
        blocks_until(entered, lambda blocks: len(blocks) == 3)
        begun = time.monotonic()
    assert time.monotonic() - begun < HANG_S


def test_output_of_native_libraries_is_logged_once_per_message(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    prints = "[os.write(1 + k % 2, f'ALSA lib pcm.c:{k}: bad\\n'.encode()) for k in range(500)]"
    with device(f"{prints}; {DELIVER}") as (entered, _):
        blocks_until(entered, lambda _: "ALSA" in caplog.text)
    messages = [message for message in caplog.messages if "ALSA" in message]
    assert messages == ["sound library: ALSA lib pcm.c:0: bad", "sound library, 499 times more: ALSA lib pcm.c:#: bad"]


def test_nothing_is_left_open() -> None:
    before = sorted(Path("/proc/self/fd").iterdir())
    with device("report('open'); deliver(2); os._exit(0)", DELIVER) as (entered, runs):
        blocks_until(entered, lambda _: len(runs.started) == 2)
    assert sorted(Path("/proc/self/fd").iterdir()) == before


def test_iterator_ends_with_the_context() -> None:
    with device(DELIVER) as (entered, _):
        pass
    assert list(entered) == []
