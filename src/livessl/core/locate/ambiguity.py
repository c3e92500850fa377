"""Decides whether a position is ambiguous with its mirror images, and how probable each of the candidates is.

`livessl.core.mirror` proposes the mirror images from the geometry of the microphones. If another array, or a microphone
off the plane, distinguishes them from the position, they have less power.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from livessl.core.geometry import Grid
from livessl.core.locate import refine
from livessl.core.locate.confidence import NEAR_M, Rivals
from livessl.core.locate.srp import SRPFunctional
from livessl.core.mirror import CURE, described, look_alikes
from livessl.core.types import ArraySpec, Candidate, FloatArray

SAME_POWER: Final = 0.02
"""Margin, as a share of the power, at which another place is less probable by a factor of e. Mirror images of coplanar
microphones have a margin of 0. Errors of poses and geometry, and the sampling of the lag axis, change powers by about
this much."""

MOST_CANDIDATES: Final = 8
"""Largest number of candidates of an ambiguous result; on a circle around a line there are infinitely many."""

_NAMED: Final = 3
"""Largest number of other places in a reason; `candidates` has all places."""

_LEAST_POWER: Final = 0.8
"""Power, as a share of that at the position, below which a proposed place is not refined."""


def rivals(
    functional: SRPFunctional,
    specs: Sequence[ArraySpec],
    position_m: FloatArray,
    power: float,
    grid: Grid,
) -> Rivals:
    """Compare a position with its `look_alikes` by their power.

    Parameters
    ----------
    functional : SRPFunctional
        SRP of the evidence.
    specs : sequence of ArraySpec
        The arrays of the evidence.
    position_m : (3,) float64
    power : float
        The functional there.
    grid : Grid
        Search grid.
    """
    alone = Rivals(1.0, (), np.zeros((3, 3)))
    proposed_m = look_alikes(position_m, specs, grid, functional.c_m_s)
    if not len(proposed_m) or power <= 0.0:
        return alone
    values = functional.value(proposed_m)
    far = np.linalg.norm(proposed_m - position_m, axis=1) > NEAR_M
    near_m = (proposed_m - position_m)[~far & (values >= (1.0 - SAME_POWER) * power)]
    spread_m2 = near_m.T @ near_m / (len(near_m) + 1)
    places = [(position_m, power)]
    for k in _apart(proposed_m, np.where(far & (values >= _LEAST_POWER * power), values, -np.inf)):
        place_m, place_power = refine.refine(functional, proposed_m[k], grid)
        if all(np.linalg.norm(place_m - known_m) > NEAR_M for known_m, _ in places):
            places.append((place_m, place_power))
    if len(places) == 1:
        return Rivals(1.0, (), spread_m2)
    weights = np.exp([(place_power - power) / (SAME_POWER * power) for _, place_power in places])
    weights /= weights.sum()
    candidates = [Candidate(place_m, float(share)) for (place_m, _), share in zip(places, weights, strict=True)]
    others = sorted(candidates[1:], key=lambda candidate: -candidate.probability)
    why = _reason(others, specs, functional.c_m_s)
    return Rivals(candidates[0].probability, (candidates[0], *others), spread_m2, why)


def _reason(others: Sequence[Candidate], specs: Sequence[ArraySpec], c_m_s: float) -> str:
    """Return the reason why a result is ambiguous, and the cure, in words."""
    places = ", ".join(f"({', '.join(f'{x:.2f}' for x in each.position_m)})" for each in others[:_NAMED])
    more = f" and {len(others) - _NAMED} more" if len(others) > _NAMED else ""
    explain = "explains" if len(others) == 1 else "explain"
    return f"{described(specs, c_m_s)}, so {places}{more} {explain} the sound as well; {CURE}"


def _apart(places_m: FloatArray, values: FloatArray) -> list[int]:
    """Return the indices of the highest places that are more than `NEAR_M` apart, at most `MOST_CANDIDATES`."""
    chosen: list[int] = []
    for k in np.argsort(-values, kind="stable"):
        if values[k] == -np.inf or len(chosen) == MOST_CANDIDATES - 1:
            break
        if all(np.linalg.norm(places_m[k] - places_m[other]) > NEAR_M for other in chosen):
            chosen.append(int(k))
    return chosen
