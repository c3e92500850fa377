"""A simulated hall on two servers: arrays on both sides of a border, and sounds that they record."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import yaml

from livessl.core.types import Float32Array
from livessl.recordings.assign import AssignedRecording
from livessl.recordings.recording import MemoryRecording
from livessl.simulation.scene import Scene, Source, render
from livessl.site.load import parse_site
from livessl.site.models import Site
from small_site import RATE_HZ, hiss

HALL_M: Final = (12.0, 6.0, 3.0)
BORDER_M: Final = 6.0
"""Where the tiles of the two servers meet, on x."""

ARRAYS: Final[Mapping[str, tuple[float, float, float]]] = {
    "a1": (1.5, 1.6, 1.7),
    "a2": (4.4, 4.3, 1.5),
    "b1": (7.6, 1.7, 1.6),
    "b2": (10.4, 4.4, 1.4),
}
"""The places of all arrays of the hall; the first letter names the node that captures them."""

TILES: Final = {"west": (0.0, BORDER_M), "east": (BORDER_M, HALL_M[0])}
SEEN: Final = {"west": ("a1", "a2", "b1"), "east": ("a2", "b1", "b2")}
"""Arrays whose sound each server gets: its own, and the nearest of its neighbour."""

NODES: Final = {"node-a": "west", "node-b": "east"}
"""The server to which each node belongs."""

REACH_M: Final = 3.0
"""How far beyond its tile each server searches for sounds."""


def site_data(name: str, urls: Sequence[str]) -> dict[str, Any]:
    """The site file of one of the servers."""
    low, high = TILES[name]
    corners = [[low, 0.0], [high, 0.0], [high, HALL_M[1]], [low, HALL_M[1]]]
    hub = {"servers": list(urls), "hall": {"name": "works", "tile_m": corners}}
    bounds = [[max(0.0, low - REACH_M), min(HALL_M[0], high + REACH_M)], [0.0, HALL_M[1]], [0.0, HALL_M[2]]]
    return {
        "site": name,
        "room": {"size_m": list(HALL_M)},
        "grid": {"spacing_m": 0.25, "bounds_m": bounds},
        "arrays": {array: _array(array) for array in SEEN[name]},
        "nodes": {node: _node([array for array in arrays if array in SEEN[name]]) for node, arrays in OF_NODES.items()},
        "server": {
            "bind": "tcp://127.0.0.1:*",
            "http": {"host": "127.0.0.1", "port": 0},
            "events_db": f"{name}.sqlite",
            "hub": hub,
        },
    }


OF_NODES: Final = {node: [array for array in ARRAYS if array[0] == node[-1]] for node in NODES}
"""Arrays that each node captures."""


def _array(name: str) -> dict[str, Any]:
    return {"geometry": {"tetrahedron": {"edge_m": 0.3}}, "position_m": list(ARRAYS[name])}


def _node(arrays: Sequence[str]) -> dict[str, Any]:
    channels = {array: list(range(4 * n + 1, 4 * n + 5)) for n, array in enumerate(arrays)}
    return {
        "device": {"name": "UMC1820", "sample_rate_hz": RATE_HZ},
        "arrays": channels,
        "further_servers": [{"server": "tcp://127.0.0.1:5571"}],
    }


def hall_site(
    name: str,
    urls: Sequence[str] = ("nats://127.0.0.1:4222",),
    directory: Path | None = None,
    bind: str = "tcp://127.0.0.1:*",
) -> Site:
    """One of the two servers' sites."""
    data = site_data(name, urls)
    data["server"]["bind"] = bind
    return parse_site(yaml.safe_dump(data, sort_keys=False), directory=directory)


def node_site(node: str, endpoints: Mapping[str, str], directory: Path | None = None) -> Site:
    """The site of a node, which sends to its own server, and the arrays that the neighbour gets to this one."""
    own = NODES[node]
    other = next(name for name in TILES if name != own)
    data = site_data(own, ["nats://127.0.0.1:4222"])
    data["arrays"] = {array: _array(array) for array in OF_NODES[node]}
    data["nodes"] = {node: _node(OF_NODES[node])}
    shared = [array for array in OF_NODES[node] if array in SEEN[other]]
    data["nodes"][node] |= {
        "server": endpoints[own],
        "further_servers": [{"server": endpoints[other], "arrays": shared}],
    }
    return parse_site(yaml.safe_dump(data, sort_keys=False), directory=directory)


def hall_scene(sounds: Sequence[tuple[float, tuple[float, float, float]]], rt60_s: float = 0.0) -> Scene:
    """Bursts of noise in the hall, each at its time in seconds and its place."""
    sources = tuple(
        Source(f"burst-{n}", start_s, np.array(position_m), hiss(0.4, 1, seed=50 + n)[0])
        for n, (start_s, position_m) in enumerate(sounds)
    )
    return Scene(HALL_M, rt60_s, 343.0, float(RATE_HZ), sources, max(start_s for start_s, _ in sounds) + 2.5)


def recorded(scene: Scene) -> dict[str, Float32Array]:
    """What the arrays of the hall record, (4, n) each."""
    sites = [hall_site(name) for name in TILES]
    specs = {spec.name: spec for site in sites for spec in site.specs}
    return {name: render(scene, specs[name].microphones_m, seed=n) for n, name in enumerate(ARRAYS)}


def of_node(node: str, heard: Mapping[str, Float32Array], start_ns: int) -> list[AssignedRecording]:
    """The recordings of a node's arrays, begun at a site time."""
    return [
        AssignedRecording(array, MemoryRecording(array, float(RATE_HZ), heard[array]), start_ns, (1, 2, 3, 4))
        for array in OF_NODES[node]
    ]
