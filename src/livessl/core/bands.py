"""What a frequency band asks for. It is light: whoever checks a site file loads it."""

from __future__ import annotations

from typing import Final

ENVELOPE_ABOVE: Final = 0.25
"""Lower band edge over band width from which the envelope is used; 100 to 6000 Hz has 0.017, 4 to 16 kHz 0.33."""


def uses_envelope(band_hz: tuple[float, float]) -> bool:
    """Whether R is the magnitude instead of the real part: see `GCCPhat`."""
    low, high = band_hz
    return low > ENVELOPE_ABOVE * (high - low)
