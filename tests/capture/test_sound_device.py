"""The PortAudio device, with a fake `sounddevice` for rare hardware states, and with a virtual sound card."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from ctypes.util import find_library
from itertools import islice
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from numpy.typing import NDArray

from conftest import require
from livessl.capture import sound_device
from livessl.capture.sound_device import SoundDevice, input_devices
from livessl.clock import UnpacedClock
from livessl.core.types import FRAME_NS
from livessl.errors import DeviceError
from livessl.site.node_models import SoundDeviceConfig
from small_site import HANG_S, wait_until

RATE_HZ = 48000
BLOCK = 960
"""Samples in the configured default of 20 ms at 48 kHz."""

NOW_NS = 1_700_000_000_000_000_000


class FakeError(Exception):
    """Replaces sounddevice.PortAudioError: a text, and usually a code."""


class FakeStream:
    """Replaces sounddevice.InputStream; `play` acts as the driver."""

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

    def play(
        self, samples: NDArray[np.float32], age_s: float = 0.0, origin_s: float = 5.0, overflow: bool = False
    ) -> None:
        """Deliver (n, channels) samples of which the first was converted `age_s` ago."""
        times = SimpleNamespace(inputBufferAdcTime=origin_s - age_s, currentTime=origin_s)
        self.wanted["callback"](samples, len(samples), times, SimpleNamespace(input_overflow=overflow))


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
    InputStream = FakeStream

    def __init__(self) -> None:
        self.plugged: list[tuple[str, int]] = []
        self.seen: list[tuple[str, int]] = []
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
def portaudio(monkeypatch: pytest.MonkeyPatch) -> FakePortAudio:
    """Install the fake library as `sounddevice`, and shorten the device's waits to milliseconds."""
    fake = FakePortAudio()
    fake.plug(("Built-in: ALC257 (hw:0,0)", 2), ("HDMI (hw:0,3)", 0), ("UMC1820: USB Audio (hw:1,0)", 8))
    monkeypatch.setitem(sys.modules, "sounddevice", fake)
    monkeypatch.setattr(FakeStream, "opened", [])
    monkeypatch.setattr(FakeStream, "refusal", None)
    for name, seconds in {"WAIT_S": 0.001, "REOPEN_S": 0.004, "STALLED_S": 0.010}.items():
        monkeypatch.setattr(sound_device, name, seconds)
    return fake


def device(name: str = "UMC1820", channels: int = 4) -> SoundDevice:
    return SoundDevice(SoundDeviceConfig(name=name), channels, UnpacedClock(NOW_NS))


def noise(channels: int = 4, seed: int = 0) -> NDArray[np.float32]:
    return np.random.default_rng(seed).uniform(-1, 1, (BLOCK, channels)).astype(np.float32)


def steps(opened: SoundDevice, until: Callable[[], bool]) -> None:
    """Iterate over empty blocks until something has happened."""
    for _, block in zip(range(100), opened, strict=False):
        assert block.samples.shape == (opened.channels, 0)
        if until():
            return
    pytest.fail(f"nothing happened in 100 steps; problem is {opened.problem!r}")


