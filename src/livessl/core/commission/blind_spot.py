"""Words a blind spot, a fault of a pose that the sounds so far cannot reveal; `blind_spots` finds them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

CURE: Final = "clap at places that you know, and run livessl calibrate verify"
"""Action that reveals a fault which sounds at unknown places hide."""

MOST_SHIFT_M: Final = 1000.0
"""Least visible shift, in metres, from which its size is not reported, because practically no shift would be
visible."""

MOST_TURN_DEG: Final = 180.0
"""Least visible rotation, in degrees, from which its size is not reported, because no rotation would be visible."""


@dataclass(frozen=True, slots=True)
class BlindSpot:
    """A fault of a pose that some sounds would not reveal.

    Parameters
    ----------
    fault : str
        `moved`, `turned` or `mirrored`.
    arrays : tuple of str
        The array; several if the same fault would be hidden for each of them. For a mirrored room, the arrays whose
        channels would be exchanged.
    least : float
        Smallest shift, in metres, or rotation, in degrees, that the sounds would reveal in nine of ten cases. For a
        mirrored room, the largest rotation, in degrees, of an array in addition to exchanged channels.
    along : (3,) tuple of float
        Unit vector of the shift, of the axis of rotation, or at right angles to the plane of the mirror.
    """

    fault: str
    arrays: tuple[str, ...]
    least: float
    along: tuple[float, ...]

    @property
    def message(self) -> str:
        """One sentence, without a full stop, that describes the fault that the sounds cannot reveal."""
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
