"""The process that owns a device: its callback and its main loop, with a fake `sounddevice`."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from numpy.typing import NDArray

from fake_portaudio import BLOCK, RATE_HZ, BrokenStream, FakePortAudio, FakeStream, installed, wanted
from livessl.capture import device_main
from livessl.capture.device_main import Receiver
from livessl.capture.device_report import DeviceState, Report
from livessl.capture.ring import RingReader, RingWriter
from livessl.clock import UnpacedClock

NOW_NS = 1_700_000_000_000_000_000


@pytest.fixture
def sd(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> FakePortAudio:
    return installed(monkeypatch, tmp_path)


@pytest.fixture
def ring() -> Iterator[tuple[RingWriter, RingReader]]:
    reader = RingReader(wanted().ring)
    yield RingWriter(reader.memory_fd, reader.published_fd, wanted().ring), reader
    reader.close()


Ends = tuple[RingWriter, RingReader]


def noise(seed: int = 0, channels: int = 4) -> NDArray[np.float32]:
    return np.random.default_rng(seed).uniform(-1, 1, (BLOCK, channels)).astype(np.float32)


def play(
    receiver: Receiver,
    samples: NDArray[np.float32] | None = None,
    age_s: float = 0.02,
    origin_s: float = 5.0,
    overflow: bool = False,
) -> None:
    """Deliver (n, channels) samples of which the first was converted `age_s` ago, as PortAudio does."""
    times = SimpleNamespace(inputBufferAdcTime=origin_s - age_s, currentTime=origin_s)
    data = noise() if samples is None else samples
    receiver.receive(data.tobytes(), len(data), times, SimpleNamespace(input_overflow=overflow))


def received(reader: RingReader) -> list[tuple[int, int, bool]]:
    """Return index, time and flag of all blocks that wait."""
    reader.receive()
    blocks = []
    while reader.waiting:
        slot = reader.first()
        blocks.append((slot.first_index, slot.time_ns, slot.lost))
        slot.samples.release()
        reader.release()
    return blocks


def receiver(ring: Ends, *, is_hardware: bool = True, latency_s: float = 0.1) -> Receiver:
    return Receiver(ring[0], UnpacedClock(NOW_NS), RATE_HZ, is_hardware=is_hardware, latency_s=latency_s)


def test_samples_are_copied(ring: Ends) -> None:
    first, second = noise(1), noise(2)
    memory = first.copy()
    ours = receiver(ring)
    play(ours, memory)
    memory[:] = second  # the driver uses its memory again
    play(ours, memory)
    memory[:] = 0
    ring[1].receive()
    for expected in (first, second):
        slot = ring[1].first()
        assert_array_equal(np.frombuffer(slot.samples, np.float32).reshape(-1, 4).copy(), expected)
        slot.samples.release()
        ring[1].release()


@pytest.mark.parametrize(
    ("age_s", "origin_s", "believed_s"),
    [
        (0.020, 5.0, 0.020),
        (0.060, 5.0, 0.060),  # two more blocks wait behind it
        (0.0, 0.0, 0.020),  # no times at all
        (-3.0, 5.0, 0.020),  # converted in the future
        (0.010, 5.0, 0.020),  # before its last sample was there
        (9.0, 5.0, 0.020),
    ],
)
def test_stamp_is_the_conversion_time_if_plausible(
    ring: Ends, age_s: float, origin_s: float, believed_s: float
) -> None:
    play(receiver(ring), age_s=age_s, origin_s=origin_s)
    [(_, time_ns, _)] = received(ring[1])
    assert abs(time_ns - (NOW_NS - believed_s * 1e9)) < 1000  # float64 seconds keep a microsecond


@pytest.mark.parametrize("latency_s", [0.1, 0.9, 1.5, 4.0])
def test_stamp_of_samples_that_waited_in_a_long_buffer_is_their_conversion_time(ring: Ends, latency_s: float) -> None:
    """A buffer of more than a second, which a busy machine may need, may be full when the block comes."""
    for waited_s in (0.0, 0.5 * latency_s, latency_s, latency_s + 0.9):
        play(receiver(ring, latency_s=latency_s), age_s=waited_s + 0.02)
        [(_, time_ns, _)] = received(ring[1])
        assert abs(time_ns - (NOW_NS - (waited_s + 0.02) * 1e9)) < 1000
    play(receiver(ring, latency_s=latency_s), age_s=latency_s + 1.1)  # no buffer of that length keeps samples so long
    [(_, time_ns, _)] = received(ring[1])
    assert abs(time_ns - (NOW_NS - 0.02e9)) < 1000


def test_conversion_time_of_a_sound_server_is_ignored(ring: Ends) -> None:
    play(receiver(ring, is_hardware=False), age_s=0.2)
    assert received(ring[1]) == [(0, NOW_NS - 20_000_000, False)]


def test_flagged_block_is_dropped_whole_and_the_next_one_marked(ring: Ends) -> None:
    ours = receiver(ring)
    for overflow in (False, True, False, False):
        play(ours, overflow=overflow)
    assert [(index // BLOCK, lost) for index, _, lost in received(ring[1])] == [(0, False), (2, True), (3, False)]
    assert ring[1].flagged == 1


def test_full_ring_leaves_a_gap_of_the_right_length(ring: Ends) -> None:
    ours = receiver(ring)
    for _ in range(7):
        play(ours)
    assert [(index // BLOCK, lost) for index, _, lost in received(ring[1])] == [(k, False) for k in range(4)]
    play(ours)
    play(ours)
    assert [(index // BLOCK, lost) for index, _, lost in received(ring[1])] == [(7, True), (8, False)]
    assert ring[1].overruns == 3


class Reports:
    """What the device process reports; `at` is called with the number of each report, and changes the world."""

    def __init__(self, at: Any) -> None:
        self.all: list[Report] = []
        self._at = at

    def report(self, report: Report) -> None:
        if not self.all or report != self.all[-1]:
            self.all.append(report)
            self._at(len(self.all))


def ran(monkeypatch: pytest.MonkeyPatch, ring: Ends, at: Any) -> list[Report]:
    """Run the device process's main loop, with waits of milliseconds, and return its reports."""
    monkeypatch.setattr(device_main, "request_realtime", lambda: "real-time scheduling: refused here")
    monkeypatch.setattr(device_main, "BEAT_S", 0.001)
    monkeypatch.setattr(device_main, "REOPEN_S", 0.002)
    ended = threading.Event()

    def step(number: int) -> None:
        if at(number):
            ended.set()

    reports = Reports(step)
    device_main.run(wanted(), ring[0], reports, ended)  # type: ignore[arg-type]
    return reports.all


