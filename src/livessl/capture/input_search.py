"""Searches for an audio input in a process of its own, because a sound library may hang while it lists the devices.

Each search also starts the library anew: only then does it list devices that were connected since.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import asdict
from typing import Final

from livessl.capture.device_report import Wanted
from livessl.capture.portaudio import InputDevice, find_input

SEARCH_S: Final = 15.0
"""Longest wait for a search, in seconds; slow machines load the library for seconds."""


def search_input(wanted: Wanted) -> InputDevice | None:
    """Return the input that has the wanted name, serial number and USB port.

    Parameters
    ----------
    wanted : Wanted
        The device; an input with fewer channels is not found.

    Returns
    -------
    InputDevice or None
        None if no input or several have that name, if another program holds the device, or if the library fails. The
        attempt to open the device says which.
    """
    command = [sys.executable, "-P", "-m", __name__, wanted.to_json()]
    try:
        done = subprocess.run(command, capture_output=True, timeout=SEARCH_S, check=True)  # noqa: S603  # our program
        found = json.loads(done.stdout.splitlines()[-1])
    except (subprocess.SubprocessError, OSError, ValueError, IndexError):
        return None
    return None if found is None else InputDevice(**found)


def _main() -> None:
    found = find_input(Wanted.from_json(sys.argv[1]))
    sys.stdout.write("\n" + json.dumps(None if found is None else asdict(found)) + "\n")
    sys.stdout.flush()
    os._exit(0)  # a library may hang at its end


if __name__ == "__main__":
    _main()
