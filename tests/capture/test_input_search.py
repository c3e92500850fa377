"""The list of inputs comes from a process of its own, whatever the sound library does in it."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict

import pytest

from livessl.capture.input_search import list_inputs
from livessl.capture.portaudio import InputDevice
from livessl.errors import DeviceError
from small_site import HANG_S

FOUND = [
    InputDevice("UMC1820: USB Audio (hw:1,0)", "ALSA", 8, 48000.0, "A1", "usb-0000:00:14.0-1"),
    InputDevice("Micr\ufffdfono", "ALSA", 2, 44100.0),
]


def program(script: str) -> tuple[str, ...]:
    return (sys.executable, "-c", f"import os, sys, time\n{script}")


def test_inputs_are_listed_whatever_the_library_prints_before() -> None:
    answer = json.dumps({"inputs": [asdict(device) for device in FOUND]})
    script = f"os.write(1, b'ALSA lib: noise'); print(); print({answer!r}); os.write(2, b'jack: noise')"
    assert list_inputs(program(script), HANG_S) == FOUND


@pytest.mark.parametrize(
    ("script", "wait_s", "words"),
    [
        ("time.sleep(1000)", 0.3, "did not list the devices within 0.3 s; unplug the interface that was connected"),
        (
            "os.write(2, b'noise\\nassertion failed\\n\\n'); os.kill(os.getpid(), 9)",
            HANG_S,
            "signal 9; assertion failed",
        ),
        ("os._exit(3)", HANG_S, "failed while it listed the devices: code 3"),
        ("print('no list')", HANG_S, "gave no list: "),
        ("pass", HANG_S, "gave no list: "),
        ('print(\'{"error": "install PortAudio"}\')', HANG_S, "^install PortAudio"),
    ],
)
def test_library_that_hangs_or_fails_is_an_error_with_a_cure(script: str, wait_s: float, words: str) -> None:
    with pytest.raises(DeviceError, match=words):
        list_inputs(program(script), wait_s)
