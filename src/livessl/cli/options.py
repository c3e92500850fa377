"""Options that several commands share: --site, --method, --wav, --channels, --joint, --json, --write; older names."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

from livessl.cli import argument
from livessl.core.methods import METHODS
from livessl.errors import ConfigError, Fault, UseError

if TYPE_CHECKING:
    from livessl.site.models import Site

T = TypeVar("T")

BESIDE_THE_SITE: Final = Path()
"""Value of --write without a file. It stands for the file that the site file names, or for calibration/SITE.yaml."""


def add_site(parser: Any) -> None:
    """Add --site."""
    parser.add_argument("--site", type=Path, required=True, help="site file")


def add_older_name(parser: Any, name: str, option: argparse.Action) -> None:
    """Accept an option by an older name as well, which the help does not show."""
    parser.add_argument(
        name,
        dest=option.dest,
        type=option.type,
        default=argparse.SUPPRESS,
        help=argparse.SUPPRESS,
        metavar=option.metavar,
    )


def add_method(parser: Any, default: str = "the site's") -> None:
    """Add --method; `default` describes the method that is used without the option."""
    parser.add_argument(
        "--method",
        type=argument.method,
        metavar=f"{{{','.join(sorted(METHODS))},MODULE:NAME}}",
        help=f"localization method; MODULE:NAME imports your own estimator (default: {default})",
    )


def add_calibration_file(parser: Any) -> None:
    """Add --write and --undo."""
    parser.add_argument(
        "--write",
        type=Path,
        nargs="?",
        const=BESIDE_THE_SITE,
        metavar="FILE",
        help="store the result in FILE; --write without FILE stores it in the calibration file that the site file "
        "names, otherwise in calibration/SITE.yaml beside the site file (default: the result is only printed)",
    )
    parser.add_argument(
        "--undo",
        action="store_true",
        help="measure nothing, and restore the calibration file that the last --write replaced; needs --site or "
        "--write FILE",
    )


def refuse_unused(command: str, given: Mapping[str, object], why: str) -> None:
    """Refuse options that would have no effect.

    Parameters
    ----------
    command : str
        Name of the command.
    given : mapping of str to object
        Value of each such option; one that is not given has a value that is false.
    why : str
        Reason, which follows "have no effect".

    Raises
    ------
    UseError
        If any of them is given.
    """
    names = [option for option, value in given.items() if value]
    if names:
        verb, cure = ("has", "it") if len(names) == 1 else ("have", "them")
        raise UseError(f"{command}: {' and '.join(names)} {verb} no effect {why}; remove {cure}")


def import_from_here() -> None:
    """Make modules in the current directory importable, for a method that is named `MODULE:NAME`.

    The directory comes last, so that no file in it hides an installed module.
    """
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.append(here)


def add_json(parser: Any, text: str = "print one JSON object per event") -> None:
    """Add --json."""
    parser.add_argument("--json", action="store_true", help=text)


def add_joint(parser: Any) -> None:
    """Add --joint."""
    parser.add_argument(
        "--joint",
        action="append",
        type=argument.joint,
        default=[],
        metavar="NAME=ARRAY,ARRAY,…",
        help="join arrays of one node into one array called NAME, in addition to those that the site file joins",
    )


def add_wav(parser: Any, text: str, *, hint: str = "", required: bool = False) -> None:
    """Add --wav and --channels; the help of --wav ends with the hint."""
    parser.add_argument(
        "--wav",
        action="append",
        type=argument.assignment,
        default=[],
        metavar="ARRAY=FILE[,FILE…]",
        help=f"{text}. If each microphone has a file of its own, name the files in the order of the microphones: "
        f"ARRAY=a.wav,b.wav{hint and f'. {hint}'}",
        required=required,
    )
    parser.add_argument(
        "--channels",
        action="append",
        type=argument.channels,
        default=[],
        metavar="ARRAY=1,2,3,4",
        help="channels of ARRAY's files, in the order of its microphones in the site file, counted from 1",
    )


def make_folder(path: Path, option: str) -> None:
    """Make the folder that a command writes to, if there is none.

    Raises
    ------
    UseError
        If it cannot be made.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        what = "expected a folder, got a file" if isinstance(error, FileExistsError) else error.strerror or str(error)
        raise UseError(f"{option} {path}: cannot be made: {what}; name another folder") from error


def read_site(arguments: argparse.Namespace) -> Site:
    """Read the site file that --site names, with the arrays that --joint joins."""
    from livessl.site.load import load_site

    return load_site(arguments.site, joints(arguments))


def joints(arguments: argparse.Namespace) -> dict[str, list[str]]:
    """Return the names of the arrays that --joint joins, by the name of the joint array."""
    return each_once(arguments.joint, "--joint")


def wavs(arguments: argparse.Namespace) -> tuple[dict[str, tuple[Path, ...]], dict[str, list[int]]]:
    """Return the files of --wav and the channels of --channels, by array."""
    each = "; give one file for each microphone as ARRAY=FILE,FILE,…"
    return each_once(arguments.wav, "--wav", each), each_once(arguments.channels, "--channels")


def each_once(pairs: Sequence[tuple[str, T]], option: str, hint: str = "") -> dict[str, T]:
    """Return the value that an option gives for each array; raise `ConfigError` if an array is named twice."""
    names = [name for name, _ in pairs]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise ConfigError([Fault(option, f"expected each array once, got {twice!r} twice; remove one{hint}")])
    return dict(pairs)
