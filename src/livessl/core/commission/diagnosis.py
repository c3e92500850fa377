"""Chooses the alternative that explains contradictory delays best: swapped channels, a turned or moved array.

If the filed set-up is wrong, the arrays' delays of a sound fit no place. These alternatives are compared: every order
of an array's channels, rotations and shifts of an array, and another speed of sound. The alternative that explains the
sounds best is chosen if it explains them far better than the filed set-up, and better than every alternative of another
array. Sounds at unknown places are judged with the freedom of a careful set-up (`livessl.core.commission.judge`), those
at measured places by their misfits (`livessl.core.commission.trial`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from livessl.core.commission.alternative import Alternative
from livessl.core.commission.finding import LEAST_SOUNDS
from livessl.core.commission.judge import Judge, least_gain
from livessl.core.commission.places import Delays, KnownPlaces, Microphones, PlaceSearch, contradictions_s
from livessl.core.commission.set_up import Known, careful
from livessl.core.commission.trial import FLOOR_S as KNOWN_FLOOR_S
from livessl.core.commission.trial import Trial
from livessl.core.types import FloatArray, IntArray

MIN_LEAD: Final = 6.0
MIN_LEAD_OF_GAIN: Final = 0.06
"""Least lead of the best alternative over the best one about another array or channel, in deviance, and as a share of
what the best one gains. If both explain much, the errors of the delays may be what distinguishes them."""

EQUAL: Final = 0.5
"""Share of the required lead (`MIN_LEAD`, or `MIN_LEAD_OF_GAIN` of a large gain) within which alternatives count as
explaining the sounds equally well."""

KNOWN_MIN_GAIN: Final = 12.0
KNOWN_MIN_LEAD: Final = 6.0
"""Least gain over the set-up as filed, and least lead over the other alternatives, for sounds at measured
places; both in the Bayesian information criterion."""

FLOOR_S: Final = 12e-6
"""Misfit, in seconds, that remains in a carefully measured set-up, with microphones to 2 mm and arrays to 2 cm and 1.5
degrees."""

MOST_SOUNDS: Final = 24
"""Largest number of sounds that are used. More sounds add little, because the errors of the set-up do not average
out."""

MOST_ARRAYS: Final = 8
"""Largest number of arrays that are judged together. The time of each fit grows with the cube of this number, the
memory with the square, and the number of alternatives grows as well."""

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
        The chosen alternative; None if the set-up as filed is as good, or no alternative stands out.
    rivals : tuple of Alternative
        All alternatives that were refined, best first.
    contradicts : bool
        Whether the sounds contradict the set-up as filed, with or without an explanation.
    lead : float
        Lead of the best alternative over the set-up as filed and over alternatives of other arrays, in the criterion.
    gained : float
        Lead of the first rival over the set-up as filed.
    undecided : tuple of Alternative
        Two or more alternatives with the same fault of different arrays that explain the sounds equally well, best
        first. One of them is true.
    """

    sounds: int
    misfit_s: float
    best: Alternative | None
    rivals: tuple[Alternative, ...]
    contradicts: bool
    lead: float = 0.0
    gained: float = 0.0
    undecided: tuple[Alternative, ...] = ()

    @property
    def confidence(self) -> float:
        """Probability of the best alternative against the next best one."""
        return float(1.0 / (1.0 + np.exp(-self.lead / 2.0)))


