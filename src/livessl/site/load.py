"""Reads a site file, and tells all that is wrong with it, each with its line. It opens no device and no socket."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import yaml
from pydantic import ValidationError

from livessl.core.geometry import as_positions_m, posed
from livessl.core.types import ArraySpec, FloatArray
from livessl.site.checks import Finding, Place, cross_faults, leaks, processed_specs, wide_arrays
from livessl.site.models import ArrayConfig, ConfigError, Fault, GeometryFile, Orientation, Site


def load_site(path: Path | str, joint: Mapping[str, Sequence[str]] | None = None) -> Site:
    """Read and check a site file; `joint` adds to its own.

    Raises
    ------
    ConfigError
        With every fault found, each with its line.
    """
    path = Path(path)
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
        processed, apart = processed_specs(site)
        site = site.model_copy(update={"processed": processed})
        lost = set(data["arrays"]) - set(site.arrays)
        findings += [*wrong, *(finding for finding in apart if not _follows(finding[0], lost))]
        findings += [finding for finding in cross_faults(site) if not _follows(finding[0], lost)]
    if findings or site is None:
        raise ConfigError([at.fault(path, what) for path, what in findings])
    return site.model_copy(update={"warnings": (*wide_arrays(site), *leaks(site))})


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


class _Places:
    """Turns a path inside the file into "file:line: path"."""

    def __init__(self, source: str, lines: Mapping[Place, int]) -> None:
        self._source = source
        self._lines = {tuple(map(str, path)): line for path, line in lines.items()}

    def fault(self, path: Place, what: str) -> Fault:
        known = tuple(map(str, path))
        while known and known not in self._lines:
            known = known[:-1]
        line = self._lines.get(known)
        where = self._source if line is None else f"{self._source}:{line}"
        dotted = ".".join(map(str, path))
        return Fault(f"{where}: {dotted}" if dotted else where, what)


def _valid_part(data: Mapping[str, Any]) -> tuple[Site | None, list[Finding]]:
    """What is left without the parts that are wrong, so that faults elsewhere show too; and what is wrong."""
    left = copy.deepcopy(dict(data))
    found: list[Finding] = []
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


def _part(path: Place, unknown_key: bool) -> Place:
    """The smallest part of the file that can be left out for a fault at `path`."""
    return path if unknown_key else path[: 2 if path[:1] in _NAMED_PARTS else 1]


_NAMED_PARTS: Final = (("arrays",), ("joint",), ("nodes",), ("zones",))


def _take_away(data: dict[str, Any], path: Place) -> bool:
    holder: Any = data
    for part in path[:-1]:
        holder = holder[part] if isinstance(holder, dict) and part in holder else None
    if not isinstance(holder, dict) or path[-1] not in holder:
        return False
    del holder[path[-1]]
    return True


def _follows(path: Place, lost: set[str]) -> bool:
    """Whether a finding may come only of arrays that were left out."""
    return bool(lost) and (path[-1] in lost or path == ("fusion", "min_arrays"))


def _lines(node: yaml.Node | None, path: Place = ()) -> Iterator[tuple[Place, int]]:
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


def _duplicate_keys(node: yaml.Node | None, path: Place = ()) -> Iterator[Finding]:
    if isinstance(node, yaml.MappingNode):
        seen: set[str] = set()
        for key, value in node.value:
            here = (*path, key.value)
            if key.value in seen:
                yield here, "stands here twice and only the last would count; take one away"
            seen.add(key.value)
            yield from _duplicate_keys(value, here)


_UNION_PARTS: Final = frozenset({"Shape", "[key]", "str", "SoundDeviceConfig", "WavDeviceConfig", "SceneDeviceConfig"})


def _path(location: tuple[str | int, ...]) -> Place:
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


def _array_specs(site: Site, directory: Path) -> tuple[tuple[ArraySpec, ...], list[Finding]]:
    specs: list[ArraySpec] = []
    wrong: list[Finding] = []
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
