"""Writes calibration files for `calibrate --write`, puts back the one before (`--undo`), and notifies the server."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Final

from livessl.cli.options import BESIDE_THE_SITE
from livessl.cli.output import complain
from livessl.cli.own_work import refuse_foreign
from livessl.cli.server_answers import order
from livessl.clock import SystemClock
from livessl.errors import ConfigError, RunError, UseError

if TYPE_CHECKING:
    from livessl.core.commission.resection import MeasuredSetUp
    from livessl.site.models import CalibratedArray, CalibrationFile, Site

TAKE_OVER_S: Final = 60.0
"""Longest wait, in seconds, for a server that takes over a calibration: it computes its tables anew."""


def write(arguments: argparse.Namespace, site: Site, action: str, measured: MeasuredSetUp) -> Path:
    """Write a calibration file, and keep the one that it replaces; return where it is.

    Raises
    ------
    RunError
        If a site with it could not be loaded: a microphone would be outside the room.
    UseError
        If it cannot be written.
    """
    from livessl.site.build.calibrated import measured_arrays
    from livessl.site.calibration_file import calibration_path, extended, write_calibration

    path = _path(arguments, site)
    arrays = measured_arrays(site, measured)
    _check_room(site, arrays)
    now_ns = SystemClock().now_ns()
    calibration = extended(_before(path), arrays, action, now_ns, measured.sounds, measured.c_m_s)
    try:
        write_calibration(path, calibration)
    except OSError as error:
        raise UseError(f"--write: cannot write {path}: {error.strerror}") from error
    found = path.resolve() == calibration_path(site).resolve()
    hint = "" if found else f"; name it in the site file as calibration: {_relative(path, arguments)}"
    complain(f"written to {path}{hint}", kind="note")
    return path


def refuse_foreign_file(arguments: argparse.Namespace) -> None:
    """Raise `UseError` if --write names a file that is no calibration, such as the site file."""
    path: Path = arguments.write
    if path == BESIDE_THE_SITE:
        if arguments.site is None:
            return  # there is no place beside it
        try:
            path = _named(arguments.site)
        except UseError:
            return  # it is no valid site file, as its reader says
    refuse_foreign("--write", [path], _is_calibration, arguments.site, "which is no calibration")


def _is_calibration(path: Path) -> bool:
    """Return whether a file has the keys of a calibration, be their values right or wrong."""
    import yaml

    from livessl.site.findings import read_yaml
    from livessl.site.models import CalibrationFile

    try:
        data = read_yaml(path.read_text(encoding="utf-8"))
    except (UnicodeDecodeError, yaml.YAMLError, RecursionError):
        return False
    return isinstance(data, dict) and "arrays" in data and data.keys() <= CalibrationFile.model_fields.keys()


def _check_room(site: Site, arrays: Mapping[str, CalibratedArray]) -> None:
    """Raise `RunError` if a microphone would be outside the room."""
    for name, array in arrays.items():
        for number, at_m in enumerate(array.microphones_m, 1):
            if not all(0.0 <= x <= size for x, size in zip(at_m, site.room.size_m, strict=True)):
                size_m, where_m = ([f"{x:g}" for x in xyz] for xyz in (site.room.size_m, at_m))
                raise RunError(
                    f"--write: expected array {name!r} within the room of {' x '.join(size_m)} m, got microphone "
                    f"{number} at ({', '.join(where_m)}); the site could not be loaded. Correct room.size_m, or "
                    "measure again, with all places from the corner that is the origin"
                )


def tell_server(arguments: argparse.Namespace, url: str | None, path: Path) -> None:
    """Have the running server take over a calibration file that has changed, and show the user whether it did.

    Parameters
    ----------
    arguments : Namespace
    url : str or None
        Address of the server; None if it is not known.
    path : Path
        The file.
    """
    from livessl.server.api.set_up_schema import Changed
    from livessl.site.calibration_file import read_calibration

    later = "it takes effect when the server starts, or by Set-up on its dashboard"
    if url is None:
        complain(f"no address of a running server is known; {later}", kind="note")
        return
    try:
        answer = order(Changed, url, "set-up/reload", arguments.token_file, {}, TAKE_OVER_S)
    except RunError as error:
        complain(f"{error}; {later}", kind="note")
        return
    written = {name: array.microphones_m for name, array in read_calibration(path).arrays.items()}
    elsewhere = [
        name
        for name, array in answer.arrays.items()
        if name in written and array.microphones_m != [list(at_m) for at_m in written[name]]
    ]
    if elsewhere:
        file = answer.calibration.file
        complain(f"the server at {url} has other poses: its file is {file} beside its own site file; copy it there")
    elif answer.changed:
        complain(f"the server at {url} has taken over {', '.join(answer.changed)}", kind="note")


def undo(arguments: argparse.Namespace) -> Path:
    """Put back the file before the last `write`; return where it is.

    Raises
    ------
    UseError
        If there is none.
    """
    from livessl.site.calibration_file import kept_path, undo_calibration

    if arguments.write in (None, BESIDE_THE_SITE) and arguments.site is None:
        raise UseError("--undo: expected --site FILE, or --write FILE, the calibration file to put back")
    given: Path | None = arguments.write
    path = given if given is not None and given != BESIDE_THE_SITE else _named(arguments.site)
    try:
        undo_calibration(path)
    except FileNotFoundError as error:
        raise UseError(
            f"--undo: expected {kept_path(path)}, the file that --write has replaced; there is none. To do without "
            f"calibration, delete {path} and remove calibration: from the site file"
        ) from error
    except OSError as error:
        raise UseError(f"--undo: cannot replace {path}: {error.strerror}") from error
    complain(f"{path} is as it was before", kind="note")
    return path


def _named(site_file: Path) -> Path:
    """Return the calibration file of a site file, which need not be valid: its calibration may be what is wrong."""
    import yaml

    from livessl.site.calibration_file import default_name
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
        return site_file.parent / default_name(site)
    raise UseError(f"--undo: expected site or calibration in {site_file}; give the calibration file as --write FILE")


def _path(arguments: argparse.Namespace, site: Site | None) -> Path:
    from livessl.site.calibration_file import default_name

    given: Path | None = arguments.write
    if given is not None and given != BESIDE_THE_SITE:
        return given
    if site is None or arguments.site is None:
        raise UseError("--write: expected --site FILE to store the calibration beside, or --write FILE")
    return Path(arguments.site).parent / (site.calibration or default_name(site.site))


def _before(path: Path) -> CalibrationFile:
    """Return the calibration that is replaced: its arrays that were not measured now stay as they are."""
    from livessl.site.calibration_file import read_calibration
    from livessl.site.models import CalibrationFile

    try:
        return read_calibration(path)
    except ConfigError:
        return CalibrationFile(arrays={})  # it is no calibration


def _relative(path: Path, arguments: argparse.Namespace) -> str:
    if arguments.site is None:
        return "FILE"
    try:
        return path.resolve().relative_to(Path(arguments.site).resolve().parent).as_posix()
    except ValueError:
        return str(path)
