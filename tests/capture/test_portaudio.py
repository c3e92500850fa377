"""The search for a device and its opening, with a fake `sounddevice` for rare states."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from fake_portaudio import BLOCK, FakeError, FakePortAudio, FakeStream, installed, wanted
from livessl.capture import hardware
from livessl.capture.device_report import DeviceState, OpeningError
from livessl.capture.portaudio import input_devices, library, open_stream
from livessl.errors import DeviceError


@pytest.fixture
def sd(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> FakePortAudio:
    return installed(monkeypatch, tmp_path)


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


class Undecodable(FakePortAudio):
    """A library that fails on the names that are not UTF-8, as sounddevice does, and its interface to C."""

    def __init__(self, names: list[bytes]) -> None:
        super().__init__()
        self.plug(*((name.decode("utf-8", "replace"), 4) for name in names))
        infos = [SimpleNamespace(name=name, hostApi=0, maxInputChannels=4, defaultSampleRate=48000.0) for name in names]
        self._names = names
        self._lib = SimpleNamespace(Pa_GetDeviceCount=lambda: len(infos), Pa_GetDeviceInfo=infos.__getitem__)
        self._ffi = SimpleNamespace(string=bytes)

    def query_devices(self, index: int | None = None) -> Any:
        if index is None:
            return [self.query_devices(number) for number in range(len(self._names))]
        self._names[index].decode()
        return super().query_devices()[index]


@pytest.mark.parametrize("odd", [b"Micr\xf3fono (hw:2,0)", b"\xff\xfe (hw:2,0)", b"cut \xe2\x82"])
def test_device_whose_name_is_not_utf8_hides_no_other(
    odd: bytes, sd: FakePortAudio, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = [b"UMC1820: USB Audio (hw:1,0)", odd, "Mikrofon f\u00fcr alle (hw:3,0)".encode()]
    library = Undecodable(names)
    monkeypatch.setitem(sys.modules, "sounddevice", library)
    shown = odd.decode("utf-8", "replace")
    assert [found.name for found in input_devices()] == [names[0].decode(), shown, names[2].decode()]
    assert opened(library, "UMC1820").wanted["device"] == 0
    assert opened(library, shown).wanted["device"] == 1


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
