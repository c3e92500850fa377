"""Finds what explains the contradictions between the delays of sounds: other orders of channels, other poses.

With the set-up as filed, the arrays' delays of a sound fit no place if something is wrong. Each alternative is tried:
every order of an array's channels, turns and shifts of an array, another speed of sound. The one that explains the
sounds best is named, provided that it explains them far better than the set-up as filed, and better than every
alternative of another kind.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import combinations, permutations
from typing import Final

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from livessl.core.commission.places import Delays, Microphones, Places, PlaceSearch, degrees_of_freedom
from livessl.core.commission.poses import DELAY_STD_S, Adjusted, Freedom, adjust
from livessl.core.types import FloatArray, IntArray

ALL_ORDERS: Final = 4
"""Most microphones of an array of which all orders are tried; of larger arrays exchanges of two, shifts and mirror."""

REFINED: Final = 6
"""Alternatives, the best at first sight, whose places are refined."""

MIN_FOR_ONE: Final = 4
"""Fewest microphones of an array of which a single one is examined: the others must say what it ought to receive."""

LEAST_SOUNDS: Final = 3
"""Fewest sounds from which anything is concluded."""

MIN_GAIN: Final = 12.0
"""Least gain in the Bayesian information criterion for which a set-up is said to be other than filed."""

MIN_LEAD: Final = 6.0
"""Least lead in the same measure over the best alternative of another array, or of the whole site."""

MIN_RATIO: Final = 1.3
"""Least ratio between the misfit as filed and that of the alternative."""

FLOOR_S: Final = 12e-6
"""Misfit, in seconds, that remains in a set-up that is filed as well as one can measure it: microphones to 2 mm, arrays
to 2 cm and 1.5 degrees. A smaller one is no reason to prefer an alternative."""

LEAST_TURN_DEG: Final = 4.0
"""Smallest turn that is told."""

LEAST_SHIFT_M: Final = 0.1
"""Smallest shift that is told, metres."""

LEAST_DISPLACEMENT_M: Final = 0.02
"""Smallest displacement of a single microphone that is told, metres."""

LEAST_LATE_S: Final = 40e-6
"""Smallest delay of a single channel that is told, seconds: two samples at 48 kHz."""

LEAST_SPEED_M_S: Final = 6.0
"""Smallest error of the speed of sound that is told, m/s: some 10 degrees of temperature."""

_TURNED: Final = (0.02, 180.0)
_MOVED: Final = (1.0, 1.5)
_SPEED_STD_M_S: Final = 20.0
"""What an alternative leaves free: standard deviations in metres, degrees and m/s."""


@dataclass(frozen=True, slots=True)
class Alternative:
    """A set-up other than the one that is filed.

    Parameters
    ----------
    fault : str
        Code of the fault: swapped, mirrored, exchanged, turned, moved, late_channel, geometry, temperature.
    array : str or None
        The array that is other than filed; None for the whole site.
    other : str or None
        The array that it is exchanged with.
    channel : int or None
        The channel, from 1, that is late or whose microphone is elsewhere.
    misfit_s : float
        Misfit of the sounds with it, seconds.
    criterion : float
        Bayesian information criterion; the lowest is best.
    order : tuple of int
        For each microphone of the site file, the channel from 1 that carries it; empty if channels are as filed.
    turn_deg, shift_m : (3,) tuple of float
        Turn of the array about its centre (a vector along the axis), and its shift or that of the microphone.
    late_s : float
        Delay of the channel, seconds.
    speed_m_s : float or None
        Speed of sound, if it is what differs.
    speed_off_m_s : float
        Its difference from the filed one, m/s.
    """

    fault: str
    array: str | None
    misfit_s: float
    criterion: float
    other: str | None = None
    channel: int | None = None
    order: tuple[int, ...] = ()
    turn_deg: tuple[float, ...] = (0.0, 0.0, 0.0)
    shift_m: tuple[float, ...] = (0.0, 0.0, 0.0)
    late_s: float = 0.0
    speed_m_s: float | None = None
    speed_off_m_s: float = 0.0

    @property
    def concerns(self) -> tuple[str | None, str | None]:
        """The arrays that it is about: alternatives of the same arrays are no rivals of each other."""
        return self.array, self.other

    @property
    def is_large(self) -> bool:
        """Whether it differs from what is filed by more than a careful set-up may."""
        if self.fault == "turned":
            return float(np.linalg.norm(self.turn_deg)) >= LEAST_TURN_DEG
        if self.fault in ("moved", "geometry"):
            least_m = LEAST_SHIFT_M if self.fault == "moved" else LEAST_DISPLACEMENT_M
            return float(np.linalg.norm(self.shift_m)) >= least_m
        if self.fault == "late_channel":
            return abs(self.late_s) >= LEAST_LATE_S
        return self.fault != "temperature" or abs(self.speed_off_m_s) >= LEAST_SPEED_M_S


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """What the delays of some sounds say about the set-up.

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
        Lead of the best alternative over the set-up as filed and over alternatives of other arrays, in the Bayesian
        information criterion.
    """

    sounds: int
    misfit_s: float
    best: Alternative | None
    rivals: tuple[Alternative, ...]
    contradicts: bool
    lead: float = 0.0

    @property
    def confidence(self) -> float:
        """Probability of the best alternative against the next best one."""
        return float(1.0 / (1.0 + np.exp(-self.lead / 2.0)))


def diagnose(microphones: Microphones, delays: Delays, bounds_m: FloatArray, c_m_s: float) -> Diagnosis:
    """Compare the set-up as filed with its alternatives.

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
    trial = _Trial(microphones, delays, PlaceSearch(bounds_m, c_m_s))
    if trial.sounds < LEAST_SOUNDS or len(microphones) < 2 or trial.filed.misfit_s <= MIN_RATIO * FLOOR_S:
        return Diagnosis(trial.sounds, trial.filed.misfit_s, None, (), contradicts=False)
    tried = (*trial.orders(), *trial.exchanges(), *trial.channels(), *trial.poses(), *trial.speeds())
    rivals = sorted(tried, key=lambda one: one.criterion)
    gained = trial.criterion(trial.filed, 0) - rivals[0].criterion
    contradicts = gained > MIN_GAIN and trial.filed.misfit_s > MIN_RATIO * max(rivals[0].misfit_s, FLOOR_S)
    best = rivals[0]
    others = [one for one in rivals if one.concerns != best.concerns]
    lead = others[0].criterion - best.criterion if others else gained
    named = contradicts and lead > MIN_LEAD and best.is_large
    return Diagnosis(
        trial.sounds, trial.filed.misfit_s, best if named else None, tuple(rivals), contradicts, min(gained, lead)
    )


