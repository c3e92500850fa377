"""Keys and defaults of `nodes` in the site file: devices, block length, spool limits, channels of arrays."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from livessl.site.addresses import check_endpoint
from livessl.site.fields import FileName, Model, Positive
from livessl.site.slips import counted_from_0


class SoundDeviceConfig(Model):
    """An audio interface, by its name, and by serial number or USB port if several interfaces have that name.

    `latency_s` is the latency requested from the driver, in seconds. It sets the size of the driver's buffer, and so
    how long the machine may be busy before samples are lost; blocks still arrive every `block_s`.
    """

    type: Literal["sound"] = "sound"
    name: str
    serial: str | None = None
    usb_port: str | None = None
    sample_rate_hz: Positive = 48000.0
    block_s: Annotated[float, Field(gt=0, le=1)] = 0.02
    latency_s: Annotated[float, Field(gt=0, le=2)] = 0.1


class WavDeviceConfig(Model):
    """Recorded files in place of a device, played in real time; an array has one file, or a file for each channel."""

    type: Literal["wav"]
    files: dict[str, FileName | Annotated[list[FileName], Field(min_length=1)]]
    sample_rate_hz: Positive | None = None
    loop: bool = False


class SceneDeviceConfig(Model):
    """A simulated scene in place of a device, played in real time."""

    type: Literal["scene"]
    rt60_s: Annotated[float, Field(ge=0, le=100)] = 0.7
    events: Annotated[int, Field(ge=1)] = 8
    seed: Annotated[int, Field(ge=0, le=2**63 - 1)] = 0
    sample_rate_hz: Positive = 44100.0
    loop: bool = True


DeviceConfig = SoundDeviceConfig | WavDeviceConfig | SceneDeviceConfig


class SpoolConfig(Model):
    """The store of the frames that the server may still need: a folder, or by default memory.

    The oldest frames are removed beyond `max_mb` megabytes or `max_age_s` seconds. In memory, a lower limit applies as
    well: `livessl.capture.spool.MEMORY_BYTES`.
    """

    directory: FileName | None = None
    max_mb: Positive = 512.0
    max_age_s: Positive = 3600.0


class FurtherServer(Model):
    """A further server that a node sends to: the neighbour in a hall that is divided among servers.

    `arrays` are the arrays whose sound it gets; None for all arrays of the node. `public_key` is the file with the
    server's public key; None if it has the key of the node's first server.
    """

    server: str
    arrays: Annotated[tuple[str, ...], Field(min_length=1)] | None = None
    public_key: FileName | None = None

    @field_validator("server")
    @classmethod
    def _endpoint(cls, endpoint: str) -> str:
        return check_endpoint(endpoint)


class NodeConfig(Model):
    """A capture node: one device, and one or more arrays on its channels, which are counted from 1."""

    server: str = "tcp://127.0.0.1:5570"
    further_servers: tuple[FurtherServer, ...] = ()
    device: DeviceConfig
    spool: SpoolConfig = SpoolConfig()
    arrays: Annotated[dict[str, list[int]], Field(min_length=1)]

    @model_validator(mode="before")
    @classmethod
    def _sound_by_default(cls, data: Any) -> Any:
        device = data.get("device") if isinstance(data, dict) else None
        if isinstance(device, dict) and "type" not in device:
            return {**data, "device": {"type": "sound", **device}}
        return data

    @field_validator("device", mode="before")
    @classmethod
    def _by_type(cls, device: Any) -> Any:
        if not isinstance(device, dict):
            raise ValueError("expected a mapping such as {name: UMC1820, sample_rate_hz: 44100}")
        kinds: dict[str, type[Model]] = {
            "sound": SoundDeviceConfig,
            "wav": WavDeviceConfig,
            "scene": SceneDeviceConfig,
        }
        kind = kinds.get(str(device.get("type")))
        if kind is None:
            raise ValueError(f"type: expected one of {', '.join(kinds)}, got {device.get('type')!r}")
        return kind.model_validate(device)

    @field_validator("arrays")
    @classmethod
    def _from_one(cls, arrays: dict[str, list[int]]) -> dict[str, list[int]]:
        wrong = counted_from_0(arrays)
        if wrong is not None:
            raise ValueError(wrong)
        return arrays

    @field_validator("server")
    @classmethod
    def _endpoint(cls, endpoint: str) -> str:
        return check_endpoint(endpoint)

    @property
    def endpoints(self) -> tuple[str, ...]:
        """Addresses of all servers that the node sends to."""
        return self.server, *(further.server for further in self.further_servers)
