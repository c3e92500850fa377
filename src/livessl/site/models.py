"""The keys of the site file and defaults: room, grid spacing, frequency band (`band_hz`), arrays, cameras, privacy.

Defaults of `activity` are in `core/stream/activity.py`, those of `fusion` in `core/stream/parameters.py`.

The other sections are in `node_models`, `server_models`, `alert_models`, `zone_models` and `hub_models`. The models
only validate; `livessl.site.build` computes from them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Final, Literal, get_origin

from pydantic import AfterValidator, ConfigDict, Field, ValidationError, field_validator, model_validator
from pydantic_core.core_schema import ValidationInfo, ValidatorFunctionWrapHandler

from livessl.core.methods import ONSET
from livessl.core.stream.activity import ActivityParameters
from livessl.core.stream.parameters import FusionParameters
from livessl.core.types import MAX_MICROPHONES, MIN_MICROPHONES, ArraySpec, Uncertainty
from livessl.site.alert_models import AlertsConfig
from livessl.site.fields import BandHz, Bounds, Coordinate, FileName, Model, Position, Positive, ordered, without_nul
from livessl.site.node_models import NodeConfig
from livessl.site.server_models import ServerConfig, StoreConfig
from livessl.site.zone_models import FloorPlan, Zone

_ACTIVITY: Final = ActivityParameters()
_FUSION: Final = FusionParameters()
_UNCERTAINTY: Final = Uncertainty()

MicrophonesM = Annotated[list[Position], Field(min_length=MIN_MICROPHONES, max_length=MAX_MICROPHONES)]


def _celsius(temperature_c: float) -> float:
    if -60 < temperature_c < 80:
        return temperature_c
    hint = f"; did you mean {(temperature_c - 32) / 1.8:.1f}, from Fahrenheit?" if 80 <= temperature_c <= 130 else ""
    if 213.15 < temperature_c < 353.15:
        hint = f"; did you mean {temperature_c - 273.15:.1f}, from kelvin?"
    raise ValueError(f"expected a temperature between -60 and 80 degrees Celsius, got {temperature_c:g}{hint}")


def _metres(size_m: tuple[float, float, float]) -> tuple[float, float, float]:
    if min(size_m) < 1000:
        return size_m
    meant = ", ".join(f"{length / 1000:g}" for length in size_m)
    raise ValueError(f"expected metres, got {list(size_m)}; did you mean [{meant}], from millimetres?")


class Room(Model):
    """The room: a box with one corner at the origin."""

    size_m: Annotated[tuple[Positive, Positive, Positive], AfterValidator(_metres)]


class GridConfig(Model):
    """The search grid; without bounds it fills the room."""

    spacing_m: Annotated[Positive, Field(ge=1e-4)] = 0.05
    bounds_m: Bounds | None = None

    @field_validator("bounds_m")
    @classmethod
    def _ordered(cls, bounds: Bounds | None) -> Bounds | None:
        return None if bounds is None else ordered(bounds)


class Tetrahedron(Model):
    """A regular tetrahedron: channel 1 is the apex, 2 to 4 the base counter-clockwise, 2 towards +x."""

    edge_m: Positive


class Circle(Model):
    """A horizontal circle: channel 1 towards +x, then counter-clockwise, or clockwise with `clockwise: true`."""

    radius_m: Positive
    count: Annotated[int, Field(ge=MIN_MICROPHONES, le=MAX_MICROPHONES)]
    clockwise: bool = False


class Line(Model):
    """A straight line along x, channel 1 at the smallest x."""

    spacing_m: Positive
    count: Annotated[int, Field(ge=MIN_MICROPHONES, le=MAX_MICROPHONES)]


class Shape(Model):
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


class GeometryFile(Model):
    """A file under `calibration/`: measured positions around the array's own origin."""

    microphones_m: MicrophonesM
    description: str = ""


class CalibratedArray(Model):
    """Measured microphones of one array, and how well they are known."""

    microphones_m: MicrophonesM
    position_std_m: Annotated[float, Field(ge=0)] = 0.0
    orientation_std_deg: Annotated[float, Field(ge=0)] = 0.0
    misfit_us: list[Annotated[float, Field(ge=0)]] = Field(default_factory=list)
    covariance: list[list[float]] = Field(default_factory=list)


class CalibrationFile(Model):
    """A file that `livessl calibrate` and the server write; its positions of arrays replace those of the site file."""

    measured_utc: str = ""
    method: str = ""
    speed_of_sound_m_s: Annotated[float, Field(ge=0)] = 0.0
    sounds: Annotated[int, Field(ge=0)] = 0
    arrays: dict[str, CalibratedArray]


class Orientation(Model):
    """Angles in degrees: roll about x, then pitch about y, then yaw about z."""

    yaw: Coordinate = 0.0
    pitch: Coordinate = 0.0
    roll: Coordinate = 0.0

    @property
    def named_deg(self) -> dict[str, float]:
        """The angles as arguments of `livessl.core.geometry.posed`."""
        return {"yaw_deg": self.yaw, "pitch_deg": self.pitch, "roll_deg": self.roll}


