"""What is wrong with a site beyond its types: its parts held side by side, arrays against room, grid and nodes."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from itertools import combinations
from typing import Final

import numpy as np

from livessl.core.correlate.band import uses_envelope
from livessl.core.geometry import microphone_pairs
from livessl.core.joint_array import joined
from livessl.core.steering import alias_free_hz
from livessl.core.types import ArraySpec, FloatArray
from livessl.site.build.grid import search_grid
from livessl.site.models import METHODS, Bounds, Site, is_loopback

COINCIDENT_M: Final = 1e-3
"""Two microphones nearer than this are a slip of the pen: no capsule is that small."""

MOST_NODES: Final = 50_000_000
"""Of a grid: the search would take more, but every node is looked at once when a node joins, some tens of ns each."""

SAMPLED_NODES: Final = 500
"""Nodes, about, at which the grid is held against an array: enough for a median."""

Place = tuple[str | int, ...]
"""Where something stands in the file: keys and indices from its top down."""

Finding = tuple[Place, str]
"""What is wrong somewhere."""

_NAME: Final = re.compile(r"[A-Za-z0-9._-]{1,64}")


def processed_specs(site: Site) -> tuple[tuple[ArraySpec, ...], list[Finding]]:
    """The arrays as they are processed; where a joint one is wrong, those that it joins stay apart."""
    known = {spec.name: spec for spec in site.specs}
    wrong = [*_joint_faults(site)]
    at_fault = {path[1] for path, _ in wrong}
    joint: list[ArraySpec] = []
    for name, members in site.joint.items():
        if name in at_fault or not set(members) <= set(known):
            continue
        nodes = {member: site.node_of(member) for member in members}
        clocks = {member: f"node {node!r}" if node else "no node" for member, node in nodes.items()}
        try:
            joint.append(joined([known[member] for member in members], clocks, name))
        except ValueError as error:
            wrong.append((("joint", name), str(error).removeprefix(f"array {name!r}: ")))
    taken = {member for spec in joint for member in site.joint[spec.name]}
    return (*(spec for spec in site.specs if spec.name not in taken), *joint), wrong


def _joint_faults(site: Site) -> Iterator[Finding]:
    """What is wrong with joint arrays before their microphones are looked at."""
    used: dict[str, str] = {}
    for name, members in site.joint.items():
        if name in site.arrays:
            yield ("joint", name), "expected another name: an array is called so already; rename it"
        for member in members:
            here: Place = ("joint", name, member)
            if member not in site.arrays:
                yield here, f"no such array; arrays are {', '.join(site.arrays)}"
            elif member in used:
                yield here, f"already joined in {used[member]!r}; take it away here or there"
            used[member] = name
        offsets_s = {site.arrays[member].wav_offset_s for member in members if member in site.arrays}
        if len(offsets_s) > 1:
            each = ", ".join(f"{offset_s:g}" for offset_s in sorted(offsets_s))
            yield ("joint", name), f"expected arrays of one wav_offset_s, since they are recorded together, got {each}"


def cross_faults(site: Site) -> Iterator[Finding]:
    """Faults that only show when parts of the file are held side by side."""
    if site.speed_of_sound_m_s is not None and site.temperature_c is not None:
        yield (
            ("temperature_c",),
            "expected either speed_of_sound_m_s or temperature_c, got both; take one away",
        )
    if site.band_hz[0] >= site.band_hz[1]:
        yield ("band_hz",), f"expected [low, high] with low < high, got {list(site.band_hz)}"
    if site.fusion.method not in METHODS:
        yield ("fusion", "method"), f"expected one of {', '.join(METHODS)}, got {site.fusion.method!r}"
    yield from _name_faults(site)
    count = len(site.arrays) + len(site.processed) - len(site.specs)
    if site.fusion.min_arrays > count:
        yield (
            ("fusion", "min_arrays"),
            f"expected at most the number of arrays, {count}{' (joint ones are one)' if site.joint else ''}, "
            f"got {site.fusion.min_arrays}",
        )
    boxes = {("zones", name, "bounds_m"): zone.bounds_m for name, zone in site.zones.items()}
    for place, bounds in ((("grid", "bounds_m"), site.grid.bounds_m), *boxes.items()):
        yield from ((place, what) for what in _outside(site, bounds))
    for spec in site.specs:
        yield from _array_faults(site, spec)
    for name in {spec.name for spec in site.processed} & set(site.joint):
        yield from ((("joint", name), what) for what in _touching(site, site.joint[name]))
    yield from _grid_faults(site)
    yield from _node_faults(site)


def _name_faults(site: Site) -> Iterator[Finding]:
    for kind, names in (("arrays", site.arrays), ("joint", site.joint), ("nodes", site.nodes), ("zones", site.zones)):
        for name in names:
            if not _NAME.fullmatch(name):
                yield (kind, name), "expected a name of 1 to 64 letters, digits, '.', '_' or '-'; rename it"
            elif name == "fused" and kind in ("arrays", "joint"):
                yield (kind, name), "expected another name: 'fused' is the map of all arrays together; rename it"


def _outside(site: Site, bounds: Bounds | None) -> Iterator[str]:
    for axis, (low, high), size in zip("xyz", bounds or (), site.room.size_m, strict=False):
        if high < 0 or low > size:
            yield (
                f"expected a box that reaches into the room, on {axis} from 0 to {size:g} m, got [{low:g}, {high:g}]; "
                "correct it or room.size_m"
            )


def _array_faults(site: Site, spec: ArraySpec) -> Iterator[Finding]:
    positions = spec.microphones_m
    for i in range(len(positions)):
        for k in range(i + 1, len(positions)):
            if np.linalg.norm(positions[i] - positions[k]) < COINCIDENT_M:
                yield (
                    ("arrays", spec.name),
                    f"microphones {i + 1} and {k + 1} are at one place {_xyz(positions[i])}; correct one of them",
                )
    size = np.array(site.room.size_m)
    outside = [k for k, position in enumerate(positions) if (position < 0).any() or (position > size).any()]
    if outside:
        k = outside[0]
        yield (
            ("arrays", spec.name),
            f"microphone {k + 1} at {_xyz(positions[k])} is outside the room {_xyz(size)} m; "
            "correct the array's position or room.size_m",
        )


def _touching(site: Site, members: Sequence[str]) -> Iterator[str]:
    for one, other in combinations(members, 2):
        between_m = site.array(one).microphones_m[:, None] - site.array(other).microphones_m
        apart_m = np.linalg.norm(between_m, axis=2)
        if apart_m.min() < COINCIDENT_M:
            i, k = np.unravel_index(apart_m.argmin(), apart_m.shape)
            yield (
                f"microphone {i + 1} of {one!r} and microphone {k + 1} of {other!r} are at one place "
                f"{_xyz(site.array(one).microphones_m[i])}; correct one of them"
            )


def _grid_faults(site: Site) -> Iterator[Finding]:
    grid = search_grid(site)
    if grid.size > MOST_NODES:
        fits = site.grid.spacing_m * (grid.size / MOST_NODES) ** (1 / max(1, len(grid.free_axes)))
        yield (
            ("grid", "spacing_m"),
            f"a grid of {grid.size:,} nodes takes too long to set up, allowed are {MOST_NODES:,}; use a spacing of "
            f"{np.ceil(fits * 1000) / 1000:g} m or more, or smaller bounds_m",
        )


def wide_arrays(site: Site) -> Iterator[str]:
    """What is said of arrays whose peaks the grid steps over.

    That is where, at half of all nodes and pairs or more, the delay changes by over half a period from a node to a
    corner of its cell.
    """
    grid = search_grid(site)
    nodes = grid.nodes_m(slice(0, grid.size, grid.size // SAMPLED_NODES | 1))
    reach_m = grid.spacing_m * len(grid.free_axes) ** 0.5 / 2.0
    for spec in site.processed:
        if reach_m == 0.0 or uses_envelope(spec.band_hz):
            continue
        pairs, high = microphone_pairs(len(spec.microphones_m)), spec.band_hz[1]
        kept = float(np.median(alias_free_hz(nodes, spec.microphones_m, pairs, reach_m, site.c_m_s)))
        cure = f"take joint.{spec.name} away" if spec.name in site.joint else "make arrays smaller"
        if kept < high:
            yield (
                f"grid.spacing_m: array {spec.name!r} is {spec.aperture_m:.1f} m wide: up to {high:g} Hz needs a "
                f"spacing of about {grid.spacing_m * kept / high:.2g} m, got {grid.spacing_m:g}; positions may be "
                f"wrong: lower the array's band_hz, or {cure}"
            )


def leaks(site: Site) -> Iterator[str]:
    """What is let in or kept although the file seems to say otherwise."""
    http, days = site.server.http, site.store.retention_days
    if http.tokens is not None and http.certificate is None and not is_loopback(http.host):
        yield (
            "server.http: tokens and positions travel unencrypted; set certificate and private_key, or listen on "
            "127.0.0.1 behind a proxy that has them"
        )
    if days is not None and site.server.sinks:
        yield f"store.retention_days: {days:g} days do not reach server.sinks; rotate those files yourself"


def _node_faults(site: Site) -> Iterator[Finding]:
    claimed: dict[str, str] = {}
    for node_name, node in site.nodes.items():
        used: dict[int, str] = {}
        if site.privacy == "positions-only" and node.spool.directory is not None:
            yield (
                ("nodes", node_name, "spool", "directory"),
                "with privacy: positions-only no sound is kept on a disk; take it away, and it is kept in memory",
            )
        for name, channels in node.arrays.items():
            here: Place = ("nodes", node_name, "arrays", name)
            if name not in site.arrays:
                yield here, f"no such array; arrays are {', '.join(site.arrays)}"
                continue
            if name in claimed:
                yield here, f"already captured by node {claimed[name]!r}; an array belongs to one node"
            claimed[name] = node_name
            spec = next((spec for spec in site.specs if spec.name == name), None)
            if spec is not None and len(channels) != len(spec.microphones_m):
                yield (
                    here,
                    f"expected {len(spec.microphones_m)} channels, one for each microphone of {name!r}, "
                    f"got {len(channels)}",
                )
            for channel in channels:
                if channel in used:
                    yield here, f"channel {channel} is already used by {used[channel]!r}"
                used[channel] = name
            rate = node.device.sample_rate_hz
            if spec is not None and rate is not None and spec.band_hz[1] >= rate / 2:
                yield (
                    here,
                    f"band_hz up to {spec.band_hz[1]:g} Hz needs a sample rate above {2 * spec.band_hz[1]:g} Hz, "
                    f"the device has {rate:g} Hz; lower band_hz or raise sample_rate_hz",
                )


def _xyz(position: Sequence[float] | FloatArray) -> str:
    return "(" + ", ".join(f"{x:g}" for x in np.round(np.asarray(position, dtype=float), 4)) + ")"
