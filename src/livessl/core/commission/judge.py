"""Compares alternative set-ups, such as swapped channels, by how well they explain delays of sounds at unknown places.

For sounds at known places this is done in `trial`; `diagnosis` chooses one of them.

Every set-up has the same small freedom, and all of them are fitted together. There are many orders of channels and
large rotations: `hypotheses` ranks them at the points of a grid, and only the best of them are fitted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from livessl.core.commission.alternative import Alternative
from livessl.core.commission.hypotheses import Hypotheses, Hypothesis
from livessl.core.commission.places import Delays, Microphones, PlaceSearch
from livessl.core.commission.poses import moved
from livessl.core.commission.set_up import Known, SetUp, Stacked, careful
from livessl.core.commission.tolerance import Explained, explained, unknowns_of
from livessl.core.types import FloatArray

COSTS: Final = {
    "exchanged": 1.0,
    "late_channel": 2.0,
    "geometry": 8.0,
    "turned": 8.0,
    "moved": 8.0,
    "height": 2.0,
    "temperature": 2.0,
}
"""Deviance that an alternative must gain to be as good as the set-up as filed: two for each unknown (Akaike), one for
each channel in another order. A shift, and a rotation about any axis, cost two more than their three unknowns, because
the rotation about the vertical alone (`UPRIGHT_COST`) is the most common error. A displaced microphone costs two more,
because there are many microphones."""

MOST_SLOPES: Final = 500_000
"""Largest number of slopes (set-ups by sounds by channels by unknowns) of one array computed at one time: 4 MB."""

MOST_NORMAL: Final = 8_000_000
"""Largest number of values in the normal equations of the set-ups that are fitted at one time: 64 MB. A set-up has the
unknowns of all its arrays, so the equations of a set-up with 30 arrays have 300 000 values."""


MIN_GAIN: Final = 7.0
"""Least gain in deviance, for sounds at unknown places and one array, at which a set-up is reported as different from
the filed one; `least_gain` is higher for more arrays. Few careful set-ups gain more by chance
(`benchmarks/doctor_chance.py`)."""


def least_gain(arrays: int) -> float:
    """Return the least gain in deviance at which a set-up is reported as different from the filed one.

    More arrays have more alternatives, and the best of them gains more by chance: twice the logarithm of the number of
    arrays (Bonferroni).
    """
    return MIN_GAIN + 2.0 * float(np.log(arrays))


class Judge:
    """Compares the alternatives with the set-up as filed, by sounds at unknown places.

    Parameters
    ----------
    microphones : mapping of array to (K, 3) float64
        As filed, metres.
    delays : mapping of array to (S, K) float64
        Seconds.
    search : PlaceSearch
    known : Known or None
        How exactly the set-up and the delays are known; None for a careful set-up in a room.
    """

    def __init__(
        self, microphones: Microphones, delays: Delays, search: PlaceSearch, known: Known | None = None
    ) -> None:
        self.arrays, self.sounds, self._search = len(microphones), len(next(iter(delays.values()))), search
        self._hypotheses = Hypotheses(microphones, delays, search, known or Known(careful(microphones)))
        self._as_filed = self._hypotheses.filed()
        [self._filed] = self._fitted([self._as_filed])

    @property
    def filed(self) -> float:
        """Deviance of the set-up as filed."""
        return self._filed.deviance

    @property
    def misfit_s(self) -> float:
        """Misfit of the sounds in the set-up exactly as filed, seconds."""
        return self._misfit_s(self._as_filed.set_up)

    def may_gain(self, least: float) -> bool:
        """Return whether any set-up near the filed one may gain `least` and its own cost, in deviance."""
        freer = self._hypotheses.freer(self._filed.places_m)
        found = zip(freer, self._fitted(freer), strict=True)
        return any(self.filed - fit.deviance >= least + (one.cost or 0.0) for one, fit in found)

    def judged(self) -> list[Alternative]:
        """Return the alternatives, the best first, each with its criterion and with the size that fits the sounds."""
        tried = [*self._hypotheses.near(self._filed.places_m), *self._hypotheses.far()]
        found = zip(tried, self._fitted(tried), strict=True)
        judged = (_adjusted(one.alternative, fit, one.cost) for one, fit in found if one.alternative is not None)
        return sorted(judged, key=lambda one: one.criterion)

    def with_misfit(self, alternative: Alternative) -> Alternative:
        """Return an alternative with the misfit of the sounds if this is the only change to the filed set-up."""
        return replace(alternative, misfit_s=self._misfit_s(_applied(self._as_filed.set_up, alternative)))

    def _misfit_s(self, set_up: SetUp) -> float:
        return self._search.fit(set_up.microphones, set_up.delays, set_up.c_m_s).misfit_s

    def _fitted(self, tried: Sequence[Hypothesis]) -> list[Explained]:
        """Fit hypotheses, in groups that need little memory."""
        most, bounds_m, found = fitted_together(tried[0].set_up), self._search.bounds_m, []
        for begin in range(0, len(tried), most):
            some = tried[begin : begin + most]
            set_ups = [one.set_up for one in some]
            starts_m = np.stack([one.starts_m for one in some])
            places_m = Stacked(set_ups, bounds_m).placed(starts_m, [one.but for one in some])
            found += explained(set_ups, places_m, bounds_m)
        return found


def fitted_together(set_up: SetUp) -> int:
    """Return the number of set-ups like this one that are fitted together, which needs little memory."""
    sounds = len(next(iter(set_up.delays.values())))
    unknowns = unknowns_of(set_up)
    slopes = max(one.size * (8 + 3 * one.shape[1]) for one in set_up.delays.values())
    normal = unknowns * (unknowns + 3 * sounds)
    return int(max(1, min(MOST_SLOPES // slopes, MOST_NORMAL // normal)))


def _applied(filed: SetUp, alternative: Alternative) -> SetUp:
    """Return the filed set-up with the change of an alternative."""
    microphones, delays, c_m_s = dict(filed.microphones), dict(filed.delays), filed.c_m_s
    name, other = alternative.array, alternative.other
    if alternative.order:
        order = np.array(alternative.order) - 1
        for array in delays if name is None else (name,):
            delays[array] = delays[array][:, order]
    elif name is None:
        c_m_s = alternative.speed_m_s or c_m_s
    elif other is not None:
        delays[name], delays[other] = delays[other], delays[name]
    elif alternative.channel is not None:
        index = alternative.channel - 1
        delays[name], microphones[name] = delays[name].copy(), microphones[name].copy()
        delays[name][:, index] -= alternative.late_s
        microphones[name][index] += alternative.shift_m
    else:
        turn = np.radians(alternative.turn_deg)
        microphones[name] = moved(microphones[name], np.array(alternative.shift_m), turn)
    return replace(filed, microphones=microphones, delays=delays, c_m_s=c_m_s)


def _adjusted(alternative: Alternative, found: Explained, cost: float | None) -> Alternative:
    """Return an alternative with its criterion, and with the fitted values of its free quantities."""
    others = sum(channel != index for index, channel in enumerate(alternative.order, start=1))
    judged = replace(
        alternative, criterion=found.deviance + (COSTS.get(alternative.fault, others) if cost is None else cost)
    )
    name = alternative.array
    if alternative.fault == "turned" and name is not None:
        first, then = (Rotation.from_rotvec(np.radians(one)) for one in (alternative.turn_deg, found.turns_deg[name]))
        return replace(judged, turn_deg=_three(np.degrees((then * first).as_rotvec())))
    if alternative.fault == "moved" and name is not None:
        return replace(judged, shift_m=_three(found.shifts_m[name]))
    if alternative.fault == "geometry" and name is not None and alternative.channel is not None:
        return replace(judged, shift_m=_three(found.displaced_m[name][alternative.channel - 1]))
    if alternative.fault == "late_channel":
        return replace(judged, late_s=found.late_s)
    if alternative.fault == "temperature" and alternative.speed_m_s is not None:
        off_m_s = found.speed_off_m_s
        return replace(judged, speed_m_s=alternative.speed_m_s + off_m_s, speed_off_m_s=off_m_s)
    return judged


def _three(values: FloatArray) -> tuple[float, ...]:
    return tuple(float(value) for value in values)