class CameraConfig(Model):
    """A camera that can be pointed: where it is, and how it is mounted; at rest it looks along its own +x axis."""

    position_m: Position
    orientation_deg: Orientation = Orientation()


class UncertaintyConfig(Model):
    """Standard deviations of what is known of an array's set-up: see `livessl.core.types.Uncertainty`."""

    position_m: Annotated[float, Field(ge=0, le=1)] = _UNCERTAINTY.position_m
    orientation_deg: Annotated[float, Field(ge=0, le=45)] = _UNCERTAINTY.orientation_deg
    clock_s: Annotated[float, Field(ge=0, le=0.01)] = _UNCERTAINTY.clock_s
    temperature_c: Annotated[float, Field(ge=0, le=50)] = _UNCERTAINTY.temperature_c


class ArrayConfig(Model):
    """One microphone array: absolute positions, or a shape (or geometry file) and a pose."""

    microphones_m: MicrophonesM | None = None
    geometry: Shape | str | None = None
    position_m: Position | None = None
    orientation_deg: Orientation | None = None
    band_hz: BandHz | None = None
    uncertainty: UncertaintyConfig | None = None
    wav_offset_s: Coordinate = 0.0

    @field_validator("geometry", mode="before")
    @classmethod
    def _shape_or_file(cls, geometry: Any) -> Any:
        if isinstance(geometry, dict):
            return Shape.model_validate(geometry)
        if geometry is None or isinstance(geometry, str):
            return geometry and without_nul(geometry)
        raise ValueError("expected a shape such as {tetrahedron: {edge_m: 0.5}} or the path of a geometry file")

    @model_validator(mode="after")
    def _one_form(self) -> ArrayConfig:
        if (self.microphones_m is None) == (self.geometry is None):
            raise ValueError(
                "expected either microphones_m (absolute positions) or geometry with position_m, "
                f"got {'neither' if self.geometry is None else 'both'}"
            )
        if self.geometry is not None and self.position_m is None:
            raise ValueError("geometry needs position_m: the place of the array's origin in the room; add it")
        if self.microphones_m is not None and (self.position_m or self.orientation_deg):
            raise ValueError("microphones_m are absolute; remove position_m and orientation_deg, or use geometry")
        return self


class ActivityConfig(Model):
    """Parameters of the activity detection: see `livessl.core.stream.activity`."""

    threshold: Annotated[float, Field(gt=0, le=1)] = _ACTIVITY.threshold
    release_s: Positive = _ACTIVITY.release_s
    floor_window_s: Positive = _ACTIVITY.floor_window_s
    floor_factor: Annotated[float, Field(ge=1, le=1e6)] = _ACTIVITY.floor_factor
    min_level_dbfs: Annotated[float, Field(ge=-300, le=0)] = 10.0 * math.log10(_ACTIVITY.min_power)
    pre_roll_s: Annotated[float, Field(ge=0, le=5)] = _ACTIVITY.pre_roll_s
    hang_over_s: Annotated[float, Field(ge=0.05, le=5)] = _ACTIVITY.hang_over_s


class FusionConfig(Model):
    """Parameters of the fusion of arrays: see `livessl.core.stream.fusion`."""

    method: str = ONSET
    deadline_s: Annotated[float, Field(gt=0, le=10)] = _FUSION.deadline_s
    window_s: Annotated[float, Field(ge=0.05, le=2)] = _FUSION.window_s
    update_s: Annotated[float, Field(ge=0.05, le=2)] = _FUSION.update_s
    max_event_s: Annotated[float, Field(ge=0.5, le=60)] = _FUSION.max_event_s
    min_arrays: Annotated[int, Field(ge=1)] = _FUSION.min_arrays
    sources: Annotated[int, Field(ge=1, le=2)] = _FUSION.sources
    live_sources: Annotated[int, Field(ge=1, le=2)] = _FUSION.live_sources


