"""The tile of a site in a hall that is divided among servers: which arrays are its own, and what is wrong with it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np

from livessl.core.types import ArraySpec
from livessl.site import polygon
from livessl.site.addresses import same_on_loopback
from livessl.site.hub_models import HallConfig
from livessl.site.models import Site
from livessl.site.place import Finding, Place

SLACK_M: Final = 1e-6
"""Distance, in metres, by which a corner of a tile may lie outside the room, for rounding."""

_PLACE: Final[Place] = ("server", "hub", "hall")


class Neighbourhood(NamedTuple):
    """Names of the arrays of a site file, by whether they are in the site's own tile."""

    own: tuple[str, ...]
    neighbours: tuple[str, ...]


def hall_of(site: Site) -> HallConfig | None:
    """Return the hall of a site; None for a site that has its room to itself."""
    return None if site.server.hub is None else site.server.hub.hall


def neighbourhood(site: Site, hall: HallConfig) -> Neighbourhood:
    """Return which of the processed arrays have their centre in the tile, and which do not."""
    names = {is_own: tuple(_names(site, hall, is_own=is_own)) for is_own in (True, False)}
    return Neighbourhood(names[True], names[False])


def hall_faults(site: Site) -> Iterator[Finding]:
    """Yield faults of the tile, and of the further servers of nodes, that only show beside other parts of the file."""
    for name, node in site.nodes.items():
        for number, further in enumerate(node.further_servers):
            here: Place = ("nodes", name, "further_servers", number)
            known = {same_on_loopback(endpoint): endpoint for endpoint in node.endpoints[: number + 1]}
            same = known.get(same_on_loopback(further.server))
            if same is not None:
                again = "again" if same == further.server else f"which is {same!r} again"
                yield (*here, "server"), f"expected each server once, got {further.server!r} {again}; remove it"
            if further.public_key is not None and site.keys is None:
                yield (
                    (*here, "public_key"),
                    "expected keys as well, the folder with the node's own keys, got none; add keys: keys, or remove "
                    "public_key: without keys nothing is encrypted",
                )
            for array in further.arrays or ():
                if array not in node.arrays:
                    yield (
                        (*here, "arrays"),
                        f"expected arrays of this node, {', '.join(node.arrays)}, got {array!r}; correct the name",
                    )
    hall = hall_of(site)
    if hall is None:
        return
    (width_m, depth_m, _), corners = site.room.size_m, hall.tile_m
    outside = [
        f"[{x:g}, {y:g}]"
        for x, y in corners
        if not (-SLACK_M <= x <= width_m + SLACK_M and -SLACK_M <= y <= depth_m + SLACK_M)
    ]
    if outside:
        yield (
            (*_PLACE, "tile_m"),
            f"expected corners inside the room, from [0, 0] to [{width_m:g}, {depth_m:g}], got {', '.join(outside)}; "
            "all servers of a hall use its coordinates: give room.size_m of the whole hall, or correct the corners",
        )


def hall_warnings(site: Site) -> Iterator[str]:
    """Yield warnings about a tile that is valid but unlikely to work as expected."""
    hall = hall_of(site)
    if hall is None:
        return
    own, neighbours = neighbourhood(site, hall)
    where = ".".join(map(str, _PLACE))
    if not own:
        yield f"{where}.tile_m: no array is in the tile of this site; correct the corners, or the arrays' positions"
    for name in neighbours:
        node = site.node_of(name)
        if node is not None and not site.nodes[node].further_servers:
            yield (
                f"nodes.{node}: its array {name!r} is in a neighbour's tile, but it sends to one server only; name the "
                "neighbour's server and this one, the second in further_servers"
            )
    if site.grid.bounds_m is not None:
        for axis, place, (low, high) in zip("xy", zip(*hall.tile_m, strict=True), site.grid.bounds_m[:2], strict=True):
            if min(place) < low - SLACK_M or max(place) > high + SLACK_M:
                yield (
                    f"grid.bounds_m: on {axis} the tile reaches from {min(place):g} to {max(place):g} m, and sounds "
                    f"are searched from {low:g} to {high:g} m only; extend the bounds beyond the tile"
                )


def _names(site: Site, hall: HallConfig, *, is_own: bool) -> Iterator[str]:
    for spec in site.processed:
        if _is_inside(spec, hall) == is_own:
            yield spec.name


def _is_inside(spec: ArraySpec, hall: HallConfig) -> bool:
    x, y, _ = np.asarray(spec.centre_m, dtype=float)
    return polygon.contains(hall.tile_m, float(x), float(y))
