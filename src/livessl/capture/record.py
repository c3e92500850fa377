"""Records an audio device to a session, for `livessl record`; the files are written in `recordings/recorder.py`."""

from __future__ import annotations

import logging
from collections.abc import Callable

from livessl.capture.device import Device
from livessl.recordings.recorder import Recorder

_log = logging.getLogger(__name__)


def record_device(recorder: Recorder, device: Device, over: Callable[[], bool]) -> None:
    """Record a device until `over` returns True; problems of the device are logged."""
    problem = None
    with device, recorder:
        for block in device:
            if device.problem != problem:
                problem = device.problem
                _log.warning("%s", problem or f"device {device.name!r} delivers sound again")
            recorder.push(block)
            if over():
                break
