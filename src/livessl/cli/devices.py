"""`livessl devices`: lists the audio inputs of this machine by the names that a site file uses."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from livessl.capture.input_search import list_inputs
from livessl.capture.portaudio import InputDevice
from livessl.cli.exits import FAILED, OK
from livessl.cli.options import add_json
from livessl.cli.output import complain


def add_arguments(parser: Any) -> None:
    """Describe the command's arguments."""
    add_json(parser, "print one JSON array")


def run(arguments: argparse.Namespace) -> int:
    """Run the command."""
    devices = list_inputs()
    if arguments.json:
        print(json.dumps([asdict(device) for device in devices]))
    else:
        if devices:
            print(f"{'channels':>8}  {'rate':>8}  name")
        for device in devices:
            print(f"{device.channels:8d}  {device.default_sample_rate_hz:6.0f}Hz  {device.host_api}: {device.name}")
        if devices:
            print("\nfor the site file, under nodes.NAME:")
        for device in devices:
            print(f"  device: {_entry(device, devices)}")
    if not devices:
        complain(
            "no audio input found; connect an audio interface, then run `livessl devices` again "
            "(on Linux, `arecord -l` must list it, too)"
        )
        return FAILED
    return OK


def _entry(device: InputDevice, devices: Sequence[InputDevice]) -> str:
    """Return what a site file says to mean this device: its name, and its place on USB if others have that name.

    The name is cut before ALSA's `(hw:…)`, which changes when interfaces are plugged in again. A serial number goes
    with the interface, a USB port stays with the plug.
    """
    name = device.name.partition(" (hw:")[0]
    same = [other for other in devices if other.matches(name)]
    entry = {"name": name if device.is_hardware else device.label}
    if len(same) > 1 and device.serial and [other.serial for other in same].count(device.serial) == 1:
        entry["serial"] = device.serial
    elif len(same) > 1 and device.usb_port:
        entry["usb_port"] = device.usb_port
    values = [f"{key}: {json.dumps(value, ensure_ascii=False)}" for key, value in entry.items()]
    values.append(f"sample_rate_hz: {device.default_sample_rate_hz:.0f}")
    return f"{{{', '.join(values)}}}"
