"""`livessl plan`: the error to expect before anything is built, and advice on where arrays should go."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from livessl.cli import argument, progress
from livessl.cli.exits import OK, WRONG_USE
from livessl.cli.options import add_json, add_site, make_folder
from livessl.cli.output import complain
from livessl.cli.own_work import NO_PICTURE, is_own_json, is_own_picture, refuse_foreign
from livessl.lab.plan.defaults import CALIBRATION_M


def add_arguments(parser: Any) -> None:
    """Describe the command's arguments."""
    add_site(parser)
    parser.add_argument(
        "--rt60",
        type=argument.not_negative,
        default=0.7,
        metavar="S",
        help="reverberation time, seconds; 0 is anechoic (default: 0.7)",
    )
    parser.add_argument(
        "--height",
        type=argument.not_negative,
        metavar="M",
        help="height of the sounds, metres (default: 1.5, or the middle of a search volume that ends below 1.5 m)",
    )
    parser.add_argument(
        "--calibration",
        type=argument.above_zero,
        default=CALIBRATION_M,
        metavar="M",
        help="assumed error of the position of each microphone within its array (standard deviation, metres); a larger "
        f"one makes the predicted error larger (default: {CALIBRATION_M:g})",
    )
    add_json(parser, "print one JSON object")
    parser.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="also write plan.json and plan.png to DIR; those of an earlier plan are replaced",
    )


def run(arguments: argparse.Namespace) -> int:
    """Run the command."""
    from livessl.lab.plan import design, figure, words
    from livessl.site.load import load_site

    site = load_site(arguments.site)
    if arguments.out is not None:
        figure.require_matplotlib()
        _refuse_foreign(arguments.out, arguments.site)
    try:
        with progress.counted("trying positions", "array") as bar:
            plan = design.make_plan(site, arguments.rt60, arguments.height, arguments.calibration, bar)
    except ValueError as error:
        complain(str(error))
        return WRONG_USE
    result = words.as_json(plan)
    if arguments.out is not None:
        make_folder(arguments.out, "--out")
        (arguments.out / "plan.json").write_text(json.dumps(result, allow_nan=False) + "\n", encoding="utf-8")
        figure.draw(plan, arguments.out / "plan.png")
    print(json.dumps(result, allow_nan=False) if arguments.json else words.as_text(plan))
    return OK


def _refuse_foreign(out: Path, site: Path) -> None:
    """Raise an error if the folder holds a plan or a picture of that name that another program has made."""
    keys = frozenset({"site", "rt60_s", "predicted_error", "advice"})
    option = f"--out {out}"
    refuse_foreign(option, [out / "plan.json"], lambda path: is_own_json(path, keys), site, "which is no complete plan")
    refuse_foreign(option, [out / "plan.png"], is_own_picture, site, NO_PICTURE)
