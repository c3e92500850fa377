"""The site: what is where, as its file says it. `livessl.site.load` reads it, `livessl.site.checks` judges it whole."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from ipaddress import ip_address
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from livessl.core.geometry import (
    circle,
    line,
    speed_of_sound_m_s,
    tetrahedron,
)
from livessl.core.stream.activity import ActivityParameters
from livessl.core.stream.parameters import FusionParameters
from livessl.core.types import MAX_MICROPHONES, MIN_MICROPHONES, ArraySpec, FloatArray
from livessl.errors import UseError

DEFAULT_SPEED_OF_SOUND_M_S: Final = 343.0
METHODS: Final = ("onset", "srp-phat", "cepstral", "averaged")
"""Names of `livessl.core.locate.estimators.ESTIMATORS`: who checks a site file need not load what localizes."""

_ACTIVITY: Final = ActivityParameters()
_FUSION: Final = FusionParameters()

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
    """The rule that finds sound: see `livessl.core.stream.activity`."""

    threshold: Annotated[float, Field(gt=0, le=1)] = _ACTIVITY.threshold
    release_s: Positive = _ACTIVITY.release_s
    floor_window_s: Positive = _ACTIVITY.floor_window_s
    floor_factor: Annotated[float, Field(ge=1, le=1e6)] = _ACTIVITY.floor_factor
    min_level_dbfs: Annotated[float, Field(ge=-300, le=0)] = 10.0 * math.log10(_ACTIVITY.min_power)
    pre_roll_s: Annotated[float, Field(ge=0, le=5)] = _ACTIVITY.pre_roll_s
    hang_over_s: Annotated[float, Field(ge=0.05, le=5)] = _ACTIVITY.hang_over_s


class FusionConfig(_Model):
    """How arrays are joined."""

    method: str = "onset"
    deadline_s: Annotated[float, Field(gt=0, le=10)] = _FUSION.deadline_s
    window_s: Annotated[float, Field(ge=0.05, le=2)] = _FUSION.window_s
    update_s: Annotated[float, Field(ge=0.05, le=2)] = _FUSION.update_s
    max_event_s: Annotated[float, Field(ge=0.5, le=60)] = _FUSION.max_event_s
    min_arrays: Annotated[int, Field(ge=1)] = _FUSION.min_arrays
    sources: Annotated[int, Field(ge=1, le=2)] = _FUSION.sources
    live_sources: Annotated[int, Field(ge=1, le=2)] = _FUSION.live_sources


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
