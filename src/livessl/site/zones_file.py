"""Reads and writes the file of the zones that operators draw: `zones_file` of the site file names it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import yaml
from pydantic import TypeAdapter, ValidationError

from livessl.errors import ConfigError, Fault
from livessl.site.fields import Model
from livessl.site.findings import Locator, duplicate_keys, nodes_of, reason, validation_findings, value_of
from livessl.site.secret_files import NAME, write_whole
from livessl.site.zone_models import Zone

HEAD: Final = "# Written by livessl: the zones that operators draw on the dashboard. Reload the server after edits.\n"

MAX_DRAWN: Final = 100
"""Most zones that operators can draw: each costs time for every event."""

_ZONES: Final = TypeAdapter(dict[str, Zone])


class _File(Model):
    zones: dict[str, Zone]


def read_zones(path: Path) -> dict[str, Zone]:
    """Return the zones of a file, by name; none if there is no such file yet.

    Raises
    ------
    ConfigError
        With every fault of the file, each with its line.
    """
    if not path.exists():
        return {}
    try:
        root = nodes_of(path.read_text(encoding="utf-8"))
        data = value_of(root) or {}
    except (OSError, UnicodeDecodeError, yaml.YAMLError, RecursionError) as error:
        raise ConfigError([Fault(str(path), f"cannot be read: {reason(error)}; correct it, or delete it")]) from error
    locator = Locator(str(path), root)
    findings = list(duplicate_keys(root))
    zones: dict[str, Zone] = {}
    try:
        zones = _ZONES.validate_python(data)
    except ValidationError as error:
        errors = [{**each, "loc": ("zones", *each["loc"])} for each in error.errors()]
        findings += [(place[1:], what) for place, what in validation_findings(_File, errors)]
    findings += [((name,), what) for name, what in _name_faults(zones)]
    if findings:
        raise ConfigError([locator.fault(place, what) for place, what in findings])
    return zones


def write_zones(path: Path, zones: Mapping[str, Zone]) -> None:
    """Write zones into a file, whole or not at all.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    data = {name: zone.model_dump(exclude_defaults=True, mode="json") for name, zone in zones.items()}
    write_whole(path, HEAD + yaml.safe_dump(data, sort_keys=False, allow_unicode=True, default_flow_style=None), 0o644)


def zone_name_fault(name: str) -> str | None:
    """Return what is wrong with the name of a zone; None if nothing is."""
    if NAME.fullmatch(name):
        return None
    return "expected a name of 1 to 64 letters, digits, '.', '_' or '-'; rename it"


def _name_faults(zones: Mapping[Any, Zone]) -> Iterator[tuple[str, str]]:
    for name in zones:
        what = zone_name_fault(name)
        if what is not None:
            yield name, what
