"""Reads and writes a recorded session (`session.yaml`): files with start times, and the copied site file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from livessl.clock import recordable_ns, utc_ns, utc_text
from livessl.errors import ConfigError, Fault
from livessl.site.findings import dotted, read_yaml, validation_findings
from livessl.site.load import load_site
from livessl.site.models import Site

SESSION_FILE: Final = "session.yaml"
SITE_FILE: Final = "site.yaml"
VERSION: Final = 1
"""Version of the session file; files of another version are refused."""


class Piece(BaseModel):
    """One recording of one array, a file without gaps. Its channels are in the order of the array's microphones."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    array: str
    file: str
    start_utc: str

    @field_validator("start_utc")
    @classmethod
    def _instant(cls, text: str) -> str:
        recordable_ns(text)
        return text

    @property
    def start_ns(self) -> int:
        """Site time of the first sample, nanoseconds."""
        return utc_ns(self.start_utc)


class _SessionFile(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    version: int
    pieces: list[Piece] = Field(min_length=1)


@dataclass(frozen=True)
class Session:
    """A folder with recordings and their site file."""

    directory: Path
    pieces: tuple[Piece, ...]

    def path(self, piece: Piece) -> Path:
        """Return the path of a piece's file."""
        return self.directory / piece.file

    def site(self, joint: Mapping[str, Sequence[str]] | None = None) -> Site:
        """Return the site of the session, with the joint arrays of `joint` in addition to those of its site file."""
        return load_site(self.directory / SITE_FILE, joint)

    def inputs(self) -> dict[str, list[int]]:
        """Return the recorded inputs of the device for each array, in the order of the channels of its files.

        Arrays without a node are missing. If the site file of the session cannot be read, the result is empty.
        """
        try:
            data = read_yaml((self.directory / SITE_FILE).read_text(encoding="utf-8"))
            return {
                str(name): [int(number) for number in numbers]
                for node in data.get("nodes", {}).values()
                for name, numbers in node.get("arrays", {}).items()
            }
        except (OSError, yaml.YAMLError, RecursionError, AttributeError, TypeError, ValueError, OverflowError):
            return {}


def piece(array: str, file: str, start_ns: int) -> Piece:
    """Return a piece that begins at a site time."""
    return Piece(array=array, file=file, start_utc=utc_text(start_ns))


def write_session(directory: Path, site: Site, pieces: list[Piece]) -> None:
    """Write the session file and the site file into the folder of the recordings.

    Older files are replaced entirely or not at all, so that the session can be read even after a full disk or a crash.
    """
    described = _SessionFile(version=VERSION, pieces=pieces).model_dump()
    _replace(directory / SITE_FILE, site_text(site))
    _replace(directory / SESSION_FILE, yaml.safe_dump(described, sort_keys=False))


def holds_copied_site(directory: Path) -> bool:
    """Return whether the site file in a folder is the copy that a session has, without comments or another layout."""
    try:
        text = (directory / SITE_FILE).read_text(encoding="utf-8")
        return bool(text == _site_yaml(read_yaml(text)))
    except (OSError, UnicodeDecodeError, yaml.YAMLError, RecursionError):
        return False


def _replace(path: Path, text: str) -> None:
    part = path.with_name(path.name + ".part")
    try:
        part.write_text(text, encoding="utf-8")
        part.replace(path)
    except OSError:
        with suppress(OSError):
            part.unlink()
        raise


def read_session(directory: Path) -> Session:
    """Read a session.

    Raises
    ------
    ConfigError
        If the folder does not hold a valid session.
    """
    path = directory / SESSION_FILE
    try:
        described = _SessionFile.model_validate(read_yaml(path.read_text(encoding="utf-8")))
    except OSError as error:
        raise ConfigError(
            [
                Fault(
                    str(path),
                    f"expected a recorded session, cannot read it: {error.strerror}; make one with "
                    "`livessl record` or `livessl simulate`",
                )
            ]
        ) from error
    except (UnicodeDecodeError, yaml.YAMLError) as error:
        raise ConfigError([Fault(str(path), f"not valid YAML: {error}")]) from error
    except ValidationError as error:
        findings = validation_findings(_SessionFile, error.errors())
        raise ConfigError([Fault(f"{path}: {dotted(place)}", what) for place, what in findings]) from error
    if described.version != VERSION:
        raise ConfigError(
            [Fault(str(path), f"expected version {VERSION}, got {described.version}; use the livessl that recorded it")]
        )
    return Session(directory, tuple(described.pieces))


def site_text(site: Site) -> str:
    """Return a site as YAML that needs no other files: with absolute positions, and without keys and tokens."""
    http = {"tokens", "certificate", "private_key"}
    data: dict[str, Any] = site.model_dump(
        mode="json", exclude_defaults=True, exclude={"keys": True, "calibration": True, "server": {"http": http}}
    )
    for spec in site.specs:
        array = {"microphones_m": spec.microphones_m.round(6).tolist()}
        given = site.arrays[spec.name]
        if given.band_hz is not None:
            array["band_hz"] = list(given.band_hz)
        data["arrays"][spec.name] = array
    for name, node in site.nodes.items():
        data["nodes"][name]["device"]["type"] = node.device.type
    return _site_yaml(data)


def _site_yaml(data: Any) -> str:
    return str(yaml.safe_dump(data, sort_keys=False, default_flow_style=None))
