"""Judges a set-up by claps at known places: whether findings or large errors show that it is wrong."""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from typing import Final

from livessl.core.commission.finding import Finding, Severity

LARGE_ERROR_M: Final = 0.3
"""Error at a known place, in metres, from which a set-up counts as wrong even if no finding explains the error."""


class SetUpVerdict(StrEnum):
    """Verdict on a set-up by sounds at known places.

    `ok`: every sound was located near its place. `wrong`: a finding explains what is wrong. `unexplained`: a sound was
    located far from its place or not at all, and no finding explains it.
    """

    OK = "ok"
    WRONG = "wrong"
    UNEXPLAINED = "unexplained"


def set_up_verdict(findings: Sequence[Finding], errors_m: Sequence[float | None]) -> SetUpVerdict:
    """Judge a set-up by the findings and by the error at each known place; None is a sound without a position."""
    if any(finding.severity is Severity.ERROR for finding in findings):
        return SetUpVerdict.WRONG
    far = any(error_m is None or error_m > LARGE_ERROR_M for error_m in errors_m)
    return SetUpVerdict.UNEXPLAINED if far else SetUpVerdict.OK
