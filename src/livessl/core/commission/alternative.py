"""An alternative to the filed set-up, and how large a turn, shift or delay must be for doctor to report it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

LEAST_TURN_DEG: Final = 3.0
"""Smallest rotation, in degrees, that is reported."""

LEAST_SHIFT_M: Final = 0.1
"""Smallest shift, in metres, that is reported."""

LEAST_DISPLACEMENT_M: Final = 0.02
"""Smallest displacement of a single microphone, in metres, that is reported."""

LEAST_LATE_S: Final = 40e-6
"""Smallest delay of a single channel, in seconds, that is reported: two samples at 48 kHz."""

LEAST_SPEED_M_S: Final = 6.0
"""Smallest error of the speed of sound, in m/s, that is reported: about 10 degrees of temperature."""


@dataclass(frozen=True, slots=True)
class Alternative:
    """A set-up that differs from the filed one.

    Parameters
    ----------
    fault : str
        Code of the fault: swapped, mirrored, exchanged, turned, moved, height, late_channel, geometry,
        temperature.
    array : str or None
        The array that differs from the filed set-up; None for the whole site.
    other : str or None
        The array with which `array` is exchanged.
    channel : int or None
        The channel, counted from 1, that is late or whose microphone is at another place.
    misfit_s : float
        Misfit of the sounds with this set-up, seconds.
    criterion : float
        Bayesian information criterion; the lowest is best.
    order : tuple of int
        For each microphone of the site file, the channel from 1 that carries it; empty if channels are as filed.
    turn_deg, shift_m : (3,) tuple of float
        Rotation of the array about its centre (a vector along the axis), and shift of the array or the microphone.
    late_s : float
        Delay of the channel, seconds.
    speed_m_s : float or None
        Speed of sound, m/s, if it differs.
    speed_off_m_s : float
        Difference from the filed speed of sound, m/s.
    """

    fault: str
    array: str | None
    misfit_s: float
    criterion: float
    other: str | None = None
    channel: int | None = None
    order: tuple[int, ...] = ()
    turn_deg: tuple[float, ...] = (0.0, 0.0, 0.0)
    shift_m: tuple[float, ...] = (0.0, 0.0, 0.0)
    late_s: float = 0.0
    speed_m_s: float | None = None
    speed_off_m_s: float = 0.0

    @property
    def concerns(self) -> tuple[str | None, str | None, int | None]:
        """The arrays and the channel that differ; alternatives about the same ones do not compete with each other."""
        return self.array, self.other, self.channel

    @property
    def is_large(self) -> bool:
        """True if the difference is larger than in a careful set-up."""
        if self.fault == "turned":
            return float(np.linalg.norm(self.turn_deg)) >= LEAST_TURN_DEG
        if self.fault in ("moved", "height", "geometry"):
            least_m = LEAST_DISPLACEMENT_M if self.fault == "geometry" else LEAST_SHIFT_M
            return float(np.linalg.norm(self.shift_m)) >= least_m
        if self.fault == "late_channel":
            return abs(self.late_s) >= LEAST_LATE_S
        return self.fault != "temperature" or abs(self.speed_off_m_s) >= LEAST_SPEED_M_S
