"""The request to the process that owns a device, and that process's reports on the device's state, as JSON.

This module uses only the standard library, because the device process imports as little as possible.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from enum import StrEnum

from livessl.capture.ring import RingShape


@dataclass(frozen=True, slots=True)
class Wanted:
    """The requested device.

    Parameters
    ----------
    name : str
        Name, part of it, or `HOSTAPI: part of the name`.
    channels : int
        Number of channels to record, counted from the first channel.
    sample_rate_hz : float
    block_samples : int
        Samples per channel of one block.
    latency_s : float
        Latency requested from the driver, in seconds: the size of its buffer.
    slots : int
        Number of blocks in the ring.
    serial : str or None
        Serial number of the USB device; None if any will do.
    usb_port : str or None
        USB port, such as `usb-0000:00:14.0-2`; None if any will do.
    """

    name: str
    channels: int
    sample_rate_hz: float
    block_samples: int
    latency_s: float
    slots: int
    serial: str | None = None
    usb_port: str | None = None

    @property
    def ring(self) -> RingShape:
        """Shape of the ring for the blocks of the device."""
        return RingShape(self.channels, self.block_samples, self.slots)

    def to_json(self) -> str:
        """Return the text that `from_json` reads."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> Wanted:
        """Return what `to_json` has written."""
        return cls(**json.loads(text))


class DeviceState(StrEnum):
    """State of the device, as the process that owns it reports it."""

    OPEN = "open"
    """The stream has started."""
    ABSENT = "absent"
    """No input has that name."""
    BUSY = "busy"
    """Another program holds the device."""
    UNSUITABLE = "unsuitable"
    """The device cannot be used even later: wrong rate, too few channels, an ambiguous name, or no PortAudio."""
    FAILED = "failed"
    """The device cannot be opened for another reason."""
    STOPPED = "stopped"
    """The stream has ended; the process ends as well."""


@dataclass(frozen=True, slots=True)
class Report:
    """A change of state.

    Parameters
    ----------
    state : DeviceState
    message : str
        The problem, in words; empty if there is none.
    hardware : bool
        Whether samples come directly from the device, not through a sound server.
    not_realtime : str
        Reason why the process has no real-time scheduling or no locked memory; empty if it has both.
    """

    state: DeviceState
    message: str = ""
    hardware: bool = False
    not_realtime: str = ""

    def to_json(self) -> str:
        """Return one line."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, line: str) -> Report:
        """Return what `to_json` has written."""
        data = json.loads(line)
        return cls(**{**data, "state": DeviceState(data["state"])})


class OpeningError(Exception):
    """Reason why a device cannot be opened now.

    Parameters
    ----------
    state : DeviceState
    message : str
        Words for the problem: what, expected, got, cure.
    """

    def __init__(self, state: DeviceState, message: str) -> None:
        super().__init__(message)
        self.state = state
