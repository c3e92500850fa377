"""Finds what explains the contradictions between the delays of sounds: other orders of channels, other poses.

With the set-up as filed, the arrays' delays of a sound fit no place if something is wrong. Each alternative is tried:
every order of an array's channels, turns and shifts of an array, another speed of sound. The one that explains the
sounds best is named, provided that it explains them far better than the set-up as filed, and better than every
alternative of another array.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from livessl.core.commission.alternative import Alternative
from livessl.core.commission.finding import LEAST_SOUNDS
from livessl.core.commission.judge import COSTS, Judge
from livessl.core.commission.places import Delays, KnownPlaces, Microphones, PlaceSearch
from livessl.core.commission.trial import Trial
from livessl.core.types import FloatArray

MIN_GAIN: Final = 4.0
"""Least gain in the criterion of sounds at unknown places, for each array beyond the first, for which a set-up is said
to be other than filed."""

MIN_LEAD: Final = 3.0
"""Least lead in the same measure over the best alternative about another array or channel."""

KNOWN_MIN_GAIN: Final = 12.0
KNOWN_MIN_LEAD: Final = 6.0
"""The same for sounds at places that somebody measured, in the Bayesian information criterion."""

MIN_RATIO: Final = 1.3
"""Least ratio between the misfit as filed and that of the alternative."""


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """The diagnosis of a set-up from the delays of some sounds.

    Parameters
    ----------
    sounds : int
        Number of sounds.
    misfit_s : float
        Misfit with the set-up as filed, seconds.
    best : Alternative or None
        The alternative to believe; None if the set-up as filed is as good, or no alternative stands out.
    rivals : tuple of Alternative
        All that were refined, best first.
    contradicts : bool
        Whether the sounds contradict the set-up as filed, explained or not.
    lead : float
        Lead of the best alternative over the set-up as filed and over alternatives of other arrays, in the criterion.
    undecided : tuple of Alternative
        Two or more that are the same fault of different arrays and explain the sounds equally well, best first: one of
        them is true.
    """

    sounds: int
    misfit_s: float
    best: Alternative | None
    rivals: tuple[Alternative, ...]
    contradicts: bool
    lead: float = 0.0
    undecided: tuple[Alternative, ...] = ()

    @property
    def confidence(self) -> float:
        """Probability of the best alternative against the next best one."""
        return float(1.0 / (1.0 + np.exp(-self.lead / 2.0)))


def diagnose(microphones: Microphones, delays: Delays, bounds_m: FloatArray, c_m_s: float) -> Diagnosis:
    """Compare the set-up as filed with its alternatives, by sounds at unknown places.

    Parameters
    ----------
    microphones : mapping of array to (K, 3) float64
        As filed, metres.
    delays : mapping of array to (S, K) float64
        Delays of the same S sounds at each array, seconds; NaN where an array did not receive one.
    bounds_m : (3, 2) float64
        Search volume, metres.
    c_m_s : float
        Speed of sound as filed, m/s.
    """
    trial = Trial(microphones, delays, PlaceSearch(bounds_m, c_m_s))
    if trial.sounds < LEAST_SOUNDS or len(microphones) < 2:
        return Diagnosis(trial.sounds, trial.filed.misfit_s, None, (), contradicts=False)
    return _compared(trial, Judge(microphones, delays, PlaceSearch(bounds_m, c_m_s)))


def verify(microphones: Microphones, delays: Delays, places_m: FloatArray, c_m_s: float) -> Diagnosis:
    """Compare the set-up as filed with its alternatives, by sounds at places that somebody measured.

    One array is enough, and one sound shows whether something is wrong; three or four tell what.

    Parameters
    ----------
    microphones, delays, c_m_s
        As in `diagnose`.
    places_m : (S, 3) float64
        Where the sounds were made, metres.
    """
    return _compared(Trial(microphones, delays, KnownPlaces(places_m, c_m_s)))


def _compared(trial: Trial, judge: Judge | None = None) -> Diagnosis:
    """Compare alternatives by the judge, or by their misfits alone."""
    least, least_lead = KNOWN_MIN_GAIN, KNOWN_MIN_LEAD
    if judge is not None:
        least, least_lead = MIN_GAIN * (judge.arrays - 1), MIN_LEAD
    is_small = trial.filed.misfit_s <= MIN_RATIO * trial.floor_s
    if is_small and (judge is None or not judge.may_gain(least + COSTS["turned"])):
        return Diagnosis(trial.sounds, trial.filed.misfit_s, None, (), contradicts=False)
    tried = [
        *trial.orders(),
        *trial.exchanges(),
        *trial.channels(),
        *trial.poses(),
        *trial.heights(),
        *trial.speeds(),
    ]
    filed = trial.criterion(trial.filed, 0)
    if judge is not None:
        filed, tried = judge.filed, [judge.judged(one) for one in tried]
    rivals = sorted(tried, key=lambda one: one.criterion)
    best, gained = rivals[0], filed - rivals[0].criterion
    contradicts = gained > least
    if judge is not None:
        contradicts &= best.is_large  # smaller errors are those of a careful set-up
    else:
        contradicts &= trial.filed.misfit_s > MIN_RATIO * max(best.misfit_s, trial.floor_s)
    others = [one for one in rivals if one.concerns != best.concerns]
    lead = others[0].criterion - best.criterion if others else gained
    named = contradicts and lead > least_lead and best.is_large
    undecided = _undecided(rivals, least_lead) if contradicts and not named else ()
    return Diagnosis(
        trial.sounds,
        trial.filed.misfit_s,
        best if named else None,
        tuple(rivals),
        contradicts,
        min(gained, lead),
        undecided,
    )


def _undecided(rivals: Sequence[Alternative], least_lead: float) -> tuple[Alternative, ...]:
    """Return the best alternatives if they are the same fault of different arrays, such as a shift of one of two."""
    best = rivals[0]
    close = [one for one in rivals if one.criterion - best.criterion <= least_lead and one.array != best.array]
    if not close or any(one.fault != best.fault or not one.is_large for one in (best, *close)):
        return ()
    firsts = {one.array: one for one in reversed((best, *close))}
    return tuple(sorted(firsts.values(), key=lambda one: one.criterion))
