"""Whether arrays agree on a place, and which of them the others outvote. It sees evidence, and no sound.

Each array has a place of its own where its evidence stands highest. What the arrays lose at the place they are said to
have in common, each against its own, is next to nothing where they agree; an array that is turned or moved, or hears
something else, loses nearly all of its standing there, or makes the others lose theirs.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from livessl.core.geometry import Grid, angle_deg
from livessl.core.locate.confidence import NEAR_M, array_power, standing
from livessl.core.locate.peak_search import PeakSearch
from livessl.core.locate.srp import SRPFunctional, pair_weight
from livessl.core.types import Evidence, FloatArray

MOST_LOST: Final = 0.8
"""Where arrays lose more standing than this at a place, one without which the others lose so much less is outvoted.
One of three turned by 30 degrees makes them lose more in 19 events of 20, even at 10 dB in a room that rings for 2 s;
all that are right lose more there in one event of ten, and next to never elsewhere."""

MOST_LOST_UNSETTLED: Final = 1.5
"""Where arrays lose more standing than this and none can be outvoted, they do not agree. Those that are right lose more
in one event of fifty at 10 dB in a room that rings for 2 s, and hardly ever elsewhere."""

MOST_LOST_DOUBTED: Final = 0.6
"""What an array that is doubted may cost in standing to be taken back in."""

LEAST_LEAD: Final = 0.05
"""Where leaving out another array would be as good but for so little, and lead elsewhere, nobody can tell who is wrong:
two directions may meet in a false place as well as in the right one. By more than this the right one leads in all
events without noise and in 85 % at 10 dB."""

SUSPECTS: Final = 3
"""Of more arrays, those that lose most are tried without."""


@dataclass(frozen=True, slots=True)
class Place:
    """The highest place of some arrays' summed maps.

    Parameters
    ----------
    evidence : tuple of Evidence
        Theirs, in the order of their names.
    functional : SRPFunctional
        Of it.
    position_m : (3,) float64
    power, rival_power : float
        The functional there, and the highest outside its `peaks.neighbourhood`.
    proven : bool
        Whether no node of the grid is higher.
    """

    evidence: tuple[Evidence, ...]
    functional: SRPFunctional
    position_m: FloatArray
    power: float
    rival_power: float
    proven: bool

    @property
    def is_heard_by_all(self) -> bool:
        """Whether each of the arrays hears something there: noise alone stands as high as its rms."""
        terms = self.functional.pair_terms(self.position_m)
        each = (standing(heard, array_power(heard, term)) for heard, term in zip(self.evidence, terms, strict=True))
        return min(each) >= 1.0

    def apart_m(self, other: Place) -> float:
        """How far it is from another."""
        return float(np.linalg.norm(self.position_m - other.position_m))


@dataclass(frozen=True, slots=True)
class Agreed:
    """A place, and who does not agree.

    Parameters
    ----------
    place : Place
    outvoted : mapping of name to float
        Arrays that the place was found without, and by what angle, in degrees, each hears the sound elsewhere.
    refused : str or None
        Why the place should not be relied on, where it should not.
    """

    place: Place
    outliers: Mapping[str, float] = field(default_factory=dict)
    refused: str | None = None


def agreed(
    everyone: Sequence[Evidence],
    suspect: Collection[str],
    search: PeakSearch,
    grid: Grid,
    locate: Callable[[Sequence[Evidence]], Place],
) -> Agreed:
    """The place that most arrays agree on.

    Arrays that are doubted are heard last, as long as the others are more than half of all. Where arrays do not agree,
    each of the suspects is left out in turn, and the one without which the others lose least is outvoted. More than
    half of all are always left.

    Parameters
    ----------
    everyone : sequence of Evidence
    doubted : collection of str
        Arrays that have disagreed lately.
    search : PeakSearch
    grid : Grid
        That it searches.
    locate : callable
        From the evidence of some of them to their place.
    """
    own = _Own(search, grid)
    first = [heard for heard in everyone if heard.spec.name not in suspect]
    last = [heard for heard in everyone if heard.spec.name in suspect]
    if 2 * len(first) <= len(everyone):
        first, last = list(everyone), []
    out: list[Evidence] = []
    place = locate(first)
    while len(everyone) > 1:
        lost = own.lost(place)
        suspects = sorted(place.evidence, key=lambda heard: -lost[heard.spec.name])[:SUSPECTS]
        disagreement = sum(lost[heard.spec.name] for heard in suspects)
        refused = _divided(everyone) if disagreement > MOST_LOST_UNSETTLED else None
        if disagreement <= MOST_LOST:
            break
        if 2 * (len(place.evidence) - 1) <= len(everyone):
            if refused:
                return Agreed(place, refused=refused)
            break
        places = [locate([heard for heard in place.evidence if heard is not suspect]) for suspect in suspects]
        losses = [sum(own.lost(without).values()) for without in places]
        best = int(np.argmin(losses))
        if sum(lost.values()) - losses[best] <= MOST_LOST:
            break
        rivals = (
            other.apart_m(places[best]) > NEAR_M
            for other, loss in zip(places, losses, strict=True)
            if loss - losses[best] < LEAST_LEAD
        )
        if any(rivals):
            if refused:
                return Agreed(place, refused=refused)
            break
        out.append(suspects[best])
        place = places[best]
    for heard in last:
        together = locate([*place.evidence, heard])
        if sum(own.lost(together).values()) - sum(own.lost(place).values()) > MOST_LOST_DOUBTED:
            out.append(heard)
        else:
            place = together
    return Agreed(place, {heard.spec.name: own.angle_deg(heard, place.position_m) for heard in out})


class _Own:
    """Where each array's evidence stands highest, looked for when it is asked for."""

    def __init__(self, search: PeakSearch, grid: Grid) -> None:
        self._search = search
        self._grid = grid
        self._highest: dict[str, tuple[float, FloatArray]] = {}

    def lost(self, place: Place) -> dict[str, float]:
        """What standing each array loses at a place; no less, and where all of it is little, perhaps more."""
        terms = place.functional.pair_terms(place.position_m)
        here = {
            heard.spec.name: standing(heard, array_power(heard, term))
            for heard, term in zip(place.evidence, terms, strict=True)
        }
        lost = {heard.spec.name: max(0.0, _most(heard) - here[heard.spec.name]) for heard in place.evidence}
        if sum(sorted(lost.values())[-SUSPECTS:]) > MOST_LOST:
            for heard in place.evidence:
                name = heard.spec.name
                if lost[name] > MOST_LOST / SUSPECTS:
                    lost[name] = max(0.0, standing(heard, self._at(heard)[0]) - here[name])
        return lost

    def angle_deg(self, heard: Evidence, position_m: FloatArray) -> float:
        """Angle at an array between its own place and another."""
        return angle_deg(self._at(heard)[1] - heard.spec.centre_m, position_m - heard.spec.centre_m)

    def _at(self, heard: Evidence) -> tuple[float, FloatArray]:
        name = heard.spec.name
        if name not in self._highest:
            (peak,) = self._search.among([heard])(1)
            self._highest[name] = (peak.power, self._grid.node_m(peak.node))
        return self._highest[name]


def _most(heard: Evidence) -> float:
    """Standing that no place has more of: all of an array's pairs at their highest."""
    highest = heard.gcc.values.max(axis=1).sum(dtype=np.float64)
    return standing(heard, pair_weight(len(heard.spec.microphones_m)) * float(highest))


def _divided(everyone: Sequence[Evidence]) -> str:
    names = " and ".join(repr(heard.spec.name) for heard in everyone) if len(everyone) == 2 else "the arrays"
    return f"{names} point to different places, and it cannot be told which is wrong: are their poses right?"
