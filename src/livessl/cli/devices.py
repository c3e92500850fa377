"""`livessl devices`: the audio inputs of this machine, by the names that a site file uses."""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from typing import Any

from livessl.capture.portaudio import input_devices
from livessl.cli.exits import FAILED, OK
from livessl.cli.options import add_json
from livessl.cli.output import complain


def add_arguments(parser: Any) -> None:
    """Describe the command's arguments."""
    add_json(parser, "print one JSON array")


def run(arguments: argparse.Namespace) -> int:
    """Run the command."""
    devices = input_devices()
    if arguments.json:
        print(json.dumps([asdict(device) for device in devices]))
    else:
        if devices:
            print(f"{'channels':>8}  {'rate':>8}  name")
        for device in devices:
            print(f"{device.channels:8d}  {device.default_sample_rate_hz:6.0f}Hz  {device.host_api}: {device.name}")
    if not devices:
        complain(
            "no audio input found; connect an audio interface, then run `livessl devices` again "
            "(on Linux, `arecord -l` must list it, too)"
        )
        return FAILED
    return OK
