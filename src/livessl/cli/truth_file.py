"""Reads `truth.jsonl`, the true places and times of the sounds of a simulated session (--truth)."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from livessl.errors import UseError

if TYPE_CHECKING:
    from livessl.calibration import KnownSound


def add_truth(parser: Any) -> None:
    """Add --truth, which `truth_given` reads."""
    parser.add_argument(
        "--truth",
        type=Path,
        metavar="FILE",
        help="file truth.jsonl that `livessl simulate` wrote into the folder of the session: it has the places and "
        "times of the sounds, so that --at is not needed",
    )


def truth_given(arguments: argparse.Namespace) -> list[KnownSound]:
    """Return the sounds of the file that --truth names.

    Raises
    ------
    UseError
        If `read_truth` raises it, if there are too many sounds, or if --at gives places as well.
    """
    from livessl.calibration import MOST_CLAPS

    if arguments.at:
        raise UseError("calibrate: expected the places by --at or by --truth, got both; remove one of them")
    known = read_truth(arguments.truth)
    if len(known) > MOST_CLAPS:
        raise UseError(f"--truth: expected {MOST_CLAPS} sounds at most, got {len(known)}; simulate fewer with --count")
    return known


def read_truth(path: Path) -> list[KnownSound]:
    """Return the sounds that `livessl simulate` has placed.

    Raises
    ------
    UseError
        If the file cannot be read, or is no such file.
    """
    import numpy as np

    from livessl.calibration import KnownSound

    try:
        entries = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
        places_m = np.array([entry["position_m"] for entry in entries], dtype=np.float64).reshape(-1, 3)
        starts_s = [float(entry["start_s"]) for entry in entries]
        if len(places_m) != len(starts_s) or not starts_s or not np.isfinite([*starts_s, *places_m.ravel()]).all():
            raise ValueError
    except OSError as error:
        raise UseError(f"--truth: cannot read {path}: {error.strerror or error}; name another file") from error
    except (ValueError, KeyError, TypeError, RecursionError, OverflowError) as error:
        raise UseError(
            f"--truth: expected the truth.jsonl that `livessl simulate` writes, got another file: {path}"
        ) from error
    return [KnownSound(start_s, place_m) for start_s, place_m in zip(starts_s, places_m, strict=True)]
