"""Recording through a sound server: a private PulseAudio."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Iterator
from ctypes.util import find_library
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from numpy.typing import NDArray

from conftest import require
from livessl.core.types import FRAME_NS
from small_site import HANG_S
from sound_server import RATE_HZ, VirtualCard

BLOCK = 960
"""Samples in the configured default of 20 ms at 48 kHz."""

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
    seconds = np.arange(60 * RATE_HZ)[:, None] / RATE_HZ
    card.play((AMPLITUDE * np.sin(2 * np.pi * np.array(TONES_HZ) * seconds)).astype(np.float32))
    path, count = tmp_path / "recorded.npz", 200
    for _ in range(3):  # on a machine that is busy sound is lost, and told as lost
        recorder = card.start(sys.executable, "-c", RECORDER, str(path), str(count))
        assert recorder.wait(timeout=HANG_S) == 0
        recorded = np.load(path)
        if not recorded["overflow"].any():
            break

    assert recorded["samples"].shape == (4, count * BLOCK)
    assert not recorded["overflow"].any()
    assert_array_equal(recorded["first_index"], BLOCK * np.arange(count))
    # Stamps serve to put frames on a frame index of 50 ms, so most must lie nearer than that to an even run. The first
    # ones are no measure of it: a sound server that has just started delivers them late or at once.
    offset_ns = recorded["stamp_ns"] - recorded["first_index"] / RATE_HZ * 1e9
    assert np.median(np.abs(offset_ns - np.median(offset_ns))) < FRAME_NS

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
    assert "'virtual'" in gone["problem"]
    assert gone["index"] > first["index"]
    card.plug_in()
    back = next(state for state in states if state["sound"])
    assert back["index"] >= gone["index"]  # what was received before the end may be read after it
    assert (back["overflow"], back["problem"]) == (True, None)
