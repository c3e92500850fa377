"""The parts of a new site. It imports nothing that takes time, so that the help of a command may use it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from livessl.site.fields import Bounds

SIZE_M: Final = {"tetrahedron": 0.5, "square": 0.5, "line": 0.1, "circle": 0.05}
"""Kinds of arrays with their default size in metres: the edge, the distance of neighbours on a line, the radius."""

MICROPHONES: Final = 4
"""Number of microphones of an array, where nothing else is given."""


@dataclass(frozen=True, slots=True)
class DraftArray:
    """One array.

    Parameters
    ----------
    name : str
    kind : str
        A key of `SIZE_M`.
    size_m : float
        Edge, distance of neighbours, or radius, metres.
    count : int
        Number of microphones; 4 for a tetrahedron and a square.
    centre_m : tuple of float
        Its centre in the room, metres.
    yaw_deg : float
        Turn about the vertical, counter-clockwise from above, degrees.
    """

    name: str
    kind: str
    size_m: float
    count: int
    centre_m: tuple[float, float, float]
    yaw_deg: float


@dataclass(frozen=True, slots=True)
class DraftNode:
    """One audio interface: its name, its sampling rate in hertz, and the channels, from 1, of each of its arrays."""

    name: str
    interface: str
    rate_hz: float
    channels: dict[str, tuple[int, ...]]


@dataclass(frozen=True, slots=True)
class Draft:
    """A whole site; lengths in metres, temperature in degrees Celsius. `bounds_m` None searches the whole room."""

    site: str
    room_m: tuple[float, float, float]
    temperature_c: float
    arrays: tuple[DraftArray, ...]
    nodes: tuple[DraftNode, ...]
    bounds_m: Bounds | None = None
