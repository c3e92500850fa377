"""Writes calibration files, and puts back the one before."""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from livessl.cli.exits import OK
from livessl.cli.output import complain
from livessl.clock import SystemClock, utc_text
from livessl.errors import RunError, UseError

if TYPE_CHECKING:
    from livessl.core.commission.resection import MeasuredPose, MeasuredSetUp
    from livessl.site.models import Site

FOLDER: Final = "calibration"
"""Folder of calibration files, beside the site file."""

BESIDE_THE_SITE: Final = Path()
"""Value of --write without a file: the file that the site file names, or else `FOLDER/SITE.yaml`."""


def add_file(parser: Any) -> None:
    """Add --write and --undo."""
    parser.add_argument(
        "--write",
        type=Path,
        nargs="?",
        const=BESIDE_THE_SITE,
        metavar="FILE",
        help="store the result in FILE (default: the calibration file that the site file names, otherwise "
        "calibration/SITE.yaml beside the site file)",
    )
    parser.add_argument("--undo", action="store_true", help="put back the file that --write has replaced")


def write(arguments: argparse.Namespace, site: Site, action: str, measured: MeasuredSetUp) -> None:
    """Write a calibration file, and keep the one that it replaces.

    Raises
    ------
    RunError
        If a site with it could not be loaded: a microphone would be outside the room.
    UseError
        If it cannot be written.
    """
    import yaml

    path = _path(arguments, site)
    arrays = {name: array for joint, pose in measured.poses.items() for name, array in _arrays(site, joint, pose)}
    _check_room(site, arrays)
    content = {
        "measured_utc": utc_text(SystemClock().now_ns()),
        "method": action,
        "sounds": measured.sounds,
        "speed_of_sound_m_s": round(measured.c_m_s, 1),
        "arrays": _others(path, arrays) | arrays,
    }
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _replace(path, yaml.safe_dump(content, sort_keys=False, default_flow_style=None).encode())
    except OSError as error:
        raise UseError(f"--write: cannot write {path}: {error.strerror}") from error
    named = site.calibration is not None and site.file(site.calibration).resolve() == path.resolve()
    hint = "" if named else f"; name it in the site file as calibration: {_relative(path, arguments)}"
    complain(f"written to {path}{hint}", kind="note")


def _check_room(site: Site, arrays: dict[str, dict[str, Any]]) -> None:
    """Raise `RunError` if a microphone would be outside the room."""
    for name, array in arrays.items():
        for number, at_m in enumerate(array["microphones_m"], 1):
            if not all(0.0 <= x <= size for x, size in zip(at_m, site.room.size_m, strict=True)):
                size_m, where_m = ([f"{x:g}" for x in xyz] for xyz in (site.room.size_m, at_m))
                raise RunError(
                    f"--write: expected array {name!r} within the room of {' x '.join(size_m)} m, got microphone "
                    f"{number} at ({', '.join(where_m)}); the site could not be loaded. Correct room.size_m, or "
                    "measure again, with all places from the corner that is the origin"
                )


def _replace(path: Path, content: bytes) -> None:
    """Write a file and keep the one before; at each moment either the whole old file or the whole new one is there."""
    new, kept = _written(path, content), _kept(path)
    if path.exists():
        _written(kept, path.read_bytes()).replace(kept)
    else:
        kept.unlink(missing_ok=True)
    new.replace(path)


def _written(path: Path, content: bytes) -> Path:
    """Write what shall replace a file to the disk, beside it; return where."""
    new = path.with_name(path.name + ".new")
    with new.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    return new


def _arrays(site: Site, name: str, pose: MeasuredPose) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield what is stored of a measured array; of a joint array, each of its members."""
    first = 0
    for member in site.members(name):
        count = len(site.array(member).microphones_m)
        yield (
            member,
            {
                "microphones_m": pose.microphones_m[first : first + count].round(4).tolist(),
                "position_std_m": round(pose.position_std_m, 4),
                "orientation_std_deg": round(pose.orientation_std_deg, 2),
                "misfit_us": [round(1e6 * pose.misfit_before_s, 1), round(1e6 * pose.misfit_s, 1)],
                "covariance": [[float(f"{value:.3g}") for value in row] for row in pose.covariance.tolist()],
            },
        )
        first += count


def undo(arguments: argparse.Namespace) -> int:
    """Put back the file before the last `write`; return the exit code.

    Raises
    ------
    UseError
        If there is none.
    """
    if arguments.write in (None, BESIDE_THE_SITE) and arguments.site is None:
        raise UseError("--undo: expected --site FILE, or --write FILE, the calibration file to put back")
    given: Path | None = arguments.write
    path = given if given is not None and given != BESIDE_THE_SITE else _named(arguments.site)
    if not _kept(path).exists():
        raise UseError(
            f"--undo: expected {_kept(path)}, the file that --write has replaced; there is none. To do without "
            "calibration, remove calibration: from the site file"
        )
    try:
        _kept(path).replace(path)
    except OSError as error:
        raise UseError(f"--undo: cannot replace {path}: {error.strerror}") from error
    complain(f"{path} is as it was before", kind="note")
    return OK


def _named(site_file: Path) -> Path:
    """Return the calibration file of a site file, which need not be valid: its calibration may be what is wrong."""
    import yaml

    from livessl.site.findings import read_yaml

    try:
        data = read_yaml(site_file.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError, RecursionError) as error:
        what = f"cannot read {site_file} ({type(error).__name__})"
        raise UseError(f"--undo: {what}; give the calibration file as --write FILE") from error
    known = data if isinstance(data, dict) else {}
    calibration, site = known.get("calibration"), known.get("site")
    if isinstance(calibration, str):
        return site_file.parent / calibration
    if isinstance(site, str):
        return site_file.parent / FOLDER / f"{site}.yaml"
    raise UseError(f"--undo: expected site or calibration in {site_file}; give the calibration file as --write FILE")


def _path(arguments: argparse.Namespace, site: Site | None) -> Path:
    given: Path | None = arguments.write
    if given is not None and given != BESIDE_THE_SITE:
        return given
    if site is None or arguments.site is None:
        raise UseError("--write: expected --site FILE to store the calibration beside, or --write FILE")
    if site.calibration is not None:
        return site.file(site.calibration)
    return Path(arguments.site).parent / FOLDER / f"{site.site}.yaml"


def _others(path: Path, arrays: dict[str, Any]) -> dict[str, Any]:
    """Return the arrays of the file that is replaced which were not measured now: they stay as they are."""
    import yaml

    try:
        known = yaml.safe_load(path.read_text(encoding="utf-8"))["arrays"]
        return {name: array for name, array in known.items() if name not in arrays}
    except (OSError, UnicodeDecodeError, yaml.YAMLError, KeyError, TypeError, AttributeError):
        return {}  # there is no such file, or it is none


def _relative(path: Path, arguments: argparse.Namespace) -> str:
    if arguments.site is None:
        return "FILE"
    try:
        return path.resolve().relative_to(Path(arguments.site).resolve().parent).as_posix()
    except ValueError:
        return str(path)


def _kept(path: Path) -> Path:
    return path.with_suffix(path.suffix + ".before")