class _Trial:
    """The sounds, and the set-up as filed, against which alternatives are tried."""

    def __init__(self, microphones: Microphones, delays: Delays, search: PlaceSearch) -> None:
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
            for order in _orders(delays.shape[1]):
                costs = self._search.costs(self._tables[name], delays[:, order])
                tried.append((self._lowest({name: costs}), name, {name: order}))
        counts = {delays.shape[1] for delays in self._delays.values()}
        if len(counts) == 1:
            for order in _orders(counts.pop()):
                together = {
                    name: self._search.costs(self._tables[name], delays[:, order])
                    for name, delays in self._delays.items()
                }
                tried.append((self._lowest(together), None, dict.fromkeys(self._delays, order)))
        for _, name, orders in sorted(tried, key=lambda one: one[0])[:REFINED]:
            delays = dict(self._delays) | {array: self._delays[array][:, order] for array, order in orders.items()}
            places = self._search.fit(self._microphones, delays)
            order = next(iter(orders.values()))
            moved = int((order != np.arange(len(order))).sum())
            fault = "swapped" if name is not None else "mirrored"
            yield Alternative(
                fault,
                name,
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
        unit = towards[:, index] / away_m[:, index, None]
        shift_m = least_squares(
            lambda shift: (late_s + unit @ shift / c_m_s)[known] / DELAY_STD_S, np.zeros(3), loss="soft_l1"
        ).x
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

    def speeds(self) -> Iterator[Alternative]:
        """Yield the speed of sound that the sounds say best."""
        adjusted = self._adjusted(self._microphones, self.filed.positions_m, Freedom({}, speed_std_m_s=_SPEED_STD_M_S))
        places = self._search.refine(self._microphones, self._delays, adjusted.places_m, adjusted.c_m_s)
        yield Alternative("temperature", None, places.misfit_s, self.criterion(places, 1.0), speed_m_s=adjusted.c_m_s)

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
        return adjust(microphones, self._delays, places_m, self._search.c_m_s, freedom)

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


def _orders(count: int) -> list[IntArray]:
    """Orders of channels to try: `order[i]` is the channel that carries microphone i."""
    same = tuple(range(count))
    if count <= ALL_ORDERS:
        return [np.array(order) for order in permutations(same) if order != same]
    tried = []
    for i, k in combinations(same, 2):
        order = list(same)
        order[i], order[k] = k, i
        tried.append(tuple(order))
    tried += [tuple(np.roll(same, shift)) for shift in range(1, count)]
    tried += [tuple(np.roll(same[::-1], shift)) for shift in range(count)]
    return [np.array(order) for order in dict.fromkeys(tried)]
