"""The site file: what is where, checked whole before anything starts. It opens no device and no socket."""

from __future__ import annotations

import copy
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from ipaddress import ip_address
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

import numpy as np
import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from livessl.core.activity import ActivityParameters
from livessl.core.bands import uses_envelope
from livessl.core.geometry import (
    Grid,
    as_positions_m,
    circle,
    line,
    microphone_pairs,
    posed,
    speed_of_sound_m_s,
    tetrahedron,
)
from livessl.core.joint import joined
from livessl.core.steering import alias_free_hz
from livessl.core.types import MAX_MICROPHONES, MIN_MICROPHONES, ArraySpec, FloatArray
from livessl.errors import UseError

if TYPE_CHECKING:
    from livessl.core.clock_offsets import ClockOffsets
    from livessl.core.fusion import Fusion
    from livessl.core.listening import Each

DEFAULT_SPEED_OF_SOUND_M_S: Final = 343.0
METHODS: Final = ("onset", "srp-phat", "cepstral", "averaged")
"""Names of `livessl.core.estimators.ESTIMATORS`: who checks a site file need not load what localizes."""

COINCIDENT_M: Final = 1e-3
"""Two microphones nearer than this are a slip of the pen: no capsule is that small."""

MOST_NODES: Final = 50_000_000
"""Of a grid: the search would take more, but every node is looked at once when a node joins, some tens of ns each."""

SAMPLED_NODES: Final = 500
"""Nodes, about, at which the grid is held against an array: enough for a median."""

Coordinate = Annotated[float, Field(ge=-1e6, le=1e6, allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, le=1e6, allow_inf_nan=False)]
Position = tuple[Coordinate, Coordinate, Coordinate]
Interval = tuple[Coordinate, Coordinate]
Bounds = tuple[Interval, Interval, Interval]
BandHz = tuple[Annotated[float, Field(ge=0)], Positive]


@dataclass(frozen=True)
class Fault:
    """One thing wrong: where it stands, and what, expected, got and cure in one sentence."""

    where: str
    what: str

    def __str__(self) -> str:
        return f"{self.where}: {self.what}"


class ConfigError(UseError):
    """Everything that is wrong with what the user gave, at once."""

    def __init__(self, faults: Sequence[Fault]) -> None:
        super().__init__("\n".join(str(fault) for fault in faults))
        self.faults = tuple(faults)


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


def _ordered(bounds: Bounds) -> Bounds:
    for axis, (low, high) in zip("xyz", bounds, strict=True):
        if low > high:
            raise ValueError(f"expected lower <= upper on {axis}, got [{low:g}, {high:g}]; swap them")
    return bounds


class Room(_Model):
    """The room: a box from the origin."""

    size_m: tuple[Positive, Positive, Positive]


class GridConfig(_Model):
    """The search grid."""

    spacing_m: Annotated[Positive, Field(ge=1e-4)] = 0.05
    bounds_m: Bounds | None = None

    @field_validator("bounds_m")
    @classmethod
    def _ordered(cls, bounds: Bounds | None) -> Bounds | None:
        return None if bounds is None else _ordered(bounds)


class Tetrahedron(_Model):
    """A regular tetrahedron: channel 1 the apex, 2 to 4 the base counter-clockwise, 2 towards +x."""

    edge_m: Positive


class Circle(_Model):
    """A horizontal circle: channel 1 towards +x, counter-clockwise unless told otherwise."""

    radius_m: Positive
    count: Annotated[int, Field(ge=MIN_MICROPHONES, le=MAX_MICROPHONES)]
    clockwise: bool = False


class Line(_Model):
    """A straight line along x, channel 1 at the smallest x."""

    spacing_m: Positive
    count: Annotated[int, Field(ge=MIN_MICROPHONES, le=MAX_MICROPHONES)]