class TestFinding:
    @pytest.mark.parametrize(
        "name",
        ["UMC1820", "umc18", "usb audio", "UMC1820: USB Audio (hw:1,0)", "ALSA: UMC1820", "alsa: umc1820: usb"],
    )
    def test_part_of_the_name_is_enough(self, portaudio: FakePortAudio, name: str) -> None:
        with device(name) as opened:
            assert opened.problem is None
        assert [stream.wanted["device"] for stream in FakeStream.opened] == [2]

    def test_stream_is_opened_as_configured(self, portaudio: FakePortAudio) -> None:
        with SoundDevice(SoundDeviceConfig(name="UMC", sample_rate_hz=44100, block_s=0.01), 8, UnpacedClock()):
            wanted = FakeStream.opened[0].wanted
        assert (wanted["samplerate"], wanted["blocksize"], wanted["channels"]) == (44100, 441, 8)
        assert wanted["dtype"] == "float32"

    def test_ambiguous_name_prints_the_candidates(self, portaudio: FakePortAudio) -> None:
        portaudio.plug(("UMC1820: USB Audio (hw:1,0)", 8), ("UMC404HD (hw:2,0)", 4), ("Webcam", 1))
        with pytest.raises(DeviceError, match=r"'umc'.*matches one input device, got 2: ALSA: UMC1820.*ALSA: UMC404HD"):
            device("umc").__enter__()

    def test_host_api_distinguishes_devices_of_one_name(self, portaudio: FakePortAudio) -> None:
        portaudio.plug(("UMC1820", 8), ("JACK UMC1820", 8))
        with pytest.raises(DeviceError, match="got 2"):
            device("UMC1820").__enter__()
        with device("JACK Audio Connection Kit: UMC1820"):
            assert FakeStream.opened[0].wanted["device"] == 1

    def test_host_api_alone_matches_no_device(self, portaudio: FakePortAudio) -> None:
        for name in ("ALSA", "ALSA: "):
            with device(name) as opened:
                assert "not connected" in str(opened.problem)

    def test_full_name_takes_precedence_over_names_that_contain_it(self, portaudio: FakePortAudio) -> None:
        portaudio.plug(("Mic Pro", 4), ("Mic", 4))
        with device("mic"):
            assert FakeStream.opened[0].wanted["device"] == 1

    def test_device_with_too_few_channels_is_refused(self, portaudio: FakePortAudio) -> None:
        with pytest.raises(DeviceError, match="'ALC257': expected at least 5 input channels, got 2; correct"):
            device("ALC257", channels=5).__enter__()

    def test_output_devices_are_not_listed(self, portaudio: FakePortAudio) -> None:
        assert [found.name for found in input_devices()] == ["Built-in: ALC257 (hw:0,0)", "UMC1820: USB Audio (hw:1,0)"]

    def test_unsupported_sampling_rate_is_refused(
        self, portaudio: FakePortAudio, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(FakeStream, "refusal", FakeError("Invalid sample rate", -9997))
        with pytest.raises(DeviceError, match=r"4 channels at 48000 Hz; set device\.sample_rate_hz"):
            device().__enter__()
        assert FakeStream.opened[0].closed

    def test_missing_portaudio_is_reported(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        (tmp_path / "sounddevice.py").write_text('raise OSError("PortAudio library not found")\n')
        monkeypatch.syspath_prepend(tmp_path)
        monkeypatch.delitem(sys.modules, "sounddevice", raising=False)
        for attempt in (input_devices, device().__enter__):
            with pytest.raises(DeviceError, match="apt install libportaudio2"):
                attempt()


class TestBlocks:
    @pytest.mark.parametrize("channels", [1, 4])
    def test_samples_are_a_transposed_copy(self, portaudio: FakePortAudio, channels: int) -> None:
        first, second = noise(channels, seed=1), noise(channels, seed=2)
        memory = first.copy()
        with device(channels=channels) as opened:
            FakeStream.opened[0].play(memory)
            memory[:] = second  # the driver uses its memory again
            FakeStream.opened[0].play(memory)
            memory[:] = 0
            blocks = list(islice(opened, 2))
        for block, samples, index in zip(blocks, (first, second), (0, BLOCK), strict=True):
            assert_array_equal(block.samples, samples.T)
            assert block.samples.flags.c_contiguous
            assert (block.first_index, block.overflow) == (index, False)

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
        self, portaudio: FakePortAudio, age_s: float, origin_s: float, believed_s: float
    ) -> None:
        with device() as opened:
            FakeStream.opened[0].play(noise(), age_s, origin_s)
            block = next(opened)
        assert abs(block.stamp_ns - (NOW_NS - believed_s * 1e9)) < 1000  # float64 seconds keep a microsecond

    def test_conversion_time_of_a_sound_server_is_ignored(self, portaudio: FakePortAudio) -> None:
        portaudio.plug(("pulse", 32))
        with device("pulse") as opened:
            FakeStream.opened[0].play(noise(), age_s=0.2)
            assert next(opened).stamp_ns == NOW_NS - 20_000_000

    def test_overflow_marks_the_block_after_the_loss(self, portaudio: FakePortAudio) -> None:
        with device() as opened:
            for overflow in (False, True, False):
                FakeStream.opened[0].play(noise(), overflow=overflow)
            blocks = list(islice(opened, 3))
        assert [block.overflow for block in blocks] == [False, True, False]
        assert [block.first_index for block in blocks] == [0, BLOCK, 2 * BLOCK]

    def test_full_queue_leaves_a_gap_of_the_right_length(self, portaudio: FakePortAudio) -> None:
        capacity = round(sound_device.QUEUE_S * RATE_HZ / BLOCK)
        with device() as opened:
            for _ in range(capacity + 3):
                FakeStream.opened[0].play(noise())
            blocks = list(islice(opened, capacity))
            assert next(opened).samples.shape == (4, 0)
            FakeStream.opened[0].play(noise())
            FakeStream.opened[0].play(noise())
            after, later = islice(opened, 2)
        assert [block.first_index for block in blocks] == [k * BLOCK for k in range(capacity)]
        assert not any(block.overflow for block in blocks)
        assert (after.first_index, after.overflow) == ((capacity + 3) * BLOCK, True)
        assert (later.first_index, later.overflow) == ((capacity + 4) * BLOCK, False)

    def test_empty_block_comes_while_the_device_is_silent(self, portaudio: FakePortAudio) -> None:
        with device() as opened:
            FakeStream.opened[0].play(noise())
            _, block = islice(opened, 2)
        assert (block.first_index, block.samples.shape, block.stamp_ns) == (BLOCK, (4, 0), NOW_NS)
        assert not block.overflow

    def test_iterator_ends_with_the_context(self, portaudio: FakePortAudio) -> None:
        opened = device()
        assert list(opened) == []
        with opened:
            FakeStream.opened[0].play(noise())
        assert list(opened) == []
        assert FakeStream.opened[0].closed


class TestWaiting:
    def test_absent_device_is_opened_when_it_appears(self, portaudio: FakePortAudio) -> None:
        umc = portaudio.plugged.pop()
        portaudio._initialize()
        with device() as opened:
            assert opened.problem == ("device 'UMC1820' is not connected, or another program holds it; waiting for it")
            assert next(opened).samples.shape == (4, 0)
            portaudio.plugged.append(umc)
            steps(opened, lambda: len(FakeStream.opened) == 1)
            assert opened.problem is None
            FakeStream.opened[0].play(noise())
            assert next(opened).first_index == 0

    def test_device_that_returns_continues_after_a_gap(self, portaudio: FakePortAudio) -> None:
        umc = portaudio.plugged[-1]
        with device() as opened:
            FakeStream.opened[0].play(noise())
            assert not next(opened).overflow
            portaudio.plugged = portaudio.plugged[:-1]
            FakeStream.opened[0].active = False
            steps(opened, lambda: opened.problem is not None)
            assert "device 'UMC1820' has stopped" in str(opened.problem)
            assert FakeStream.opened[0].closed
            steps(opened, lambda: "not connected" in str(opened.problem))
            portaudio.plugged = [umc]
            steps(opened, lambda: opened.problem is None)
            FakeStream.opened[1].play(noise())
            FakeStream.opened[1].play(noise())
            back, later = islice(opened, 2)
        assert (back.first_index, back.overflow) == (BLOCK, True)
        assert (later.first_index, later.overflow) == (2 * BLOCK, False)

    def test_stream_whose_state_cannot_be_read_is_given_up(
        self, portaudio: FakePortAudio, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(FakePortAudio, "InputStream", BrokenStream)
        with device() as opened:
            steps(opened, lambda: "has stopped" in str(opened.problem))

    def test_stream_that_hangs_is_opened_again(self, portaudio: FakePortAudio) -> None:
        with device() as opened:
            steps(opened, lambda: "delivered nothing" in str(opened.problem))
            steps(opened, lambda: len(FakeStream.opened) == 2)
            assert opened.problem is None

    def test_busy_device_is_retried(self, portaudio: FakePortAudio, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(FakeStream, "refusal", FakeError("Device unavailable", -9985))
        with device() as opened:
            assert opened.problem == "device 'UMC1820' cannot be opened: Device unavailable; trying again"
            assert FakeStream.opened[0].closed
            monkeypatch.setattr(FakeStream, "refusal", None)
            steps(opened, lambda: opened.problem is None)

    def test_unsuitable_device_during_a_run_is_a_problem_and_no_error(self, portaudio: FakePortAudio) -> None:
        portaudio.plug()
        with device() as opened:
            portaudio.plugged = [("UMC1820 a", 8), ("UMC1820 b", 8)]
            steps(opened, lambda: "got 2: ALSA: UMC1820 a; ALSA: UMC1820 b" in str(opened.problem))
            portaudio.plugged = portaudio.plugged[:1]
            steps(opened, lambda: opened.problem is None)

    def test_start_of_portaudio_is_retried(self, portaudio: FakePortAudio) -> None:
        umc = portaudio.plugged[-1]
        portaudio.plug()
        with device() as opened:
            portaudio.broken = True
            steps(opened, lambda: "PortAudio cannot be started: no host API" in str(opened.problem))
            portaudio.broken, portaudio.plugged = False, [umc]
            steps(opened, lambda: opened.problem is None)


TONES_HZ = (440.0, 700.0, 1130.0, 1870.0)
"""Frequencies in Hz, one for each channel; none is a harmonic of another."""

AMPLITUDE = 0.5

RECORDER = """
import sys
import numpy as np
from livessl.capture.sound_device import SoundDevice
from livessl.clock import SystemClock
from livessl.site.node_models import SoundDeviceConfig

with SoundDevice(SoundDeviceConfig(name="virtual", sample_rate_hz=48000), 4, SystemClock()) as device:
    blocks = []
    for block in device:
        if block.samples.shape[1] > 0:
            blocks.append(block)
        if len(blocks) == int(sys.argv[2]):
            break
np.savez(
    sys.argv[1],
    samples=np.hstack([block.samples for block in blocks]),
    first_index=[block.first_index for block in blocks],
    stamp_ns=[block.stamp_ns for block in blocks],
    overflow=[block.overflow for block in blocks],
)
"""

WATCHER = """
import json
from livessl.capture.sound_device import SoundDevice
from livessl.clock import SystemClock
from livessl.site.node_models import SoundDeviceConfig

clock, last = SystemClock(), None
end_ns = clock.now_ns() + 60_000_000_000
with SoundDevice(SoundDeviceConfig(name="virtual", sample_rate_hz=48000), 4, clock) as device:
    for block in device:
        state = (block.samples.shape[1] > 0, block.overflow, device.problem)
        if state != last:
            print(json.dumps({"index": block.first_index, "sound": state[0], "overflow": state[1],
                              "problem": state[2]}), flush=True)
            last = state
        if clock.now_ns() > end_ns:
            break
"""


class VirtualCard:
    """A virtual sound card of four channels, a private PulseAudio: sound that is played into it can be recorded."""

    CHANNELS = "front-left,front-right,rear-left,rear-right"
    """Channel map in ALSA's order of four channels, so that no layer remixes them."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        socket = directory / "native"
        alsa = directory / "asound.conf"
        alsa.write_text(
            'pcm.virtual {\n type pulse\n device "virtual.monitor"\n}\n'
            "pcm.default {\n type null\n}\n"  # PortAudio counts on there being a default
        )
        directory.chmod(0o700)
        self.environment = {
            **os.environ,
            "HOME": str(directory),
            "XDG_RUNTIME_DIR": str(directory),
            "XDG_CONFIG_HOME": str(directory),
            "PULSE_RUNTIME_PATH": str(directory),
            "PULSE_SERVER": f"unix:{socket}",
            "ALSA_CONFIG_PATH": str(alsa),
            "JACK_NO_START_SERVER": "1",
        }
        self.socket = socket
        self.running: list[subprocess.Popen[str]] = []
        self.server: subprocess.Popen[str] | None = None

    def plug_in(self) -> None:
        """Start the card, and wait until it answers."""
        self.server = self.start(
            "pulseaudio",
            "--daemonize=no",
            "--use-pid-file=no",
            "--exit-idle-time=-1",
            "--log-target=null",
            "-n",
            f"--load=module-native-protocol-unix auth-anonymous=1 socket={self.socket}",
            f"--load=module-null-sink sink_name=virtual channels=4 rate={RATE_HZ} channel_map={self.CHANNELS}",
        )
        server = self.server
        wait_until(lambda: server.poll() is not None or self._sinks() == ["virtual"], "pulseaudio's answer")
        assert server.poll() is None, f"pulseaudio has exited with {server.returncode}"

    def _sinks(self) -> list[str]:
        listed = subprocess.run(
            ["pactl", "list", "short", "sinks"], env=self.environment, capture_output=True, text=True, check=False
        )
        return [line.split("\t")[1] for line in listed.stdout.splitlines()]

    def pull_out(self) -> None:
        """Stop the card."""
        assert self.server is not None
        self.server.terminate()
        self.server.wait()

    def play(self, samples: NDArray[np.float32]) -> None:
        """Begin to play (n, 4) samples."""
        path = self.directory / "signal.raw"
        path.write_bytes(samples.astype("<f4").tobytes())
        self.start(
            "pacat",
            "--playback",
            "--raw",
            "--device=virtual",
            "--format=float32le",
            "--channels=4",
            f"--rate={RATE_HZ}",
            f"--channel-map={self.CHANNELS}",
            str(path),
        )

    def start(self, *command: str) -> subprocess.Popen[str]:
        """Start a program that sees only this card; it ends with the test."""
        process = subprocess.Popen(
            command, env=self.environment, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )
        self.running.append(process)
        return process

    def close(self) -> None:
        """End everything."""
        for process in reversed(self.running):
            process.terminate()
        for process in self.running:
            with suppress(subprocess.TimeoutExpired):
                process.wait(timeout=HANG_S)
            process.kill()
            process.communicate()


@pytest.fixture
def card(tmp_path_factory: pytest.TempPathFactory) -> Iterator[VirtualCard]:
    for program in ("pulseaudio", "pactl", "pacat"):
        require(shutil.which(program) is not None, f"{program} is not installed (pulseaudio, pulseaudio-utils)")
    require(find_library("portaudio") is not None, "PortAudio is not installed (libportaudio2)")
    plugins = [*Path("/usr").glob("lib*/*/alsa-lib/libasound_module_pcm_pulse.so")]
    plugins += Path("/usr").glob("lib*/alsa-lib/libasound_module_pcm_pulse.so")
    require(plugins != [], "ALSA's pulse plugin is not installed (libasound2-plugins)")
    card = VirtualCard(tmp_path_factory.mktemp("card"))  # a short path: sockets have at most 107 characters
    try:
        yield card
    finally:
        card.close()


def sine_parts(signal: NDArray[np.floating[Any]], frequency_hz: float) -> tuple[float, float]:
    """Return the amplitude of the best fitting sine, and the RMS of the residual."""
    phase = 2 * np.pi * frequency_hz * np.arange(len(signal)) / RATE_HZ
    basis = np.column_stack([np.cos(phase), np.sin(phase)])
    weights, *_ = np.linalg.lstsq(basis, signal, rcond=None)
    return float(np.hypot(*weights)), float(np.sqrt(np.mean((signal - basis @ weights) ** 2)))


@pytest.mark.sound_card
def test_each_channel_of_a_card_is_recorded_in_its_place(card: VirtualCard, tmp_path: Path) -> None:
    card.plug_in()
    seconds = np.arange(20 * RATE_HZ)[:, None] / RATE_HZ
    card.play((AMPLITUDE * np.sin(2 * np.pi * np.array(TONES_HZ) * seconds)).astype(np.float32))
    path, count = tmp_path / "recorded.npz", 200
    recorder = card.start(sys.executable, "-c", RECORDER, str(path), str(count))
    assert recorder.wait(timeout=HANG_S) == 0
    recorded = np.load(path)

    assert recorded["samples"].shape == (4, count * BLOCK)
    assert not recorded["overflow"].any()
    assert_array_equal(recorded["first_index"], BLOCK * np.arange(count))
    # Stamps serve to put frames on a frame index of 50 ms, so most must lie nearer than that to an even run.
    even_ns = recorded["stamp_ns"][0] + recorded["first_index"] / RATE_HZ * 1e9
    assert np.median(np.abs(recorded["stamp_ns"] - even_ns)) < FRAME_NS

    # The card keeps 16 bits: rounding leaves 2^-15 / sqrt(12) = 9e-6 RMS in each of player, mixer and monitor. One
    # sample lost shifts a 440 Hz tone by d = 0.058 rad from there on; a loss after a fraction f of the second leaves
    # 0.5 d sqrt(f (1 - f) / 2) RMS: 1e-2 in the middle, and above 1e-4 unless it is among the last two samples.
    last_second = recorded["samples"][:, -RATE_HZ:].astype(np.float64)
    for channel, frequency_hz in enumerate(TONES_HZ):
        amplitude, rest = sine_parts(last_second[channel], frequency_hz)
        assert amplitude == pytest.approx(AMPLITUDE, rel=0.01), f"channel {channel + 1}"
        assert rest < 1e-4, f"channel {channel + 1}"
        others = [sine_parts(last_second[k], frequency_hz)[0] for k in range(4) if k != channel]
        assert max(others) < 1e-4, f"tone of channel {channel + 1} leaks"


@pytest.mark.sound_card
def test_card_that_is_pulled_out_is_opened_again(card: VirtualCard) -> None:
    watcher = card.start(sys.executable, "-c", WATCHER)
    assert watcher.stdout is not None
    states: Iterator[dict[str, Any]] = (json.loads(line) for line in watcher.stdout)

    absent = next(states)
    assert not absent["sound"]
    assert "'virtual' is not connected" in absent["problem"]
    card.plug_in()
    first = next(state for state in states if state["sound"])
    assert first["problem"] is None
    card.pull_out()
    gone = next(state for state in states if state["problem"])
    assert "'virtual' has stopped" in gone["problem"]
    assert gone["index"] > first["index"]
    card.plug_in()
    back = next(state for state in states if state["sound"])
    assert back == {"index": gone["index"], "sound": True, "overflow": True, "problem": None}