class SiteFile(Model):
    """A whole site file, as it is written.

    If the validation context is a list, faults are appended to it instead of raised. The faulty section or named entry
    is dropped, and the rest is still checked. A fault of `site` or `room` always raises.
    """

    site: Annotated[str, Field(min_length=1, max_length=64, pattern=r"^[A-Za-z0-9._-]+$")]
    room: Room
    speed_of_sound_m_s: Annotated[float, Field(gt=100, lt=2000)] | None = None
    temperature_c: Annotated[float, AfterValidator(_celsius)] | None = None
    band_hz: BandHz = (100.0, 6000.0)
    uncertainty: UncertaintyConfig = UncertaintyConfig()
    grid: GridConfig = GridConfig()
    arrays: Annotated[dict[str, ArrayConfig], Field(min_length=1)]
    calibration: FileName | None = None
    joint: dict[str, Annotated[tuple[str, ...], Field(min_length=2)]] = Field(default_factory=dict)
    nodes: dict[str, NodeConfig] = Field(default_factory=dict)
    server: ServerConfig = ServerConfig()
    keys: FileName | None = None
    privacy: Literal["positions-only", "no-speech", "recording"] = "recording"
    store: StoreConfig = StoreConfig()
    activity: ActivityConfig = ActivityConfig()
    fusion: FusionConfig = FusionConfig()
    zones: dict[str, Zone] = Field(default_factory=dict)
    zones_file: FileName | None = None
    floor_plan: FloorPlan | None = None
    alerts: AlertsConfig = AlertsConfig()
    cameras: dict[str, CameraConfig] = Field(default_factory=dict)

    @field_validator("*", mode="wrap")
    @classmethod
    def _record_faults(cls, value: Any, handler: ValidatorFunctionWrapHandler, info: ValidationInfo) -> Any:
        if not isinstance(info.context, list):
            return handler(value)
        field = cls.model_fields[str(info.field_name)]
        named = get_origin(field.annotation) is dict and isinstance(value, dict) and len(value) > 0
        valid: list[Any] = []
        for part in [{name: entry} for name, entry in value.items()] if named else [value]:
            try:
                valid.append(handler(part))
            except ValidationError as error:
                if field.is_required() and not named:
                    raise
                info.context.extend({**item, "loc": (info.field_name, *item["loc"])} for item in error.errors())
        if named:
            return {name: entry for part in valid for name, entry in part.items()}
        return valid[0] if valid else field.get_default(call_default_factory=True)

    @property
    def may_record(self) -> bool:
        """Whether sound may be stored, or passed on, without being examined for speech."""
        return self.privacy == "recording"

    @property
    def forbidden_sound(self) -> str:
        """The sound that `privacy` forbids to store, if it forbids any, as a part of a sentence."""
        return "sound" if self.privacy == "positions-only" else "sound that may be speech"

    def members(self, array: str) -> tuple[str, ...]:
        """Return the names of the arrays that a joint array is made of; for any other array, its own name."""
        return self.joint.get(array, (array,))

    def node_of(self, array: str) -> str | None:
        """Return the name of the node that captures an array; all members of a joint array are on one node."""
        first = self.members(array)[0]
        return next((name for name, node in self.nodes.items() if first in node.arrays), None)


class Site(SiteFile):
    """A site file with the values that were built from it; `livessl.site.load` makes it.

    Attributes
    ----------
    directory : Path
        Folder of the site file.
    c_m_s : float
        Speed of sound, m/s: as given, from the temperature, or 343; see `livessl.site.build.arrays`.
    specs : tuple of ArraySpec
        The arrays of the file with absolute positions, as they are recorded.
    processed : tuple of ArraySpec
        The arrays as they are processed: a joint array takes the place of its members.
    warnings : tuple of str
        Settings that are valid but unlikely to work.
    drawn_zones : mapping of str to Zone
        The zones of `zones_file`, as it was when the site file was read.
    """

    directory: Annotated[Path, Field(exclude=True)]
    c_m_s: Annotated[float, Field(exclude=True)]
    specs: Annotated[tuple[ArraySpec, ...], Field(exclude=True)]
    processed: Annotated[tuple[ArraySpec, ...], Field(exclude=True)]
    warnings: Annotated[tuple[str, ...], Field(exclude=True)] = ()
    drawn_zones: Annotated[Mapping[str, Zone], Field(exclude=True)] = Field(default_factory=dict)

    model_config = ConfigDict(frozen=True, extra="forbid", arbitrary_types_allowed=True)

    def zones_of(self, position_m: Sequence[float] | None) -> list[str]:
        """Return the names of the zones that hold a position."""
        return (
            [] if position_m is None else [name for name, zone in self.all_zones.items() if zone.contains(position_m)]
        )

    @property
    def all_zones(self) -> dict[str, Zone]:
        """The zones of the site file, and those that operators have drawn."""
        return {**self.zones, **self.drawn_zones}

    def file(self, name: str) -> Path:
        """Return the path of a file or folder that the site file names, relative to the site file's folder."""
        return self.directory / name

    def array(self, name: str) -> ArraySpec:
        """Return the array of that name, joint or not, with absolute positions."""
        return next(spec for spec in (*self.specs, *self.processed) if spec.name == name)

    def joined_channels(self, channels: Mapping[str, Sequence[int]]) -> dict[str, list[int]]:
        """Return the channels of the processed arrays, from channels of the file's arrays or of joint ones."""
        found = {}
        for name in (spec.name for spec in self.processed):
            given = [name] if name in channels else self.members(name)
            if not set(given).isdisjoint(channels):
                found[name] = [number for array in given for number in channels[array]]
        return found