def diagnose(
    microphones: Microphones, delays: Delays, bounds_m: FloatArray, c_m_s: float, known: Known | None = None
) -> Diagnosis:
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
    known : Known or None
        How exactly the set-up and the delays are known; None for a careful set-up in a room.
    """
    known = known or Known(careful(microphones))
    search, arrays = PlaceSearch(bounds_m, c_m_s), len(microphones)
    if arrays > MOST_ARRAYS:
        names = most_doubtful(microphones, of_sounds(delays, most_telling(delays)), search)
        microphones, delays = ({name: of[name] for name in names} for of in (microphones, delays))
    rows = most_telling(delays)
    judge = Judge(microphones, of_sounds(delays, rows), search, known.of_sounds(rows))
    if judge.sounds < LEAST_SOUNDS or judge.arrays < 2:
        return Diagnosis(judge.sounds, judge.misfit_s, None, (), contradicts=False)
    return _by_judge(judge, arrays)


def verify(microphones: Microphones, delays: Delays, places_m: FloatArray, c_m_s: float) -> Diagnosis:
    """Compare the set-up as filed with its alternatives, by sounds at measured places.

    One array is enough. One sound shows whether something is wrong, and three or four sounds show what is wrong.

    Parameters
    ----------
    microphones, delays, c_m_s
        As in `diagnose`.
    places_m : (S, 3) float64
        Where the sounds were made, metres.
    """
    return _by_criterion(Trial(microphones, delays, KnownPlaces(places_m, c_m_s)))


def most_telling(delays: Delays) -> IntArray:
    """Return the indices of at most `MOST_SOUNDS` sounds: those that most channels received, over the whole time."""
    received = np.sum([np.isfinite(one).sum(axis=1) for one in delays.values()], axis=0)
    if len(received) <= MOST_SOUNDS:
        return np.arange(len(received))
    able = np.flatnonzero(received >= np.sort(received)[-MOST_SOUNDS])
    return np.asarray(able[np.linspace(0, len(able) - 1, MOST_SOUNDS).round().astype(int)])


def of_sounds(delays: Delays, rows: IntArray) -> dict[str, FloatArray]:
    """Return the delays of some of the sounds."""
    return {name: one[rows] for name, one in delays.items()}


def most_doubtful(microphones: Microphones, delays: Delays, search: PlaceSearch) -> list[str]:
    """Return the names of the `MOST_ARRAYS` arrays that are judged together, in the order of the site.

    Half of them disagree most with the places that all arrays together give. The others received the sounds of these
    arrays best, because a fault of an array is visible only in comparison with other arrays.
    """
    places_m = search.fit(microphones, delays).positions_m
    off_s = {}
    for name, one in delays.items():
        squares = contradictions_s(microphones, {name: one}, places_m, search.c_m_s) ** 2
        counts = np.maximum(np.isfinite(one).sum(axis=1) - 1, 0)
        each = squares.sum(axis=1)[counts > 0] / counts[counts > 0]
        # a median, because one echo is no fault of an array
        off_s[name] = float(np.sqrt(np.median(each))) if len(each) >= LEAST_SOUNDS else 0.0
    worst = sorted(delays, key=lambda name: off_s[name], reverse=True)[: MOST_ARRAYS // 2]
    heard = np.any([np.isfinite(delays[name]).sum(axis=1) > 1 for name in worst], axis=0)
    others = [name for name in delays if name not in worst]
    others.sort(key=lambda name: int(np.isfinite(delays[name][heard]).sum()), reverse=True)
    used = {*worst, *others[: MOST_ARRAYS - len(worst)]}
    return [name for name in delays if name in used]


def _by_criterion(trial: Trial) -> Diagnosis:
    """Compare alternatives by their misfits alone, which is enough for sounds at known places."""
    filed_s = trial.filed.misfit_s
    if filed_s <= MIN_RATIO * KNOWN_FLOOR_S:
        return Diagnosis(trial.sounds, filed_s, None, (), contradicts=False)
    tried = [
        *trial.orders(),
        *trial.exchanges(),
        *trial.channels(),
        *trial.poses(),
        *trial.heights(),
        *trial.speeds(),
    ]
    rivals = sorted(tried, key=lambda one: one.criterion)
    gained = trial.criterion(trial.filed, 0) - rivals[0].criterion
    contradicts = gained > KNOWN_MIN_GAIN and filed_s > MIN_RATIO * max(rivals[0].misfit_s, KNOWN_FLOOR_S)
    return _decided(trial.sounds, filed_s, rivals, gained, contradicts, KNOWN_MIN_LEAD, KNOWN_MIN_LEAD)


def _by_judge(judge: Judge, arrays: int) -> Diagnosis:
    """Compare alternatives with the freedom of a careful set-up; `arrays` is the number of all arrays."""
    least = least_gain(arrays)
    misfit_s = judge.misfit_s
    if misfit_s <= MIN_RATIO * FLOOR_S and not judge.may_gain(least):
        return Diagnosis(judge.sounds, misfit_s, None, (), contradicts=False)
    rivals = judge.judged()
    gained = judge.filed - rivals[0].criterion
    contradicts = gained > least and rivals[0].is_large  # smaller errors are those of a careful set-up
    rivals[0] = judge.with_misfit(rivals[0])
    least_lead = max(MIN_LEAD, MIN_LEAD_OF_GAIN * gained)
    apart = max(EQUAL * MIN_LEAD, MIN_LEAD_OF_GAIN * gained)
    return _decided(judge.sounds, misfit_s, rivals, gained, contradicts, least_lead, apart)


def _decided(
    sounds: int,
    misfit_s: float,
    rivals: Sequence[Alternative],
    gained: float,
    contradicts: bool,
    least_lead: float,
    apart: float,
) -> Diagnosis:
    """Choose the best alternative if its lead is large enough, or those that explain the sounds equally well."""
    best = rivals[0]
    others = [one for one in rivals if one.concerns != best.concerns]
    lead = others[0].criterion - best.criterion if others else gained
    named = contradicts and lead > least_lead and best.is_large
    undecided = _undecided(rivals, apart) if contradicts and not named else ()
    return Diagnosis(
        sounds,
        misfit_s,
        best if named else None,
        tuple(rivals),
        contradicts,
        min(gained, lead),
        gained,
        undecided,
    )


def _undecided(rivals: Sequence[Alternative], apart: float) -> tuple[Alternative, ...]:
    """Return the best alternatives if they are the same fault of different arrays, such as a shift of one of two."""
    best = rivals[0]
    close = [one for one in rivals if one.criterion - best.criterion <= apart and one.array != best.array]
    if not close or any(one.fault != best.fault or not one.is_large for one in (best, *close)):
        return ()
    firsts = {one.array: one for one in reversed((best, *close))}
    return tuple(sorted(firsts.values(), key=lambda one: one.criterion))
