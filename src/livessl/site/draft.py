"""Makes the text of a first site file, and proposes where its arrays stand.

It asks nothing, and it neither reads nor writes files.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Final

import yaml

from livessl.core import mirror
from livessl.core.geometry import Grid, circle, line, tetrahedron
from livessl.core.types import FloatArray
from livessl.site.build.grid import search_grid
from livessl.site.draft_parts import Draft, DraftArray
from livessl.site.fields import Bounds
from livessl.site.load import parse_site

CLEARANCE: Final = 0.3
"""Distance of the proposed arrays from the middle of the room, as a share of its length and width: metres apart, and
away from the walls, whose reflections would arrive together with the direct sound."""

WALL_M: Final = 0.6
"""Distance, in metres, of proposed lines from the wall behind them: far enough that its reflection can be separated."""

LIFT_M: Final = 0.25
"""Distance, in metres, by which proposed arrays lie above and below half the height of the room, in turn: for flat
arrays at one height, a position and its mirror image look alike."""


def proposed_pose(
    room_m: Sequence[float], kind: str, index: int, count: int
) -> tuple[tuple[float, float, float], float]:
    """Return a centre in metres and a yaw in degrees for one of some arrays in a room.

    Lines hang side by side along the longer wall. Other arrays stand on an ellipse around the middle, the first ones
    at the ends of the room, and face the middle.
    """
    x, y, z = room_m
    if kind == "line":
        along, across = (index + 0.5) / count, min(WALL_M, min(x, y) / 4.0)
        place = (along * x, across, z / 2.0) if x >= y else (across, along * y, z / 2.0)
        yaw_deg = 0.0 if x >= y else 90.0
    elif count == 1:
        place, yaw_deg = (x / 2.0, y / 2.0, z / 2.0), 0.0
    else:
        angle = math.radians((180.0 if x >= y else 270.0) + 360.0 * index / count)
        off = CLEARANCE * x * math.cos(angle), CLEARANCE * y * math.sin(angle)
        place = x / 2.0 + off[0], y / 2.0 + off[1], z / 2.0 + min(LIFT_M, z / 8.0) * (-1.0) ** index
        yaw_deg = float(round(math.degrees(math.atan2(-off[1], -off[0])))) % 360.0
    px, py, pz = (round(length, 2) for length in place)
    return (px, py, pz), yaw_deg


def searchable(draft: Draft) -> Draft:
    """Return the draft with the largest search volume in which no position looks like its mirror image.

    Flat arrays in one plane and arrays on one line need a volume on one side of them. If no box is free of mirror
    images, the draft is returned as it is.

    Raises
    ------
    ConfigError
        If the draft is no valid site.
    """
    site = parse_site(site_text(draft))
    if mirror.warning(site.processed, search_grid(site), site.c_m_s) is None:
        return draft
    for bounds in sorted(_halves(draft), key=_volume, reverse=True):
        if mirror.warning(site.processed, Grid(bounds, site.grid.spacing_m), site.c_m_s) is None:
            return replace(draft, bounds_m=bounds)
    return draft


def _halves(draft: Draft) -> Iterator[Bounds]:
    """Yield the parts of the room on one side of the arrays, also in the horizontal plane of their centre.

    To horizontal lines up and down look alike, so that only a plane is left.
    """
    whole = [(0.0, length) for length in draft.room_m]
    centres = [[array.centre_m[axis] for array in draft.arrays] for axis in range(3)]
    middle = [round(sum(each) / len(each), 4) for each in centres]
    plane = (middle[2], middle[2])
    for height in (plane,) if all(array.kind == "line" for array in draft.arrays) else (whole[2], plane):
        for axis in range(3 if height is whole[2] else 2):
            edges = sorted({min(centres[axis]), middle[axis], max(centres[axis])})
            for part in (*((0.0, edge) for edge in edges), *((edge, draft.room_m[axis]) for edge in edges)):
                box = [whole[0], whole[1], height]
                box[axis] = part
                yield box[0], box[1], box[2]


def _volume(bounds: Bounds) -> float:
    return math.prod(max(high - low, 1e-3) for low, high in bounds)


def site_text(draft: Draft) -> str:
    """Return the text of the site file, with comments."""
    return "\n".join(_lines(draft)) + "\n"


def _lines(draft: Draft) -> Iterator[str]:
    yield "# Made by `livessl init`. Lengths in metres from a corner of the floor: x and y along the walls, z up."
    yield "# `livessl check` finds mistakes and draws the room; `livessl config show` prints every setting."
    yield f"site: {_text(draft.site)}"
    yield _noted(f"room: {{size_m: {_list(draft.room_m)}}}", "length (x), width (y), height (z)")
    yield _noted(f"temperature_c: {_number(draft.temperature_c)}", "sets the speed of sound; 5 degrees are 1 %")
    if draft.bounds_m is not None:
        yield ""
        yield "# To flat arrays a position and its mirror image look alike, so that only one side is searched."
        yield "# Change the bounds if sounds come from the other side."
        yield f"grid: {{bounds_m: [{', '.join(map(_list, draft.bounds_m))}]}}"
    yield ""
    yield "arrays:"
    for array in draft.arrays:
        yield f"  {_text(array.name)}:"
        yield f"    # {order(array)}"
        yield f"    geometry: {_geometry(array)}"
        yield _noted(f"    position_m: {_list(array.centre_m)}", "the centre; measure it to the centimetre")
        yaw = f"    orientation_deg: {{yaw: {_number(array.yaw_deg)}}}"
        yield _noted(yaw, "turn from +x, counter-clockwise from above; to the degree")
    if draft.nodes:
        yield ""
        if len({node.interface for node in draft.nodes}) < len(draft.nodes):
            yield "# Interfaces of one name on one machine: paste the lines that `livessl devices` prints."
        yield "nodes:"
    for node in draft.nodes:
        yield _noted(f"  {_text(node.name)}:", f"livessl capture --site FILE --node {node.name}")
        yield _noted("    server: tcp://127.0.0.1:5570", "address of the server, seen from this node")
        device = f"{{name: {json.dumps(node.interface, ensure_ascii=False)}, sample_rate_hz: {_number(node.rate_hz)}}}"
        yield _noted(f"    device: {device}", "part of a name in `livessl devices`")
        yield _noted("    arrays:", "inputs of the interface, from 1, in the order of the microphones")
        for name, channels in node.channels.items():
            yield f"      {_text(name)}: {list(channels)}"
    yield ""
    yield "server:"
    yield _noted("  bind: tcp://127.0.0.1:5570", "for nodes on other machines: tcp://*:5570, with keys: keys")
    yield _noted("  http: {host: 127.0.0.1, port: 8000}", "the dashboard")


def _noted(text: str, note: str) -> str:
    """Return a line with a comment."""
    return f"{text:<44}  # {note}"


def _geometry(array: DraftArray) -> str:
    if array.kind == "tetrahedron":
        return f"{{tetrahedron: {{edge_m: {_number(array.size_m)}}}}}"
    if array.kind == "line":
        return f"{{line: {{spacing_m: {_number(array.size_m)}, count: {array.count}}}}}"
    radius_m = array.size_m / math.sqrt(2.0) if array.kind == "square" else array.size_m
    return f"{{circle: {{radius_m: {_number(radius_m)}, count: {array.count}}}}}"


def order(array: DraftArray) -> str:
    """Return in words where the microphones are before the turn."""
    if array.kind == "tetrahedron":
        return "microphone 1 on top, 2 to 4 below it, counter-clockwise from above, 2 towards +x before the turn"
    if array.kind == "line":
        return "along x before the turn, microphone 1 at the smallest x"
    what = f"a square with edges of {_number(array.size_m)} m: " if array.kind == "square" else ""
    return f"{what}microphone 1 towards +x before the turn, the others counter-clockwise from above"


def shape_m(array: DraftArray) -> FloatArray:
    """Return the positions (K, 3) of the microphones around the centre, before the turn, metres."""
    if array.kind == "tetrahedron":
        return tetrahedron(array.size_m)
    if array.kind == "line":
        return line(array.size_m, array.count)
    return circle(array.size_m / math.sqrt(2.0) if array.kind == "square" else array.size_m, array.count)


def _number(value: float) -> str:
    """Return a number with at most four decimals: a tenth of a millimetre, or of a hertz."""
    return f"{round(value, 4):.10g}"


def _list(values: Sequence[float]) -> str:
    return f"[{', '.join(map(_number, values))}]"


def _text(name: str) -> str:
    """Return a name as YAML reads it back: in quotes where it would be a number, a date or true."""
    try:
        plain = yaml.safe_load(f"{name}: 0") == {name: 0}
    except (yaml.YAMLError, ValueError):
        plain = False
    return name if plain else json.dumps(name, ensure_ascii=False)
