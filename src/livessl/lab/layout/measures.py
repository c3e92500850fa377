"""Distances of a site's arrays from walls and each other, and the errors to expect (`livessl check`)."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from livessl.core.types import ArraySpec
from livessl.lab.plan.design import Prediction, predict
from livessl.site.models import Site


@dataclass(frozen=True, slots=True)
class Neighbour:
    """The nearest wall or array: its name, and its distance in metres."""

    name: str
    distance_m: float


@dataclass(frozen=True, slots=True)
class ArrayLayout:
    """One array.

    Parameters
    ----------
    spec : ArraySpec
    node : str or None
        Node that captures it.
    wall : Neighbour
        The wall, floor or ceiling nearest to one of its microphones.
    nearest : Neighbour or None
        The array whose centre is nearest to its own; None if it is alone.
    """

    spec: ArraySpec
    node: str | None
    wall: Neighbour
    nearest: Neighbour | None


@dataclass(frozen=True, slots=True)
class Layout:
    """A site with its distances.

    Parameters
    ----------
    site : Site
    arrays : tuple of ArrayLayout
    distances_m : dict
        Distance in metres between the centres of each two arrays, by their names.
    speed_source : str
        Where the speed of sound is from, in words.
    expected : Prediction or None
        Errors to expect; None if they cannot be predicted.
    problem : str
        Why they cannot be predicted.
    """

    site: Site
    arrays: tuple[ArrayLayout, ...]
    distances_m: dict[tuple[str, str], float]
    speed_source: str
    expected: Prediction | None
    problem: str = ""


def layout_of(site: Site, rt60_s: float) -> Layout:
    """Return the distances and the expected errors of a site with a reverberation time in seconds."""
    distances_m = {
        (one.name, other.name): float(np.linalg.norm(one.centre_m - other.centre_m))
        for one, other in combinations(site.specs, 2)
    }
    expected, problem = None, ""
    try:
        expected = predict(site, rt60_s)
    except ValueError as error:
        problem = str(error)
    arrays = tuple(
        ArrayLayout(spec, site.node_of(spec.name), nearest_wall(spec, site), _nearest(spec.name, distances_m))
        for spec in site.specs
    )
    return Layout(site, arrays, distances_m, _speed_source(site), expected, problem)


def nearest_wall(spec: ArraySpec, site: Site) -> Neighbour:
    """Return the wall, floor or ceiling that is nearest to a microphone."""
    x, y, z = site.room.size_m
    names = (("the wall x = 0", f"the wall x = {x:g} m"), ("the wall y = 0", f"the wall y = {y:g} m"))
    low, high = spec.microphones_m.min(axis=0), np.array((x, y, z)) - spec.microphones_m.max(axis=0)
    gaps = {(axis, 0): float(low[axis]) for axis in range(3)} | {(axis, 1): float(high[axis]) for axis in range(3)}
    axis, side = min(gaps, key=lambda place: gaps[place])
    return Neighbour((*names, ("the floor", "the ceiling"))[axis][side], gaps[axis, side])


def _nearest(name: str, distances_m: dict[tuple[str, str], float]) -> Neighbour | None:
    others = {
        one if other == name else other: apart for (one, other), apart in distances_m.items() if name in (one, other)
    }
    nearest = min(others, key=lambda other: others[other], default=None)
    return None if nearest is None else Neighbour(nearest, others[nearest])


def _speed_source(site: Site) -> str:
    if site.speed_of_sound_m_s is not None:
        return "as given"
    if site.temperature_c is not None:
        return f"in air of {site.temperature_c:g} degrees Celsius"
    return "the default; give temperature_c"