class Shape(_Model):
    """Exactly one shape."""

    tetrahedron: Tetrahedron | None = None
    circle: Circle | None = None
    line: Line | None = None

    @model_validator(mode="after")
    def _one(self) -> Shape:
        given = [name for name in ("tetrahedron", "circle", "line") if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(f"expected exactly one of tetrahedron, circle, line; got {', '.join(given) or 'none'}")
        return self

    def microphones_m(self) -> FloatArray:
        """Positions (K, 3) around the shape's own origin, metres."""
        if self.tetrahedron is not None:
            return tetrahedron(self.tetrahedron.edge_m)
        if self.circle is not None:
            return circle(self.circle.radius_m, self.circle.count, self.circle.clockwise)
        assert self.line is not None
        return line(self.line.spacing_m, self.line.count)


class GeometryFile(_Model):
    """A file under `calibration/`: measured positions around the array's own origin."""

    microphones_m: Annotated[list[Position], Field(min_length=MIN_MICROPHONES, max_length=MAX_MICROPHONES)]
    description: str = ""


class Orientation(_Model):
    """Roll about x, then pitch about y, then yaw about z."""

    yaw: Coordinate = 0.0
    pitch: Coordinate = 0.0
    roll: Coordinate = 0.0


class ArrayConfig(_Model):
    """One microphone array: absolute positions, or a shape (or geometry file) and a pose."""

    microphones_m: Annotated[list[Position], Field(min_length=MIN_MICROPHONES, max_length=MAX_MICROPHONES)] | None = (
        None
    )
    geometry: Shape | str | None = None
    position_m: Position | None = None
    orientation_deg: Orientation | None = None
    band_hz: BandHz | None = None
    wav_offset_s: Coordinate = 0.0

    @field_validator("geometry", mode="before")
    @classmethod
    def _shape_or_file(cls, geometry: Any) -> Any:
        if isinstance(geometry, dict):
            return Shape.model_validate(geometry)
        if geometry is None or isinstance(geometry, str):
            return geometry
        raise ValueError("expected a shape such as {tetrahedron: {edge_m: 0.5}} or the path of a geometry file")

    @model_validator(mode="after")
    def _one_form(self) -> ArrayConfig:
        if (self.microphones_m is None) == (self.geometry is None):
            raise ValueError(
                "expected either microphones_m (absolute positions) or geometry with position_m, "
                f"got {'neither' if self.geometry is None else 'both'}"
            )
        if self.geometry is not None and self.position_m is None:
            raise ValueError("geometry needs position_m: where the array's origin is in the room")
        if self.microphones_m is not None and (self.position_m or self.orientation_deg):
            raise ValueError("microphones_m are absolute; take position_m and orientation_deg away, or use geometry")
        return self


class SoundDeviceConfig(_Model):
    """An audio interface, by name."""

    type: Literal["sound"] = "sound"
    name: str
    sample_rate_hz: Positive = 48000.0
    block_s: Annotated[float, Field(gt=0, le=1)] = 0.02


class WavDeviceConfig(_Model):
    """The fake device: recorded files at real speed."""

    type: Literal["wav"]
    files: dict[str, str]
    sample_rate_hz: Positive | None = None
    loop: bool = False


class SceneDeviceConfig(_Model):
    """A simulated scene at real speed."""

    type: Literal["scene"]
    rt60_s: Annotated[float, Field(ge=0, le=100)] = 0.7
    events: Annotated[int, Field(ge=1)] = 8
    seed: int = 0
    sample_rate_hz: Positive = 44100.0
    loop: bool = True


DeviceConfig = SoundDeviceConfig | WavDeviceConfig | SceneDeviceConfig


FileName = Annotated[str, Field(min_length=1)]
"""A file or folder, looked up from the site file's folder."""


class SpoolConfig(_Model):
    """Where a node keeps the sound that the server may still need; without a folder in memory, never on a disk."""

    directory: FileName | None = None
    max_mb: Positive = 512.0
    max_age_s: Positive = 3600.0


class NodeConfig(_Model):
    """A capture node: one device, one or more arrays on its channels (counted from 1)."""

    server: str = "tcp://127.0.0.1:5570"
    device: DeviceConfig
    spool: SpoolConfig = SpoolConfig()
    arrays: Annotated[dict[str, list[Annotated[int, Field(ge=1)]]], Field(min_length=1)]

    @model_validator(mode="before")
    @classmethod
    def _sound_by_default(cls, data: Any) -> Any:
        device = data.get("device") if isinstance(data, dict) else None
        if isinstance(device, dict) and "type" not in device:
            return {**data, "device": {"type": "sound", **device}}
        return data

    @field_validator("device", mode="before")
    @classmethod
    def _of_its_type(cls, device: Any) -> Any:
        if not isinstance(device, dict):
            raise ValueError("expected a mapping such as {name: UMC1820, sample_rate_hz: 44100}")
        kinds: dict[str, type[_Model]] = {
            "sound": SoundDeviceConfig,
            "wav": WavDeviceConfig,
            "scene": SceneDeviceConfig,
        }
        kind = kinds.get(str(device.get("type")))
        if kind is None:
            raise ValueError(f"type: expected one of {', '.join(kinds)}, got {device.get('type')!r}")
        return kind.model_validate(device)

    @field_validator("server")
    @classmethod
    def _endpoint(cls, endpoint: str) -> str:
        return check_endpoint(endpoint)


class HttpConfig(_Model):
    """Where the API and the dashboard listen, and whom they let in."""

    host: str = "127.0.0.1"
    port: Annotated[int, Field(ge=0, le=65535)] = 8000
    tokens: FileName | None = None
    certificate: FileName | None = None
    private_key: FileName | None = None

    @model_validator(mode="after")
    def _pair(self) -> HttpConfig:
        if (self.certificate is None) != (self.private_key is None):
            raise ValueError(
                "expected certificate and private_key, got "
                f"{'private_key' if self.certificate is None else 'certificate'} alone; add the other one"
            )
        return self


class SinkConfig(_Model):
    """Another place for events: a file with one JSON object a line."""

    type: Literal["jsonl"]
    path: Annotated[str, Field(min_length=1)]


class ServerConfig(_Model):
    """The fusion server."""

    bind: str = "tcp://127.0.0.1:5570"
    http: HttpConfig = HttpConfig()
    events_db: str | None = None
    sinks: tuple[SinkConfig, ...] = ()

    @field_validator("bind")
    @classmethod
    def _endpoint(cls, endpoint: str) -> str:
        return check_endpoint(endpoint, wildcards=True)


class StoreConfig(_Model):
    """How long events are kept: for ever, unless told otherwise."""

    retention_days: Positive | None = None


class ActivityConfig(_Model):
    """The rule that finds sound: see `livessl.core.activity`."""

    threshold: Annotated[float, Field(gt=0, le=1)] = 0.1
    release_s: Positive = 1.0
    floor_window_s: Positive = 3.0
    floor_factor: Annotated[float, Field(ge=1, le=1e6)] = 4.0
    min_level_dbfs: Annotated[float, Field(ge=-300, le=0)] = -90.0
    pre_roll_s: Annotated[float, Field(ge=0, le=5)] = 0.4
    hang_over_s: Annotated[float, Field(ge=0.05, le=5)] = 0.3


class FusionConfig(_Model):
    """How arrays are joined."""

    method: str = "onset"
    deadline_s: Annotated[float, Field(gt=0, le=10)] = 0.5
    window_s: Annotated[float, Field(ge=0.05, le=2)] = 0.2
    update_s: Annotated[float, Field(ge=0.05, le=2)] = 0.1
    max_event_s: Annotated[float, Field(ge=0.5, le=60)] = 10.0
    min_arrays: Annotated[int, Field(ge=1)] = 1
    sources: Annotated[int, Field(ge=1, le=2)] = 2
    live_sources: Annotated[int, Field(ge=1, le=2)] = 1


class Zone(_Model):
    """A named box of interest."""

    bounds_m: Bounds

    @field_validator("bounds_m")
    @classmethod
    def _ordered(cls, bounds: Bounds) -> Bounds:
        return _ordered(bounds)

    def contains(self, position_m: Sequence[float]) -> bool:
        """Whether a position lies in it."""
        return all(low <= x <= high for x, (low, high) in zip(position_m, self.bounds_m, strict=True))


class Site(_Model):
    """A whole site file."""

    site: Annotated[str, Field(min_length=1, max_length=64, pattern=r"^[A-Za-z0-9._-]+$")]
    room: Room
    speed_of_sound_m_s: Annotated[float, Field(gt=100, lt=2000)] | None = None
    temperature_c: Annotated[float, Field(gt=-60, lt=80)] | None = None
    band_hz: BandHz = (100.0, 6000.0)
    grid: GridConfig = GridConfig()
    arrays: Annotated[dict[str, ArrayConfig], Field(min_length=1)]
    joint: dict[str, Annotated[tuple[str, ...], Field(min_length=2)]] = {}
    nodes: dict[str, NodeConfig] = {}
    server: ServerConfig = ServerConfig()
    keys: FileName | None = None
    privacy: Literal["positions-only", "recording"] = "recording"
    store: StoreConfig = StoreConfig()
    activity: ActivityConfig = ActivityConfig()
    fusion: FusionConfig = FusionConfig()
    zones: dict[str, Zone] = {}
    specs: Annotated[tuple[ArraySpec, ...], Field(exclude=True, default=())]
    """The arrays as they stand in the room, and are recorded."""
    processed: Annotated[tuple[ArraySpec, ...], Field(exclude=True, default=())]
    """The arrays as they are processed: a joint one in the place of those that it joins."""
    warnings: Annotated[tuple[str, ...], Field(exclude=True, default=())]
    """What is valid and yet unlikely to work, in words."""
    directory: Annotated[Path, Field(exclude=True, default=Path())]
    """The site file's folder."""

    model_config = ConfigDict(frozen=True, extra="forbid", arbitrary_types_allowed=True)

    @property
    def c_m_s(self) -> float:
        """Speed of sound, m/s: as given, from the temperature, or 343."""
        if self.speed_of_sound_m_s is not None:
            return self.speed_of_sound_m_s
        if self.temperature_c is not None:
            return speed_of_sound_m_s(self.temperature_c)
        return DEFAULT_SPEED_OF_SOUND_M_S

    def file(self, name: str) -> Path:
        """A file that the site file names."""
        return self.directory / name

    def search_grid(self) -> Grid:
        """The shared grid: the bounds given, or the whole room."""
        x, y, z = self.room.size_m
        return Grid(self.grid.bounds_m or ((0.0, x), (0.0, y), (0.0, z)), self.grid.spacing_m)

    def array(self, name: str) -> ArraySpec:
        """The array of that name, joint or not, with absolute positions."""
        return next(spec for spec in (*self.specs, *self.processed) if spec.name == name)

    def members(self, array: str) -> tuple[str, ...]:
        """Names of the arrays that one joins: of one that is not joint, its own."""
        return self.joint.get(array, (array,))

    def joined_channels(self, channels: Mapping[str, Sequence[int]]) -> dict[str, list[int]]:
        """Channels of the arrays as they are processed, from those of the arrays as they stand, or of joint ones."""
        found = {}
        for name in (spec.name for spec in self.processed):
            given = [name] if name in channels else self.members(name)
            if not set(given).isdisjoint(channels):
                found[name] = [number for array in given for number in channels[array]]
        return found

    def activity_parameters(self) -> ActivityParameters:
        """The activity rule's numbers, for the core."""
        a = self.activity
        return ActivityParameters(
            threshold=a.threshold,
            release_s=a.release_s,
            floor_window_s=a.floor_window_s,
            floor_factor=a.floor_factor,
            min_power=10.0 ** (a.min_level_dbfs / 10.0),
            pre_roll_s=a.pre_roll_s,
            hang_over_s=a.hang_over_s,
        )

    def make_clock_offsets(self) -> ClockOffsets:
        """What nobody knows yet of this site's clocks: one each node, or each array that is on none."""
        from livessl.core.clock_offsets import ClockOffsets

        return ClockOffsets({spec.name: self.node_of(spec.name) or spec.name for spec in self.processed}, self.c_m_s)

    def make_fusion(
        self,
        method: str | None = None,
        *,
        updates: bool = True,
        live: bool = False,
        clock_offsets: ClockOffsets | None = None,
        each: Each | None = None,
    ) -> Fusion:
        """A new fusion of this site's arrays, by the site's method or another of `METHODS`.

        `clock_offsets` is what is known already of the arrays' clocks; `each` is what arrays are listened to by.
        """
        from livessl.core.estimators import ESTIMATORS
        from livessl.core.fusion import ANSWER_S, Fusion, FusionParameters
        from livessl.core.segmenter import RECENT_S

        f, a = self.fusion, self.activity
        estimator = ESTIMATORS[method or f.method](self.processed, self.search_grid(), self.c_m_s)
        parameters = FusionParameters(
            deadline_s=f.deadline_s,
            answer_s=ANSWER_S if live else RECENT_S,
            window_s=f.window_s,
            update_s=f.update_s,
            max_event_s=f.max_event_s,
            min_arrays=f.min_arrays,
            sources=f.sources,
            live_sources=f.live_sources,
            threshold=a.threshold,
            pre_roll_s=a.pre_roll_s,
            hang_over_s=a.hang_over_s,
        )
        return Fusion(
            self.site,
            self.processed,
            estimator,
            parameters,
            updates=updates,
            newest_only=live,
            clock_offsets=self.make_clock_offsets() if clock_offsets is None else clock_offsets,
            each=each,
        )

    def node_of(self, array: str) -> str | None:
        """Name of the node that captures an array; a joint one's arrays are all on one."""
        first = self.members(array)[0]
        return next((name for name, node in self.nodes.items() if first in node.arrays), None)

    def zones_of(self, position_m: Sequence[float] | None) -> list[str]:
        """Names of the zones that hold a position."""
        return [] if position_m is None else [name for name, zone in self.zones.items() if zone.contains(position_m)]


def check_endpoint(endpoint: str, *, wildcards: bool = False) -> str:
    """Return `endpoint` if it is a ZeroMQ TCP or IPC address; `*` for host or port is none that one can connect to.

    Raises
    ------
    ValueError
        With what was expected.
    """
    scheme, _, rest = endpoint.partition("://")
    host, _, port = rest.rpartition(":")
    numbered = re.fullmatch("[0-9]{1,5}", port) is not None and int(port) <= 65535
    tcp = scheme == "tcp" and host != "" and (numbered or port == "*") and (wildcards or "*" not in (host, port))
    if not (tcp or (scheme == "ipc" and rest)):
        raise ValueError(f"expected tcp://HOST:PORT or ipc://PATH, got {endpoint!r}")
    return endpoint


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches what listens on `host`."""
    try:
        return ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return host == "localhost"


def open_doors(site: Site) -> list[Fault]:
    """What would let the whole network in: addresses that others reach, without a way to tell who they are."""
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


def load_site(path: Path, joint: Mapping[str, Sequence[str]] | None = None) -> Site:
    """Read and check a site file; `joint` adds to its own.

    Raises
    ------
    ConfigError
        With every fault found, each with its line.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError([Fault(str(path), f"cannot be read: {_reason(error)}")]) from error
    return parse_site(text, str(path), path.parent, joint)


def parse_site(
    text: str,
    source: str = "site file",
    directory: Path | None = None,
    joint: Mapping[str, Sequence[str]] | None = None,
) -> Site:
    """Check the text of a site file; geometry files are looked up from `directory`, and `joint` adds to its own.

    Raises
    ------
    ConfigError
        With every fault found, each with its line.
    """
    try:
        data = read_yaml(text)
        root = yaml.compose(text, Loader=yaml.SafeLoader)
        at = _Places(source, dict(_lines(root)))
    except RecursionError as error:
        raise ConfigError([Fault(source, "not a site: it holds itself, or is nested too deeply")]) from error
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f"{source}:{mark.line + 1}" if mark else source
        raise ConfigError([Fault(where, f"not valid YAML: {getattr(error, 'problem', error)}")]) from error
    if not isinstance(data, dict):
        raise ConfigError([Fault(source, "expected a mapping with the keys site, room and arrays")])
    findings = [*_duplicate_keys(root)]
    for key in ("specs", "processed", "warnings", "directory"):
        if key in data:
            findings.append(((key,), "unknown key; take it away"))
            del data[key]
    if joint and isinstance(data.setdefault("joint", {}), dict):
        data["joint"] |= {name: list(members) for name, members in joint.items()}
    site, wrong = _valid_part(data)
    findings += wrong
    if site is not None:
        specs, wrong = _array_specs(site, directory or Path())
        site = site.model_copy(update={"specs": specs, "directory": directory or Path()})
        processed, apart = _processed_specs(site)
        site = site.model_copy(update={"processed": processed})
        lost = set(data["arrays"]) - set(site.arrays)
        findings += [*wrong, *(finding for finding in apart if not _follows(finding[0], lost))]
        findings += [finding for finding in _cross_faults(site) if not _follows(finding[0], lost)]
    if findings or site is None:
        raise ConfigError([at.fault(path, what) for path, what in findings])
    return site.model_copy(update={"warnings": (*_wide_arrays(site), *_leaks(site))})


def read_yaml(text: str) -> Any:
    """Value of a YAML text.

    Raises
    ------
    yaml.YAMLError
        Where it is no YAML, or holds a value such as the 45th of a month.
    """
    try:
        return yaml.safe_load(text)
    except (ValueError, KeyError, AttributeError, RecursionError) as error:  # let through by the library's constructors
        raise yaml.YAMLError(f"{type(error).__name__}: {error}") from error


_Place = tuple[str | int, ...]
_Finding = tuple[_Place, str]


class _Places:
    """Turns a path inside the file into "file:line: path"."""

    def __init__(self, source: str, lines: Mapping[_Place, int]) -> None:
        self._source = source
        self._lines = {tuple(map(str, path)): line for path, line in lines.items()}

    def fault(self, path: _Place, what: str) -> Fault:
        known = tuple(map(str, path))
        while known and known not in self._lines:
            known = known[:-1]
        line = self._lines.get(known)
        where = self._source if line is None else f"{self._source}:{line}"
        dotted = ".".join(map(str, path))
        return Fault(f"{where}: {dotted}" if dotted else where, what)


def _valid_part(data: Mapping[str, Any]) -> tuple[Site | None, list[_Finding]]:
    """What is left without the parts that are wrong, so that faults elsewhere show too; and what is wrong."""
    left = copy.deepcopy(dict(data))
    found: list[_Finding] = []
    while True:
        try:
            return Site.model_validate(left), found
        except ValidationError as error:
            items = error.errors()
        if not found:  # what is missing in later rounds has been taken away here
            found = [(_path(item["loc"]), _sentence(item)) for item in items]
        for part in {_part(_path(item["loc"]), item["type"] == "extra_forbidden") for item in items}:
            if not part or not _take_away(left, part):
                return None, found


def _part(path: _Place, unknown_key: bool) -> _Place:
    """The smallest part of the file that can be left out for a fault at `path`."""
    return path if unknown_key else path[: 2 if path[:1] in _NAMED_PARTS else 1]


_NAMED_PARTS: Final = (("arrays",), ("joint",), ("nodes",), ("zones",))


def _take_away(data: dict[str, Any], path: _Place) -> bool:
    holder: Any = data
    for part in path[:-1]:
        holder = holder[part] if isinstance(holder, dict) and part in holder else None
    if not isinstance(holder, dict) or path[-1] not in holder:
        return False
    del holder[path[-1]]
    return True


def _follows(path: _Place, lost: set[str]) -> bool:
    """Whether a finding may come only of arrays that were left out."""
    return bool(lost) and (path[-1] in lost or path == ("fusion", "min_arrays"))


def _lines(node: yaml.Node | None, path: _Place = ()) -> Iterator[tuple[_Place, int]]:
    if node is None:
        return
    if isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            here = (*path, key.value)
            yield here, key.start_mark.line + 1
            yield from _lines(value, here)
    elif isinstance(node, yaml.SequenceNode):
        for index, value in enumerate(node.value):
            yield (*path, index), value.start_mark.line + 1
            yield from _lines(value, (*path, index))


def _duplicate_keys(node: yaml.Node | None, path: _Place = ()) -> Iterator[_Finding]:
    if isinstance(node, yaml.MappingNode):
        seen: set[str] = set()
        for key, value in node.value:
            here = (*path, key.value)
            if key.value in seen:
                yield here, "stands here twice and only the last would count; take one away"
            seen.add(key.value)
            yield from _duplicate_keys(value, here)


_NAME: Final = re.compile(r"[A-Za-z0-9._-]{1,64}")

_UNION_PARTS: Final = frozenset({"Shape", "[key]", "str", "SoundDeviceConfig", "WavDeviceConfig", "SceneDeviceConfig"})


def _path(location: tuple[str | int, ...]) -> _Place:
    """A pydantic location without the names of union members, which the user never wrote."""
    return tuple(part for part in location if part not in _UNION_PARTS)


def _sentence(item: Any) -> str:
    kind, got = item["type"], item.get("input")
    if kind == "extra_forbidden":
        return "unknown key; correct its spelling or take it away"
    if kind == "missing":
        return "missing; add it"
    message = str(item["msg"]).removeprefix("Value error, ")
    simple = isinstance(got, str | int | float | bool) or got is None
    return f"{message}, got {got!r}" if simple and "got" not in message else message


def _array_specs(site: Site, directory: Path) -> tuple[tuple[ArraySpec, ...], list[_Finding]]:
    specs: list[ArraySpec] = []
    wrong: list[_Finding] = []
    for name, array in site.arrays.items():
        try:
            positions = _microphones_m(array, directory)
        except ConfigError as error:
            wrong.append((("arrays", name, "geometry"), "; ".join(str(fault) for fault in error.faults)))
            continue
        if array.band_hz is not None and array.band_hz[0] >= array.band_hz[1]:
            wrong.append(
                (
                    ("arrays", name, "band_hz"),
                    f"expected [low, high] with low < high, got {list(array.band_hz)}",
                )
            )
            continue
        if site.band_hz[0] < site.band_hz[1]:
            specs.append(ArraySpec(name, positions, array.band_hz or site.band_hz))
    return tuple(specs), wrong


def _processed_specs(site: Site) -> tuple[tuple[ArraySpec, ...], list[_Finding]]:
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


def _joint_faults(site: Site) -> Iterator[_Finding]:
    """What is wrong with joint arrays before their microphones are looked at."""
    used: dict[str, str] = {}
    for name, members in site.joint.items():
        if name in site.arrays:
            yield ("joint", name), "expected another name: an array is called so already; rename it"
        for member in members:
            here: _Place = ("joint", name, member)
            if member not in site.arrays:
                yield here, f"no such array; arrays are {', '.join(site.arrays)}"
            elif member in used:
                yield here, f"already joined in {used[member]!r}; take it away here or there"
            used[member] = name
        offsets_s = {site.arrays[member].wav_offset_s for member in members if member in site.arrays}
        if len(offsets_s) > 1:
            each = ", ".join(f"{offset_s:g}" for offset_s in sorted(offsets_s))
            yield ("joint", name), f"expected arrays of one wav_offset_s, since they are recorded together, got {each}"


def _microphones_m(array: ArrayConfig, directory: Path) -> FloatArray:
    if array.microphones_m is not None:
        return as_positions_m(array.microphones_m)
    if isinstance(array.geometry, str):
        shape = as_positions_m(_geometry_file(directory / array.geometry).microphones_m)
    else:
        assert array.geometry is not None
        shape = array.geometry.microphones_m()
    turn = array.orientation_deg or Orientation()
    assert array.position_m is not None
    return posed(shape, array.position_m, turn.yaw, turn.pitch, turn.roll)


def _geometry_file(path: Path) -> GeometryFile:
    try:
        return GeometryFile.model_validate(read_yaml(path.read_text(encoding="utf-8")))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ConfigError([Fault(str(path), f"geometry file cannot be read: {_reason(error)}")]) from error
    except ValidationError as error:
        raise ConfigError(
            [
                Fault(f"{path}: {'.'.join(str(part) for part in item['loc'])}", _sentence(item))
                for item in error.errors()
            ]
        ) from error


def _reason(error: Exception) -> str:
    return getattr(error, "strerror", None) or str(error)


def _cross_faults(site: Site) -> Iterator[_Finding]:
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


def _name_faults(site: Site) -> Iterator[_Finding]:
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


def _array_faults(site: Site, spec: ArraySpec) -> Iterator[_Finding]:
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


def _grid_faults(site: Site) -> Iterator[_Finding]:
    grid = site.search_grid()
    if grid.size > MOST_NODES:
        fits = site.grid.spacing_m * (grid.size / MOST_NODES) ** (1 / max(1, len(grid.free_axes)))
        yield (
            ("grid", "spacing_m"),
            f"a grid of {grid.size:,} nodes takes too long to set up, allowed are {MOST_NODES:,}; use a spacing of "
            f"{np.ceil(fits * 1000) / 1000:g} m or more, or smaller bounds_m",
        )


def _wide_arrays(site: Site) -> Iterator[str]:
    """What is said of arrays whose peaks the grid steps over.

    That is where, at half of all nodes and pairs or more, the delay changes by over half a period from a node to a
    corner of its cell.
    """
    grid = site.search_grid()
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


def _leaks(site: Site) -> Iterator[str]:
    """What is let in or kept although the file seems to say otherwise."""
    http, days = site.server.http, site.store.retention_days
    if http.tokens is not None and http.certificate is None and not is_loopback(http.host):
        yield (
            "server.http: tokens and positions travel unencrypted; set certificate and private_key, or listen on "
            "127.0.0.1 behind a proxy that has them"
        )
    if days is not None and site.server.sinks:
        yield f"store.retention_days: {days:g} days do not reach server.sinks; rotate those files yourself"


def _node_faults(site: Site) -> Iterator[_Finding]:
    claimed: dict[str, str] = {}
    for node_name, node in site.nodes.items():
        used: dict[int, str] = {}
        if site.privacy == "positions-only" and node.spool.directory is not None:
            yield (
                ("nodes", node_name, "spool", "directory"),
                "with privacy: positions-only no sound is kept on a disk; take it away, and it is kept in memory",
            )
        for name, channels in node.arrays.items():
            here: _Place = ("nodes", node_name, "arrays", name)
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
