"""Starts a process that lists audio inputs or searches for one, because a sound library may hang while it does so.

`portaudio.py` decides which input a name, serial number or USB port means. Each search starts the library anew, because
only then does the library list devices that were connected since.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any, Final

from livessl.capture.device_report import Wanted
from livessl.capture.portaudio import InputDevice, find_input, input_devices
from livessl.errors import DeviceError

SEARCH_S: Final = 15.0
"""Longest wait for a search, in seconds; slow machines load the library for seconds."""

PROGRAM: Final = (sys.executable, "-P", "-m", __name__)
"""The program that searches."""


def list_inputs(program: Sequence[str] = PROGRAM, wait_s: float = SEARCH_S) -> list[InputDevice]:
    """Return all audio inputs of this machine, in the order of the library.

    Parameters
    ----------
    program : sequence of str
        The program that lists them.
    wait_s : float
        Longest wait for it, in seconds.

    Raises
    ------
    DeviceError
        If PortAudio is not installed, cannot list the devices, hangs or fails.
    """
    try:
        done = subprocess.run(program, capture_output=True, timeout=wait_s, check=True)  # noqa: S603  # our program
        answer = json.loads(done.stdout.splitlines()[-1])
    except subprocess.TimeoutExpired as error:
        raise DeviceError(
            f"the sound library did not list the devices within {wait_s:g} s; unplug the interface that was connected "
            "last, or restart the sound server, then try again"
        ) from error
    except subprocess.CalledProcessError as error:
        raise DeviceError(f"the sound library failed while it listed the devices: {_last_words(error)}") from error
    except (OSError, ValueError, IndexError) as error:
        raise DeviceError(f"the process that lists the devices gave no list: {error}") from error
    if "error" in answer:
        raise DeviceError(answer["error"])
    return [InputDevice(**found) for found in answer["inputs"]]


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
    command = [*PROGRAM, wanted.to_json()]
    try:
        done = subprocess.run(command, capture_output=True, timeout=SEARCH_S, check=True)  # noqa: S603  # our program
        found = json.loads(done.stdout.splitlines()[-1])
    except (subprocess.SubprocessError, OSError, ValueError, IndexError):
        return None
    return None if found is None else InputDevice(**found)


def _last_words(error: subprocess.CalledProcessError) -> str:
    """Return how a process ended, with the last line that it printed to stderr."""
    how = f"signal {-error.returncode}" if error.returncode < 0 else f"code {error.returncode}"
    lines = error.stderr.decode("utf-8", "replace").split("\n")
    last = next((line.strip() for line in reversed(lines) if line.strip()), "")
    return f"{how}; {last}" if last else how


def _main() -> None:
    answer: Any
    if len(sys.argv) > 1:
        found = find_input(Wanted.from_json(sys.argv[1]))
        answer = None if found is None else asdict(found)
    else:
        try:
            answer = {"inputs": [asdict(device) for device in input_devices()]}
        except DeviceError as error:
            answer = {"error": str(error)}
    sys.stdout.write("\n" + json.dumps(answer) + "\n")
    sys.stdout.flush()
    os._exit(0)  # a library may hang at its end


if __name__ == "__main__":
    _main()
