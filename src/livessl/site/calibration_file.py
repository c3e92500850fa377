"""Calibration files: where a site's file lies, and how it is read, replaced as a whole, and put back.

The command and the server both write them. A file is replaced as a whole, and the one before it is kept beside it, so
that one step can be undone.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import yaml

from livessl.clock import utc_text
from livessl.site.findings import read_model, read_yaml
from livessl.site.models import CalibratedArray, CalibrationFile, Site

FOLDER: Final = "calibration"
"""Folder of calibration files, beside the site file."""

NOTHING: Final = "# The poses of the site file are in force: nothing is calibrated.\narrays: {}\n"
"""A calibration file without arrays: what is kept where there was no file before."""


def default_name(site: str) -> str:
    """Return the name of the calibration file of a site whose file names none."""
    return f"{FOLDER}/{site}.yaml"


def found_name(site: Any, directory: Path) -> str | None:
    """Return the name of the calibration file that lies at its usual place; None if there is none.

    Parameters
    ----------
    site : Any
        Name of the site as its file has it, which may be no name at all.
    directory : Path
        Folder of the site file.
    """
    if not isinstance(site, str) or "/" in site or "\0" in site:
        return None
    name = default_name(site)
    try:
        data = read_yaml((directory / name).read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except (OSError, UnicodeDecodeError, yaml.YAMLError, RecursionError):
        return name  # it is there, and whoever reads it says what is wrong
    return name if isinstance(data, dict) and "arrays" in data else None  # others are files of geometries


def calibration_path(site: Site) -> Path:
    """Return where the calibration of a site is, or would be."""
    return site.file(site.calibration or default_name(site.site))


def is_absent(path: Path) -> bool:
    """Return whether there is certainly no such file; what cannot be looked for may be there."""
    try:
        path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return True
    except OSError:
        return False
    return False


def read_calibration(path: Path) -> CalibrationFile:
    """Return a calibration; one without arrays if there is no such file.

    Raises
    ------
    ConfigError
        With every fault of the file.
    """
    return CalibrationFile(arrays={}) if is_absent(path) else read_model(CalibrationFile, path, "calibration file")


def extended(
    before: CalibrationFile,
    arrays: Mapping[str, CalibratedArray],
    method: str,
    time_ns: int,
    sounds: int = 0,
    c_m_s: float = 0.0,
) -> CalibrationFile:
    """Return a calibration with these arrays; other arrays stay as they are.

    Parameters
    ----------
    before : CalibrationFile
    arrays : mapping of array to CalibratedArray
    method : str
        How they were measured: `poses`, `refine` or `typed`.
    time_ns : int
        When they were measured, UTC.
    sounds : int
        Number of sounds that they rest on.
    c_m_s : float
        Measured speed of sound, m/s; 0 if it was not.
    """
    return CalibrationFile(
        measured_utc=utc_text(time_ns),
        method=method,
        speed_of_sound_m_s=round(c_m_s, 1),
        sounds=sounds,
        arrays={**before.arrays, **arrays},
    )


def write_calibration(path: Path, calibration: CalibrationFile) -> None:
    """Write a calibration file and keep the one before.

    At each moment either the whole old file or the whole new one is there.

    Raises
    ------
    OSError
        If it cannot be written; then nothing has changed.
    """
    content = calibration.model_dump(mode="json", exclude_defaults=True)
    path.parent.mkdir(parents=True, exist_ok=True)
    new, kept = (
        _written(path, yaml.safe_dump(content, sort_keys=False, default_flow_style=None).encode()),
        kept_path(path),
    )
    _written(kept, path.read_bytes() if path.exists() else NOTHING.encode()).replace(kept)
    new.replace(path)


def undo_calibration(path: Path) -> None:
    """Put back the file before the last `write_calibration`.

    Raises
    ------
    FileNotFoundError
        If there is none.
    OSError
        If the file cannot be replaced.
    """
    kept_path(path).replace(path)


def contents(path: Path) -> dict[Path, bytes | None]:
    """Return the content of a calibration file and of the one before; None where there is none.

    Raises
    ------
    OSError
        If one of them cannot be read.
    """
    return {one: None if is_absent(one) else one.read_bytes() for one in (path, kept_path(path))}


def put_back(before: Mapping[Path, bytes | None]) -> None:
    """Put back what `contents` has returned.

    Raises
    ------
    OSError
        If a file cannot be replaced.
    """
    for path, content in before.items():
        if content is None:
            path.unlink(missing_ok=True)
        else:
            _written(path, content).replace(path)


def can_undo(path: Path) -> bool:
    """Return whether there is a file to put back."""
    return kept_path(path).exists()


def kept_path(path: Path) -> Path:
    """Return where the file before is kept."""
    return path.with_suffix(path.suffix + ".before")


def _written(path: Path, content: bytes) -> Path:
    """Write what shall replace a file to the disk, beside it; return where."""
    new = path.with_name(path.name + ".new")
    with new.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    return new
