"""Arguments and answers that describe a new site: each function turns a text into a value."""

from __future__ import annotations

import argparse
import math
import re
from dataclasses import dataclass
from typing import Final

from livessl.cli import argument
from livessl.errors import did_you_mean
from livessl.site.draft_parts import MICROPHONES, SIZE_M

SIZES: Final = {
    "tetrahedron": "edge",
    "square": "edge",
    "line": "distance between neighbours",
    "circle": "radius",
}
"""Name of the size of each kind of array."""

COUNTED: Final = ("line", "circle")
"""Kinds of arrays with any number of microphones."""

MOST_ARRAYS: Final = 64
"""Most arrays of a site that is drafted: each is checked beside all others, and more are written by a script."""

_ARRAY: Final = re.compile(r"(?P<name>[^=]+)=(?P<kind>[a-z]+)(:(?P<size>[^@x]+)(x(?P<count>[0-9]+))?)?(?P<pose>@.*)?")
_EXPECTED: Final = "expected NAME=KIND:SIZE@X,Y,Z@YAW, such as north=tetrahedron:0.5@4,2.5,1.5@90, got"


@dataclass(frozen=True, slots=True)
class ArrayWish:
    """A new array as it was asked for, in metres and degrees; None where size, place or yaw is proposed."""

    name: str
    kind: str = "tetrahedron"
    size_m: float | None = None
    count: int = MICROPHONES
    centre_m: tuple[float, float, float] | None = None
    yaw_deg: float | None = None


def array(text: str) -> ArrayWish:
    """Return an array from `NAME=KIND[:SIZE[xCOUNT]][@X,Y,Z[@YAW]]`."""
    found = _ARRAY.fullmatch(text)
    if found is None:
        raise argparse.ArgumentTypeError(f"{_EXPECTED} {text!r}")
    kind, count = found["kind"], found["count"]
    if kind not in SIZE_M:
        raise argparse.ArgumentTypeError(
            f"expected an array of kind {', '.join(SIZE_M)}, got {kind!r}{did_you_mean(kind, SIZE_M)}"
        )
    if count is not None and kind not in COUNTED:
        raise argparse.ArgumentTypeError(f"expected {kind}:SIZE, which has {MICROPHONES} microphones, got {text!r}")
    place, _, yaw = (found["pose"] or "")[1:].partition("@")
    return ArrayWish(
        name(found["name"]),
        kind,
        None if found["size"] is None else argument.above_zero(found["size"]),
        MICROPHONES if count is None else argument.positive(count),
        argument.place(place) if place else None,
        finite(yaw) if yaw else None,
    )


def array_count(text: str) -> int:
    """Return a number of arrays, 1 to `MOST_ARRAYS`."""
    count = argument.positive(text)
    if count > MOST_ARRAYS:
        raise argparse.ArgumentTypeError(f"expected 1 to {MOST_ARRAYS} arrays, got {count}")
    return count


def name(text: str) -> str:
    """Return a name of 1 to 64 letters, digits, '.', '_' and '-'."""
    if re.fullmatch(r"[A-Za-z0-9._-]{1,64}", text) is None:
        raise argparse.ArgumentTypeError(f"expected a name of letters, digits, '.', '_' and '-', got {text!r}")
    return text


def room(text: str) -> tuple[float, float, float]:
    """Return the size of a room, three lengths above 0 in metres."""
    size_m = argument.place(text)
    if min(size_m) <= 0:
        raise argparse.ArgumentTypeError(f"expected three lengths above 0, such as 8,10,2.7, got {text!r}")
    return size_m


def inputs(text: str) -> tuple[int, ...]:
    """Return channel numbers from `1,2,3,4`."""
    return tuple(argument.positive(number.strip()) for number in text.split(","))


def finite(text: str) -> float:
    """Return a finite number."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"expected a number, got {text!r}")
    return value
