"""Guesses what a wrong value meant: another unit (mm, Fahrenheit), swapped axes, inputs that do not exist, addresses.

Guesses come with the values to write instead. A value that is certainly wrong is a fault, and its guess is the cure; a
value that is only unlikely is a warning.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from itertools import permutations
from typing import Final

import numpy as np

from livessl.core.types import ArraySpec, FloatArray
from livessl.site.addresses import is_loopback
from livessl.site.fields import Bounds
from livessl.site.interfaces import known_interface
from livessl.site.models import ArrayConfig, Orientation, Shape, Site
from livessl.site.node_models import NodeConfig, SoundDeviceConfig

HOT_C: Final = 50.0
"""Temperature, in degrees Celsius, from which Fahrenheit is more likely: that of a cold room."""

TALL_M: Final = 100.0
"""Shortest edge of a room, in metres, from which centimetres are more likely."""

COARSE_M: Final = 1.0
"""Grid spacing, in metres, from which a smaller unit is more likely: positions would be a step across the floor."""

MANY_POINTS: Final = 100
"""Number of grid points along the longest edge from which a coarse grid is meant: that of a yard."""

USUAL_SPACING_M: Final = 0.1
"""Grid spacing, in metres, next to which a value in another unit is sought."""

LARGE_M: Final = 2.0
"""Size of an array, in metres, above which it is likely to be in another unit: arrays are built much smaller."""

FAR: Final = 10.0
"""Multiple of the room's longest edge beyond which the bounds of a box are more likely in a smaller unit."""

MANY: Final = 5.0
"""Multiple of the room's longest edge from which a position outside the room may be in another unit."""

UNITS: Final = ((100.0, "centimetres"), (1000.0, "millimetres"))
"""Units of length that are mistaken for metres, by how many of them a metre has."""

AIR_M_S: Final = (300.0, 380.0)
"""Speed of sound in air from -48 to 86 degrees Celsius, m/s."""

USUAL_SPEED_M_S: Final = 343.0
"""Speed of sound at 20 degrees Celsius, m/s, next to which a speed in another unit is sought."""

SPEEDS: Final = ((0.3048, "feet per second"), (1 / 3.6, "kilometres per hour"), (0.44704, "miles per hour"))
"""Units of speed that are mistaken for metres per second, in metres per second."""

_STEP_DEG: Final = {2: 45.0, 3: 15.0, 4: 15.0}
"""Angles to which arrays are usually turned, in degrees, are multiples of this, by the decimals of an angle in radians.
An angle with more decimals is taken as one with four."""


def unlikely(site: Site) -> Iterator[str]:
    """Yield a warning for each value that is possible, but more likely a slip."""
    yield from _temperature_and_speed(site)
    yield from _lengths(site)
    for name, array in site.arrays.items():
        yield from _angles(f"arrays.{name}", array.orientation_deg)
    low, high = site.band_hz
    if high < 200.0 <= 1000.0 * high:
        yield (
            f"band_hz: a band up to {high:g} Hz is unlikely; did you mean "
            f"[{1000 * low:g}, {1000 * high:g}], from kilohertz?"
        )
    yield from _nodes(site)


def position_cure(site: Site, spec: ArraySpec) -> str:
    """Return how to mend an array that is outside the room, with the values that were probably meant."""
    array = site.arrays[spec.name]
    size_m = np.array(site.room.size_m)

    def fits(microphones_m: FloatArray) -> bool:
        return bool(((microphones_m >= 0) & (microphones_m <= size_m)).all())

    for key, given, place in _movable(array, spec):
        meant = _meant(given, place, fits, size_m)
        if meant is not None:
            return f"did you mean {key}: {meant}"
    if isinstance(array.geometry, Shape) and spec.aperture_m > LARGE_M:
        centre_m = np.array(array.position_m)
        for per_metre, unit in UNITS:
            smaller_m = centre_m + (spec.microphones_m - centre_m) / per_metre
            if fits(smaller_m) and spec.aperture_m / per_metre <= LARGE_M:
                return f"its size is {spec.aperture_m:g} m; give metres, not {unit}"
    return "correct the array's position or room.size_m"


