"""Lists the set-ups that doctor tries, such as swapped channels and turned, moved or exchanged arrays.

Alternatives that are far from the filed set-up (another order of channels, exchanged arrays, a large rotation) are
first ranked on a grid of places, which takes little time. Only the best of them are fitted.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, permutations, product
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from livessl.core.commission.alternative import Alternative
from livessl.core.commission.finding import LEAST_SOUNDS
from livessl.core.commission.places import Delays, Microphones, PlaceSearch, centred
from livessl.core.commission.set_up import Freedom, Known, SetUp
from livessl.core.types import Float32Array, FloatArray, IntArray

ALL_ORDERS: Final = 4
"""Largest number of microphones of an array for which all orders are tried. For larger arrays, exchanges of two
channels, shifts and the mirrored order are tried."""

FITTED_ORDERS: Final = 6
"""Number of orders of channels, the best ones on the grid, that are fitted."""

MIN_FOR_ONE: Final = 4
"""Fewest microphones of an array in which single ones are examined, because the others must predict the delays of
one."""

YAWS_DEG: Final = tuple(np.arange(-180.0, 180.0, 20.0).tolist())
"""Rotations about the vertical, in degrees, that are tried on the grid, the right way up and upside down."""

UPRIGHT_COST: Final = 2.0
"""Deviance that a rotation about the vertical alone must gain. It has one unknown, and is the most common error."""

FREER_COST: Final = 8.0
"""Deviance that a set-up must gain in which the pose or all microphones of an array are free: as much as a fault with
three unknowns. Faults with one unknown, which such a set-up includes, gain more if they are reported."""

FREE_M: Final = 1.0
FREE_DEG: Final = 60.0
FREE_MICROPHONE_M: Final = 0.1
FREE_SPEED_M_S: Final = 20.0
"""Standard deviations of the quantities that a hypothesis leaves free: metres, degrees, metres, m/s."""


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """An alternative as a set-up, before it is fitted.

    Parameters
    ----------
    alternative : Alternative or None
        Difference from the filed set-up; a free quantity has the value at which the fit begins. None for the filed
        set-up itself.
    set_up : SetUp
    starts_m : (S, 3) float64
        Places of the sounds at which the fit begins, metres.
    but : (str, int) or None
        Array and index of a channel that is not used to find these places; None if all are used.
    cost : float or None
        Deviance that the hypothesis must gain; None for the usual cost of its fault.
    """

    alternative: Alternative | None
    set_up: SetUp
    starts_m: FloatArray
    but: tuple[str, int] | None = None
    cost: float | None = None


class Hypotheses:
    """Makes the alternatives to a filed set-up.

    Parameters
    ----------
    microphones : mapping of array to (K, 3) float64
        As filed, metres.
    delays : mapping of array to (S, K) float64
        Seconds.
    search : PlaceSearch
    known : Known
    """

    def __init__(self, microphones: Microphones, delays: Delays, search: PlaceSearch, known: Known) -> None:
        self._microphones, self._delays, self._search = microphones, delays, search
        self._tables = {name: search.tables_s(at_m[None]) for name, at_m in microphones.items()}
        self._costs = {name: _costs(self._tables[name], one)[0] for name, one in delays.items()}
        self._freedom = {name: known.freedom[name] for name in microphones}
        self._filed = SetUp(microphones, delays, search.c_m_s, self._freedom, stds_s=known.stds_s)
        self._starts_m = self._at_lowest(self._all_but())

    def filed(self) -> Hypothesis:
        """Return the filed set-up."""
        return Hypothesis(None, self._filed, self._starts_m)

    def freer(self, places_m: FloatArray) -> list[Hypothesis]:
        """Return set-ups with more freedom than any alternative near the filed one, and the gain that each needs.

        For each array, its pose, then its microphones are left free, and the speed of sound is left free. Then only its
        rotation about the vertical is left free, which must gain less. The fits show how much can be gained at most.
        `places_m` (S, 3) are the places in the filed set-up.
        """
        freer = []
        for name, own in self._freedom.items():
            for freed in (
                replace(own, position_m=FREE_M, orientation_deg=np.full(3, FREE_DEG)),
                replace(own, microphones_m=np.full(len(own.microphones_m), FREE_MICROPHONE_M)),
            ):
                set_up = replace(self._with(name, freed), speed_std_m_s=FREE_SPEED_M_S)
                freer.append(Hypothesis(None, set_up, places_m, cost=FREER_COST))
            freer.append(Hypothesis(None, self._with(name, _upright(own)), places_m, cost=UPRIGHT_COST))
        return freer

    def near(self, places_m: FloatArray) -> Iterator[Hypothesis]:
        """Yield the alternatives whose fit begins at the filed set-up and its places (S, 3), metres."""
        for name, own in self._freedom.items():
            upright = self._with(name, _upright(own))
            yield Hypothesis(_alternative("turned", name), upright, places_m, cost=UPRIGHT_COST)
            for freed, fault in (
                (replace(own, orientation_deg=np.full(3, FREE_DEG)), "turned"),
                (replace(own, position_m=FREE_M), "moved"),
            ):
                yield Hypothesis(_alternative(fault, name), self._with(name, freed), places_m)
            for index in range(len(own.microphones_m)) if len(own.microphones_m) >= MIN_FOR_ONE else ():
                if np.isfinite(self._delays[name][:, index]).sum() < LEAST_SOUNDS:
                    continue
                one = name, index
                late = replace(self._filed, late=one)
                yield Hypothesis(_alternative("late_channel", name, channel=index + 1), late, places_m, one)
                free_m = own.microphones_m.copy()
                free_m[index] = FREE_MICROPHONE_M
                displaced = self._with(name, replace(own, microphones_m=free_m))
                yield Hypothesis(_alternative("geometry", name, channel=index + 1), displaced, places_m, one)
        faster = replace(self._filed, speed_std_m_s=FREE_SPEED_M_S)
        yield Hypothesis(replace(_alternative("temperature"), speed_m_s=self._search.c_m_s), faster, places_m)

    def far(self) -> Iterator[Hypothesis]:
        """Yield the alternatives whose fit begins elsewhere: orders of channels, exchanges and large rotations."""
        yield from self._best_orders()
        for one, other in combinations(self._delays, 2):
            if self._delays[one].shape[1] == self._delays[other].shape[1]:
                yield self._exchanged(one, other)
        for name in self._microphones:
            turned = self._best_turn(name)
            if turned is not None:
                yield turned

    def _best_orders(self) -> list[Hypothesis]:
        tried: list[tuple[float, str | None, IntArray, FloatArray]] = []
        together: dict[str, Float32Array] = {}
        for name, delays_s in self._delays.items():
            orders = channel_orders(delays_s.shape[1])
            if not orders:
                continue
            costs = _costs_in_orders(self._tables[name], delays_s, orders)
            together[name] = costs
            tried += self._ranked(name, orders, costs + self._all_but(name))
        counts = {delays_s.shape[1] for delays_s in self._delays.values()}
        if len(counts) == 1 and together:
            tried += self._ranked(None, channel_orders(counts.pop()), np.sum(list(together.values()), axis=0))
        best = sorted(tried, key=lambda one: one[0])[:FITTED_ORDERS]
        return [self._ordered(array, order, starts_m) for _, array, order, starts_m in best]

    def _ranked(
        self, array: str | None, orders: Sequence[IntArray], costs: Float32Array
    ) -> list[tuple[float, str | None, IntArray, FloatArray]]:
        """Return orders with their summed contradictions and the best grid points, from costs (n, S, G)."""
        lowest = costs.argmin(axis=-1)
        at = np.take_along_axis(costs, lowest[..., None], axis=-1)[..., 0]
        sums = np.sqrt(np.maximum(at, 0.0)).sum(axis=-1)  # one bad sound counts little
        places_m = self._search.points_m[lowest]
        return [(float(total), array, order, at_m) for total, order, at_m in zip(sums, orders, places_m, strict=True)]

    def _ordered(self, array: str | None, order: IntArray, starts_m: FloatArray) -> Hypothesis:
        delays = dict(self._delays)
        for name in delays if array is None else (array,):
            delays[name] = delays[name][:, order]
        fault = "mirrored" if array is None else "swapped"
        alternative = replace(_alternative(fault, array), order=tuple(int(channel) + 1 for channel in order))
        return Hypothesis(alternative, replace(self._filed, delays=delays), starts_m)

    def _exchanged(self, one: str, other: str) -> Hypothesis:
        delays = dict(self._delays) | {one: self._delays[other], other: self._delays[one]}
        costs = self._all_but(one, other)
        for name in (one, other):
            costs = costs + _costs(self._tables[name], delays[name])[0]
        alternative = replace(_alternative("exchanged", one), other=other)
        stds_s = dict(self._filed.stds_s)
        if one in stds_s and other in stds_s:
            stds_s |= {one: stds_s[other], other: stds_s[one]}
        return Hypothesis(alternative, replace(self._filed, delays=delays, stds_s=stds_s), self._at_lowest(costs))

    def _best_turn(self, name: str) -> Hypothesis | None:
        """Return the best rotation of the array on the grid; None if it is the filed orientation."""
        at_m, others = self._microphones[name], self._all_but(name)
        centre_m = at_m.mean(axis=0)
        turns = Rotation.from_euler("ZX", list(product(YAWS_DEG, (0.0, 180.0))), degrees=True)
        turned_m = (at_m - centre_m) @ turns.as_matrix().swapaxes(1, 2) + centre_m
        costs = _costs(self._search.tables_s(turned_m), self._delays[name])
        costs += others
        best = int(np.sqrt(np.maximum(costs.min(axis=2), 0.0)).sum(axis=1).argmin())
        turn, starts_m = turns[best], self._at_lowest(costs[best])
        if turn.magnitude() == 0.0:
            return None
        own = replace(self._freedom[name], orientation_deg=np.full(3, FREE_DEG))
        turned = dict(self._microphones) | {name: turned_m[best]}
        alternative = replace(_alternative("turned", name), turn_deg=_three(np.degrees(turn.as_rotvec())))
        return Hypothesis(alternative, replace(self._with(name, own), microphones=turned), starts_m)

    def _with(self, name: str, freedom: Freedom) -> SetUp:
        return replace(self._filed, freedom=self._freedom | {name: freedom})

    def _all_but(self, *left_out: str) -> Float32Array:
        """Return the sum of the costs (S, G) of the other arrays."""
        first = next(iter(self._costs.values()))
        kept = (costs for name, costs in self._costs.items() if name not in left_out)
        return np.asarray(sum(kept, np.zeros_like(first)))

    def _at_lowest(self, costs: Float32Array) -> FloatArray:
        return np.asarray(self._search.points_m[costs.argmin(axis=-1)])


def _upright(own: Freedom) -> Freedom:
    """Return the freedom of an array that may be rotated about the vertical."""
    return replace(own, orientation_deg=np.array([*own.orientation_deg[:2], FREE_DEG]))


def _alternative(fault: str, array: str | None = None, channel: int | None = None) -> Alternative:
    return Alternative(fault, array, np.nan, np.inf, channel=channel)


def _costs(tables_s: Float32Array, delays_s: FloatArray) -> Float32Array:
    """Return the squared contradictions (T, S, G) of delays (S, K) at one array with tables (T, K, G) of grid points.

    Single precision resolves contradictions of one microsecond; a wrong order has a hundred microseconds.
    """
    there = np.isfinite(delays_s)
    costs = np.zeros((len(tables_s), len(delays_s), tables_s.shape[2]), dtype=np.float32)
    for pattern in np.unique(there, axis=0):
        if pattern.sum() < 2:
            continue
        rows = (there == pattern).all(axis=1)
        tables = tables_s[:, pattern]
        tables -= tables.mean(axis=1, keepdims=True)
        measured = centred(delays_s[np.ix_(rows, pattern)]).astype(np.float32)
        products = (np.float32(-2.0) * measured) @ tables
        products += np.einsum("tkg,tkg->tg", tables, tables)[:, None]
        products += (measured**2).sum(axis=1)[:, None]
        costs[:, rows] = products
    return costs


def _costs_in_orders(tables_s: Float32Array, delays_s: FloatArray, orders: Sequence[IntArray]) -> Float32Array:
    """Return the costs (n, S, G) of delays (S, K) in n orders."""
    ordered = np.stack([delays_s[:, order] for order in orders])
    costs = _costs(tables_s, ordered.reshape(-1, delays_s.shape[1]))
    return costs.reshape(len(orders), len(delays_s), -1)


def channel_orders(count: int) -> list[IntArray]:
    """Return the orders of channels to try; `order[i]` is the channel that carries microphone i."""
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


def _three(values: FloatArray) -> tuple[float, ...]:
    return tuple(float(value) for value in values)
