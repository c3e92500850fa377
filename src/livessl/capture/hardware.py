"""Reads the kernel's list of capture devices (ALSA): names, USB ports, serial numbers, and which program uses one.

PortAudio hides a device that another program uses. The kernel's list distinguishes it from a device that is not
connected.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Final

_ASOUND: Final = Path("/proc/asound")
_CARD: Final = re.compile(r"^ *(\d+) \[.*?\]: .*? - (.*)\n +(.*)$", re.MULTILINE)
_PCM: Final = re.compile(r"^(\d+)-(\d+): .*? : (.*?) :(.*)$", re.MULTILINE)
_PORT: Final = re.compile(r"\bat (usb-[^ ,]+)")
_OWNER: Final = re.compile(r"^owner_pid *: *(\d+)", re.MULTILINE)


@dataclass(frozen=True, slots=True)
class HardwareInput:
    """A capture device of the kernel.

    Parameters
    ----------
    card : int
    device : int
        Numbers of card and device, as in `hw:CARD,DEVICE`. They change when interfaces are plugged in again.
    name : str
        PortAudio's name of the device.
    usb_port : str or None
        USB port, such as `usb-0000:00:14.0-2`; None if it is not on USB.
    serial : str or None
        Serial number; None if it has none.
    """

    card: int
    device: int
    name: str
    usb_port: str | None
    serial: str | None

    @property
    def holder(self) -> str | None:
        """The program that records from the device, `NAME (process ID)`; None if there is none, or it is unknown."""
        status = _read(_ASOUND / f"card{self.card}/pcm{self.device}c/sub0/status")
        owner = _OWNER.search(status)
        if owner is None:
            return None
        program = _read(Path(f"/proc/{owner[1]}/comm")).strip() or "a program"
        return f"{program} (process {owner[1]})"


def hardware_inputs() -> list[HardwareInput]:
    """Return the capture devices that the kernel lists; none on a system that is not Linux."""
    cards = {
        int(number): (name, _PORT.search(place)) for number, name, place in _CARD.findall(_read(_ASOUND / "cards"))
    }
    found = []
    for card_text, device_text, pcm, directions in _PCM.findall(_read(_ASOUND / "pcm")):
        card, device = int(card_text), int(device_text)
        if "capture" not in directions or card not in cards:
            continue
        name, port = cards[card]
        serial = _read(Path(f"/sys/class/sound/card{card}/device/../serial")).strip() if port else ""
        found.append(
            HardwareInput(
                card, device, f"{name}: {pcm} (hw:{card},{device})", port[1] if port else None, serial or None
            )
        )
    return found


def _read(path: Path) -> str:
    """Return a file's text; empty if it cannot be read, because devices can disappear."""
    try:
        return path.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""
