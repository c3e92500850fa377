"""Base class and field types of the models of the site file (positions, intervals, file names)."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

Coordinate = Annotated[float, Field(ge=-1e6, le=1e6, allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, le=1e6, allow_inf_nan=False)]
Position = tuple[Coordinate, Coordinate, Coordinate]
Interval = tuple[Coordinate, Coordinate]
Bounds = tuple[Interval, Interval, Interval]
BandHz = tuple[Annotated[float, Field(ge=0)], Positive]


def without_nul(name: str) -> str:
    """Return the path of a file; raise `ValueError` if no file can have it."""
    if "\0" in name:
        raise ValueError(f"expected the path of a file, without NUL characters, got {name!r}")
    return name


FileName = Annotated[str, Field(min_length=1), AfterValidator(without_nul)]
"""Path of a file or folder; `Site.file` resolves it from the site file's folder."""


def ordered(bounds: Bounds) -> Bounds:
    """Return bounds whose lower ends are not above the upper ones.

    Raises
    ------
    ValueError
        If they are not.
    """
    for axis, (low, high) in zip("xyz", bounds, strict=True):
        if low > high:
            raise ValueError(f"expected lower <= upper on {axis}, got [{low:g}, {high:g}]; swap them")
    return bounds


class Model(BaseModel):
    """Base of all models of the site file: frozen, and without unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid")