def box_cure(site: Site, bounds_m: Bounds) -> str:
    """Return how to mend a box that does not reach into the room."""
    size_m = np.array(site.room.size_m)

    def fits(corners_m: FloatArray) -> bool:
        low, high = corners_m.min(axis=0), corners_m.max(axis=0)
        return bool((low >= 0).all() and (high <= size_m + 0.5).all())

    meant = _meant(np.array(bounds_m).T, lambda corners_m: corners_m, fits, size_m, lambda given: given.T)
    return "correct it or room.size_m" if meant is None else f"did you mean bounds_m: {meant}"


def rate_cure(rate_hz: float, least_hz: float) -> str:
    """Return how to mend a sampling rate that is too low for the band."""
    if 1000.0 * rate_hz > least_hz and rate_hz < 1000.0:
        return f"did you mean sample_rate_hz: {1000 * rate_hz:g}, from kilohertz?"
    return "lower band_hz or raise sample_rate_hz"


def _movable(
    array: ArrayConfig, spec: ArraySpec
) -> Iterator[tuple[str, FloatArray, Callable[[FloatArray], FloatArray]]]:
    """Yield what may be in another unit or order: key, value, and a function from it to microphones."""
    if array.microphones_m is not None:
        yield "microphones_m", np.array(array.microphones_m), lambda given: given
    elif array.position_m is not None:
        centre_m = np.array(array.position_m)
        yield "position_m", centre_m, lambda given: spec.microphones_m - centre_m + given


def _meant(
    given: FloatArray,
    place: Callable[[FloatArray], FloatArray],
    fits: Callable[[FloatArray], bool],
    size_m: FloatArray,
    shown: Callable[[FloatArray], FloatArray] = lambda given: given,
) -> str | None:
    """Return positions that fit into the room, with what they were taken for; None if there are none.

    Parameters
    ----------
    given : (3,) or (K, 3) float64
        Positions as they stand in the file.
    place : callable
        Turns positions of that form into those that must fit.
    fits : callable
    size_m : (3,) float64
        Size of the room.
    shown : callable
        Turns the positions that fit into the form of the file.
    """
    for per_metre, unit in UNITS if np.abs(given).max() > MANY * size_m.max() else ():
        if fits(place(given / per_metre)):
            return f"{_text(shown(given / per_metre))}, from {unit}?"
    if ((given >= 0) & (given <= size_m)).all():  # only the edge of an array is outside: it is too near to a wall
        return None
    for order in sorted(permutations(range(3)), key=lambda order: sum(i != k for i, k in enumerate(order)))[1:]:
        if fits(place(given[..., list(order)])):
            moved = " and ".join("xyz"[i] for i, k in enumerate(order) if i != k)
            return f"{_text(shown(given[..., list(order)]))}, with {moved} swapped?"
    from_middle = given + size_m * (0.5, 0.5, 0.0)
    if (given < 0).any() and fits(place(from_middle)):
        return f"{_text(shown(from_middle))}? Positions count from a corner of the room, not from its middle"
    return None


def _temperature_and_speed(site: Site) -> Iterator[str]:
    celsius, speed_m_s = site.temperature_c, site.speed_of_sound_m_s
    if celsius is not None and celsius >= HOT_C:
        yield (
            f"temperature_c: {celsius:g} degrees Celsius is unlikely, and a wrong temperature moves positions; did you "
            f"mean {(celsius - 32) / 1.8:.1f}, from Fahrenheit?"
        )
    low, high = AIR_M_S
    if speed_m_s is not None and not low <= speed_m_s <= high:
        meant_m_s, unit = min(
            ((speed_m_s * unit_m_s, unit) for unit_m_s, unit in SPEEDS), key=lambda one: abs(one[0] - USUAL_SPEED_M_S)
        )
        if low <= meant_m_s <= high:
            yield (
                f"speed_of_sound_m_s: {speed_m_s:g} m/s is not that of air; did you mean {meant_m_s:.1f}, from {unit}?"
            )


