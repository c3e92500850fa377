"""From a virtual interface through ALSA and PortAudio, as installed, to the node and its server: blocks and faults."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from livessl.capture.device_process import DeviceProcess
from livessl.capture.sound_device import SoundDevice
from livessl.clock import SystemClock
from livessl.core.types import Block, Mark
from livessl.errors import DeviceError
from livessl.server.receiver import Receiver
from livessl.site.node_models import SoundDeviceConfig
from small_site import HANG_S, Changes, site_of, started, wait_until, write_site
from virtual_interface import COUNTED, Interfaces, counts_of

pytestmark = pytest.mark.sound_card


@pytest.fixture
def interfaces(tmp_path: Path) -> Interfaces:
    return Interfaces(tmp_path)


def opened(interfaces: Interfaces, channels: int = 4, **config: object) -> SoundDevice:
    """Return the device, whose process sees the virtual interfaces."""
    wanted = SoundDeviceConfig.model_validate({"name": "UMC1820", **config})
    return SoundDevice(
        wanted, channels, SystemClock(), lambda wanted: DeviceProcess(wanted, environment=interfaces.environment)
    )


def blocks_until(device: SoundDevice, over: Callable[[list[Block]], object]) -> list[Block]:
    """Return the blocks with samples until something has happened."""
    blocks: list[Block] = []

    def step() -> bool:
        block = next(device)
        if block.samples.shape[1]:
            blocks.append(block)
        return bool(over(blocks))

    wait_until(step, f"the device; its problem is {device.problem!r}")
    return blocks


def losses(blocks: list[Block]) -> list[int]:
    """Return the number of samples lost before each block but the first; assert that none is lost within a block."""
    counts = [counts_of(block.samples)[0] for block in blocks]
    assert all((np.diff(count) % COUNTED == 1).all() for count in counts)
    return [int((after[0] - before[-1] - 1) % COUNTED) for before, after in pairwise(counts)]


@pytest.mark.parametrize(
    ("channels", "of", "rate_hz", "ppm"), [(4, 4, 44100, -80.0), (18, 18, 48000, 120.0), (6, 10, 96000, 0.0)]
)
def test_every_sample_arrives_in_its_place(
    interfaces: Interfaces, channels: int, of: int, rate_hz: int, ppm: float
) -> None:
    interfaces.add(channels=of, ppm=ppm)
    with opened(interfaces, channels, sample_rate_hz=rate_hz) as device:
        blocks = blocks_until(device, lambda blocks: len(blocks) == 25)
    size = round(0.02 * rate_hz)
    assert all(block.samples.shape == (channels, size) for block in blocks)
    assert [block.first_index for block in blocks] == [size * k for k in range(25)]
    lost = losses(blocks)
    # A machine that is too busy loses samples, but says so.
    assert all(count == 0 or after.overflow for count, after in zip(lost, blocks[1:], strict=True))


def test_interface_that_is_unplugged_is_opened_again(interfaces: Interfaces) -> None:
    umc = interfaces.add()
    with opened(interfaces) as device:
        before = blocks_until(device, lambda blocks: len(blocks) == 5)
        interfaces.unplug(umc)
        blocks_until(device, lambda _: device.problem == "device 'UMC1820' was unplugged; waiting for it")
        interfaces.plug(umc)
        after = blocks_until(device, lambda blocks: len(blocks) == 3)
        assert device.problem is None
        assert device.interruptions == 1
        assert not device.through_sound_server
    assert [block.overflow for block in after] == [True, False, False]
    assert before[-1].first_index < after[0].first_index
    assert sum(losses([before[-1], *after])[1:]) == 0


def test_interface_that_stalls_is_opened_again(interfaces: Interfaces) -> None:
    umc = interfaces.add()
    with opened(interfaces) as device:
        blocks_until(device, lambda blocks: len(blocks) == 5)
        umc.control("stall")
        blocks_until(device, lambda _: device.problem == "device 'UMC1820' stopped delivering sound; opening it again")
        umc.control("back")
        assert blocks_until(device, lambda blocks: len(blocks) == 3)[0].overflow
        assert device.problem is None


def test_overrun_of_the_driver_is_flagged_where_samples_are_missing(interfaces: Interfaces) -> None:
    umc = interfaces.add()
    with opened(interfaces) as device:
        blocks_until(device, lambda blocks: len(blocks) == 5)
        umc.overrun()
        blocks = blocks_until(device, lambda blocks: len(blocks) > 2 and blocks[-2].overflow)
        assert device.lost_blocks >= 1
        assert device.interruptions == 0
    assert losses(blocks)[-2:][0] > 0
    assert losses(blocks)[-1] == 0


@pytest.mark.parametrize("milliseconds", [8, 150])
def test_gap_that_no_driver_flags_is_found_by_the_time(interfaces: Interfaces, milliseconds: float) -> None:
    umc = interfaces.add(ppm=-150.0)
    with opened(interfaces) as device:
        blocks_until(device, lambda blocks: len(blocks) == 30)
        umc.skip(milliseconds)
        blocks = blocks_until(device, lambda blocks: any(block.overflow for block in blocks))
        assert device.losses.unflagged_gaps == 1
    within = [int(((np.diff(counts_of(block.samples)[0]) - 1) % COUNTED).sum()) for block in blocks]
    assert sum(within) == pytest.approx(48 * milliseconds, abs=2)


def test_busy_interface_is_named_with_the_program_that_holds_it(interfaces: Interfaces) -> None:
    umc = interfaces.add()
    with ExitStack() as stack:
        with umc.held():
            device = stack.enter_context(opened(interfaces))
            blocks_until(device, lambda _: device.problem)
            assert str(device.problem).startswith("device 'UMC1820' is busy: ")
            assert f" (process {os.getpid()}) records from it; end that program" in str(device.problem)
        blocks_until(device, lambda blocks: len(blocks) == 2)
        assert device.problem is None


def test_absent_interface_is_opened_when_it_appears(interfaces: Interfaces) -> None:
    umc = interfaces.add()
    interfaces.add("Webcam", channels=1)
    interfaces.unplug(umc)
    with opened(interfaces) as device:
        blocks_until(device, lambda _: device.problem)
        assert "device 'UMC1820' is not connected; connect it, or correct device.name" in str(device.problem)
        assert "ALSA: Webcam: USB Audio (hw:1,0)" in str(device.problem)
        interfaces.plug(umc)
        blocks_until(device, lambda blocks: len(blocks) == 2)
        assert device.problem is None


@pytest.mark.parametrize("place", [{"serial": "0002"}, {"usb_port": "usb-0000:00:14.0-2"}])
def test_equal_interfaces_are_told_apart(interfaces: Interfaces, place: dict[str, str]) -> None:
    interfaces.add(channels=2)
    interfaces.add(channels=6)
    with opened(interfaces, 6, **place) as device:
        assert blocks_until(device, lambda blocks: len(blocks) == 1)[0].samples.shape[0] == 6
    with pytest.raises(DeviceError, match="matches one input device, got 2"):
        opened(interfaces, 2).__enter__()


@pytest.mark.parametrize(
    ("channels", "rate_hz", "words"),
    [
        (9, 48000, "device 'UMC1820': expected at least 9 input channels, got 8; correct the channels under arrays"),
        (8, 96000, "8 channels at 96000 Hz; set device.sample_rate_hz to a rate that it has: 44100, 48000"),
    ],
)  # fmt: skip
def test_unsuitable_interface_is_refused(interfaces: Interfaces, channels: int, rate_hz: int, words: str) -> None:
    interfaces.add(channels=8, rates_hz=(44100, 48000))
    with pytest.raises(DeviceError) as caught, opened(interfaces, channels, sample_rate_hz=rate_hz) as device:
        blocks_until(device, lambda _: False)
    assert words in str(caught.value)


def test_process_has_real_time_priority_where_permitted_and_says_where_not(
    interfaces: Interfaces, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    interfaces.add()
    with opened(interfaces) as device:
        blocks_until(device, lambda blocks: len(blocks) == 2)
        [child] = children(os.getpid())
        policies = {os.sched_getscheduler(int(task.name)) for task in Path(f"/proc/{child}/task").iterdir()}
    if "was refused real-time scheduling" in caplog.text:
        assert policies == {os.SCHED_OTHER}
    else:
        assert os.SCHED_RR in policies  # its watching thread is older and has none
        assert len(policies) <= 2


class Server:
    """The real receiver of a server, and a node as a process."""

    def __init__(self, receiver: Receiver, node: subprocess.Popen[str]) -> None:
        self.receiver = receiver
        self.node = node

    def sound(self) -> bool:
        """Return True if a message about sound has come since the last call."""
        return any(isinstance(item, Mark) for item in self.receiver.take(1000, 0.0))

    @property
    def problem(self) -> str:
        """What the server knows of a problem."""
        return str(self.receiver.ingest.problem_of("south"))

    @property
    def children(self) -> list[int]:
        """The process that owns the device, if there is one now."""
        return children(self.node.pid)


@contextmanager
def node(interfaces: Interfaces, folder: Path) -> Iterator[Server]:
    rate: Changes = {"nodes.lab-pc.device.sample_rate_hz": 48000}
    receiver = Receiver(site_of(rate), SystemClock())
    receiver.start()
    site = write_site(folder, {**rate, "nodes.lab-pc.server": receiver.endpoint})
    command = (sys.executable, "-m", "livessl", "capture", "--site", site, "--node", "lab-pc")
    try:
        with started(*command, env=interfaces.environment, stderr=subprocess.PIPE) as process:
            yield Server(receiver, process)
    finally:
        receiver.stop()


def children(pid: int) -> list[int]:
    """Return the device processes that a process has started."""
    started_by = [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    return [child for child in started_by if b"device_main" in Path(f"/proc/{child}/cmdline").read_bytes()]


def is_alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


@pytest.mark.processes
def test_node_reports_an_unplugged_interface_and_goes_on_when_it_returns(
    interfaces: Interfaces, tmp_path_factory: pytest.TempPathFactory
) -> None:
    umc = interfaces.add()
    with node(interfaces, tmp_path_factory.mktemp("site")) as server:
        wait_until(server.sound, "sound")
        interfaces.unplug(umc)
        wait_until(lambda: server.problem == "device 'UMC1820' was unplugged; waiting for it", "the problem")
        server.sound()
        interfaces.plug(umc)
        wait_until(lambda: server.sound() and server.problem == "None", "sound")
        [child] = server.children
        os.kill(server.node.pid, signal.SIGKILL)
        wait_until(lambda: not is_alive(child), "the end of the device's process")


@pytest.mark.processes
def test_node_ends_on_sigterm_while_the_library_hangs(
    interfaces: Interfaces, tmp_path_factory: pytest.TempPathFactory
) -> None:
    umc = interfaces.add()
    with node(interfaces, tmp_path_factory.mktemp("site")) as server:
        wait_until(server.sound, "sound")
        umc.control("loop")
        wait_until(lambda: server.problem != "None", "the problem")
        wait_until(lambda: server.children, "another process of the device")
        [child] = server.children
        server.node.terminate()
        assert server.node.wait(HANG_S) == 0
        wait_until(lambda: not is_alive(child), "the end of the device's process")
