"""The search for a device and its opening, and the process around them, with a fake `sounddevice` for rare states."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from numpy.typing import NDArray

from livessl.capture import device_main, hardware
from livessl.capture.device_main import Receiver
from livessl.capture.device_report import DeviceState, OpeningError, Report, Wanted
from livessl.capture.portaudio import input_devices, library, open_stream
from livessl.capture.ring import RingReader, RingWriter
from livessl.clock import UnpacedClock
from livessl.errors import DeviceError

RATE_HZ = 48000
BLOCK = 960
NOW_NS = 1_700_000_000_000_000_000


class FakeError(Exception):
    """Replaces sounddevice.PortAudioError: a text, and usually a code."""


class FakeStream:
    """Replaces sounddevice.RawInputStream."""

    opened: ClassVar[list[FakeStream]] = []
    refusal: ClassVar[FakeError | None] = None

    def __init__(self, **wanted: Any) -> None:
        self.wanted = wanted
        self.active: Any = False
        self.closed = False
        FakeStream.opened.append(self)

    def start(self) -> None:
        if FakeStream.refusal is not None:
            raise FakeStream.refusal
        self.active = True

    def abort(self) -> None:
        self.active = False

    def close(self) -> None:
        self.closed = True


class BrokenStream(FakeStream):
    """A stream that fails even when its state is read."""

    @property
    def active(self) -> bool:
        raise FakeError("stream lost", -9988)

    @active.setter
    def active(self, value: bool) -> None:
        pass


class FakePortAudio:
    """Replaces the sounddevice module: new devices appear only after `_terminate` and `_initialize`."""

    PortAudioError = FakeError
    RawInputStream = FakeStream

    def __init__(self) -> None:
        self.plugged: list[tuple[str, int]] = []
        self.seen: list[tuple[str, int]] = []
        self.rates: set[int] = {44100, 96000}
        self.broken = False
        self.running = True

    def plug(self, *devices: tuple[str, int]) -> None:
        """Connect devices (name, input channels) that PortAudio has detected already."""
        self.plugged = self.seen = list(devices)

    def query_hostapis(self) -> list[dict[str, Any]]:
        return [{"name": "ALSA"}, {"name": "JACK Audio Connection Kit"}]

    def query_devices(self) -> list[dict[str, Any]]:
        return [
            {
                "name": name.removeprefix("JACK "),
                "index": index,
                "hostapi": int(name.startswith("JACK ")),
                "max_input_channels": channels,
                "default_samplerate": 44100.0,
            }
            for index, (name, channels) in enumerate(self.seen)
        ]

    def check_input_settings(self, *, samplerate: int, **_: Any) -> None:
        if samplerate not in self.rates:
            raise FakeError("Invalid sample rate", -9997)

    def _terminate(self) -> None:
        if not self.running:
            raise FakeError("PortAudio not initialized", -10000)
        self.running = False

    def _initialize(self) -> None:
        if self.broken:
            raise FakeError("no host API", -9979)
        self.running = True
        self.seen = list(self.plugged)


@pytest.fixture
def sd(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> FakePortAudio:
    """Install the fake library as `sounddevice`, on a machine without sound cards of its own."""
    fake = FakePortAudio()
    fake.plug(("Built-in: ALC257 (hw:0,0)", 2), ("HDMI (hw:0,3)", 0), ("UMC1820: USB Audio (hw:1,0)", 8))
    monkeypatch.setitem(sys.modules, "sounddevice", fake)
    monkeypatch.setattr(FakeStream, "opened", [])
    monkeypatch.setattr(FakeStream, "refusal", None)
    monkeypatch.setattr(hardware, "_ASOUND", tmp_path)
    return fake


def wanted(name: str = "UMC1820", channels: int = 4, **more: Any) -> Wanted:
    return Wanted(name, channels, more.pop("sample_rate_hz", RATE_HZ), BLOCK, 0.1, 5, **more)


def opened(sd: FakePortAudio, name: str = "UMC1820", channels: int = 4, **more: Any) -> FakeStream:
    stream, _ = open_stream(sd, wanted(name, channels, **more), lambda _: print)
    assert isinstance(stream, FakeStream)
    return stream


def trouble(sd: FakePortAudio, name: str = "UMC1820", channels: int = 4, **more: Any) -> OpeningError:
    with pytest.raises(OpeningError) as caught:
        opened(sd, name, channels, **more)
    return caught.value


@pytest.mark.parametrize(
    "name", ["UMC1820", "umc18", "usb audio", "UMC1820: USB Audio (hw:1,0)", "ALSA: UMC1820", "alsa: umc1820: usb"]
)
def test_part_of_the_name_is_enough(sd: FakePortAudio, name: str) -> None:
    assert opened(sd, name).wanted["device"] == 2


def test_stream_is_opened_as_configured(sd: FakePortAudio) -> None:
    asked = opened(sd, channels=8, sample_rate_hz=44100).wanted
    assert (asked["samplerate"], asked["blocksize"], asked["channels"], asked["latency"]) == (44100, BLOCK, 8, 0.1)
    assert asked["dtype"] == "float32"


def test_ambiguous_name_prints_the_candidates(sd: FakePortAudio) -> None:
    sd.plug(("UMC1820: USB Audio (hw:1,0)", 8), ("UMC404HD (hw:2,0)", 4), ("Webcam", 1))
    why = trouble(sd, "umc")
    assert why.state is DeviceState.UNSUITABLE
    assert "matches one input device, got 2: ALSA: UMC1820: USB Audio (hw:1,0); ALSA: UMC404HD" in str(why)


def test_host_api_distinguishes_devices_of_one_name(sd: FakePortAudio) -> None:
    sd.plug(("UMC1820", 8), ("JACK UMC1820", 8))
    assert "got 2" in str(trouble(sd))
    assert opened(sd, "JACK Audio Connection Kit: UMC1820").wanted["device"] == 1


@pytest.mark.parametrize("name", ["ALSA", "ALSA: "])
def test_host_api_alone_matches_no_device(sd: FakePortAudio, name: str) -> None:
    assert trouble(sd, name).state is DeviceState.ABSENT


def test_full_name_takes_precedence_over_names_that_contain_it(sd: FakePortAudio) -> None:
    sd.plug(("Mic Pro", 4), ("Mic", 4))
    assert opened(sd, "mic").wanted["device"] == 1


def test_device_with_too_few_channels_is_refused(sd: FakePortAudio) -> None:
    why = trouble(sd, "ALC257", channels=5)
    assert why.state is DeviceState.UNSUITABLE
    assert str(why).startswith("device 'ALC257': expected at least 5 input channels, got 2; correct")


def test_absent_device_is_reported_with_the_inputs_that_are_there(sd: FakePortAudio) -> None:
    why = trouble(sd, "Scarlett")
    assert why.state is DeviceState.ABSENT
    assert str(why) == (
        "device 'Scarlett' is not connected; connect it, or correct device.name "
        "(inputs here: ALSA: Built-in: ALC257 (hw:0,0); ALSA: UMC1820: USB Audio (hw:1,0))"
    )


def test_unsupported_rate_is_refused_with_the_rates_on_offer(
    sd: FakePortAudio, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(FakeStream, "refusal", FakeError("Invalid sample rate", -9997))
    why = trouble(sd)
    assert why.state is DeviceState.UNSUITABLE
    assert str(why) == (
        "device 'UMC1820' does not offer 4 channels at 48000 Hz; "
        "set device.sample_rate_hz to a rate that it has: 44100, 96000"
    )
    assert FakeStream.opened[0].closed


def test_device_that_another_program_holds_is_busy(sd: FakePortAudio, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(FakeStream, "refusal", FakeError("Device unavailable", -9985))
    assert trouble(sd).state is DeviceState.BUSY


def test_other_failures_keep_their_reason(sd: FakePortAudio, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(FakeStream, "refusal", FakeError("Unanticipated host error", -9999))
    assert str(trouble(sd)) == "device 'UMC1820' cannot be opened: Unanticipated host error; trying again"


def test_output_devices_are_not_listed(sd: FakePortAudio) -> None:
    assert [found.name for found in input_devices()] == ["Built-in: ALC257 (hw:0,0)", "UMC1820: USB Audio (hw:1,0)"]


def test_missing_portaudio_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "sounddevice.py").write_text('raise OSError("PortAudio library not found")\n')
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "sounddevice", raising=False)
    with pytest.raises(OpeningError, match="apt install libportaudio2"):
        library()
    with pytest.raises(DeviceError, match="apt install libportaudio2"):
        input_devices()


class Kernel:
    """The files in which a kernel describes its sound cards."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        (folder / "cards").write_text(
            " 0 [PCH            ]: HDA-Intel - HDA Intel PCH\n"
            "                      HDA Intel PCH at 0xf7210000 irq 31\n"
            " 2 [U18            ]: USB-Audio - UMC1820\n"
            "                      BEHRINGER UMC1820 at usb-0000:00:14.0-2.1, high speed\n"
            " 3 [U18_1          ]: USB-Audio - UMC1820\n"
            "                      BEHRINGER UMC1820 at usb-0000:00:14.0-3, high speed\n"
        )
        (folder / "pcm").write_text(
            "00-00: ALC257 Analog : ALC257 Analog : playback 1 : capture 1\n"
            "00-03: HDMI 0 : HDMI 0 : playback 1\n"
            "02-00: USB Audio : USB Audio : playback 1 : capture 1\n"
            "03-00: USB Audio : USB Audio : playback 1 : capture 1\n"
        )

    def hold(self, card: int, process: int) -> None:
        status = self.folder / f"card{card}/pcm0c/sub0/status"
        status.parent.mkdir(parents=True)
        status.write_text(f"state: RUNNING\nowner_pid   : {process}\ntrigger_time: 1.0\n")


