"""Reads the sounds of a simulated session from its `truth.jsonl`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

from livessl.errors import UseError

if TYPE_CHECKING:
    from livessl.calibration import KnownSound


def read_truth(path: Path) -> list[KnownSound]:
    """Return the sounds that `livessl simulate` has placed.

    Raises
    ------
    UseError
        If the file cannot be read, or holds something else.
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
