"""Tries alternative set-ups, such as swapped channels, against the delays of sounds at measured places (claps).

For sounds at unknown places this is done in `judge`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import combinations
from typing import Final

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from livessl.core.commission.alternative import LEAST_SHIFT_M, LEAST_TURN_DEG, Alternative
from livessl.core.commission.finding import LEAST_SOUNDS
from livessl.core.commission.hypotheses import MIN_FOR_ONE, channel_orders
from livessl.core.commission.places import Delays, KnownPlaces, Microphones, Places, degrees_of_freedom
from livessl.core.commission.poses import DELAY_STD_S, Adjusted, Freedom, adjust
from livessl.core.types import FloatArray, IntArray

REFINED: Final = 6
"""Alternatives, the best at first sight, whose places are refined."""

FLOOR_S: Final = 20e-6
"""Misfit, in seconds, that remains in a set-up that is filed as well as one can measure it: places to some centimetres,
which turn the direction by a degree or two. A smaller one is no reason to prefer an alternative."""

PLACE_STD_M: Final = 0.03
"""Standard deviation of such places along each axis, metres."""

MOST_RISE_M: Final = 1.5
RISE_STEP_M: Final = 0.02
"""Heights of all arrays that are tried against those filed, metres."""

_TURNED: Final = (0.02, 180.0)
_MOVED: Final = (1.0, 1.5)
_SPEED_STD_M_S: Final = 20.0
"""Quantities that an alternative leaves free: standard deviations in metres, degrees and m/s."""


class Trial:
    """The sounds, and the set-up as filed, against which alternatives are tried.

    Parameters
    ----------
    microphones : mapping of array to (K, 3) float64
        As filed, metres.
    delays : mapping of array to (S, K) float64
        Seconds.
    search : KnownPlaces
    """

    def __init__(self, microphones: Microphones, delays: Delays, search: KnownPlaces) -> None:
        self._microphones, self._delays, self._search = microphones, delays, search
        self.sounds = len(next(iter(delays.values())))
        self._tables = {name: search.table_s(at_m) for name, at_m in microphones.items()}
        self._costs = {name: search.costs(self._tables[name], delays[name]) for name in microphones}
        self._free = float(degrees_of_freedom(delays).sum())
        self.filed = search.refine(microphones, delays, search.at_lowest(self._together({})))

    def criterion(self, places: Places, unknowns: float) -> float:
        """Bayesian information criterion of a set-up with so many unknowns more than that which is filed."""
        misfit_s = np.hypot(places.misfit_s, FLOOR_S / 3.0)
        return float(self._free * np.log(misfit_s**2) + unknowns * np.log(self._free))

    def orders(self) -> Iterator[Alternative]:
        """Yield the best alternative orders of channels, of one array and of all."""
        tried: list[tuple[float, str | None, dict[str, IntArray]]] = []
        for name, delays in self._delays.items():
            for order in channel_orders(delays.shape[1]):
                costs = self._search.costs(self._tables[name], delays[:, order])
                tried.append((self._lowest({name: costs}), name, {name: order}))
        counts = {delays.shape[1] for delays in self._delays.values()}
        if len(counts) == 1:
            for order in channel_orders(counts.pop()):
                together = {
                    name: self._search.costs(self._tables[name], delays[:, order])
                    for name, delays in self._delays.items()
                }
                tried.append((self._lowest(together), None, dict.fromkeys(self._delays, order)))
        for _, array, orders in sorted(tried, key=lambda one: one[0])[:REFINED]:
            changed = {name: self._delays[name][:, order] for name, order in orders.items()}
            places = self._search.fit(self._microphones, dict(self._delays) | changed)
            order = next(iter(orders.values()))
            moved = int((order != np.arange(len(order))).sum())
            fault = "swapped" if array is not None else "mirrored"
            yield Alternative(
                fault,
                array,
                places.misfit_s,
                self.criterion(places, 0.5 * moved),
                order=tuple(int(channel) + 1 for channel in order),
            )

    def exchanges(self) -> Iterator[Alternative]:
        """Yield each two arrays of as many microphones exchanged."""
        for one, other in combinations(self._delays, 2):
            if self._delays[one].shape[1] != self._delays[other].shape[1]:
                continue
            delays = dict(self._delays) | {one: self._delays[other], other: self._delays[one]}
            places = self._search.fit(self._microphones, delays)
            yield Alternative("exchanged", one, places.misfit_s, self.criterion(places, 0.5), other=other)

    def channels(self) -> Iterator[Alternative]:
        """Yield each channel late, and each microphone elsewhere, as the other channels say best."""
        for name, delays in self._delays.items():
            if delays.shape[1] < MIN_FOR_ONE:
                continue
            for index in range(delays.shape[1]):
                if np.isfinite(delays[:, index]).sum() < LEAST_SOUNDS:
                    continue
                yield from self._channel(name, index)

    def _channel(self, name: str, index: int) -> Iterator[Alternative]:
        others = self._delays[name].copy()
        others[:, index] = np.nan
        places = self._search.refine(self._microphones, dict(self._delays) | {name: others}, self.filed.positions_m)
        at_m, c_m_s = self._microphones[name], self._search.c_m_s
        towards = places.positions_m[:, None] - at_m
        away_m = np.linalg.norm(towards, axis=2)
        there = np.isfinite(others)
        off_s = np.where(there, self._delays[name] - away_m / c_m_s, np.nan)
        rest_s = np.nansum(off_s, axis=1) / np.maximum(there.sum(axis=1), 1)
        late_s = self._delays[name][:, index] - away_m[:, index] / c_m_s - rest_s
        known = np.isfinite(late_s)
        constant_s = float(np.median(late_s[known]))
        delays = self._delays[name].copy()
        delays[:, index] -= constant_s
        found = self._search.refine(self._microphones, dict(self._delays) | {name: delays}, places.positions_m)
        yield Alternative(
            "late_channel", name, found.misfit_s, self.criterion(found, 1.5), channel=index + 1, late_s=constant_s
        )
        unit, late_s = (towards[:, index] / away_m[:, index, None])[known], late_s[known]

        def misfits(shift_m: FloatArray) -> FloatArray:
            return np.asarray((late_s + unit @ shift_m / c_m_s) / DELAY_STD_S)

        shift_m = least_squares(misfits, np.zeros(3), loss="soft_l1").x
        moved_m = at_m.copy()
        moved_m[index] += shift_m
        microphones = dict(self._microphones) | {name: moved_m}
        found = self._search.refine(microphones, self._delays, places.positions_m)
        yield Alternative(
            "geometry",
            name,
            found.misfit_s,
            self.criterion(found, 3.5),
            channel=index + 1,
            shift_m=tuple(float(part) for part in shift_m),
        )

    def poses(self) -> Iterator[Alternative]:
        """Yield each array turned, and each array moved, as the sounds say best."""
        for name in self._microphones:
            adjusted, turn = self._turned(name)
            yield from self._posed("turned", name, adjusted, turn)
            adjusted = self._adjusted(self._microphones, self.filed.positions_m, Freedom({name: _MOVED}))
            yield from self._posed("moved", name, adjusted, Rotation.identity())

    def _posed(self, fault: str, name: str, adjusted: Adjusted, turn: Rotation) -> Iterator[Alternative]:
        """Yield an adjusted pose, unless what it is not named after is large as well."""
        pose = adjusted.poses[name]
        whole = Rotation.from_rotvec(np.radians(pose.turn_deg)) * turn
        turn_deg = np.degrees(whole.as_rotvec())
        is_turned = fault == "turned"
        if pose.distance_m > LEAST_SHIFT_M if is_turned else np.linalg.norm(turn_deg) > LEAST_TURN_DEG:
            return
        places = self._placed(name, adjusted, turn)
        yield Alternative(
            fault,
            name,
            places.misfit_s,
            self.criterion(places, 3.0 if is_turned else 4.0),
            turn_deg=tuple(float(part) for part in turn_deg),
            shift_m=tuple(float(part) for part in pose.shift_m),
        )

    def heights(self) -> Iterator[Alternative]:
        """Yield all arrays higher or lower."""
        best: tuple[Places, float] | None = None
        for rise_m in np.arange(-MOST_RISE_M, MOST_RISE_M + RISE_STEP_M / 2.0, RISE_STEP_M):
            microphones = {name: at_m + np.array([0.0, 0.0, rise_m]) for name, at_m in self._microphones.items()}
            places = self._search.refine(microphones, self._delays, self.filed.positions_m)
            if best is None or places.misfit_s < best[0].misfit_s:
                best = places, float(rise_m)
        assert best is not None
        places, rise_m = best
        yield Alternative("height", None, places.misfit_s, self.criterion(places, 1.0), shift_m=(0.0, 0.0, rise_m))

    def speeds(self) -> Iterator[Alternative]:
        """Yield the speed of sound that the sounds say best."""
        adjusted = self._adjusted(self._microphones, self.filed.positions_m, Freedom({}, speed_std_m_s=_SPEED_STD_M_S))
        places = self._search.refine(self._microphones, self._delays, adjusted.places_m, adjusted.c_m_s)
        yield Alternative(
            "temperature",
            None,
            places.misfit_s,
            self.criterion(places, 1.0),
            speed_m_s=adjusted.c_m_s,
            speed_off_m_s=adjusted.c_m_s - self._search.c_m_s,
        )

    def _turned(self, name: str) -> tuple[Adjusted, Rotation]:
        """Adjust the turn of an array, from the best of the turns about the vertical and upside down."""
        at_m = self._microphones[name]
        centre_m = at_m.mean(axis=0)
        best: tuple[float, Rotation] | None = None
        for upside in (0.0, 180.0):
            for yaw in np.arange(-180.0, 180.0, 20.0):
                turn = Rotation.from_euler("ZX", [yaw, upside], degrees=True)
                turned_m = turn.apply(at_m - centre_m) + centre_m
                costs = self._search.costs(self._search.table_s(turned_m), self._delays[name])
                lowest = self._lowest({name: costs})
                if best is None or lowest < best[0]:
                    best = lowest, turn
        assert best is not None
        microphones = dict(self._microphones) | {name: best[1].apply(at_m - centre_m) + centre_m}
        places = self._search.fit(microphones, self._delays)
        return self._adjusted(microphones, places.positions_m, Freedom({name: _TURNED})), best[1]

    def _adjusted(self, microphones: Microphones, places_m: FloatArray, freedom: Freedom) -> Adjusted:
        return adjust(microphones, self._delays, places_m, self._search.c_m_s, freedom, PLACE_STD_M)

    def _placed(self, name: str, adjusted: Adjusted, turn: Rotation) -> Places:
        centre_m = self._microphones[name].mean(axis=0)
        turned_m = turn.apply(self._microphones[name] - centre_m) + centre_m
        microphones = dict(self._microphones) | {name: adjusted.poses[name].applied(turned_m)}
        low, high = self._search.bounds_m.T
        return self._search.refine(microphones, self._delays, np.clip(adjusted.places_m, low, high))

    def _together(self, changed: Mapping[str, FloatArray]) -> FloatArray:
        return np.asarray(sum((dict(self._costs) | dict(changed)).values()))

    def _lowest(self, changed: Mapping[str, FloatArray]) -> float:
        """Sum over the sounds of the lowest cost with some arrays' costs changed; one bad sound counts little."""
        lowest = self._together(changed).min(axis=1)
        return float(np.sqrt(lowest).sum())
