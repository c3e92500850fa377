"""Reads a site file: all of its faults at once, each with its line."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError

from livessl.errors import ConfigError, Fault
from livessl.site.build.arrays import build_site
from livessl.site.calibration_file import found_name
from livessl.site.checks import cross_faults, warnings_of
from livessl.site.findings import (
    Locator,
    duplicate_keys,
    nodes_of,
    one_for_each_slip,
    places_of,
    reason,
    require_sane,
    unknown_key,
    validation_findings,
    value_of,
)
from livessl.site.floor_plan import read_floor_plan
from livessl.site.models import Site, SiteFile
from livessl.site.place import Finding, Place
from livessl.site.slips import quote_keys
from livessl.site.zones_file import read_zones


def load_site(path: Path | str, joint: Mapping[str, Sequence[str]] | None = None) -> Site:
    """Read and check a site file.

    Parameters
    ----------
    path : Path or str
    joint : mapping of name to array names, or None
        Joint arrays in addition to those of the file.

    Raises
    ------
    ConfigError
        With every fault found, each with its line.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError([Fault(str(path), f"cannot be read: {reason(error)}{_cure(error)}")]) from error
    return parse_site(text, str(path), path.parent, joint)


def _cure(error: Exception) -> str:
    if isinstance(error, FileNotFoundError):
        return "; correct the name, or make a site file with `livessl init`"
    if isinstance(error, IsADirectoryError):
        return "; name the site file in it, such as site.yaml, or make one with `livessl init`"
    return ""


def parse_site(
    text: str,
    source: str = "site file",
    directory: Path | None = None,
    joint: Mapping[str, Sequence[str]] | None = None,
) -> Site:
    """Check the text of a site file.

    Parameters
    ----------
    text : str
    source : str
        Name of the file, for messages.
    directory : Path or None
        Folder that paths in the file are relative to, and in which a calibration is looked for if the file names none;
        None for the current directory, and for no calibration that is not named.
    joint : mapping of name to array names, or None
        Joint arrays in addition to those of the file.

    Raises
    ------
    ConfigError
        With every fault found, each with its line.
    """
    try:
        root = nodes_of(text)
        require_sane(root)
        locator = Locator(source, root)
        slips = list(quote_keys(root))
        data = value_of(root)
    except RecursionError as error:
        raise ConfigError([Fault(source, "not a site: an alias contains itself, or nesting is too deep")]) from error
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f"{source}:{mark.line + 1}" if mark else source
        what = getattr(error, "problem", None) or reason(error)
        raise ConfigError([Fault(where, f"not valid YAML: {what}")]) from error
    if not isinstance(data, dict):
        raise ConfigError([Fault(source, "expected a mapping with the keys site, room and arrays")])
    if joint and isinstance(data.setdefault("joint", {}), dict):
        data["joint"] |= {name: list(members) for name, members in joint.items()}
    if data.get("calibration") is None and directory is not None:
        found = found_name(data.get("site"), directory)
        data |= {} if found is None else {"calibration": found}
    site, findings = _checked(data, directory or Path())
    findings = [*duplicate_keys(root), *slips, *findings]
    if site is None or findings:
        raise ConfigError([locator.fault(place, what) for place, what in findings])
    return site.model_copy(update={"warnings": warnings_of(site)})


def _checked(data: Mapping[Any, Any], directory: Path) -> tuple[Site | None, list[Finding]]:
    """Validate each section, then check the valid ones together; return None for the site if too little is valid."""
    known = {key: value for key, value in data.items() if key in SiteFile.model_fields}
    findings: list[Finding] = [
        ((key,), unknown_key(str(key), SiteFile.model_fields, places_of(SiteFile, str(key))))
        for key in data
        if key not in known
    ]
    errors: list[Any] = []
    file = None
    try:
        # the models append most faults to the context and go on; only what stops them is raised
        file = SiteFile.model_validate(known, context=errors)
    except ValidationError as error:
        errors += error.errors()
    findings = one_for_each_slip([*findings, *validation_findings(SiteFile, errors)], errors)
    if file is None or not file.arrays:
        return None, findings
    site, faults = build_site(file, directory)
    if file.zones_file is not None:
        try:
            site = site.model_copy(update={"drawn_zones": read_zones(directory / file.zones_file)})
        except ConfigError as error:
            findings.append((("zones_file",), "; ".join(str(fault) for fault in error.faults)))
    try:
        read_floor_plan(site)
    except ConfigError as error:
        findings += [(("floor_plan", "image"), fault.what) for fault in error.faults]
    faulty = set(data["arrays"]) - set(file.arrays)
    findings += [finding for finding in (*faults, *cross_faults(site)) if not _follows_from(faulty, finding[0])]
    return site, findings


def _follows_from(faulty: set[str], place: Place) -> bool:
    """Return True if the finding may be caused only by the arrays that were dropped as faulty."""
    return bool(faulty) and (place[-1] in faulty or place == ("fusion", "min_arrays"))