@pytest.fixture
def kernel(sd: FakePortAudio, tmp_path: Path) -> Kernel:
    sd.plug(("UMC1820: USB Audio (hw:2,0)", 8), ("UMC1820: USB Audio (hw:3,0)", 8))
    return Kernel(tmp_path)


def test_kernel_lists_inputs_with_their_usb_ports(kernel: Kernel) -> None:
    assert [(found.name, found.usb_port) for found in hardware.hardware_inputs()] == [
        ("HDA Intel PCH: ALC257 Analog (hw:0,0)", None),
        ("UMC1820: USB Audio (hw:2,0)", "usb-0000:00:14.0-2.1"),
        ("UMC1820: USB Audio (hw:3,0)", "usb-0000:00:14.0-3"),
    ]


def test_usb_port_distinguishes_equal_interfaces(kernel: Kernel, sd: FakePortAudio) -> None:
    assert "give more of the name in device.name, or device.serial or device.usb_port" in str(trouble(sd))
    assert opened(sd, usb_port="usb-0000:00:14.0-2.1").wanted["device"] == 0
    assert opened(sd, usb_port="usb-0000:00:14.0-3").wanted["device"] == 1
    assert "'UMC1820' at usb-0000:00:14.0-4 is not connected" in str(trouble(sd, usb_port="usb-0000:00:14.0-4"))


def test_device_that_portaudio_hides_is_busy_with_the_program_that_holds_it(kernel: Kernel, sd: FakePortAudio) -> None:
    """PortAudio lists only devices that it could open when it started."""
    kernel.hold(2, process=1)
    sd.plug(("HDA Intel PCH: ALC257 Analog (hw:0,0)", 2))
    why = trouble(sd, usb_port="usb-0000:00:14.0-2.1")
    assert why.state is DeviceState.BUSY
    assert str(why).startswith("device 'UMC1820' is busy: ")
    assert str(why).endswith(" (process 1) records from it; end that program; trying again")


def test_device_that_nobody_holds_but_portaudio_hides_does_not_open(kernel: Kernel, sd: FakePortAudio) -> None:
    sd.plug()
    why = trouble(sd)
    assert why.state is DeviceState.FAILED
    assert "is connected but does not open" in str(why)


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


def receiver(ring: Ends, *, is_hardware: bool = True) -> Receiver:
    return Receiver(ring[0], UnpacedClock(NOW_NS), RATE_HZ, is_hardware=is_hardware)


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
