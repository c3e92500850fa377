"""Judges alternative set-ups by how well they explain sounds with the small freedom that every set-up has."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from livessl.core.commission.alternative import Alternative
from livessl.core.commission.places import Delays, Microphones, PlaceSearch
from livessl.core.commission.poses import moved
from livessl.core.commission.tolerance import SPEED_STD_M_S, Explained, Freedom, careful, explained
from livessl.core.types import FloatArray

FREE_M: Final = 1.0
FREE_DEG: Final = 20.0
FREE_MICROPHONE_M: Final = 0.1
FREE_SPEED_M_S: Final = 20.0
"""Standard deviations of what an alternative leaves free, from what was found for it: metres, degrees, metres, m/s."""

COSTS: Final = {
    "exchanged": 1.0,
    "late_channel": 2.0,
    "geometry": 8.0,
    "turned": 6.0,
    "moved": 8.0,
    "height": 2.0,
    "temperature": 2.0,
}
"""Deviance that an alternative must gain to be as good as the set-up as filed: two for each unknown (Akaike), one for
each channel in another order. A shift costs two more, because people measure distances better than angles, and a
microphone does, because there are many."""


@dataclass(frozen=True, slots=True)
class _Applied:
    """An alternative as a set-up, and delays of its channels."""

    microphones: dict[str, FloatArray]
    delays: dict[str, FloatArray]
    c_m_s: float


class Judge:
    """Compares alternatives with the set-up as filed.

    Parameters
    ----------
    microphones : mapping of array to (K, 3) float64
        As filed, metres.
    delays : mapping of array to (S, K) float64
        Seconds.
    search : PlaceSearch
    """

    def __init__(self, microphones: Microphones, delays: Delays, search: PlaceSearch) -> None:
        self._microphones, self._delays, self._search = microphones, delays, search
        self._filed = self._explained(self._applied(None), None)

    @property
    def arrays(self) -> int:
        """Number of arrays."""
        return len(self._microphones)

    @property
    def filed(self) -> float:
        """Deviance of the set-up as filed."""
        return self._filed.deviance

    def may_gain(self, least: float) -> bool:
        """Return whether a set-up that is nearly as filed may explain the sounds better by so much.

        The poses, and then the microphones, of one array after the other are left free together.
        """
        for name, at_m in self._microphones.items():
            careful_one = careful(self._microphones)[name]
            for freed in (
                replace(careful_one, position_m=FREE_M, orientation_deg=FREE_DEG),
                replace(careful_one, microphones_m=np.full(len(at_m), FREE_MICROPHONE_M)),
            ):
                found = explained(
                    self._microphones,
                    self._delays,
                    self._filed.places_m,
                    self._search.bounds_m,
                    self._search.c_m_s,
                    careful(self._microphones) | {name: freed},
                    FREE_SPEED_M_S,
                )
                if self.filed - found.deviance >= least:
                    return True
        return False

    def judged(self, alternative: Alternative) -> Alternative:
        """Return an alternative with its criterion, and with its size as the sounds say best."""
        found = self._explained(self._applied(alternative), alternative)
        others = sum(channel != index for index, channel in enumerate(alternative.order, start=1))
        return replace(_adjusted(alternative, found), criterion=found.deviance + COSTS.get(alternative.fault, others))

    def _explained(self, applied: _Applied, alternative: Alternative | None) -> Explained:
        freedom, speed_std_m_s = careful(applied.microphones), SPEED_STD_M_S
        if alternative is not None:
            name = alternative.array
            if name is not None:
                freedom[name] = _freed(freedom[name], alternative)
            if alternative.fault == "temperature":
                speed_std_m_s = FREE_SPEED_M_S
        starts_m = self._search.fit(applied.microphones, applied.delays, applied.c_m_s).positions_m
        return explained(
            applied.microphones,
            applied.delays,
            starts_m,
            self._search.bounds_m,
            applied.c_m_s,
            freedom,
            speed_std_m_s,
        )

    def _applied(self, alternative: Alternative | None) -> _Applied:
        microphones, delays, c_m_s = dict(self._microphones), dict(self._delays), self._search.c_m_s
        if alternative is None:
            return _Applied(microphones, delays, c_m_s)
        name, other = alternative.array, alternative.other
        if alternative.order:
            order = np.array(alternative.order) - 1
            for array in delays if name is None else (name,):
                delays[array] = delays[array][:, order]
        elif name is None:
            c_m_s = alternative.speed_m_s or c_m_s
            microphones = {array: at_m + alternative.shift_m for array, at_m in microphones.items()}
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
        return _Applied(microphones, delays, c_m_s)


def _freed(own: Freedom, alternative: Alternative) -> Freedom:
    """Return the freedom of an array with that which an alternative adds."""
    if alternative.fault == "turned":
        return replace(own, orientation_deg=FREE_DEG)
    if alternative.fault == "moved":
        return replace(own, position_m=FREE_M)
    if alternative.fault == "geometry" and alternative.channel is not None:
        microphones_m = own.microphones_m.copy()
        microphones_m[alternative.channel - 1] = FREE_MICROPHONE_M
        return replace(own, microphones_m=microphones_m)
    return own


def _adjusted(alternative: Alternative, found: Explained) -> Alternative:
    """Return an alternative with the change that was found for what it leaves free."""
    name = alternative.array
    if alternative.fault == "turned" and name is not None:
        first, then = (Rotation.from_rotvec(np.radians(one)) for one in (alternative.turn_deg, found.turns_deg[name]))
        return replace(alternative, turn_deg=_three(np.degrees((then * first).as_rotvec())))
    if alternative.fault == "moved" and name is not None:
        return replace(alternative, shift_m=_three(np.array(alternative.shift_m) + found.shifts_m[name]))
    if alternative.fault == "geometry" and name is not None and alternative.channel is not None:
        displaced_m = found.displaced_m[name][alternative.channel - 1]
        return replace(alternative, shift_m=_three(np.array(alternative.shift_m) + displaced_m))
    if alternative.fault == "temperature" and alternative.speed_m_s is not None:
        off_m_s = found.speed_off_m_s
        return replace(
            alternative,
            speed_m_s=alternative.speed_m_s + off_m_s,
            speed_off_m_s=alternative.speed_off_m_s + off_m_s,
        )
    return alternative


def _three(values: FloatArray) -> tuple[float, ...]:
    return tuple(float(value) for value in values)
