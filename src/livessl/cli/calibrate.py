"""`livessl calibrate`: clap at places that you know; it says how right the site is, and measures the arrays' poses."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from livessl.cli import argument, progress
from livessl.cli.doctor import add_recordings, finding_line, recordings_given
from livessl.cli.exits import FAILED, OK
from livessl.cli.options import add_json
from livessl.cli.output import complain, print_warnings, xyz
from livessl.clock import SystemClock, utc_text
from livessl.errors import UseError

if TYPE_CHECKING:
    from livessl.calibration import Clap
    from livessl.core.commission.resection import MeasuredPose
    from livessl.site.models import Site

LARGE_ERROR_M: Final = 0.3
"""Error at a known place, in metres, from which `verify` fails even if nothing explains it."""


def add_arguments(parser: Any) -> None:
    """Describe the command's arguments."""
    actions = parser.add_subparsers(title="actions", metavar="ACTION", required=True)

    def action(name: str, act: Callable[[argparse.Namespace], int], text: str, example: str) -> Any:
        sub = actions.add_parser(
            name,
            help=text,
            description=text[0].upper() + text[1:] + ".",
            epilog=f"example: livessl calibrate {example}",
        )
        sub.set_defaults(act=act)
        add_recordings(sub)
        sub.add_argument(
            "--at",
            action="append",
            type=argument.place,
            required=True,
            metavar="X,Y,Z",
            help="place of a clap in metres; repeat for each, in the order in which they were made",
        )
        return sub

    sub = action(
        "verify",
        _verify,
        "print the error at places that you know, and what explains it",
        "verify --session session/ --at 2,3,1.2 --at 6,8,1.2",
    )
    add_json(sub, "print one JSON object for each clap and each finding")
    sub = action(
        "poses",
        _poses,
        "measure where the arrays are, by claps at places that you know",
        "poses --session session/ --at 2,3,1.2 --at 6,8,1.2 … --write calibration/lab.yaml",
    )
    sub.add_argument(
        "--place-std",
        type=argument.above_zero,
        default=0.03,
        metavar="M",
        help="how exactly you know the places, standard deviation in metres (default 0.03)",
    )
    sub.add_argument(
        "--write",
        type=Path,
        metavar="FILE",
        help="calibration file to write; name it in the site file as calibration: FILE",
    )
    sub.add_argument("--undo", action="store_true", help="put back the file that --write has replaced")
    add_json(sub, "print one JSON object for each array")


def run(arguments: argparse.Namespace) -> int:
    """Run the command."""
    from livessl.calibration import MOST_CLAPS

    if len(arguments.at) > MOST_CLAPS:
        raise UseError(f"--at: expected {MOST_CLAPS} places at most, got {len(arguments.at)}")
    return int(arguments.act(arguments))


def _claps(arguments: argparse.Namespace) -> tuple[Site, list[Clap]]:
    import numpy as np

    from livessl.calibration import claps_of

    site, parts, span = recordings_given(arguments, "calibrate")
    print_warnings(site)
    with progress.timed("locating", *span) as bar:
        return site, claps_of(site, parts, np.array(arguments.at), bar)


def _verify(arguments: argparse.Namespace) -> int:
    from livessl.calibration import verified
    from livessl.core.commission.finding import Severity

    site, claps = _claps(arguments)
    for clap in claps:
        print(json.dumps(_clap_object(clap)) if arguments.json else _clap_line(clap), flush=True)
    findings = verified(site, claps)
    for finding in findings:
        print(json.dumps({"kind": "finding"} | asdict(finding)) if arguments.json else finding_line(finding))
    errors_m = [math.inf if clap.error_m is None else clap.error_m for clap in claps]
    is_wrong = any(finding.severity is Severity.ERROR for finding in findings)
    if not is_wrong and max(errors_m) > LARGE_ERROR_M:
        complain("nothing explains the errors; check that the places were measured from the corner that is the origin")
        return FAILED
    return FAILED if is_wrong else OK


def _clap_object(clap: Clap) -> dict[str, Any]:
    estimate = clap.event.estimate
    return {
        "kind": "clap",
        "place_m": clap.place_m.tolist(),
        "start_s": clap.event.start_ns / 1e9,
        "position_m": None if estimate is None else estimate.position_m.tolist(),
        "error_m": clap.error_m,
        "status": str(clap.event.status),
        "reason": clap.event.reason,
    }


