"""A fault of a pose that some sounds could not have shown, as a value."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

CURE: Final = "clap at places that you know, and run livessl calibrate verify"
"""Action that shows a fault which sounds at unknown places hide."""

MOST_SHIFT_M: Final = 1000.0
"""Least visible shift, in metres, beyond which its size is not reported: practically no shift would show."""

MOST_TURN_DEG: Final = 180.0
"""Least visible turn, in degrees, beyond which its size is not reported: no turn would show."""


@dataclass(frozen=True, slots=True)
class BlindSpot:
    """A fault of a pose that some sounds would not show.

    Parameters
    ----------
    fault : str
        `moved`, `turned` or `mirrored`.
    arrays : tuple of str
        The array; several if the same fault of each of them would be hidden alike, and of a mirrored room those whose
        channels would be exchanged.
    least : float
        Smallest shift, in metres, or turn, in degrees, that the sounds would show in nine of ten cases. Of a mirrored
        room the turn, in degrees, that some array would have besides exchanged channels.
    along : (3,) tuple of float
        Unit vector of the shift, of the axis of the turn, or at right angles to the plane of the mirror.
    """

    fault: str
    arrays: tuple[str, ...]
    least: float
    along: tuple[float, ...]

    @property
    def message(self) -> str:
        """One sentence, without a full stop, that says what the sounds cannot show."""
        names = " or ".join(repr(name) for name in self.arrays)
        along = ", ".join(f"{x:.2f}" for x in self.along)
        if self.fault == "mirrored":
            return (
                "these sounds cannot show whether all places are mirrored in the plane through the arrays, at right "
                f"angles to ({along}), because channels are exchanged at {' and '.join(map(repr, self.arrays))}, and "
                f"arrays are turned by up to {self.least:.0f} degrees"
            )
        if self.fault == "turned":
            size = f" by less than {self.least:.0f} degrees" if self.least < MOST_TURN_DEG else ""
            how = f"turned{size} about ({along})"
        else:
            size = f" by less than {self.least:.1f} m" if self.least < MOST_SHIFT_M else ""
            how = f"moved{size} along ({along})"
        return f"these sounds cannot show whether {names} is {how}"
