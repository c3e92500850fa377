"""Audio interfaces that are known: how many inputs they have, and which of them are microphones.

It knows names and numbers only, and opens no device.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True, slots=True)
class Interface:
    """An audio interface.

    Parameters
    ----------
    name : str
        Part of the name by which Linux lists it.
    inputs : int
        Most channels that it delivers.
    microphones : range
        Channels, counted from 1, to which a microphone is connected or can be connected.
    rate_hz : float
        Sampling rate to begin with, Hz.
    others : str
        What the remaining channels are; empty if there are none.
    """

    name: str
    inputs: int
    microphones: range
    rate_hz: float
    others: str = ""


INTERFACES: Final = (
    Interface("UMC1820", 18, range(1, 9), 48000.0, "line, S/PDIF and ADAT inputs"),
    Interface("UMC404HD", 4, range(1, 5), 48000.0),
    Interface("Scarlett 18i20", 26, range(1, 9), 48000.0, "S/PDIF, ADAT and loopback inputs"),
    Interface("ReSpeaker 4 Mic", 6, range(2, 6), 16000.0, "its processed sound (1) and its playback (6)"),
    Interface("XVF3800", 6, range(3, 7), 16000.0, "its processed sound (1 and 2)"),
)
"""Interfaces that `docs/hardware.md` describes, with the sources of these numbers."""


def known_interface(name: str) -> Interface | None:
    """Return the interface that the device name of a site file means; None if it is none of these."""
    folded = name.casefold()
    return next((one for one in INTERFACES if one.name.casefold() in folded), None)