def test_process_opens_a_device_when_it_appears(sd: FakePortAudio, ring: Ends, monkeypatch: pytest.MonkeyPatch) -> None:
    umc = sd.plugged[-1]
    sd.plug()

    def at(number: int) -> bool:
        if number == 1:
            sd.plugged = [umc]
        return number == 2

    first, second = ran(monkeypatch, ring, at)
    assert first.state is DeviceState.ABSENT
    assert second == Report(DeviceState.OPEN, hardware=True, not_realtime="real-time scheduling: refused here")
    assert FakeStream.opened[0].closed
    assert ring[1].beats > 0


@pytest.mark.parametrize("kind", [FakeStream, BrokenStream])
def test_process_ends_when_its_stream_stops(
    sd: FakePortAudio, ring: Ends, monkeypatch: pytest.MonkeyPatch, kind: type[FakeStream]
) -> None:
    monkeypatch.setattr(FakePortAudio, "RawInputStream", kind)

    def at(number: int) -> bool:
        FakeStream.opened[-1].active = False
        return False

    assert [report.state for report in ran(monkeypatch, ring, at)] == [DeviceState.OPEN, DeviceState.STOPPED]


def test_process_tries_to_start_portaudio_again(sd: FakePortAudio, ring: Ends, monkeypatch: pytest.MonkeyPatch) -> None:
    umc = sd.plugged[-1]
    sd.plug()
    sd.broken = True

    def at(number: int) -> bool:
        if number == 2:
            sd.broken, sd.plugged = False, [umc]
        return number == 3

    _, second, third = ran(monkeypatch, ring, at)
    assert second.message == "PortAudio cannot be started: no host API; trying again"
    assert third.state is DeviceState.OPEN


def test_process_loads_as_little_as_possible() -> None:
    script = "import sys, livessl.capture.device_main; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout.split()
    heavy = {"asyncio", "logging", "numpy", "pydantic", "scipy", "yaml", "zmq"}
    assert heavy.isdisjoint(loaded)
    rooms = {name.split(".")[1] for name in loaded if name.startswith("livessl.")}
    assert rooms == {"capture", "clock", "errors"}
