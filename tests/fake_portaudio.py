"""A fake `sounddevice`, for states of hardware that are rare."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any, ClassVar

import pytest

from livessl.capture import hardware
from livessl.capture.device_report import Wanted

RATE_HZ = 48000
BLOCK = 960


def wanted(name: str = "UMC1820", channels: int = 4, **more: Any) -> Wanted:
    return Wanted(name, channels, more.pop("sample_rate_hz", RATE_HZ), BLOCK, 0.1, 5, **more)


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


def installed(monkeypatch: pytest.MonkeyPatch, kernel: Path) -> FakePortAudio:
    """Install the fake library as `sounddevice`, on a machine whose sound cards are described in a folder."""
    fake = FakePortAudio()
    fake.plug(("Built-in: ALC257 (hw:0,0)", 2), ("HDMI (hw:0,3)", 0), ("UMC1820: USB Audio (hw:1,0)", 8))
    monkeypatch.setitem(sys.modules, "sounddevice", fake)
    monkeypatch.setattr(FakeStream, "opened", [])
    monkeypatch.setattr(FakeStream, "refusal", None)
    monkeypatch.setattr(hardware, "_ASOUND", kernel)
    return fake