def _clap_line(clap: Clap) -> str:
    estimate = clap.event.estimate
    found = xyz(None if estimate is None else estimate.position_m.tolist())
    error = "not located" if clap.error_m is None else f"{clap.error_m:.2f} m off"
    return f"{xyz(clap.place_m.tolist())}  found {found:<22}  {error}"


def _poses(arguments: argparse.Namespace) -> int:
    if arguments.undo:
        return _undo(arguments.write)
    from livessl.calibration import measured_poses
    from livessl.core.commission.resection import MOST_STD_DEG, MOST_STD_M

    site, claps = _claps(arguments)
    poses = measured_poses(site, claps, arguments.place_std)
    for name, pose in poses.items():
        print(json.dumps(_pose_object(name, pose)) if arguments.json else _pose_line(name, pose), flush=True)
    doubtful = [name for name, pose in poses.items() if not pose.is_determined]
    for name in doubtful:
        complain(
            f"array {name!r}: expected claps that determine its pose to {MOST_STD_M:g} m and {MOST_STD_DEG:g} degrees; "
            "clap at more places, on all its sides, near and far, high and low"
        )
    if arguments.write is not None and not doubtful:
        _write(arguments.write, site, len(claps), poses)
    return FAILED if doubtful else OK


def _pose_object(name: str, pose: MeasuredPose) -> dict[str, Any]:
    return {
        "kind": "pose",
        "array": name,
        "microphones_m": pose.microphones_m.round(4).tolist(),
        "shift_m": pose.shift_m.round(4).tolist(),
        "turn_deg": [round(math.degrees(angle), 2) for angle in pose.turn.as_rotvec().tolist()],
        "position_std_m": round(pose.position_std_m, 4),
        "orientation_std_deg": round(pose.orientation_std_deg, 2),
        "misfit_us": [round(1e6 * pose.misfit_before_s, 1), round(1e6 * pose.misfit_s, 1)],
        "determined": pose.is_determined,
    }


def _pose_line(name: str, pose: MeasuredPose) -> str:
    shift = ", ".join(f"{x:+.3f}" for x in pose.shift_m)
    return (
        f"{name}: shifted by ({shift}) m, turned by {math.degrees(pose.turn.magnitude()):.1f} degrees "
        f"(known to {pose.position_std_m:.3f} m and {pose.orientation_std_deg:.1f} degrees), "
        f"misfit {1e6 * pose.misfit_before_s:.0f} -> {1e6 * pose.misfit_s:.0f} us"
    )


def _write(path: Path, site: Site, sounds: int, poses: Mapping[str, MeasuredPose]) -> None:
    """Write a calibration file, and keep the one that it replaces."""
    import yaml

    arrays = {
        name: {
            "microphones_m": pose.microphones_m.round(4).tolist(),
            "position_std_m": round(pose.position_std_m, 4),
            "orientation_std_deg": round(pose.orientation_std_deg, 2),
            "misfit_us": [round(1e6 * pose.misfit_before_s, 1), round(1e6 * pose.misfit_s, 1)],
        }
        for name, pose in poses.items()
    }
    measured = {"measured_utc": utc_text(SystemClock().now_ns()), "sounds": sounds, "arrays": arrays}
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists():
            path.replace(_kept(path))
        path.write_text(yaml.safe_dump(measured, sort_keys=False, default_flow_style=None), encoding="utf-8")
    except OSError as error:
        raise UseError(f"--write: cannot write {path}: {error.strerror}") from error
    named = site.calibration is not None and site.file(site.calibration).resolve() == path.resolve()
    hint = "" if named else "; name it in the site file as calibration: FILE, relative to the site file"
    complain(f"written to {path}{hint}", kind="note")


def _undo(path: Path | None) -> int:
    if path is None:
        raise UseError("--undo: expected --write FILE, the calibration file to put back")
    if not _kept(path).exists():
        raise UseError(f"--undo: expected {_kept(path)}, the file that --write has replaced; there is none")
    _kept(path).replace(path)
    complain(f"{path} is as it was before", kind="note")
    return OK


def _kept(path: Path) -> Path:
    return path.with_suffix(path.suffix + ".before")
