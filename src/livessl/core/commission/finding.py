"""A finding of doctor as a value, the order of findings, and how many sounds (claps) doctor needs (`LEAST_SOUNDS`).

The findings themselves are made and worded in `findings`.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

LEAST_SOUNDS: Final = 3
"""Fewest sounds from which delays are judged: `doctor` and the set-up view ask for more claps below it."""

OF_SET_UP: Final = frozenset(
    {"swapped", "mirrored", "exchanged", "turned", "moved", "late_channel", "geometry", "temperature"}
)
"""Codes of the faults that only the delays of all sounds together reveal."""


class Severity(StrEnum):
    """Weight of a finding: with an error, positions are wrong or refused; with a warning, they are worse."""

    ERROR = "error"
    WARNING = "warning"
    INFO = "info"


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that is wrong with a set-up.

    Parameters
    ----------
    fault : str
        Code of the fault, such as `swapped`.
    array : str or None
        The array; None for the whole site.
    channel : int or None
        Channel of the array, from 1; None for all.
    severity : Severity
    confidence : float
        0 to 1.
    message : str
        The fault, in one sentence without a full stop.
    cure : str
        The action that corrects the fault.
    input : int or None
        Input of the device that carries the channel, from 1; None if the site file does not name it.
    """

    fault: str
    array: str | None
    channel: int | None
    severity: Severity
    confidence: float
    message: str
    cure: str
    input: int | None = None


def are_poses_in_doubt(findings: Iterable[Finding]) -> bool:
    """Return whether a finding is about the poses, or about clocks that let arrays receive different sounds."""
    return any(one.fault in OF_SET_UP or one.fault == "clock" for one in findings)


def in_order(findings: Iterable[Finding]) -> list[Finding]:
    """Return findings in the order in which they are reported: errors first, then by array and channel."""
    weights = list(Severity)
    return sorted(findings, key=lambda one: (weights.index(one.severity), one.array or "", one.channel or 0))