def _lengths(site: Site) -> Iterator[str]:
    size_m = site.room.size_m
    if min(size_m) >= TALL_M:
        yield (
            f"room.size_m: {' x '.join(f'{x:g}' for x in size_m)} m is unlikely; did you mean "
            f"[{', '.join(f'{x / 100:g}' for x in size_m)}], from centimetres?"
        )
    spacing_m = site.grid.spacing_m
    if spacing_m >= COARSE_M and MANY_POINTS * spacing_m > max(size_m):
        per_metre, unit = min(UNITS, key=lambda one: abs(math.log(spacing_m / one[0] / USUAL_SPACING_M)))
        yield (
            f"grid.spacing_m: grid points {spacing_m:g} m apart are unlikely; did you mean "
            f"{spacing_m / per_metre:g}, from {unit}?"
        )
    boxes = {f"zones.{name}": zone.box_m(size_m[2]) for name, zone in site.zones.items() if zone.bounds_m is not None}
    if site.grid.bounds_m is not None:
        boxes["grid"] = site.grid.bounds_m
    for key, bounds_m in boxes.items():
        if np.abs(bounds_m).max() > FAR * max(size_m):
            cure = box_cure(site, bounds_m)
            if cure.startswith("did"):
                yield f"{key}.bounds_m: {np.abs(bounds_m).max():g} m is far outside the room; {cure}"


def _angles(key: str, orientation_deg: Orientation | None) -> Iterator[str]:
    """Yield a warning for each angle that is a common angle in radians, but a strange one in degrees."""
    for axis, angle in () if orientation_deg is None else orientation_deg:
        decimals = min(len(repr(abs(angle)).partition(".")[2]), 4)
        if decimals not in _STEP_DEG or abs(angle) > 2.0 * math.pi + 0.01:
            continue
        step, degrees = _STEP_DEG[decimals], math.degrees(angle)
        nearest = step * round(degrees / step)
        if nearest != 0.0 and abs(degrees - nearest) <= math.degrees(10.0**-decimals):
            yield (
                f"{key}.orientation_deg.{axis}: {angle:g} degrees is unlikely; did you mean {nearest:g}, from radians?"
            )


def _nodes(site: Site) -> Iterator[str]:
    captured = {name for node in site.nodes.values() for name in node.arrays}
    for name in site.arrays if site.nodes else ():
        if name not in captured:
            yield f"arrays.{name}: no node captures it; add its channels to the arrays of a node, or remove it"
    for name, node in site.nodes.items():
        if all(any(_addresses(endpoint, site.server.bind, site)) for endpoint in node.endpoints):
            yield from (f"nodes.{name}.server: {what}" for what in _addresses(node.server, site.server.bind, site))
        yield from (f"nodes.{name}.arrays.{what}" for what in _inputs(node))


def _addresses(server: str, bind: str, site: Site) -> Iterator[str]:
    """Yield what is wrong with the address that a node connects to, next to that at which the server listens."""
    if not (server.startswith("tcp://") and bind.startswith("tcp://")):
        return
    (host, _, port), (listens, _, bound) = (text.removeprefix("tcp://").rpartition(":") for text in (server, bind))
    if bound not in ("*", port):
        which = ", that of the dashboard," if port == str(site.server.http.port) else ""
        yield f"port {port}{which} differs from that of server.bind, {bound}; did you mean tcp://{host}:{bound}?"
    if is_loopback(listens) and not is_loopback(host):
        yield (
            f"{host} is another machine, but server.bind {bind} listens only to its own; did you mean "
            f"server.bind: tcp://*:{bound}?"
        )


def _inputs(node: NodeConfig) -> Iterator[str]:
    """Yield a warning for each array on inputs that a known interface does not have or that are no microphones."""
    if not isinstance(node.device, SoundDeviceConfig):
        return
    known = known_interface(node.device.name)
    if known is None:
        return
    for name, channels in node.arrays.items():
        if max(channels) > known.inputs:
            yield f"{name}: {known.name} has {known.inputs} inputs, got {max(channels)}; correct the channels"
        elif known.others and channels == list(range(1, len(channels) + 1)) and 1 not in known.microphones:
            first = known.microphones.start
            yield (
                f"{name}: the microphones of {known.name} are {first} to {known.microphones.stop - 1}; the other "
                f"channels are {known.others}; did you mean {list(range(first, first + len(channels)))}?"
            )


def _text(values: FloatArray) -> str:
    """Return numbers as a list of the site file, to a tenth of a millimetre."""
    if values.ndim > 1:
        return f"[{', '.join(map(_text, values))}]"
    return f"[{', '.join(f'{value:.10g}' for value in np.round(values, 4) + 0.0)}]"
