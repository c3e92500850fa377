"""Decides which events of different servers of one hall are one sound, and which of them is kept. It stores nothing.

The decision depends on the events alone, whatever the order in which they are given.

- Two *located* events are one sound if their times overlap and their positions agree: the squared Mahalanobis distance
  by the sum of their covariances is at most `SAME_PLACE`. Pairs are joined in the order of their likelihood to be one
  place. All located events of a group agree with each other, and a group never has two events of one server, which
  are two sounds to that server.
- An event with a *direction* only joins the group that its candidates agree with best, its distance from the nearest
  array being known to a factor only. It never joins two groups with each other, as it may agree with both.
- A *refused* event has no position. It joins an event that overlaps with it if at least half of the arrays that
  detected one of them detected the other as well.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence, Set
from dataclasses import dataclass
from itertools import product
from typing import Any, Final, NamedTuple

import numpy as np

from livessl.clock import utc_ns
from livessl.core.types import FloatArray, Status
from livessl.server.forwarding.whereabouts import whereabouts
from livessl.server.history.query import JsonObject

SAME_PLACE: Final = 11.3
"""Largest squared Mahalanobis distance of two positions of one sound: the 99 % quantile of chi-squared with three
degrees of freedom."""

SLACK_NS: Final = 100_000_000
"""Gap, in nanoseconds, that two events may have and still overlap: two frames, for the travel of a short sound between
arrays, and for clocks of nodes that differ by some milliseconds."""

LEAST_OVERLAP: Final = 0.5
"""Least overlap as a share of the shorter event. Two servers cut one sound at about the same times; a smaller overlap
is that of a sound with the one before or after it."""

LEAST_SHARED: Final = 0.5
"""Least share of arrays that detected both of two events, of which one is refused, among those of the one that fewer
arrays detected."""

ROUNDING_M2: Final = 1e-6
"""Variance, in square metres, that is added to each position: that of a millimetre, as events are rounded."""

ROUNDING: Final = 1e-9
"""Least variance along any axis as a share of the sum of all three, so that no covariance is singular."""

_RANKS: Final = {Status.LOCATED: 0, Status.DIRECTION_ONLY: 1, Status.REFUSED: 2}
_LOCATED: Final = _RANKS[Status.LOCATED]
_REFUSED: Final = _RANKS[Status.REFUSED]


class Name(NamedTuple):
    """The name of an event at a hub."""

    site: str
    id: str


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """A sound as one server has found it.

    Parameters
    ----------
    name : Name
    start_ns, end_ns : int
        Time of the sound, in nanoseconds since the epoch.
    rank : int
        0 for a located event, 1 for a direction, 2 for a refused event.
    places_m : ndarray (n, 3)
        The position, or the candidates for it, in metres in the coordinates of the hall; none if refused.
    covariance_m2 : ndarray (3, 3)
        Covariance of each of them.
    in_tile : bool
        Whether the position lies in the tile of its own server.
    heard_by : frozenset of str
        Arrays that detected it.
    """

    name: Name
    start_ns: int
    end_ns: int
    rank: int
    places_m: FloatArray
    covariance_m2: FloatArray
    in_tile: bool
    heard_by: frozenset[str]

    @property
    def merit(self) -> tuple[Any, ...]:
        """The smaller, the rather is this event kept; equal for no two events."""
        volume = math.inf if self.rank == _REFUSED else float(np.linalg.det(self.covariance_m2))
        return self.rank, not self.in_tile, volume, -len(self.heard_by), self.name


def sighting(event: JsonObject) -> Sighting:
    """Return what an event of a hall says of its sound.

    Parameters
    ----------
    event : JsonObject
        As a hub stores it, with `site` and `hall`.

    Raises
    ------
    ValueError, KeyError, TypeError
        If its places cannot be compared with those of others.
    """
    start_ns = utc_ns(event["time_utc"])
    status, places_m, covariance_m2 = whereabouts(event)
    if places_m.ndim != 2 or places_m.shape[1] != 3 or covariance_m2.shape != (3, 3):
        raise ValueError(f"places: expected three coordinates each, got arrays of {places_m.shape}")
    if not (np.isfinite(places_m).all() and np.isfinite(covariance_m2).all()):
        raise ValueError("places: expected finite coordinates and variances, got others")
    return Sighting(
        name=Name(event["site"], event["id"]),
        start_ns=start_ns,
        end_ns=start_ns + round(1e9 * (event.get("duration_s") or 0.0)),
        rank=_RANKS[status],
        places_m=places_m,
        covariance_m2=covariance_m2,
        in_tile=bool(event["hall"]["in_tile"]),
        heard_by=frozenset(event.get("heard_by") or ()),
    )


def overlap_ns(one: Sighting, other: Sighting) -> int:
    """Return for how long two sounds overlap, with `SLACK_NS`; negative for a gap that is longer than that."""
    return min(one.end_ns, other.end_ns) - max(one.start_ns, other.start_ns) + SLACK_NS


def cost(one: Sighting, other: Sighting) -> float | None:
    """Return how unlikely it is that two events are one sound, to be compared among events of the same ranks.

    Returns
    -------
    float or None
        None if they are two sounds, or of one server.
    """
    overlap = overlap_ns(one, other)
    shorter_ns = min(one.end_ns - one.start_ns, other.end_ns - other.start_ns)
    if one.name.site == other.name.site or overlap < max(0, LEAST_OVERLAP * shorter_ns):
        return None
    if _REFUSED in (one.rank, other.rank):
        fewer = min(len(one.heard_by), len(other.heard_by))
        shared = len(one.heard_by & other.heard_by) / fewer if fewer else 0.0
        return None if shared < LEAST_SHARED else 1.0 - shared
    first, second = sorted((one, other), key=lambda each: each.name)
    spread_m2 = first.covariance_m2 + second.covariance_m2
    spread_m2 = spread_m2 + max(ROUNDING_M2, ROUNDING * float(np.trace(spread_m2))) * np.eye(3)
    apart_m = (first.places_m[:, None] - second.places_m).reshape(-1, 3)
    squared = float(np.einsum("ni,ni->n", apart_m, np.linalg.solve(spread_m2, apart_m.T).T).min())
    return squared + float(np.linalg.slogdet(spread_m2)[1]) if squared <= SAME_PLACE else None


def pairs(events: Iterable[Sighting], new: Set[Name] | None = None) -> Iterator[tuple[Sighting, Sighting, float]]:
    """Yield each two events that may be one sound, and their cost; with `new` only pairs with at least one of those."""
    sounding: list[Sighting] = []
    for event in sorted(events, key=lambda each: (each.start_ns, each.name)):
        sounding = [other for other in sounding if other.end_ns + SLACK_NS >= event.start_ns]
        for other in sounding:
            if new is not None and event.name not in new and other.name not in new:
                continue
            found = cost(event, other)
            if found is not None:
                yield event, other, found
        sounding.append(event)


def sounds(events: Sequence[Sighting]) -> list[list[Sighting]]:
    """Return the events of each sound, the one that is kept first.

    Parameters
    ----------
    events : sequence of Sighting
        Different events of one hall.
    """
    group_of = {event.name: [event] for event in events}
    ordered: list[tuple[int, float, Name, Name]] = sorted(
        (max(one.rank, other.rank), found, min(one.name, other.name), max(one.name, other.name))
        for one, other, found in pairs(events)
    )
    agreeing = {(first, second) for level, _, first, second in ordered if level == _LOCATED}
    for level, _, first, second in ordered:
        one, other = group_of[first], group_of[second]
        if not {event.name.site for event in one}.isdisjoint(event.name.site for event in other):
            continue
        if all(min(event.rank for event in group) < level for group in (one, other)):
            continue  # both are sounds already, and only an unsure event connects them
        places = ([event.name for event in group if event.rank == _LOCATED] for group in (one, other))
        if not all((min(pair), max(pair)) in agreeing for pair in product(*places)):
            continue  # an uncertain event agrees with two sounds at different places
        one += other
        for event in other:
            group_of[event.name] = one
    groups = {id(group): group for group in group_of.values()}.values()
    return [sorted(group, key=lambda each: each.merit) for group in groups]
