"""Prints what commands share: an event as a line or as JSON, warnings of a site, errors and notes on stderr."""

from __future__ import annotations

import json
import logging
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from livessl.log_format import is_json_log

if TYPE_CHECKING:
    from livessl.site.models import Site


def complain(text: str, kind: str = "error") -> None:
    """Print one line to stderr; where the log is JSON, log it."""
    if is_json_log():
        logging.getLogger("livessl").log(logging.ERROR if kind == "error" else logging.WARNING, "%s", text)
    else:
        print(f"livessl: {kind}: {text}", file=sys.stderr)


def print_warnings(site: Site) -> None:
    """Print the warnings of a site: settings that are valid but unlikely to work."""
    for warning in site.warnings:
        complain(warning, kind="note")


def print_event(event: dict[str, Any], *, as_json: bool) -> None:
    """Print an event as a line of text, or as a JSON object."""
    if as_json:
        print(json.dumps(event), flush=True)
        return
    reason = f"  ({event['reason']})" if event["reason"] else ""
    print(
        f"{event['start_s']:9.2f} s  {event['duration_s']:5.2f} s  {xyz(event['position_m']):<22} "
        f"{_spread(event['covariance_m2']):<8}  confidence {event['confidence']:.2f}  {event['status']:<14} "
        f"{', '.join(event['arrays'])}{reason}",
        flush=True,
    )


def xyz(position_m: Sequence[float] | None) -> str:
    """Return a position as text; a dash where there is none."""
    return "-" if position_m is None else "(" + ", ".join(f"{x:5.2f}" for x in position_m) + ")"


def _spread(covariance_m2: Sequence[Sequence[float]] | None) -> str:
    """Return the largest standard deviation along an axis as text; nothing for an event without a position."""
    return "" if covariance_m2 is None else f"± {max(covariance_m2[axis][axis] for axis in range(3)) ** 0.5:.2f} m"
