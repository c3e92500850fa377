"""Claims of the paper, each judged by one number and its bootstrap interval.

A claim becomes a statement about one number and the region in which it must lie. An interval inside the region is
*reproduced*, one apart from it *not reproduced*, and one across its edge *undecided*. "At every RT" is judged by the
worst reverberation time, whose resamples lean to the worse side: such a claim is harder to reproduce than others.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import numpy as np

from livessl.core.types import FloatArray
from livessl.lab.evaluate.statistics import Interval, Results

LEAST_POSITIONS: Final = 30
"""Fewest positions for a verdict; with fewer, a bootstrap interval means little."""

NOT_RUN: Final = "not run"
"""Note of a claim whose experiment was not run."""


class Verdict(StrEnum):
    """The outcome for a claim."""

    REPRODUCED = "reproduced"
    NOT_REPRODUCED = "not reproduced"
    UNDECIDED = "undecided"


@dataclass(frozen=True, slots=True)
class Claim:
    """One statement of the paper.

    Parameters
    ----------
    name : str
        A short and stable name.
    paper : str
        The paper's statement.
    measure : str
        The number that decides, in words.
    region : (float, float)
        Range in which the number lies if the claim holds.
    ours : Interval or None
        The number found and its interval; None if the experiment was not run.
    verdict : Verdict
    note : str
        An explanation of the number or of the verdict.
    """

    name: str
    paper: str
    measure: str
    region: tuple[float, float]
    ours: Interval | None
    verdict: Verdict
    note: str = ""


def judged(interval: Interval, region: tuple[float, float]) -> Verdict:
    """Return the verdict for an interval and a region, ends included."""
    low, high = region
    if low <= interval.low and interval.high <= high:
        return Verdict.REPRODUCED
    if interval.high < low or interval.low > high:
        return Verdict.NOT_REPRODUCED
    return Verdict.UNDECIDED


def decided(
    results: Results | None,
    name: str,
    paper: str,
    measure: str,
    region: tuple[float, float],
    number: Callable[[Results], FloatArray],
    note: str = "",
) -> Claim:
    """Judge a claim by a number, (1 + B,) with its resamples, as far as the campaign has what the number needs."""
    if results is None:
        return Claim(name, paper, measure, region, None, Verdict.UNDECIDED, NOT_RUN)
    try:
        ours = Interval.of(number(results))
    except (KeyError, _NothingLeftError):
        return Claim(
            name, paper, measure, region, None, Verdict.UNDECIDED, "run without the systems or methods that this needs"
        )
    if results.positions < LEAST_POSITIONS:
        few = f"{results.positions} positions are too few"
        return Claim(name, paper, measure, region, ours, Verdict.UNDECIDED, few)
    return Claim(name, paper, measure, region, ours, judged(ours, region), note)


class _NothingLeftError(Exception):
    """The campaign has none of the claim's reverberation times."""


def over(
    results: Results,
    wanted: Callable[[float], bool],
    number: Callable[[float], FloatArray],
    join: Callable[..., FloatArray],
) -> FloatArray:
    """Join the numbers of all reverberation times wanted, for example to the largest, the least or the mean."""
    chosen = [number(rt60_s) for rt60_s in results.rt60s_s if wanted(rt60_s)]
    if not chosen:
        raise _NothingLeftError
    return np.asarray(join(np.stack(chosen), axis=0))
